"""How much the field of equal indentations varies over time and between skins (paper figure 4)."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field

from pipeline.description import rank, rms
from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.plot import drawing, svg
from pipeline.settings import Settings
from reskin import io
from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.schema import Readings

SAME_MM = 1e-3  # places and depths are commanded values in float32; they are equal if they differ by less than this
LISTED_N = 8  # largest number of places or depths listed in an error message
LINES_MAX_N = 40  # largest number of lines (visits of a place) in a panel of the figure
DECIMALS = 1  # fields in uT are rounded to this many decimals for the figures

Count = Annotated[int, Field(ge=1)]
Place_mm = tuple[float, float]


class Variation(Strict):
    """Settings section `variation`: places and depth of the compared indentations, number of skins and of contacts."""

    places_mm: Annotated[tuple[Place_mm, ...], Field(min_length=1, max_length=4)]
    depth_mm: Annotated[float, Field(gt=0)]
    skins_n: Count
    contacts_n: Count  # indentations of the worn skin are compared within its first `contacts_n` contacts


def variation(settings: Settings, section: Variation, main: Path, indentations: Path, results: Path) -> None:
    """Compare the fields of equal indentations, over time and between skins.

    Folder `indentations` contains the worn skin, which is compared over time. Folder `main` contains the skins that are
    compared with one another.
    """
    worn_capture = read_captures(indentations)[0]
    boards: dict[str, str] = {}
    visits: dict[str, list[Visits]] = {}
    for name in settings.captures_in(main):  # captures are read one by one, to limit the use of memory
        capture = io.read_readings(main / f"{name}.parquet")
        boards[capture.skin] = capture.board
        visits[capture.skin] = [find_visits(capture, place_mm, section.depth_mm) for place_mm in section.places_mm]
    skins = first_of_each_board(boards, section.skins_n)

    places: list[dict[str, Any]] = []
    plot_data: list[dict[str, Any]] = []
    for place_i, (x_mm, y_mm) in enumerate(section.places_mm):
        time, time_lines = over_time(find_visits(worn_capture, (x_mm, y_mm), section.depth_mm), section.contacts_n)
        of_skins, skin_lines = over_skins({skin: visits[skin][place_i] for skin in skins})
        places.append({"x_mm": x_mm, "y_mm": y_mm, "time": time, "skins": of_skins})
        plot_data.append({"x_mm": x_mm, "y_mm": y_mm, "time": time_lines, "skins": skin_lines})
    numbers = {"depth_mm": section.depth_mm, "places": places}
    write_results(results, numbers, {"places": plot_data}, read_losses(indentations, {}))


@dataclass(frozen=True)
class Visits:
    """All visits (indentations) at one place and depth in order of time, each averaged over its readings."""

    contacts_n: Int[np.ndarray, " n"]  # contacts of the skin before each visit
    b_uT: Float[np.ndarray, "n ch"]
    db_uT: Float[np.ndarray, "n ch"]


def find_visits(readings: Readings, place_mm: tuple[float, float], depth_mm: float) -> Visits:
    """Return the visits of one place at one depth; raise `ParamsError` if there are none."""
    selected = _at(readings, place_mm, depth_mm)
    if not selected.any():
        place = f"place {place_mm[0]:g}, {place_mm[1]:g} mm (variation.places_mm)"
        what = f"{place} is never pressed to a depth of {depth_mm:g} mm (variation.depth_mm)"
        where = f"experiment variation, capture {readings.capture}"
        raise ParamsError(f"{where}: {what}. {_visited(readings, place_mm)}")
    visit_i, n_contacts = rank(readings.indentation[selected]), readings.n_contacts[selected]
    _, first_i, n = np.unique(visit_i, return_index=True, return_counts=True)
    means = [
        np.add.reduceat(values, first_i, axis=0, dtype=np.float64) / n[:, None]
        for values in (readings.b_uT[selected], readings.db_uT[selected])
    ]
    return Visits(n_contacts[first_i], *means)


def _at(readings: Readings, place_mm: tuple[float, float], depth_mm: float | None) -> Bool[np.ndarray, " f"]:
    near = (np.abs(readings.x_mm - place_mm[0]) < SAME_MM) & (np.abs(readings.y_mm - place_mm[1]) < SAME_MM)
    return near if depth_mm is None else near & (np.abs(readings.depth_mm - depth_mm) < SAME_MM)


def _visited(readings: Readings, place_mm: tuple[float, float]) -> str:
    """Describe the depths visited at a place or, if there are none, all depths and some places, for an error."""

    def join(values_mm: np.ndarray) -> str:
        return ", ".join(f"{value:g}" for value in values_mm[:LISTED_N])

    at_place = _at(readings, place_mm, None)
    if at_place.any():
        return f"Choose one of the depths at this place: {join(np.unique(readings.depth_mm[at_place]))} mm."
    places = np.unique(np.stack([readings.x_mm, readings.y_mm], axis=1), axis=0)
    examples = "; ".join(f"{x:g}, {y:g}" for x, y in places[:LISTED_N])
    depths = join(np.unique(readings.depth_mm))
    return f"Choose from depths {depths} mm and from {len(places)} places, among them {examples} mm."


def over_time(visits: Visits, contacts_n: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare the visits within a skin's first `contacts_n` contacts with the first of these visits.

    The first result contains two rms differences over channels between the last and the first visit: the difference of
    the field as read, and the difference of the change of field. The second result contains the lines to draw, which
    are the fields of all visits minus the field of the first visit.
    """
    early = visits.contacts_n - visits.contacts_n[0] < contacts_n
    before_n, b_uT, db_uT = visits.contacts_n[early], visits.b_uT[early], visits.db_uT[early]
    raw_uT, change_uT, size_uT = rms(b_uT[-1] - b_uT[0]), rms(db_uT[-1] - db_uT[0]), rms(db_uT[0])
    numbers = {
        "visits_n": len(before_n),
        "contacts_n": int(before_n[-1] - before_n[0]),
        "first_db_uT": size_uT,
        "raw_change_uT": raw_uT,
        "raw_change_pct": 100 * raw_uT / size_uT,
        "db_change_uT": change_uT,
        "db_change_pct": 100 * change_uT / size_uT,
    }
    chosen = np.unique(np.linspace(0, len(before_n) - 1, LINES_MAX_N).round().astype(int))
    lines = np.round(b_uT[chosen] - b_uT[0], DECIMALS)
    return numbers, {"contacts_n": before_n[chosen].tolist(), "b_uT": lines.tolist()}


def over_skins(visits: Mapping[str, Visits]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare the mean changes of field of several skins; return the numbers, and the lines to draw.

    `spread_uT` is the rms difference over channels and pairs of skins. `spread_pct` is this difference as a percentage
    of the rms change of field.
    """
    mean_uT = {skin: skin_visits.db_uT.mean(axis=0) for skin, skin_visits in visits.items()}
    size_uT = rms(np.array(list(mean_uT.values())))
    numbers: dict[str, Any] = {"skins": list(mean_uT), "mean_db_uT": size_uT}
    if len(mean_uT) > 1:
        spread_uT = rms(np.array([first - second for first, second in combinations(mean_uT.values(), 2)]))
        numbers |= {"spread_uT": spread_uT, "spread_pct": 100 * spread_uT / size_uT}
    return numbers, {skin: np.round(line, DECIMALS).tolist() for skin, line in mean_uT.items()}


def first_of_each_board(boards: Mapping[str, str], skins_n: int) -> list[str]:
    """Choose `skins_n` skins: the first skin of every board, then the second skin of every board, and so on.

    `boards` maps the names of skins to the names of their boards.
    """
    order: dict[str, int] = {}
    ranked = []
    for skin in sorted(boards):
        ranked.append((order.setdefault(boards[skin], 0), boards[skin], skin))
        order[boards[skin]] += 1
    if skins_n > len(ranked):
        rule = f"at most the {len(ranked)} skins of the main captures"
        raise ParamsError("experiment variation", "variation.skins_n", rule, skins_n, "Reduce variation.skins_n.")
    return [skin for *_, skin in sorted(ranked)[:skins_n]]


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot how the field varies over time (figure 4a) and between skins (figure 4b), with one panel per place."""
    return {
        "variation_time.svg": _draw_time(numbers, drawn["places"], source),
        "variation_skins.svg": _draw_skins(numbers, drawn["places"], source),
    }


def _draw_time(numbers: Mapping[str, Any], places: Sequence[Mapping[str, Any]], source: str) -> str:
    import matplotlib as mpl

    # The upper 15 % of the colour map are left out, because yellow is hard to see on white.
    colours = mpl.colors.ListedColormap(mpl.colormaps["viridis"](np.linspace(0, 0.85, 256)))
    scale = mpl.colors.Normalize(0, max(place["time"]["contacts_n"][-1] for place in places))
    title = f"Field over time at {numbers['depth_mm']:g} mm depth ({source})"
    with _panels(places, title, "minus first visit / µT") as (figure, panels):
        for axes, place in zip(panels, places, strict=True):
            for contacts_n, line_uT in zip(place["time"]["contacts_n"], place["time"]["b_uT"], strict=True):
                axes.plot(line_uT, color=colours(scale(contacts_n)), marker="")
            _name_channels(axes, len(place["time"]["b_uT"][0]))
        bar = {"location": "bottom", "aspect": 50, "label": "contacts before"}
        figure.colorbar(mpl.cm.ScalarMappable(scale, colours), ax=panels, **bar)
        return svg(figure)


def _draw_skins(numbers: Mapping[str, Any], places: Sequence[Mapping[str, Any]], source: str) -> str:
    title = f"Field of several skins at {numbers['depth_mm']:g} mm depth ({source})"
    with _panels(places, title, "change of field / µT") as (figure, panels):
        for axes, place in zip(panels, places, strict=True):
            for skin, line_uT in place["skins"].items():
                axes.plot(line_uT, label=skin)
            _name_channels(axes, len(line_uT))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=4)
        return svg(figure)


@contextmanager
def _panels(places: Sequence[Mapping[str, Any]], title: str, ylabel: str) -> Iterator[tuple[Any, Any]]:
    """Yield a figure with one panel per place, arranged in a column."""
    with drawing(1.2 + 1.6 * len(places), title) as figure:
        panels = figure.subplots(len(places), 1, squeeze=False, sharex=True)[:, 0]
        for axes, place in zip(panels, places, strict=True):
            axes.set(title=f"at x = {place['x_mm']:g} mm, y = {place['y_mm']:g} mm", ylabel=ylabel)
        yield figure, panels


def _name_channels(axes: Any, channels_n: int) -> None:
    """Label the ticks of the x axis with the names of the channels: Bx0 is Bx of chip 0."""
    names = [f"B{'xyz'[i % 3]}{i // 3}" for i in range(channels_n)]
    axes.set_xticks(range(channels_n), names, rotation=90)
