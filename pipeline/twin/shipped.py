"""The map that comes with the project: tables of nominal skins -> places and forces on a skin nobody calibrated.

For the paper's board: five chips, turned as recorded boards have them. Places are labels: the board's axes, its middle
at (8, 8) mm. Refuses to know recordings: nothing of them is in the file but the form of the law.
"""

from collections.abc import Mapping
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
from pipeline.twin.law import Setup
from pipeline.twin.skin_map import ROUNDS_N, Estimate, Reader, SkinMap, new_map, see_labelled, see_pokes, see_rest
from pipeline.twin.tables import NOMINAL, OF_NOMINAL, Tables, tabulate

FILE = Path(__file__).with_name("universal.safetensors")  # its card beside it, .json
CHIPS_MM = ((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0))
SKIN_MM = (20.0, 20.0)
TURNS_DEG = (0.0, 180.0, 270.0, 90.0, 0.0)
TEMPER = 0.6  # assumed: channels err together, so a reading tells less than its noise says
CHANNELS_N = 3 * len(TURNS_DEG)


@dataclass
class Universal:
    """A map of one skin that learns while it is used: `zero`, then `see` pokes anywhere or `label` some, `predict`."""

    tables: Tables
    skin: SkinMap = field(init=False)

    def __post_init__(self) -> None:
        """Start from nominal skins."""
        self.skin = self._nominal = new_map(self.tables)
        self._noload_uT: np.ndarray | None = None
        self._reader: Reader | None = None
        self._seen = False  # any poke since it was zeroed

    @property
    def card(self) -> dict[str, Any]:
        """What the map was made of, and what it must not be used for (its JSON card)."""
        return io.read_json(FILE.with_suffix(".json"))

    def zero(self, b_uT: Float[np.ndarray, "f ch"]) -> "Universal":
        """Take the mean of readings without contact as the no-load field, and learn the skin's seat and gap from it."""
        self._noload_uT, self._seen = _rows(b_uT).mean(axis=0), False
        return self._learn(see_rest(self._nominal, to_board(self._noload_uT[None])[0]))

    def see(self, b_uT: Float[np.ndarray, "n ch"]) -> "Universal":
        """Learn from pokes at unknown places, a reading each: some dozens all over the skin, later ones as they come.

        The first set is looked at several times over, what comes later once: by then the skin is known.
        """
        rounds_n, self._seen = (1 if self._seen else ROUNDS_N), True
        return self._learn(see_pokes(self.skin, self._change(b_uT), rounds_n=rounds_n, reader=self._ready()))

    def label(
        self, place_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"], b_uT: Float[np.ndarray, "m ch"]
    ) -> "Universal":
        """Learn from pokes at known places under known forces, all that are known; earlier ones are forgotten."""
        skin = see_labelled(self.skin, np.asarray(place_mm) - CENTRE_MM, np.asarray(force_N, float), self._change(b_uT))
        return self._learn(skin)

    def predict(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Give x_mm, y_mm and the normal force in N of readings in contact."""
        found = self.estimate(b_uT)
        return np.column_stack([found.place_mm, found.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "f ch"]) -> Estimate:
        """Give the same with the place's standard deviation, and the misfit: far above 1, this is no skin it knows."""
        found = self._ready().estimate(self._change(b_uT))
        return Estimate(found.place_mm + CENTRE_MM, found.sd_mm, found.force_N, found.misfit)

    def __call__(self, db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Answer changes of field, as a network does."""
        noload_uT = self._noload_uT if self._noload_uT is not None else np.zeros(CHANNELS_N)
        return self.predict(_rows(db_uT) + noload_uT).astype(np.float32)

    def _change(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
        noload_uT = self._noload_uT if self._noload_uT is not None else 0.0
        return to_board(_rows(b_uT) - noload_uT)

    def _ready(self) -> Reader:
        if self._reader is None:
            self._reader = Reader(self.skin)
        return self._reader

    def _learn(self, skin: SkinMap) -> "Universal":
        self.skin, self._reader = replace(skin, temper=TEMPER), None
        return self


def load_universal(file: Path = FILE) -> Universal:
    """Load the map that comes with the project.

    >>> skin = load_universal()  # doctest: +SKIP
    >>> x_mm, y_mm, force_N = skin.zero(noload_uT).predict(b_uT)[0]  # doctest: +SKIP
    """
    return Universal(_tables(file))


@lru_cache(maxsize=2)
def _tables(file: Path) -> Tables:
    parts, _ = io.read_tensors(file)
    names = tuple(io.read_json(file.with_suffix(".json"))["spreads"])
    return Tables(names=names, **{name: part.astype(float) for name, part in parts.items()})


def write(tables: Tables, words: Mapping[str, Any], file: Path = FILE) -> None:
    """Write tables in single precision, and a card of what they are: the spreads, and some words."""
    parts = [one.name for one in fields(tables) if one.name != "names"]
    io.write_tensors(file, {name: getattr(tables, name).astype(np.float32) for name in parts}, {})
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
    """Make the file anew, of the skin of params.yaml over the paper's board: half a minute."""
    design = parse(SkinDesign, read_yaml(Path("params.yaml"))["skin"], "params.yaml: skin")
    setup = Setup(design, np.array(CHIPS_MM), NOMINAL.gap_mm, SKIN_MM, design.flipped, design.tip_radius_mm)
    card = {
        "name": "universal map, simulated alone",
        "format": "reskin-map/1",
        "source": "simulated",
        "centre": asdict(NOMINAL),
        "made_of": "pokes of simulated skins on a lattice of places and forces, and their slopes; no recorded row",
        "recorded_knowledge": "the form of the law and the middle of its stiffness and slide, from two recorded boards",
        "tested_on": "reports/lab: leave-one-board-out, method `universal map, simulated alone`",
        "not_for": "boards of other chips or turns, skins of other magnets, other thickness, two contacts, shear",
    }
    write(tabulate(NOMINAL, OF_NOMINAL, setup), card)


if __name__ == "__main__":
    make()
