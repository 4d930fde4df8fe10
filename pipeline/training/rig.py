"""Make universal models from simulated skins and from the recorded boards of a rig, for each board that is held out.

A physical model (law) is fitted to each other board. The map is tabulated around the mean of these laws, the errors of
the laws are described by a Gaussian process (residual), and networks are trained on simulated skins and on the recorded
presses of the other boards.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.executors import make_executor
from pipeline.training.recorded import RecordedBoards
from reskin.data.rows import Rows
from reskin.universal.axes import BoardAxes
from reskin.universal.batches import RecordedBoard, SkinPrior, TrainingSettings
from reskin.universal.law import TEN, AlignedPresses, Law, Setup, fit, simulate_uT
from reskin.universal.layout import BoardLayout
from reskin.universal.map import RIG_SPREADS, Residual, Tables, fit_residual, mean_law, tabulate
from reskin.universal.network import Weights

READINGS_N = 100  # readings that training uses per press of a recorded board


@dataclass(frozen=True)
class RigModel:
    """A model before calibration to a board, and the prior distribution from which its simulated skins were drawn."""

    prior: SkinPrior
    tables: Tables
    networks: Sequence[Weights]


def make_models(
    boards: RecordedBoards, layout: BoardLayout, training: TrainingSettings, seed: int
) -> dict[str, RigModel]:
    """Make a model for each recorded board from all other boards; return the models by name of the held-out board."""
    from reskin.universal.training import train_networks  # imported late, because it imports PyTorch

    setup, presses = boards.axes.setup, boards.presses
    with make_executor(imports="reskin.universal.training") as executor:
        fitted = executor.map(fit, presses.values(), [setup] * len(presses), [TEN] * len(presses))
        laws = dict(zip(presses, fitted, strict=True))
        priors = {board: prior_without(boards, laws, board, layout) for board in presses}
        tables = [
            executor.submit(tabulate, prior.centre, prior.spreads, setup, layout.tabulated_N)
            for prior in priors.values()
        ]
        networks = [executor.submit(train_networks, prior, training, seed) for prior in priors.values()]
        parts = zip(priors.items(), tables, networks, strict=True)
        return {board: RigModel(prior, of_map.result(), trained.result()) for (board, prior), of_map, trained in parts}


def prior_without(boards: RecordedBoards, laws: Mapping[str, Law], board: str, layout: BoardLayout) -> SkinPrior:
    """Return the prior for held-out board `board`: it is made from all other boards.

    The prior contains the mean law of the other boards, the errors of their laws, and their readings.
    """
    others = {other: own for other, own in boards.presses.items() if other != board}
    recorded = [recorded_board(boards.rows, boards.axes, other, own.rest_uT.ravel()) for other, own in others.items()]
    setup, centre = boards.axes.setup, mean_law([laws[other] for other in others])
    residual = residual_of(others, laws, setup)
    return SkinPrior(
        f"without {board}", centre, RIG_SPREADS, setup, recorded, residual, forces=layout.forces
    )  # the name selects the random streams


def residual_of(presses: Mapping[str, AlignedPresses], laws: Mapping[str, Law], setup: Setup) -> Residual:
    """Fit a model of the errors of laws. The data are the relative errors of each law on the board of its fit."""
    errors = []
    for board, own in presses.items():
        simulated_uT = simulate_uT(laws[board], setup, own.place_mm, own.recorded.force_N)
        simulated_uT = simulated_uT.reshape(len(simulated_uT), -1)
        error_uT = own.db_uT.reshape(simulated_uT.shape) - simulated_uT
        errors.append(error_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    boards = list(presses.values())
    return fit_residual([own.place_mm for own in boards], [own.recorded.force_N for own in boards], errors)


def recorded_board(rows: Rows, axes: BoardAxes, board: str, rest_uT: Float[np.ndarray, " ch"]) -> RecordedBoard:
    """Select `READINGS_N` training readings of each press that has a force.

    If a press has fewer readings, its readings are repeated.
    """
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    # The readings of a press are adjacent in `own`: the first has index `first`.
    rows_by_press = own[first[:, None] + np.arange(READINGS_N) % counts[:, None]]
    db_uT = axes.field(rows.db_uT[rows_by_press.ravel()]).reshape(*rows_by_press.shape, -1)
    place_mm = axes.place(rows.target[rows_by_press[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[rows_by_press, 2]
    return RecordedBoard(*(part.astype(np.float32) for part in parts))
