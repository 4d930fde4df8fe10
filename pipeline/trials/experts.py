"""What comes with the project for further boards: known boards -> tables, errors and networks; and their files.

Some know no board, and for each board some know the others. Refuses to know folds and scores.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.core import io
from pipeline.core.executors import make_executor
from pipeline.dataset.rows import Rows
from pipeline.trials.training import SceneData
from pipeline.twin.fit import TEN, Seen, fit
from pipeline.twin.law import Law, Setup, simulate_uT
from pipeline.twin.opinion import Weights, of_tensors, to_tensors
from pipeline.twin.residual import Residual, carry
from pipeline.twin.tables import NOMINAL, OF_NOMINAL, OF_RIG, Tables, middle, tabulate
from pipeline.twin.training import NAMELESS, Lessons, Recorded, Syllabus, teach

READINGS_N = 100  # of a poke that a network is taught
FORMAT = "reskin-universal-1"


@dataclass(frozen=True)
class Frame:
    """How boards lie under their labels: chips' axes, and labels' middle and direction of y."""

    turn: Float[np.ndarray, "k 3 3"]
    middle_mm: tuple[float, float]
    mirrored: bool

    def field(self, b_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
        """Turn readings from the chips' axes to the board's."""
        of_chips = b_uT.astype(float).reshape(len(b_uT), -1, 3)
        return np.einsum("kij,nkj->nki", self.turn, of_chips).reshape(len(b_uT), -1)

    def place(self, label_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn labels to places in the board's frame."""
        return (label_mm - self.middle_mm) * (1, -1 if self.mirrored else 1)

    def label(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn places in the board's frame to labels."""
        return place_mm * (1, -1 if self.mirrored else 1) + self.middle_mm


@dataclass(frozen=True)
class Known:
    """What is known before a board is held out."""

    data: SceneData
    frame: Frame
    setup: Setup
    seen: Mapping[str, Seen]


@dataclass(frozen=True)
class Experts:
    """What is ready for a further board: tables, networks, and what the law misses on known boards."""

    tables: Tables
    networks: Sequence[Weights]
    residual: Residual | None
    syllabus: Syllabus


def make_experts(known: Known, lessons: Lessons) -> tuple[Experts, dict[str, Experts]]:
    """Fit known boards; make experts that know none, and for each board those that know the others."""
    with make_executor(imports="pipeline.twin.training") as executor:
        syllabuses = _syllabuses(known, executor)
        tables = [executor.submit(tabulate, each.centre, each.spreads, known.setup) for each in syllabuses]
        networks = [executor.submit(teach, each, lessons, known.data.settings.seed) for each in syllabuses]
        found = [
            Experts(of_map.result(), of_networks.result(), each.residual, each)
            for each, of_map, of_networks in zip(syllabuses, tables, networks, strict=True)
        ]
    return found[0], dict(zip(known.seen, found[1:], strict=True))


def read_experts(known: Known, models: Path) -> tuple[Experts, dict[str, Experts]]:
    """Make the same again with networks that were written; laws and tables, which are no files, are found anew."""
    with make_executor(imports="pipeline.twin.tables") as executor:
        syllabuses = _syllabuses(known, executor)
        tables = [executor.submit(tabulate, each.centre, each.spreads, known.setup) for each in syllabuses]
        found = [
            Experts(of_map.result(), read_networks(models, each.name), each.residual, each)
            for each, of_map in zip(syllabuses, tables, strict=True)
        ]
    return found[0], dict(zip(known.seen, found[1:], strict=True))


def _syllabuses(known: Known, executor: Executor) -> list[Syllabus]:
    """Say what may be known where no board is, and where each is held out."""
    seen, setup = known.seen, known.setup
    laws = dict(zip(seen, executor.map(fit, seen.values(), [setup] * len(seen), [TEN] * len(seen)), strict=True))
    nominal = Syllabus(NAMELESS, NOMINAL, OF_NOMINAL, setup)
    return [nominal, *(syllabus_without(known, laws, board) for board in seen)]


def syllabus_without(known: Known, laws: Mapping[str, Law], board: str) -> Syllabus:
    """Put together what may be known where a board is held out: laws, errors and readings of the others."""
    others = {other: own for other, own in known.seen.items() if other != board}
    rows, frame = known.data.rows, known.frame
    taught = [recorded(rows, frame, other, own.rest_uT.ravel()) for other, own in others.items()]
    centre, residual = middle([laws[other] for other in others]), carried(others, laws, known.setup)
    return Syllabus(f"without {board}", centre, OF_RIG, known.setup, taught, residual)


def carried(seen: Mapping[str, Seen], laws: Mapping[str, Law], setup: Setup) -> Residual:
    """Carry what laws miss on the boards that they were fitted on."""
    missed = []
    for board, own in seen.items():
        simulated_uT = simulate_uT(laws[board], setup, own.place_mm, own.pokes.force_N).reshape(len(own.pokes), -1)
        off_uT = own.db_uT.reshape(simulated_uT.shape) - simulated_uT
        missed.append(off_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    boards = list(seen.values())
    return carry([own.place_mm for own in boards], [own.pokes.force_N for own in boards], missed)


def recorded(rows: Rows, frame: Frame, board: str, rest_uT: Float[np.ndarray, " ch"]) -> Recorded:
    """Take a known board's readings for teaching: as many of each poke, of those with a force."""
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    each = own[first[:, None] + np.arange(READINGS_N) % counts[:, None]]  # an indentation's readings lie together
    db_uT = frame.field(rows.db_uT[each.ravel()]).reshape(*each.shape, -1)
    place_mm = frame.place(rows.target[each[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[each, 2]
    return Recorded(*(part.astype(np.float32) for part in parts))


def write_networks(models: Path, experts: Sequence[Experts], lessons: Lessons, seed: int) -> None:
    """Write the networks of each, and beside them what they were taught."""
    with io.replacing(models) as folder:
        folder.mkdir()
        for each in experts:
            name = _file_name(each.syllabus.name)
            io.write_tensors(folder / f"{name}.safetensors", to_tensors(each.networks), {"format": FORMAT})
            io.write_json(folder / f"{name}.json", card_of(each, lessons, seed))


def read_networks(models: Path, name: str) -> list[Weights]:
    """Read the networks of what is known, by its name, in their order."""
    return of_tensors(io.read_tensors(models / f"{_file_name(name)}.safetensors")[0])


def _file_name(name: str) -> str:
    return name.replace(" ", "-")


def card_of(experts: Experts, lessons: Lessons, seed: int) -> dict[str, object]:
    """Describe networks: what skins they were taught, and what they are not for."""
    taught = experts.syllabus
    return {
        "format": FORMAT, "method": f"universal, {taught.name}", "seed": seed,
        "skins_n": lessons.skins_n, "steps_n": lessons.steps_n, "networks_n": len(experts.networks),
        "centre": asdict(taught.centre), "spreads": dict(taught.spreads), "recorded_boards_n": len(taught.recorded),
        "inputs": "change of field (uT, board's axes), field at rest, any number of unlabelled pokes",
        "outputs": "x, y over 8 mm; log F over 3; log sd of each",
        "not_for": "other boards' layouts, skins of another polarity, two contacts at once, shear",
    }  # fmt: skip
