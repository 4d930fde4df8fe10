"""What comes with the project: a map and a network of nominal skins -> places and forces on a skin nobody calibrated.

For the paper's board: five chips, turned as recorded boards have them. Places are labels: the board's axes, its middle
at (8, 8) mm. Refuses to know recordings: nothing of them is in the file but the form of the law.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from reskin import io
from reskin.data.grid import CENTRE_MM
from reskin.errors import SchemaError
from reskin.universal.axes import to_board, to_chips
from reskin.universal.calibration import (
    CHANNELS_N,
    Shown,
    Sureness,
    by_misfit,
    by_residuals,
    labels_of,
    learnt_rows_of,
    left_out,
    ratios,
    read_shown,
    rows_of,
    worth,
    write_shown,
)
from reskin.universal.combine import Labels, multiply, off_middle_mm, told_mm
from reskin.universal.map import (
    ROUNDS_N,
    Estimate,
    Reader,
    SkinMap,
    Tables,
    joined,
    new_map,
    see_even,
    see_labelled,
    see_pokes,
    see_rest,
)
from reskin.universal.network import FULL_SET_N, Layers, Weights, ask, moved, of_tensors, tell, to_tensors

FILE = Path(__file__).with_name("universal.safetensors")  # its card beside it, .json
FORMAT = "reskin-universal-3"
SKIN_MM = (20.0, 20.0)
REACH_MM = np.array([[-0.5], [0.5]]) * SKIN_MM  # of places, about the middle
CHOICE_EVERY_N = 3  # of the lattice's places, one may be the next to press
BLOCK_N = 200  # readings at a time, to bound memory


@dataclass(frozen=True)
class Ready:
    """A map and networks that have been told all that is known of a skin."""

    reader: Reader
    networks: Sequence[Layers]

    def estimates(self, db_uT: Float[np.ndarray, "n ch"], tempers: Sequence[float]) -> list[Estimate]:
        """Read places and forces by both, under each temper, and by the map alone whether this is such a skin."""
        weighed, opinion = self.reader.weigh(db_uT), ask(self.networks, db_uT)
        return [multiply(self.reader, weighed, opinion, temper) for temper in tempers]


@dataclass
class Universal:
    """A model of a skin that learns while it is used: `zero`, then `see` pokes anywhere or `label` some, `predict`."""

    tables: Tables
    networks: Sequence[Weights]
    sureness: Sureness
    skin: SkinMap = field(init=False)

    def __post_init__(self) -> None:
        """Start from nominal skins."""
        self._noload_uT: np.ndarray | None = None
        self._told: Ready | None = None
        self._ratio: float | None = None
        self._temper: float | None = None
        self._nominal = new_map(self.tables)
        self._begin(self._nominal, Shown(self.tables.rest_uT))

    @property
    def card(self) -> dict[str, Any]:
        """What the model was made of, and what it must not be used for (its JSON card)."""
        return io.read_json(FILE.with_suffix(".json"))

    @property
    def noload_uT(self) -> Float[np.ndarray, " ch"]:
        """The no-load field that changes are taken from, along the chips' axes; zeros before it was zeroed."""
        return np.zeros(CHANNELS_N) if self._noload_uT is None else self._noload_uT

    @property
    def told_n(self) -> int:
        """Count the pokes that it learns from, labelled or not."""
        return len(self._shown.pokes_uT) + len(self._shown.labelled[0])

    @property
    def misfit(self) -> float:
        """How badly the pokes that it was let see fit: the median of chi^2 a channel; 1 of none or too few to tell."""
        self._ready()
        return float(np.median(self._misfits)) if self.sureness.of_misfit(len(self._misfits)) else 1.0

    @property
    def temper(self) -> float:
        """To what power of their product both are believed: by pokes' misfit, and by labels that are left out."""
        pokes_n, labels_n, even = len(self._shown.pokes_uT), len(self._shown.labelled[0]), len(self._shown.even_uT) > 0
        told = by_misfit(self.sureness.of(pokes_n, labels_n, even=even), self.misfit)
        if self._ratio is None:
            (self._ratio,) = self.ratios([told])
        return by_residuals(told, self._ratio)

    def zero(self, b_uT: Float[np.ndarray, "*f ch"], *, keep: bool = False) -> "Universal":
        """Take the mean of readings without contact as the no-load field, and learn the skin's seat and gap from it.

        What it learnt of a skin before is forgotten; `keep` the pokes and labels where the same skin has drifted.
        """
        noload_uT = learnt_rows_of(b_uT)
        if not len(noload_uT):
            raise SchemaError("zero", "readings without contact", "one or more", 0, "Read the board before a touch.")
        self._noload_uT = noload_uT.mean(axis=0)
        rest_uT = to_board(self._noload_uT[None])[0]
        return self._take(replace(self._shown, rest_uT=rest_uT) if keep else Shown(rest_uT))

    def see(self, b_uT: Float[np.ndarray, "*n ch"], *, even: bool = False) -> "Universal":
        """Learn from pokes at unknown places, a reading each: some dozens all over the skin, later ones as they come.

        The first set is looked at several times over, what comes later once: by then the skin is known. If these and
        all before lie evenly over the skin (a grid, each place once), say so: their mean place is then its middle.
        """
        db_uT, shown = self._change(learnt_rows_of(b_uT)), self._shown
        pokes_uT = np.concatenate([shown.pokes_uT, db_uT])[-FULL_SET_N:]
        if even:
            self._misfits = np.full(len(pokes_uT), np.nan)
            return self._anew(replace(shown, pokes_uT=pokes_uT, even_uT=pokes_uT))._label(*shown.labelled)
        labelled, rounds_n = shown.labelled, 1 if len(shown.pokes_uT) else ROUNDS_N
        if len(labelled[0]):  # what is told counts, and not in which order
            skin = see_pokes(self._unlabelled, db_uT, rounds_n=rounds_n, reader=Reader(self._unlabelled))
        else:
            skin = see_pokes(self.skin, db_uT, rounds_n=rounds_n, reader=self._ready().reader)
        self._misfits = np.concatenate([self._misfits, np.full(len(db_uT), np.nan)])[-FULL_SET_N:]
        return self._learn(skin, Shown(shown.rest_uT, pokes_uT, shown.even_uT))._label(*labelled)

    def label(
        self,
        place_mm: Float[np.ndarray, "*m 2"] | Sequence[Any],
        force_N: Float[np.ndarray, "*m"] | Sequence[float] | float,
        b_uT: Float[np.ndarray, "*m ch"],
        *,
        keep: bool = False,
    ) -> "Universal":
        """Learn from pokes at known places under known forces, all that are known; `keep` earlier ones, or forget them.

        One poke, or several; raise SchemaError, with nothing learnt, on a place off the skin or a force of 0 N or less.
        """
        rows_uT = learnt_rows_of(b_uT)
        places_mm, forces_N = labels_of(
            np.asarray(place_mm, float), np.asarray(force_N, float), len(rows_uT), CENTRE_MM + REACH_MM
        )
        labelled = [places_mm - CENTRE_MM, forces_N, self._change(rows_uT)]
        if keep:
            labelled = [np.concatenate(both) for both in zip(self._shown.labelled, labelled, strict=True)]
            labels_of(labelled[0], labelled[1], len(labelled[2]), REACH_MM)  # with those they may be too many
        if len(self._shown.labelled[0]):
            self._anew(self._shown)
        return self._label(*labelled)

    def next_place(self, force_N: float = 2.0) -> Float[np.ndarray, "2"]:
        """Give the place whose poke, labelled, would tell most of the skin, in mm; about so strong."""
        place_mm = self.skin.hypotheses.place_mm[::CHOICE_EVERY_N]
        return place_mm[worth(self.skin, place_mm, np.full(len(place_mm), force_N)).argmax()] + CENTRE_MM

    def predict(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f 3"]:
        """Give x_mm, y_mm and the normal force in N of readings in contact."""
        found = self.estimate(b_uT)
        return np.column_stack([found.place_mm, found.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "*f ch"]) -> Estimate:
        """Give the same with the place's standard deviation, and the misfit: far above 1, this is no skin it knows."""
        if self._temper is None:
            self._temper = self.temper
        return self.estimates(b_uT, [self._temper])[0]

    def estimates(self, b_uT: Float[np.ndarray, "*f ch"], tempers: Sequence[float]) -> list[Estimate]:
        """Give the same under some tempers: only standard deviations differ."""
        db_uT, told = self._change(b_uT), self._ready()
        parts = [told.estimates(db_uT[i : i + BLOCK_N], tempers) for i in range(0, max(len(db_uT), 1), BLOCK_N)]
        found = [joined(of_temper) for of_temper in zip(*parts, strict=True)]
        return [replace(one, place_mm=one.place_mm + CENTRE_MM) for one in found]

    def ratios(self, tempers: Sequence[float]) -> list[float]:
        """Give how much larger variances are than under each temper, by labels: each is left out in its turn."""
        place_mm, force_N, db_uT = self._shown.labelled
        networks, parts = self._networks(), []
        for kept, left in left_out(len(place_mm)):
            skin = see_labelled(self._unlabelled, place_mm[kept], force_N[kept], db_uT[kept])
            told = Ready(Reader(skin), self._shifted(networks, place_mm[kept], db_uT[kept]))
            parts.append((told.estimates(db_uT[left], tempers), place_mm[left]))
        return ratios(len(tempers), parts)

    def save(self, file: Path | str) -> None:
        """Write what it was told of this skin, for `load_universal(file)`; raise SchemaError if it was never zeroed."""
        if self._noload_uT is None:
            raise SchemaError("save", "the model", "zeroed", "no no-load reading", "First call zero.")
        write_shown(self._shown, Path(file))

    def remember(self, file: Path | str) -> "Universal":
        """Take up what `save` wrote of a skin, in place of what it was told; then `zero(b_uT, keep=True)`."""
        shown = read_shown(Path(file), REACH_MM)
        self._noload_uT = to_chips(shown.rest_uT[None])[0]
        return self._take(shown)

    def __call__(self, db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Answer changes of field, as a network does."""
        return self.predict(rows_of(db_uT) + self.noload_uT).astype(np.float32)

    def _change(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f ch"]:
        return to_board(rows_of(b_uT) - self.noload_uT)

    def _ready(self) -> Ready:
        if self._told is None:
            place_mm, _, db_uT = self._shown.labelled
            reader, unread = Reader(self.skin), np.isnan(self._misfits)
            if unread.any():  # pokes misfit the map that has first learnt from them
                self._misfits[unread] = reader.weigh(self._shown.pokes_uT[unread]).misfit()
            self._told = Ready(reader, self._shifted(self._networks(), place_mm, db_uT))
        return self._told

    def _networks(self) -> list[Layers]:
        return [tell(weights, self._shown.rest_uT, self._shown.pokes_uT) for weights in self.networks]

    def _shifted(
        self, networks: Sequence[Layers], place_mm: Float[np.ndarray, "m 2"], db_uT: Float[np.ndarray, "m ch"]
    ) -> list[Layers]:
        # Towards the middle, if pokes lie evenly, then by what labels say.
        even_uT, said_mm = self._shown.even_uT, ask(networks, db_uT).place_mm
        by_mm = -off_middle_mm(ask(networks, even_uT).place_mm, len(place_mm)) if len(even_uT) else np.zeros(2)
        by_mm = by_mm + told_mm(Labels(said_mm + by_mm, place_mm))
        return [moved(layers, by_mm) for layers in networks]

    def _take(self, shown: Shown) -> "Universal":
        return self._begin(see_rest(self._nominal, shown.rest_uT), shown)._label(*shown.labelled)

    def _begin(self, skin: SkinMap, shown: Shown) -> "Universal":
        self._start, self._misfits = skin, np.full(len(shown.pokes_uT), np.nan)
        return self._anew(shown)

    def _anew(self, shown: Shown) -> "Universal":
        # From the start, all that is shown but labels.
        skin = see_pokes(self._start, shown.pokes_uT) if len(shown.pokes_uT) else self._start
        skin = see_even(skin, shown.even_uT) if len(shown.even_uT) else skin
        self._ratio = 1.0
        return self._learn(skin, Shown(shown.rest_uT, shown.pokes_uT, shown.even_uT))

    def _label(
        self, on_board_mm: Float[np.ndarray, "m 2"], force_N: Float[np.ndarray, " m"], db_uT: Float[np.ndarray, "m ch"]
    ) -> "Universal":
        if not len(on_board_mm):
            return self
        self._ready()  # pokes misfit a map that no label has bent
        self._unlabelled, self._ratio = self.skin, None
        skin = see_labelled(self.skin, on_board_mm, force_N, db_uT)
        return self._learn(skin, replace(self._shown, labelled=(on_board_mm, force_N, db_uT)))

    def _learn(self, skin: SkinMap, shown: Shown) -> "Universal":
        self.skin, self._shown, self._told, self._temper = skin, shown, None, None
        return self


def load_universal(skin: Path | str | None = None, *, file: Path = FILE) -> Universal:
    """Load the model that comes with the project; with a file that `save` wrote, as it is on that skin."""
    model = Universal(*_parts(file))
    return model if skin is None else model.remember(skin)


@lru_cache(maxsize=2)
def _parts(file: Path) -> tuple[Tables, Sequence[Weights], Sureness]:
    card_file = file.with_suffix(".json")
    card = io.read_json(card_file)
    form = card.get("format") if isinstance(card, dict) else None
    if form != FORMAT:
        remedy = "Take file and card of this version, or make them again: python -m pipeline.training.shipping"
        raise SchemaError(card_file, "format", FORMAT, form, remedy)
    parts, _ = io.read_tensors(file, digest_needed=True)
    of_map = {one.name: parts.pop(one.name).astype(float) for one in fields(Tables) if one.name != "names"}
    return Tables(names=tuple(card["spreads"]), **of_map), of_tensors(parts), Sureness.of_card(card["sureness"])


def write(
    tables: Tables, networks: Sequence[Weights], sureness: Sureness, words: Mapping[str, Any], file: Path = FILE
) -> None:
    """Write tables in single precision and networks, and a card of what they are: how sure, the spreads, some words."""
    parts = [one.name for one in fields(tables) if one.name != "names"]
    of_map = {name: getattr(tables, name).astype(np.float32) for name in parts}
    io.write_tensors(file, of_map | to_tensors(networks), {})
    spreads = dict(zip(tables.names, tables.spreads.tolist(), strict=True))
    card = {"format": FORMAT, **words, "sureness": sureness.to_card(), "spreads": spreads}
    io.write_json(file.with_suffix(".json"), card)
