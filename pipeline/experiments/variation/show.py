"""Tables and figures of question variation (paper figure 4). In: its numbers and lines. Out: tables, SVG text.

Same numbers, same bytes. Refuses to know captures and paths.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pandas as pd

from pipeline.experiments.drift.show import say_pace
from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import tabulate
from pipeline.report.paper import FIGURE_4

MEANING = (
    "By how much equal pokes differ: rms over the channels, and as a part of the change of field that the poke makes. "
    "As read: the field itself. Change: less the no-load reading of the same indentation, which is what a model sees."
)
AXES_PER_CHIP_N = 3


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Make a table of how far equal pokes differ, over time and between skins; the paper gives no numbers."""
    lines = []
    for place in numbers["places"]:
        time, skins = place["time"], place["skins"]
        at = {"place, mm": f"{place['x_mm']:g}, {place['y_mm']:g}", "depth, mm": f"{numbers['depth_mm']:g}"}
        over = f"over {time['contacts_n']:,} contacts of {numbers['worn_skin']}, {time['visits_n']} visits"
        for what, name in (("field as read", "raw"), ("change of field", "db")):
            lines.append(at | _line(f"{over}: {what}", time[f"{name}_change_uT"], time[f"{name}_change_pct"]))
        if "spread_uT" in skins:
            over = f"between {len(skins['skins'])} skins: change of field"
            lines.append(at | _line(over, skins["spread_uT"], skins["spread_pct"]))
    meaning = f"{MEANING} {say_pace(numbers, source)}{_say_shown(numbers)} Paper: {FIGURE_4}."
    return {"variation": tabulate([line | {"source": source} for line in lines], meaning=meaning)}


def _say_shown(numbers: Mapping[str, Any]) -> str:
    if "shown_s" not in numbers or "warmer_K" not in numbers:
        return ""
    return (
        f" The contacts compared over time take {numbers['shown_s']:,.0f} s, in which the chips' temperature changes "
        f"by {numbers['warmer_K']:+.2g} K: the field shows that too, beside the skin's own wear."
    )


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw how the field varies over time (figure 4a) and from skin to skin (figure 4b), a panel a place."""
    return {
        "variation_time.svg": _over_time(numbers, drawn["places"], source),
        "variation_skins.svg": _over_skins(numbers, drawn["places"], source),
    }


def _over_time(numbers: Mapping[str, Any], places: Sequence[Mapping[str, Any]], source: str) -> str:
    most_n = max(place["time"]["contacts_n"][-1] for place in places)
    title = f"Field over time at {numbers['depth_mm']:g} mm depth, first visit subtracted ({source})"
    with _panels(places, title, "field less the first / µT") as (figure, panels):
        colours = mpl.colors.ListedColormap(
            mpl.colormaps["viridis"](np.linspace(0, 0.85, 256))
        )  # its yellow is pale on white
        scale = mpl.colors.Normalize(0, most_n)
        for axes, place in zip(panels, places, strict=True):
            for contacts_n, line_uT in zip(place["time"]["contacts_n"], place["time"]["b_uT"], strict=True):
                name = f"{contacts_n:,} contacts before"
                axes.plot(line_uT, color=colours(scale(contacts_n)), linewidth=0.9, label=name)
            _name_channels(axes, len(place["time"]["b_uT"][0]))
        figure.colorbar(mpl.cm.ScalarMappable(scale, colours), ax=panels, label="contacts before", shrink=0.8)
        return svg(figure)


def _over_skins(numbers: Mapping[str, Any], places: Sequence[Mapping[str, Any]], source: str) -> str:
    title = f"Mean change of field on several skins at {numbers['depth_mm']:g} mm depth ({source})"
    with _panels(places, title, "change of field / µT") as (figure, panels):
        for axes, place in zip(panels, places, strict=True):
            for i, (skin, line_uT) in enumerate(place["skins"].items()):
                look = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)], "markersize": 4}
                axes.plot(line_uT, label=skin, linewidth=1, **look)
            _name_channels(axes, len(line_uT))
        names = panels[0].get_legend_handles_labels()
        figure.legend(*names, loc="outside lower center", ncols=5, frameon=False, title="skin")
        return svg(figure)


@contextmanager
def _panels(places: Sequence[Mapping[str, Any]], title: str, ylabel: str) -> Iterator[tuple[Any, Any]]:
    """Set up a panel a place, one below the other."""
    with drawing(7.2, 0.8 + 2.5 * len(places)) as figure:
        panels = figure.subplots(len(places), 1, squeeze=False)[:, 0]
        for axes, place in zip(panels, places, strict=True):
            axes.set_title(f"at x = {place['x_mm']:g} mm, y = {place['y_mm']:g} mm", loc="left", fontsize=10)
            axes.set_ylabel(ylabel)
            axes.axhline(0, color="0.7", linewidth=0.8)
            axes.grid(alpha=0.25)
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        yield figure, panels


def _name_channels(axes: Any, channels_n: int) -> None:
    """Name the ticks by axis and chip: Bx of chip 0 is x0."""
    names = [f"{'xyz'[i % AXES_PER_CHIP_N]}{i // AXES_PER_CHIP_N}" for i in range(channels_n)]
    axes.set_xticks(range(channels_n), [f"B{name}" for name in names], rotation=90 if channels_n > 15 else 0)


def _line(what: str, rms_uT: float, pct: float) -> dict[str, str]:
    return {"what": what, "difference, µT": f"{rms_uT:.3g}", "difference, % of the change": f"{pct:.3g}"}
