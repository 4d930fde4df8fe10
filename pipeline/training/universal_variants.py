"""Train universal models, or read them from files, before they are calibrated to a held-out board.

There are two variants of the model. Variant `rig` is made from simulated skins and from the recorded boards that are
not held out. Variant `nominal` is made from simulated skins alone.

Each variant is made in three steps. First, a prior distribution of the parameters of skins is chosen. The parameters
are those of the law, a simulation that gives the field change of a press (`reskin.universal.law`). For variant `rig`,
the law is fitted to the recorded boards. Second, the field changes according to the law are tabulated as a map, a
probabilistic model of one skin (`reskin.universal.map`). Third, networks are trained on skins that are drawn from the
prior.
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

READINGS_N = 100  # number of readings that training uses for each press of a recorded board
FORMAT = "reskin-universal-1"


@dataclass(frozen=True)
class Frame:
    """Conversions between the coordinates of a scene's recordings and the coordinates of its boards.

    Recorded fields are along the axes of the chips, which are converted to the axes of the board. The labels of a scene
    have their own origin, and are converted to places relative to the board's centre.

    turn: the rotation from a chip's axes to the board's axes, for each chip.
    middle_mm: the board's centre, in the coordinates of the labels.
    mirrored: whether the y axis of the labels points opposite to the y axis of the board.
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
    """All recorded boards of a scene. They include the boards that are held out, one at a time, when models are made.

    data: the rows and folds of the scene.
    frame: the conversion of the recordings to the boards' coordinates.
    setup: the layout and the settings with which skins are simulated.
    presses: the presses on each board, with places and fields in the board's coordinates.
    """

    data: SceneData
    frame: Frame
    setup: Setup
    presses: Mapping[str, AlignedPresses]


@dataclass(frozen=True)
class Variant:
    """One variant of the universal model, which is not yet calibrated to a board.

    `prior` is the distribution from which the skins were drawn on which the networks of `model` were trained.
    """

    prior: SkinPrior
    model: PriorModel


class Variants(NamedTuple):
    """Both variants of the model. For variant `rig`, there is one model for each held-out board.

    The model `rig[board]` was made without data of this board.
    """

    nominal: Variant
    rig: Mapping[str, Variant]


def make_variants(known: KnownBoards, settings: TrainingSettings) -> Variants:
    """Make all models: choose their priors, tabulate their maps, and train their networks."""
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
    """Read the networks of all models, which `write_networks` wrote.

    The priors and maps are computed again, because they are not stored in the files.
    """
    with make_executor(imports="reskin.universal.map") as executor:
        priors = _priors(known, executor)
        tables = [executor.submit(tabulate, prior.centre, prior.spreads, known.setup) for prior in priors]
        variants = [
            Variant(prior, PriorModel(new_map(of_map.result(), prior.residual), read_networks(models, prior.name)))
            for prior, of_map in zip(priors, tables, strict=True)
        ]
    return Variants(variants[0], dict(zip(known.presses, variants[1:], strict=True)))


def _priors(known: KnownBoards, executor: Executor) -> list[SkinPrior]:
    """Fit the law to each board, and return the priors of all models.

    The first one is the nominal prior. It is followed, for each board, by the prior that is made from all other boards.
    """
    boards, setup = known.presses, known.setup
    laws = dict(
        zip(boards, executor.map(fit, boards.values(), [setup] * len(boards), [TEN] * len(boards)), strict=True)
    )
    nominal = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    return [nominal, *(prior_without(known, laws, board) for board in boards)]


def prior_without(known: KnownBoards, laws: Mapping[str, Law], board: str) -> SkinPrior:
    """Return the prior that is made from all boards except `board`.

    The centre of the prior is the mean of the laws that were fitted to these boards (see `mean_law`). The prior also
    contains the readings of these boards, and a model of the errors that the fitted laws have on them.
    """
    others = {other: own for other, own in known.presses.items() if other != board}
    rows, frame = known.data.rows, known.frame
    recorded = [recorded_board(rows, frame, other, own.rest_uT.ravel()) for other, own in others.items()]
    centre, residual = mean_law([laws[other] for other in others]), residual_of(others, laws, known.setup)
    return SkinPrior(f"without {board}", centre, RIG_SPREADS, known.setup, recorded, residual)


def residual_of(presses: Mapping[str, AlignedPresses], laws: Mapping[str, Law], setup: Setup) -> Residual:
    """Fit a model of the errors of the law (`Residual`).

    On each board, the errors are the differences between the measured field changes and those of the law that was
    fitted to this board. Each error is divided by the size of the simulated field change.
    """
    errors = []
    for board, own in presses.items():
        simulated_uT = simulate_uT(laws[board], setup, own.place_mm, own.recorded.force_N)
        simulated_uT = simulated_uT.reshape(len(simulated_uT), -1)
        error_uT = own.db_uT.reshape(simulated_uT.shape) - simulated_uT
        errors.append(error_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    boards = list(presses.values())
    return fit_residual([own.place_mm for own in boards], [own.recorded.force_N for own in boards], errors)


def recorded_board(rows: Rows, frame: Frame, board: str, rest_uT: Float[np.ndarray, " ch"]) -> RecordedBoard:
    """Select `READINGS_N` readings of each press of a board, for training; rows without a force are left out.

    If a press has fewer readings, they are repeated. If it has more, the first ones are used.
    """
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    rows_by_press = own[
        first[:, None] + np.arange(READINGS_N) % counts[:, None]
    ]  # this is possible because the readings of a press are adjacent rows
    db_uT = frame.field(rows.db_uT[rows_by_press.ravel()]).reshape(*rows_by_press.shape, -1)
    place_mm = frame.place(rows.target[rows_by_press[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[rows_by_press, 2]
    return RecordedBoard(*(part.astype(np.float32) for part in parts))


def write_networks(models: Path, variants: Variants, settings: TrainingSettings, seed: int) -> None:
    """Write the networks of each model to a file of its own, with a JSON card (its description) beside the file."""
    with io.replacing(models) as folder:
        folder.mkdir()
        for variant in (variants.nominal, *variants.rig.values()):
            name = _file_name(variant.prior.name)
            io.write_tensors(folder / f"{name}.safetensors", to_tensors(variant.model.networks), {"format": FORMAT})
            io.write_json(folder / f"{name}.json", card_of(variant, settings, seed))


def read_networks(models: Path, name: str) -> list[Weights]:
    """Read the networks that were trained on skins from the prior with this name."""
    return from_tensors(io.read_tensors(models / f"{_file_name(name)}.safetensors")[0])


def _file_name(name: str) -> str:
    return name.replace(" ", "-")


def card_of(variant: Variant, settings: TrainingSettings, seed: int) -> dict[str, object]:
    """Return the content of the JSON card of a model's networks.

    The card states how the networks were trained, what their inputs and outputs are, and what they must not be used
    for.
    """
    prior = variant.prior
    return {
        "format": FORMAT, "method": f"universal, {prior.name}", "seed": seed,
        "skins_n": settings.skins_n, "steps_n": settings.steps_n, "networks_n": len(variant.model.networks),
        "centre": asdict(prior.centre), "spreads": dict(prior.spreads), "recorded_boards_n": len(prior.recorded),
        "inputs": "change of field (uT, board's axes), field at rest, any number of unlabelled pokes",
        "outputs": "x, y over 8 mm; log F over 3; log sd of each",
        "not_for": "other boards' layouts, skins of another polarity, two contacts at once, shear",
    }  # fmt: skip
