"""What comes with the project: a map and a network of nominal skins -> places and forces on a skin nobody calibrated.

For the paper's board: five chips, turned as recorded boards have them. Places are labels: the board's axes, its middle
at (8, 8) mm. Refuses to know recordings: nothing of them is in the file but the form of the law.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from pipeline.core import io
from pipeline.core.config import parse, read_yaml
from pipeline.core.errors import SchemaError
from pipeline.dataset.grid import CENTRE_MM
from pipeline.physics.skin import SkinDesign
from pipeline.twin.choosing import worth
from pipeline.twin.experts import MAP_TEMPER, Labels, multiply, told_mm
from pipeline.twin.law import Setup
from pipeline.twin.opinion import FULL_SET_N, Layers, Weights, ask, moved, of_tensors, tell, to_tensors
from pipeline.twin.skin_map import (
    ROUNDS_N,
    Estimate,
    Reader,
    SkinMap,
    joined,
    new_map,
    see_labelled,
    see_pokes,
    see_rest,
)
from pipeline.twin.tables import NOMINAL, OF_NOMINAL, Tables, tabulate

FILE = Path(__file__).with_name("universal.safetensors")  # its card beside it, .json
CHIPS_MM = ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0))
SKIN_MM = (20.0, 20.0)
TURNS_DEG = (0.0, 180.0, 270.0, 90.0, 0.0)
TEMPER = 0.5  # assumed, of what both say: two experts on one reading, the mean
CHOICE_EVERY_N = 3  # of the lattice's places, one may be the next to press
BLOCK_N = 200  # readings at a time, to bound memory
CHANNELS_N = 3 * len(TURNS_DEG)
CARD = {
    "name": "universal, simulated alone",
    "format": "reskin-universal-2",
    "source": "simulated",
    "centre": asdict(NOMINAL),
    "map": "pokes of simulated skins on a lattice of places and forces, and their slopes; no recorded row",
    "network": "taught pokes of simulated skins, with errors of the law drawn anew at every step; no recorded row",
    "answers": "places: the map's probabilities times the network's normal; misfit: the map's",
    "made_in_s_of": "one core's processor time; other machines take others",
    "recorded_knowledge": "the form of the law and the middle of its stiffness and slide, from two recorded boards",
    "tested_on": "reports/lab, leave-one-board-out: `universal, simulated alone`, told that pokes lie evenly, too",
    "not_for": "boards of other chips or turns, skins of other magnets, of other thickness, two contacts, shear",
}


@dataclass(frozen=True)
class Shown:
    """What networks are told of a skin: its field at rest, pokes (at most a full set), and labelled ones."""

    rest_uT: Float[np.ndarray, " ch"]
    pokes_uT: Float[np.ndarray, "c ch"] = field(default_factory=lambda: np.zeros((0, CHANNELS_N)))
    labelled_mm: Float[np.ndarray, "m 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    labelled_uT: Float[np.ndarray, "m ch"] = field(default_factory=lambda: np.zeros((0, CHANNELS_N)))


@dataclass(frozen=True)
class Ready:
    """A map and networks that have been told all that is known of a skin."""

    reader: Reader
    networks: Sequence[Layers]

    def estimate(self, db_uT: Float[np.ndarray, "n ch"]) -> Estimate:
        """Read places and forces by both, and by the map alone whether this is such a skin."""
        return multiply(self.reader, self.reader.weigh(db_uT), ask(self.networks, db_uT), TEMPER)


@dataclass
class Universal:
    """A model of a skin that learns while it is used: `zero`, then `see` pokes anywhere or `label` some, `predict`."""

    tables: Tables
    networks: Sequence[Weights]
    skin: SkinMap = field(init=False)

    def __post_init__(self) -> None:
        """Start from nominal skins."""
        self._noload_uT: np.ndarray | None = None
        self._told: Ready | None = None
        self._nominal = new_map(self.tables)
        self._learn(self._nominal, Shown(self.tables.rest_uT))

    @property
    def card(self) -> dict[str, Any]:
        """What the model was made of, and what it must not be used for (its JSON card)."""
        return io.read_json(FILE.with_suffix(".json"))

    def zero(self, b_uT: Float[np.ndarray, "f ch"]) -> "Universal":
        """Take the mean of readings without contact as the no-load field, and learn the skin's seat and gap from it."""
        self._noload_uT = _rows(b_uT).mean(axis=0)
        rest_uT = to_board(self._noload_uT[None])[0]
        return self._learn(see_rest(self._nominal, rest_uT), Shown(rest_uT))

    def see(self, b_uT: Float[np.ndarray, "n ch"]) -> "Universal":
        """Learn from pokes at unknown places, a reading each: some dozens all over the skin, later ones as they come.

        The first set is looked at several times over, what comes later once: by then the skin is known.
        """
        db_uT, pokes_uT = self._change(b_uT), self._shown.pokes_uT
        rounds_n = 1 if len(pokes_uT) else ROUNDS_N
        skin = see_pokes(self.skin, db_uT, rounds_n=rounds_n, reader=self._ready().reader)
        return self._learn(skin, replace(self._shown, pokes_uT=np.concatenate([pokes_uT, db_uT])[-FULL_SET_N:]))

    def label(
        self, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"], b_uT: Float[np.ndarray, "m ch"]
    ) -> "Universal":
        """Learn from pokes at known places under known forces, all that are known; earlier ones are forgotten."""
        on_board_mm, db_uT = np.asarray(place_mm, float) - CENTRE_MM, self._change(b_uT)
        skin = see_labelled(self.skin, on_board_mm, np.asarray(force_N, float), db_uT)
        return self._learn(skin, replace(self._shown, labelled_mm=on_board_mm, labelled_uT=db_uT))

    def next_place(self, force_N: float = 2.0) -> Float[np.ndarray, "2"]:
        """Give the place whose poke, labelled, would tell most of the skin, in mm; about so strong."""
        place_mm = self.skin.hypotheses.place_mm[::CHOICE_EVERY_N]
        return place_mm[worth(self.skin, place_mm, np.full(len(place_mm), force_N)).argmax()] + CENTRE_MM

    def predict(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Give x_mm, y_mm and the normal force in N of readings in contact."""
        found = self.estimate(b_uT)
        return np.column_stack([found.place_mm, found.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "f ch"]) -> Estimate:
        """Give the same with the place's standard deviation, and the misfit: far above 1, this is no skin it knows."""
        db_uT, told = self._change(b_uT), self._ready()
        found = joined([told.estimate(db_uT[i : i + BLOCK_N]) for i in range(0, len(db_uT), BLOCK_N)])
        return Estimate(found.place_mm + CENTRE_MM, found.sd_mm, found.force_N, found.misfit)

    def __call__(self, db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Answer changes of field, as a network does."""
        noload_uT = self._noload_uT if self._noload_uT is not None else np.zeros(CHANNELS_N)
        return self.predict(_rows(db_uT) + noload_uT).astype(np.float32)

    def _change(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
        noload_uT = self._noload_uT if self._noload_uT is not None else 0.0
        return to_board(_rows(b_uT) - noload_uT)

    def _ready(self) -> Ready:
        if self._told is None:
            shown = self._shown
            networks = [tell(weights, shown.rest_uT, shown.pokes_uT) for weights in self.networks]
            by_mm = told_mm(Labels(ask(networks, shown.labelled_uT).place_mm, shown.labelled_mm))
            self._told = Ready(Reader(self.skin), [moved(layers, by_mm) for layers in networks])
        return self._told

    def _learn(self, skin: SkinMap, shown: Shown) -> "Universal":
        self.skin, self._shown, self._told = replace(skin, temper=MAP_TEMPER), shown, None
        return self


def load_universal(file: Path = FILE) -> Universal:
    """Load the model that comes with the project.

    >>> skin = load_universal()  # doctest: +SKIP
    >>> x_mm, y_mm, force_N = skin.zero(noload_uT).predict(b_uT)[0]  # doctest: +SKIP
    """
    return Universal(*_parts(file))


@lru_cache(maxsize=2)
def _parts(file: Path) -> tuple[Tables, Sequence[Weights]]:
    parts, _ = io.read_tensors(file)
    names = tuple(io.read_json(file.with_suffix(".json"))["spreads"])
    of_map = {one.name: parts.pop(one.name).astype(float) for one in fields(Tables) if one.name != "names"}
    return Tables(names=names, **of_map), of_tensors(parts)


def write(tables: Tables, networks: Sequence[Weights], words: Mapping[str, Any], file: Path = FILE) -> None:
    """Write tables in single precision and networks, and a card of what they are: the spreads, and some words."""
    parts = [one.name for one in fields(tables) if one.name != "names"]
    of_map = {name: getattr(tables, name).astype(np.float32) for name in parts}
    io.write_tensors(file, of_map | to_tensors(networks), {})
    spreads = dict(zip(tables.names, tables.spreads.tolist(), strict=True))
    io.write_json(file.with_suffix(".json"), {**words, "spreads": spreads})


def to_board(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
    """Turn readings from the chips' axes to the board's."""
    return b_uT @ _turn()


@cache
def _turn() -> Float[np.ndarray, "ch ch"]:
    of_chips = Rotation.from_euler("z", np.array(TURNS_DEG)[:, None], degrees=True).as_matrix()
    return np.array(block_diag(*of_chips)).T


def _rows(b_uT: Float[np.ndarray, "..."]) -> Float[np.ndarray, "f ch"]:
    rows_uT = np.atleast_2d(np.asarray(b_uT, float))
    if rows_uT.shape[1] != CHANNELS_N:
        rule, remedy = f"the {CHANNELS_N} of five chips", "Load a model of such boards."
        raise SchemaError("fields", "channels", rule, f"shape {np.shape(b_uT)}", remedy)
    return rows_uT


def make() -> None:
    """Make the file anew, of the skin of params.yaml over the paper's board: some minutes.

    The network is that which scene lab tests as the one that knows no board: the same lessons, the same seed.
    """
    from pipeline.twin.training import NAMELESS, Lessons, Syllabus, teach

    design = parse(SkinDesign, read_yaml(Path("params.yaml"))["skin"], "params.yaml: skin")
    setup = Setup(design, np.array(CHIPS_MM), NOMINAL.gap_mm, SKIN_MM, design.flipped, design.tip_radius_mm)
    scene = read_yaml(Path("pipeline/scenes/lab.yaml"))
    lessons = {name: scene["universal"][name] for name in Lessons.model_fields}
    start_s = time.process_time()
    tables = tabulate(NOMINAL, OF_NOMINAL, setup)
    mapped_s = time.process_time()
    syllabus = Syllabus(NAMELESS, NOMINAL, OF_NOMINAL, setup)
    networks = teach(syllabus, parse(Lessons, lessons, "pipeline/scenes/lab.yaml: universal"), scene["seed"])
    took_s = {"map": round(mapped_s - start_s), "network": round(time.process_time() - mapped_s)}
    write(tables, networks, CARD | {"lessons": lessons | {"seed": scene["seed"]}, "made_in_s": took_s})


if __name__ == "__main__":
    make()
