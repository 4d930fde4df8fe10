"""Compare recorded changes of field with simulated ones, press by press, on recorded boards (not in the paper).

A law is a physical model of a skin, which gives the change of field from the place and the force of a press. Each board
with known forces is simulated in three ways:
- nominal: the nominal skin, without any fit,
- fitted: a law whose ten parameters are fitted to this board,
- refitted: the law of another board, after the seven parameters that may differ between boards are fitted to this one.

On every board, labels, chips and skin are also checked for another orientation than the scene states.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.experiments.results import read_captures, write_results
from pipeline.fitting.axes import BoardAxes
from pipeline.fitting.frames import describe_outside, frames_of
from pipeline.fitting.law_fit import SEVEN, TEN, AlignedPresses, fit
from pipeline.fitting.presses import RecordedPresses, cosines, explained, growth, magnitudes_uT, pool_skins, thin
from pipeline.plot import drawing, svg
from pipeline.settings import Settings
from pipeline.training.recorded import Compare
from reskin.universal.law import Law, simulate_uT

FITTED_MAX_N = 600  # largest number of presses per board; fits to more would take minutes


def compare(settings: Settings, section: Compare, indentations: Path, results: Path) -> None:
    """Compare the recorded changes of field of a scene's boards with simulated ones, and write the results.

    For boards without known forces, only the orientations of labels, chips and skin are checked.
    """
    captures = read_captures(indentations, tuple(settings.captures_in(indentations)))
    axes = section.axes
    numbers, drawn = compare_boards(pool_skins(captures, with_force=False), axes)
    write_results(results, numbers, drawn | {"outline": _outline(axes)})


def compare_boards(boards: Mapping[str, RecordedPresses], axes: BoardAxes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compare the recordings of every board with simulations; return the numbers, and the data for the figure.

    Of each board, at most `FITTED_MAX_N` presses are compared.
    """
    aligned = {board: axes.align(thin(presses, FITTED_MAX_N)) for board, presses in boards.items()}
    known = {board: presses for board, presses in aligned.items() if presses.recorded.forces_known}
    laws = {board: fit(presses, axes.setup, TEN, axes.start) for board, presses in known.items()}
    names, by_board, drawn = list(known), {}, {}
    for board, presses in aligned.items():
        by_board[board] = {"frames": check_frames(presses, axes), "pokes_n": len(boards[board])}
        if board in known:
            other = names[(names.index(board) + 1) % len(names)]
            agreements, fitted_uT = _agreements(presses, axes, laws[board], laws[other] if other != board else None)
            by_board[board] = agreements.pop("fitted") | agreements | by_board[board]
            fields = {"recorded": presses.db_uT, "simulated": fitted_uT}
            drawn[board] = {
                "force_N": presses.recorded.force_N.round(3).tolist(),
                "length_uT": {name: magnitudes_uT(db_uT).round(1).tolist() for name, db_uT in fields.items()},
            }
    return {"by_board": by_board}, {"boards": drawn}


def _agreements(
    presses: AlignedPresses, axes: BoardAxes, fitted: Law, of_other: Law | None
) -> tuple[dict[str, Any], Float[np.ndarray, "n k 3"]]:
    """Return the agreement of each simulation with a board, and the changes of field of the fitted law."""
    place_mm, force_N, setup = presses.place_mm, presses.recorded.force_N, axes.setup
    laws = {"fitted": fitted}
    if of_other is not None:
        laws["refitted"] = fit(presses, setup, SEVEN, axes.start, of_other)
    laws["nominal"] = axes.nominal
    simulated_uT = {name: simulate_uT(law, setup, place_mm, force_N) for name, law in laws.items()}
    agreements = {name: agreement(presses, db_uT) for name, db_uT in simulated_uT.items()}
    return agreements, simulated_uT["fitted"]


def agreement(presses: AlignedPresses, simulated_uT: Float[np.ndarray, "n k 3"]) -> dict[str, Any]:
    """Compare simulated with recorded changes of field: their directions, their sizes, and their growth with force.

    - cosine_mean: cosine between recorded and simulated dB over all channels, mean over presses.
    - explained_median: 1 - |simulated - recorded|² / |recorded|², median over presses.
    - growth: the exponent n in |dB| ~ F^n at one place, median over places.
    """
    fields = {"recorded": presses.db_uT, "simulated": simulated_uT}
    grown = {name: growth(presses.recorded, db_uT) for name, db_uT in fields.items()}
    return {
        "cosine_mean": float(cosines(simulated_uT, presses.db_uT).mean()),
        "explained_median": float(np.median(explained(simulated_uT, presses.db_uT))),
    } | ({} if None in grown.values() else {"growth": grown})


def check_frames(presses: AlignedPresses, axes: BoardAxes) -> dict[str, str]:
    """Describe in a sentence whether labels, chips and skin are oriented as stated."""
    outside = describe_outside(presses.place_mm, axes)
    return {"sentence": outside or frames_of(presses, axes).sentence(axes.stated_by)}


def _outline(axes: BoardAxes) -> dict[str, Any]:
    """Return the skin's smallest x and y, its sides and the chips' centres, in the coordinates of the labels."""
    sides_mm = np.array(axes.setup.skin_mm)
    corner_mm, chips_mm = np.array(axes.labels_middle_mm) - sides_mm / 2, axes.label(axes.setup.chips_mm)
    return {"corner_mm": corner_mm.tolist(), "sides_mm": sides_mm.tolist(), "chips_mm": chips_mm.tolist()}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot recorded and simulated |dB| against the force, one panel per board with known forces."""
    boards = drawn["boards"]
    if not boards:
        return {}
    with drawing(0.4 + 2.4 * len(boards), f"Change of field against force ({source})") as figure:
        panels = figure.subplots(len(boards), 1, squeeze=False)[:, 0]
        for axes, (board, of_board) in zip(panels, boards.items(), strict=True):
            for side in ("recorded", "simulated"):
                slope = numbers["by_board"][board].get("growth", {}).get(side)
                label = side if slope is None else f"{side}: power {slope:.2f}"
                axes.plot(of_board["force_N"], of_board["length_uT"][side], label=label, linestyle="", alpha=0.6)
            axes.set(xscale="log", yscale="log", xlabel="force / N", ylabel="|dB| / µT", title=board)
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.25), ncols=2)
        return {"compare_growth.svg": svg(figure)}
