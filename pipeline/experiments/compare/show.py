"""Recorded beside simulated changes of field: numbers -> tables, figures. Sees no reading, no physics and no path."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import show_digits, tabulate
from pipeline.report.statistics import all_of, verdict, verdict_within

COSINE_MIN = {"nominal": 0.90, "fitted": 0.90, "refitted": 0.85}
EXPLAINED_MIN, GROWTH_WITHIN, MEMORY_PCT = 0.80, 0.10, (5.0, 8.0)
WAYS = {
    "nominal": "nominal skin, nothing fitted", "fitted": "ten numbers, fitted on this board",
    "refitted": "law of another board, seven refitted",
}  # fmt: skip
COSINE, EXPLAINED, GROWTH = "cosine", f"explained (≥ {EXPLAINED_MIN:.2f})", f"growth (within {GROWTH_WITHIN:.2f})"
HELD = "held at the deepest"
MEMORY = "memory, % ({:g} to {:g})".format(*MEMORY_PCT)
NONE = "–"
MEANING = (
    "dB of each recorded poke, the mean in contact less the mean before, beside the simulated one at its labelled "
    "place and recorded force. Bounds stand in brackets. Cosine: over all channels, the mean over pokes. Explained: 1 "
    "- |simulated - recorded|² / |recorded|², the median. Growth: d log|dB| / d log F within a place, the median over "
    "places, simulated / recorded. A board is within bounds, yes or no, by its own numbers; four boards or more are "
    "also judged together, by the 95 % interval over them (Student's t). The form of the law, its tip radius (2 mm), "
    "stiffening (power 3/2) and force at which the slide is gone (8 N) were chosen with both boards of scene lab in "
    "view: only a new board tests them. Why a skin slides away from its middle is not explained. Memory, simulated / "
    "recorded: of a poke's change in the next no-load reading; it is put in by hand, {:g} %, so that its estimator is "
    "tested and nothing predicted. Held: pokes whose force lies beyond the deepest that the law follows (0.72 of the "
    "thickness); they are simulated at that depth, and count like all others."
)
ABOUT_PARAMETERS = (
    "Seat: the skin's middle seen from the board's. Label offset: from where a label says to where the tip is. Slide "
    "away: how far the material under the tip goes from the skin's middle at no force, per distance from it; give: of "
    "the rig's arm. Gap and amplitude trade against each other: neither is a measured size."
)
ABOUT_GRIP = (
    "A tip slides the skin no further than its friction on the skin allows: k |u| <= mu F. k / mu = {grip_N_mm:g} N/mm "
    "is used (springs of 7 N/mm from a recorded sideways force, friction of 0.8: params.yaml); all else is fitted anew "
    "for each. Recordings begin above half a newton and see only the end of it: what is assumed decides the field of a "
    "light touch. Without friction the skin would jump at contact."
)
ABOUT_FRAMES = (
    "Cosines over all pokes together, with the nominal skin: read as the scene says, and in the best of all ways. A "
    "way that departs from the scene is named if it raises the sum over chips by 0.1 and more for each departure."
)
TITLES = {
    "seat_x_mm": "seat x, mm", "seat_y_mm": "seat y, mm", "rotation_deg": "rotation, degrees", "gap_mm": "gap, mm",
    "amplitude": "amplitude", "label_x_mm": "label offset x, mm", "label_y_mm": "label offset y, mm",
    "modulus_MPa": "Young's modulus, MPa", "away_um_mm": "slide away, µm/mm", "give_x_um": "give x, µm",
    "give_y_um": "give y, µm",
}  # fmt: skip
ARROW_MM = 6.0  # the longest of a board
BOARDS_MAX_N = 4  # of which arrows are drawn


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate agreement beside its bounds, what was fitted, and how labels, chips and skin lie."""
    by_board = numbers["by_board"]
    rows = [
        _row(board, way, own if way == "fitted" else own[way], own["laws"].get(way, {}))
        for board, own in by_board.items()
        for way in WAYS
        if way == "fitted" or way in own
    ] + [_over_boards(way, of_way) for way, of_way in numbers["over_boards"].items()]
    laws = [
        {"board": board, "law": _say(way, law)} | {title: f"{law[name]:.3g}" for name, title in TITLES.items()}
        for board, own in by_board.items()
        for way, law in own["laws"].items()
    ]
    found = {
        "compare": tabulate(rows, meaning=MEANING.format(100 * numbers["memory_put_in"])),
        "compare_parameters": tabulate(laws, meaning=ABOUT_PARAMETERS),
        "compare_grip": tabulate(_grips(by_board), meaning=ABOUT_GRIP.format(**numbers)),
        "compare_frames": tabulate([_lies(*row) for row in by_board.items()], meaning=ABOUT_FRAMES),
    }
    for table in found.values():
        table["source"] = source
    return found


def _row(board: str, way: str, own: Mapping[str, Any], law: Mapping[str, Any]) -> dict[str, str]:
    good = [own["cosine_mean"] >= COSINE_MIN[way], own["explained_median"] >= EXPLAINED_MIN]
    row = _cells(board, _say(way, law), f"{own['cosine_mean']:.3f}", f"{own['explained_median']:.3f}", way)
    row[HELD] = f"{own['beyond_n']}"
    row["cosine by file"] = ", ".join(f"{value:.3f}" for value in own["cosine_by_group"].values())
    if "growth" in own:
        grown = own["growth"]
        row[GROWTH] = f"{grown['simulated']:.2f} / {grown['recorded']:.2f}"
        good.append(abs(grown["simulated"] - grown["recorded"]) <= GROWTH_WITHIN)
    if "memory" in own:
        row[MEMORY] = " / ".join(f"{100 * own['memory'][side]:.1f}" for side in ("simulated", "recorded"))
    return row | {"within bounds": "yes" if all(good) else "no"}


def _over_boards(way: str, own: Mapping[str, Any]) -> dict[str, str]:
    told = [
        verdict(own["cosine_mean"], above=COSINE_MIN[way]), verdict(own["explained_median"], above=EXPLAINED_MIN)
    ]  # fmt: skip
    shown = [show_digits(own[name], 3) for name in ("cosine_mean", "explained_median")]
    row = _cells(f"all ({own['cosine_mean']['n']})", WAYS[way], shown[0], shown[1], way)
    if "growth_difference" in own:
        row[GROWTH] = f"difference {show_digits(own['growth_difference'], 2)}"
        told.append(verdict_within(own["growth_difference"], GROWTH_WITHIN))
    return row | {"within bounds": all_of(told)}


def _cells(board: str, law: str, cosine: str, explained: str, way: str) -> dict[str, str]:
    cells = {"board": board, "simulated with": law, COSINE: f"{cosine} (≥ {COSINE_MIN[way]:.2f})"}
    return cells | {"cosine by file": NONE, EXPLAINED: explained, GROWTH: NONE, MEMORY: NONE, HELD: NONE}


def _grips(by_board: Mapping[str, Any]) -> list[dict[str, str]]:
    lines = []
    for board, own in by_board.items():
        for row in own.get("grips", []):
            line = {"board": board, "k / mu, N/mm": f"{row['grip_N_mm']:.3g}", "two thirds slide at, N": NONE}
            line["two thirds slide at, N"] = f"{row['grip_N']:.2g}"
            line |= {"cosine": f"{row['cosine_mean']:.3f}", "explained": f"{row['explained_median']:.3f}"}
            grown = row.get("growth")
            line[GROWTH] = f"{grown['simulated']:.2f} / {grown['recorded']:.2f}" if grown else NONE
            lines.append(line | {"|dB| of 1 mN, µT (median place)": f"{row['light_uT']:.3g}"})
    return lines


def _say(way: str, law: Mapping[str, Any]) -> str:
    return WAYS[way].replace("another board", str(law["law_of"])) if "law_of" in law else WAYS[way]


def _lies(board: str, own: Mapping[str, Any]) -> dict[str, str]:
    chips, noise_uT = own["frames"]["chips"], own["noise_uT"]
    cosine = {
        f"cosine by chip, {words}": ", ".join(f"{chip[key]:.2f}" for chip in chips)
        for words, key in (("as written", "cosine_as_written"), ("best", "cosine_best"))
    }
    noise = {"noise of a reading x, y, z, µT": ", ".join(f"{value:.2g}" for value in noise_uT.values())}
    pokes = {"pokes": str(own["pokes_n"]), "left out": str(own["left_out_n"])}
    return {"board": board, "in one sentence": own["frames"]["sentence"]} | cosine | noise | pokes


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the field's change at the chips for a few places, and its growth with force, recorded and simulated."""
    boards = dict(list(drawn["boards"].items())[:BOARDS_MAX_N])
    return {
        "compare_arrows.svg": _arrows(boards, np.array(drawn["chips_mm"]), source),
        "compare_growth.svg": _growth(drawn["boards"], numbers["by_board"], source),
        "compare_touch.svg": _touch(drawn, numbers, source),
    }


def _touch(drawn: Mapping[str, Any], numbers: Mapping[str, Any], source: str) -> str:
    """Draw |dB| against force from the lightest touch on: recorded presses, and the law with some frictions."""
    boards, used = drawn["boards"], f"{numbers['grip_N_mm']:g}"
    with drawing(4.2 * len(boards) + 0.6, 4.2) as figure:
        panels = figure.subplots(1, len(boards), squeeze=False)[0]
        for axes, (board, own) in zip(panels, boards.items(), strict=True):
            look = {"color": COLOURS[0], "marker": MARKERS[0], "linestyle": "", "markersize": 3, "alpha": 0.5}
            axes.plot(own["force_N"], own["length_uT"]["recorded"], label="recorded", **look)
            styles = iter(("-.", ":", "--", (0, (1, 3))))
            for grip, length_uT in own["curve_uT"].items():
                line = {"linestyle": "-", "linewidth": 2} if grip == used else {"linestyle": next(styles)}
                words = "any force slides it" if float(grip) < 1e-3 else f"k / μ {grip} N/mm"
                label = f"simulated, {words}" + (" (used)" if grip == used else "")
                axes.plot(drawn["curve_N"], length_uT, color=COLOURS[1], label=label, **line)
            axes.set(xscale="log", yscale="log", xlabel="force / N", ylabel="|dB| / µT", title=board)
            axes.set_ylim(bottom=0.1)
            axes.grid(alpha=0.25)
            axes.legend(frameon=False, fontsize=8)
        title = f"From the lightest touch on: change of field against force ({source}; simulated: median over places)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _arrows(boards: Mapping[str, Any], chips_mm: np.ndarray, source: str) -> str:
    columns_n = max(len(own["places_mm"]) for own in boards.values())
    half_mm = np.abs(chips_mm).max() + 0.6 * ARROW_MM
    with drawing(2.0 * columns_n, 4.2 * len(boards) + 0.6) as figure:
        panels = figure.subplots(2 * len(boards), columns_n, squeeze=False)
        for row_i, (board, own) in enumerate(boards.items()):
            recorded_uT = np.array(own["arrows_uT"]["recorded"])
            longest_uT = np.linalg.norm(recorded_uT[..., :2], axis=-1).max()
            for side_i, (side, colour) in enumerate(zip(("recorded", "simulated"), COLOURS, strict=False)):
                row = panels[2 * row_i + side_i]
                row[0].set_ylabel(f"{board}\n{side}")
                for axes, db_uT, place_mm in zip(row, own["arrows_uT"][side], own["places_mm"], strict=False):
                    sides_mm = np.array(db_uT)[:, :2] * ARROW_MM / longest_uT
                    look = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.014}
                    axes.quiver(*chips_mm.T, *sides_mm.T, color=colour, **look)
                    axes.plot(*place_mm, marker="x", color="black")
                    for (x_mm, y_mm), (*_, z_uT) in zip(chips_mm, db_uT, strict=True):
                        axes.text(x_mm, y_mm - 1.2, f"{z_uT:+.0f}", fontsize=6, ha="center", va="top")
            panels[2 * row_i][0].set_title(f"longest {longest_uT:.0f} µT", fontsize=8, loc="left")
        for axes in panels.ravel():
            axes.set(xlim=(-half_mm, half_mm), ylim=(-half_mm, half_mm), aspect="equal", xticks=[], yticks=[])
        title = f"Change of field at the chips ({source}; ×: poke; number: along z, µT)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return svg(figure)


def _growth(boards: Mapping[str, Any], by_board: Mapping[str, Any], source: str) -> str:
    with drawing(3.6 * len(boards) + 0.6, 3.6) as figure:
        panels = figure.subplots(1, len(boards), squeeze=False)[0]
        for axes, (board, own) in zip(panels, boards.items(), strict=True):
            for side, colour, marker in zip(("recorded", "simulated"), COLOURS, MARKERS, strict=False):
                slope = by_board[board].get("growth", {}).get(side)
                label = side if slope is None else f"{side}: power {slope:.2f}"
                look = {"color": colour, "marker": marker, "linestyle": "", "markersize": 3, "alpha": 0.6}
                axes.plot(own["force_N"], own["length_uT"][side], label=label, **look)
            axes.set(xscale="log", yscale="log", xlabel="force / N", ylabel="|dB| / µT", title=board)
            axes.legend(frameon=False, fontsize=8)
        figure.suptitle(f"Change of field against force ({source})", x=0.01, ha="left", fontsize=11)
        return svg(figure)
