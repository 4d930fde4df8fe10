"""Train universal models, or read them from files, before they are calibrated to a held-out board.

There are two variants of the model. Variant `rig` is made from simulated skins and from the recorded boards that are
not held out. Variant `nominal` is made from simulated skins alone.
"""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pipeline.executors import make_executor
from pipeline.training.jobs import SceneData
from reskin import io
from reskin.data.rows import Rows
from reskin.universal.batches import NOMINAL_NAME, RecordedBoard, SkinPrior, TrainingSettings
from reskin.universal.law import TEN, AlignedPresses, Law, Setup, fit, simulate_uT
from reskin.universal.map import (
    NOMINAL,
    NOMINAL_SPREADS,
    RIG_SPREADS,
    Residual,
    fit_residual,
    mean_law,
    new_map,
    tabulate,
)
from reskin.universal.model import PriorModel
from reskin.universal.network import Weights, from_tensors, to_tensors

READINGS_N = 100  # readings that training uses per press of a recorded board
FORMAT = "reskin-universal-1"


@dataclass(frozen=True)
class Frame:
    """Conversions between the coordinates of a recording and the coordinates of the board.

    Fields are recorded in the axes of each chip, and places in the coordinates of the labels.

    - turn: for each chip, the rotation from the chip's axes to the board's axes.
    - middle_mm: centre of the board in label coordinates.
    - mirrored: whether y of the labels points opposite to y of the board.
    """

    turn: Float[np.ndarray, "k 3 3"]
    middle_mm: tuple[float, float]
    mirrored: bool

    def field(self, b_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
        """Rotate readings from the chips' axes to the board's axes."""
        of_chips = b_uT.astype(float).reshape(len(b_uT), len(self.turn), 3)
        return np.einsum("kij,nkj->nki", self.turn, of_chips).reshape(b_uT.shape)

    def place(self, label_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert label coordinates to places in the board's frame."""
        return (label_mm - self.middle_mm) * (1, -1 if self.mirrored else 1)

    def label(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert places in the board's frame to label coordinates."""
        return place_mm * (1, -1 if self.mirrored else 1) + self.middle_mm


@dataclass(frozen=True)
class KnownBoards:
    """All recorded boards of a scene, including each board that is later held out.

    presses: the presses on each board, in the board's frame.
    """

    data: SceneData
    frame: Frame
    setup: Setup
    presses: Mapping[str, AlignedPresses]


@dataclass(frozen=True)
class Variant:
    """A model before calibration to a board, and the prior distribution from which its simulated skins were drawn."""

    prior: SkinPrior
    model: PriorModel


class Variants(NamedTuple):
    """Variant `nominal`, and for each held-out board the variant `rig` that was made from the other boards."""

    nominal: Variant
    rig: Mapping[str, Variant]


def make_variants(known: KnownBoards, settings: TrainingSettings) -> Variants:
    """Make all variants of the universal model.

    A physical model (law) is fitted to each known board. For each variant, a map is then tabulated from the laws, and
    networks are trained.
    """
    from reskin.universal.training import train_networks  # imported late, because it imports PyTorch

    with make_executor(imports="reskin.universal.training") as executor:
        priors = _priors(known, executor)
        tables = [executor.submit(tabulate, prior.centre, prior.spreads, known.setup) for prior in priors]
        networks = [executor.submit(train_networks, prior, settings, known.data.settings.seed) for prior in priors]
        variants = [
            Variant(prior, PriorModel(new_map(of_map.result(), prior.residual), of_networks.result()))
            for prior, of_map, of_networks in zip(priors, tables, networks, strict=True)
        ]
    return Variants(variants[0], dict(zip(known.presses, variants[1:], strict=True)))


def read_variants(known: KnownBoards, models: Path) -> Variants:
    """Read the networks that `write_networks` wrote; compute laws and maps again, because they are not stored."""
    with make_executor(imports="reskin.universal.map") as executor:
        priors = _priors(known, executor)
        tables = [executor.submit(tabulate, prior.centre, prior.spreads, known.setup) for prior in priors]
        variants = [
            Variant(prior, PriorModel(new_map(of_map.result(), prior.residual), read_networks(models, prior.name)))
            for prior, of_map in zip(priors, tables, strict=True)
        ]
    return Variants(variants[0], dict(zip(known.presses, variants[1:], strict=True)))


def _priors(known: KnownBoards, executor: Executor) -> list[SkinPrior]:
    """Return the nominal prior first, and then, for each board, the prior made from all other boards."""
    boards, setup = known.presses, known.setup
    laws = dict(
        zip(boards, executor.map(fit, boards.values(), [setup] * len(boards), [TEN] * len(boards)), strict=True)
    )
    nominal = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    return [nominal, *(prior_without(known, laws, board) for board in boards)]


def prior_without(known: KnownBoards, laws: Mapping[str, Law], board: str) -> SkinPrior:
    """Return the prior for held-out board `board`: it is made from all other boards.

    The prior contains the mean law of the other boards, the errors of their laws, and their readings.
    """
    others = {other: own for other, own in known.presses.items() if other != board}
    rows, frame = known.data.rows, known.frame
    recorded = [recorded_board(rows, frame, other, own.rest_uT.ravel()) for other, own in others.items()]
    centre, residual = mean_law([laws[other] for other in others]), residual_of(others, laws, known.setup)
    return SkinPrior(f"without {board}", centre, RIG_SPREADS, known.setup, recorded, residual)


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


def recorded_board(rows: Rows, frame: Frame, board: str, rest_uT: Float[np.ndarray, " ch"]) -> RecordedBoard:
    """Select `READINGS_N` training readings of each press that has a force.

    If a press has fewer readings, its readings are repeated.
    """
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    # The readings of a press are adjacent in `own`: the first has index `first`.
    rows_by_press = own[first[:, None] + np.arange(READINGS_N) % counts[:, None]]
    db_uT = frame.field(rows.db_uT[rows_by_press.ravel()]).reshape(*rows_by_press.shape, -1)
    place_mm = frame.place(rows.target[rows_by_press[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[rows_by_press, 2]
    return RecordedBoard(*(part.astype(np.float32) for part in parts))


def write_networks(models: Path, variants: Variants, settings: TrainingSettings, seed: int) -> None:
    """Write the networks of each variant to a file, with a JSON card beside it."""
    with io.replacing(models) as folder:
        folder.mkdir()
        for variant in (variants.nominal, *variants.rig.values()):
            name = _file_name(variant.prior.name)
            io.write_tensors(folder / f"{name}.safetensors", to_tensors(variant.model.networks), {"format": FORMAT})
            io.write_json(folder / f"{name}.json", card_of(variant, settings, seed))


def read_networks(models: Path, name: str) -> list[Weights]:
    """Read the networks that were trained for the prior of this name."""
    return from_tensors(io.read_tensors(models / f"{_file_name(name)}.safetensors")[0])


def _file_name(name: str) -> str:
    return name.replace(" ", "-")


def card_of(variant: Variant, settings: TrainingSettings, seed: int) -> dict[str, object]:
    """Return the card of a variant's networks: how they were trained, and what they must not be used for."""
    prior = variant.prior
    return {
        "format": FORMAT, "method": f"universal, {prior.name}", "seed": seed,
        "skins_n": settings.skins_n, "steps_n": settings.steps_n, "networks_n": len(variant.model.networks),
        "centre": asdict(prior.centre), "spreads": dict(prior.spreads), "recorded_boards_n": len(prior.recorded),
        "inputs": "change of field (uT, in the board's axes), field at rest, and any number of unlabelled pokes",
        "outputs": "x and y divided by 8 mm, log F divided by 3, and the logarithm of the standard deviation of each",
        "not_for": "boards of another layout, skins of another polarity, two contacts at once, shear",
    }  # fmt: skip
