"""The universal model: places and forces on a skin of the paper's board, without training.

A map (a Gaussian process over skins) and networks, both made from nominal simulated skins, come with the project. A
new skin calibrates them: by its no-load field, by presses at unknown places and by presses at known ones. The board
has five chips, turned as on recorded boards. Places are labels: along the board's axes, its middle at (8, 8) mm.
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
from reskin.universal.calibration import (
    CHANNELS_N,
    CalibrationData,
    LabelledPresses,
    LikelihoodPowers,
    check_labels,
    check_readings,
    check_shape,
    expected_gain,
    folds_of_labels,
    lower_by_misfit,
    lower_by_residuals,
    read_calibration,
    variance_inflations,
    write_calibration,
)
from reskin.universal.combine import Labels, multiply, off_middle_mm, told_mm
from reskin.universal.law import to_board, to_chips
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
class Calibrated:
    """A map and networks, calibrated to one skin."""

    reader: Reader
    networks: Sequence[Layers]

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], powers: Sequence[float]) -> list[Estimate]:
        """Estimate places and forces, once for each likelihood power: only standard deviations depend on it."""
        weighed, opinion = self.reader.weigh(db_uT), ask(self.networks, db_uT)
        return [multiply(self.reader, weighed, opinion, power) for power in powers]


@dataclass
class Universal:
    """A model of the paper's board that is calibrated while it is used.

    Call `zero` with readings without contact, `see` with presses at unknown places, `label` with presses at known
    ones, in any order and as often as wanted; `predict` at any time. Fields are in uT along the chips' axes.

    tables: the map's prior. networks: their weights. powers: how far likelihoods are believed.
    skin: the map, calibrated by all that is known of the skin.
    """

    tables: Tables
    networks: Sequence[Weights]
    powers: LikelihoodPowers
    skin: SkinMap = field(init=False)

    def __post_init__(self) -> None:
        """Start from nominal skins."""
        self._noload_uT: np.ndarray | None = None
        self._press_reader: Reader | None = None
        self._calibrated: Calibrated | None = None
        self._power: float | None = None
        self._nominal_map = new_map(self.tables)
        self._restart(self._nominal_map, CalibrationData(self.tables.rest_uT))

    @property
    def card(self) -> dict[str, Any]:
        """What the model was made of, and what it must not be used for (its JSON card)."""
        return io.read_json(FILE.with_suffix(".json"))

    @property
    def noload_uT(self) -> Float[np.ndarray, " ch"]:
        """The no-load field that changes are taken from, along the chips' axes; zeros before it was zeroed."""
        return np.zeros(CHANNELS_N) if self._noload_uT is None else self._noload_uT

    @property
    def presses_n(self) -> int:
        """Number of presses that it is calibrated by, labelled or not."""
        return len(self._data.presses_uT) + len(self._data.labels.place_mm)

    @property
    def misfit(self) -> float:
        """Median over unlabelled presses of chi^2 a channel: about 1 on a skin of the prior; 1 if they are too few."""
        self._read_press_map()
        return float(np.median(self._misfits)) if self.powers.are_enough(len(self._misfits)) else 1.0

    @property
    def power(self) -> float:
        """Power of the combined likelihood, from the misfit of unlabelled presses and cross-validated labels.

        1: both are trusted fully. Smaller: standard deviations are larger.
        """
        if self._power is None:
            data = self._data
            believed = self.powers.of(len(data.presses_uT), len(data.labels.place_mm), even=len(data.even_uT) > 0)
            power = lower_by_misfit(believed, self.misfit)
            if len(data.labels.place_mm):
                power = lower_by_residuals(power, *self.variance_inflations([power]))
            self._power = power
        return self._power

    def zero(self, b_uT: Float[np.ndarray, "*f ch"], *, keep: bool = False) -> "Universal":
        """Take the mean of readings without contact as the no-load field, which also tells the skin's seat and gap.

        Earlier presses are forgotten; with `keep` they stay, where the same skin has drifted.
        """
        noload_uT = check_readings(b_uT)
        if not len(noload_uT):
            raise SchemaError("zero", "readings without contact", "one or more", 0, "Read the board before a touch.")
        self._noload_uT = noload_uT.mean(axis=0)
        rest_uT = to_board(self._noload_uT[None])[0]
        data = replace(self._data, rest_uT=rest_uT) if keep else CalibrationData(rest_uT)
        return self._restart(see_rest(self._nominal_map, rest_uT), data)

    def see(self, b_uT: Float[np.ndarray, "*n ch"], *, even: bool = False) -> "Universal":
        """Calibrate by presses at unknown places, a reading each: some dozens all over the skin, or more as they come.

        The first set is passed over several times, later ones once: by then the skin is known. If these and all
        before lie evenly over the skin (a grid, each place once), say `even`: their mean place is then its middle.
        """
        db_uT, data = self._change(check_readings(b_uT)), self._data
        presses_uT = np.concatenate([data.presses_uT, db_uT])[-FULL_SET_N:]
        if even:
            self._misfits = np.full(len(presses_uT), np.nan)
            return self._fit_presses(replace(data, presses_uT=presses_uT, even_uT=presses_uT))
        rounds_n = 1 if len(data.presses_uT) else ROUNDS_N
        press_map = see_pokes(self._press_map, db_uT, rounds_n=rounds_n, reader=self._read_press_map())
        self._misfits = np.concatenate([self._misfits, np.full(len(db_uT), np.nan)])[-FULL_SET_N:]
        return self._set_press_map(press_map, replace(data, presses_uT=presses_uT))

    def label(
        self,
        place_mm: Float[np.ndarray, "*m 2"] | Sequence[Any],
        force_N: Float[np.ndarray, "*m"] | Sequence[float] | float,
        b_uT: Float[np.ndarray, "*m ch"],
        *,
        keep: bool = False,
    ) -> "Universal":
        """Calibrate by presses at known places under known forces; `keep` earlier ones, or forget them.

        One press, or several; raise SchemaError, with nothing changed, on a place off the skin or a force of 0 N or
        less.
        """
        readings_uT = check_readings(b_uT)
        places_mm, forces_N = check_labels(
            np.asarray(place_mm, float), np.asarray(force_N, float), len(readings_uT), CENTRE_MM + REACH_MM
        )
        labels = LabelledPresses(places_mm - CENTRE_MM, forces_N, self._change(readings_uT))
        if keep:
            labels = LabelledPresses(*map(np.concatenate, zip(self._data.labels, labels, strict=True)))
            check_labels(labels.place_mm, labels.force_N, len(labels.db_uT), REACH_MM)  # together they may be too many
        data = replace(self._data, labels=labels)
        if len(self._data.labels.place_mm):  # the order in which presses came must not count: from the start
            return self._fit_presses(data)
        return self._set_press_map(self._press_map, data)

    def next_place(self, force_N: float = 2.0) -> Float[np.ndarray, "2"]:
        """Return the place, in mm, where a labelled press of about this force would tell most about the skin."""
        place_mm = self.skin.hypotheses.place_mm[::CHOICE_EVERY_N]
        gain = expected_gain(self.skin, place_mm, np.full(len(place_mm), force_N))
        return place_mm[gain.argmax()] + CENTRE_MM

    def predict(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f 3"]:
        """Return x_mm, y_mm and the normal force in N of readings in contact."""
        found = self.estimate(b_uT)
        return np.column_stack([found.place_mm, found.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "*f ch"]) -> Estimate:
        """Return the same with the place's standard deviation, and the misfit: far above 1, this is no known skin."""
        return self.estimates(b_uT, [self.power])[0]

    def estimates(self, b_uT: Float[np.ndarray, "*f ch"], powers: Sequence[float]) -> list[Estimate]:
        """Return the same for several likelihood powers: only standard deviations differ."""
        db_uT, calibrated = self._change(b_uT), self._calibrate()
        blocks = [db_uT[i : i + BLOCK_N] for i in range(0, max(len(db_uT), 1), BLOCK_N)]
        by_block = [calibrated.estimate(block_uT, powers) for block_uT in blocks]
        by_power = [joined(parts) for parts in zip(*by_block, strict=True)]
        return [replace(one, place_mm=one.place_mm + CENTRE_MM) for one in by_power]

    def variance_inflations(self, powers: Sequence[float]) -> list[float]:
        """Estimate the variance inflation for each likelihood power by cross-validation over the labelled presses."""
        labels, networks, parts = self._data.labels, self._condition_networks(), []
        for kept, held_out in folds_of_labels(len(labels.place_mm)):
            skin = see_labelled(self._press_map, labels.place_mm[kept], labels.force_N[kept], labels.db_uT[kept])
            shifted = self._shift_networks(networks, labels.place_mm[kept], labels.db_uT[kept])
            found = Calibrated(Reader(skin), shifted).estimate(labels.db_uT[held_out], powers)
            parts.append((found, labels.place_mm[held_out]))
        return variance_inflations(len(powers), parts)

    def save(self, file: Path | str) -> None:
        """Write the calibration data of this skin, for `load_universal(file)`; raise SchemaError before `zero`."""
        if self._noload_uT is None:
            raise SchemaError("save", "the model", "zeroed", "no no-load reading", "First call zero.")
        write_calibration(self._data, Path(file))

    def remember(self, file: Path | str) -> "Universal":
        """Read what `save` wrote, in place of all that is known of a skin; then call `zero(b_uT, keep=True)`."""
        data = read_calibration(Path(file), REACH_MM)
        self._noload_uT = to_chips(data.rest_uT[None])[0]
        return self._restart(see_rest(self._nominal_map, data.rest_uT), data)

    def __call__(self, db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Predict from changes of field, as a network does."""
        return self.predict(check_shape(db_uT) + self.noload_uT).astype(np.float32)

    def _change(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f ch"]:
        return to_board(check_shape(b_uT) - self.noload_uT)

    def _restart(self, noload_map: SkinMap, data: CalibrationData) -> "Universal":
        """Calibrate by all data, starting from a map that knows the no-load field and nothing else of the skin."""
        self._noload_map = noload_map
        self._misfits = np.full(len(data.presses_uT), np.nan)  # of each unlabelled press; NaN: not yet computed
        return self._fit_presses(data)

    def _fit_presses(self, data: CalibrationData) -> "Universal":
        """Calibrate by all presses again: unlabelled ones, then the labels."""
        press_map = self._noload_map
        if len(data.presses_uT):
            press_map = see_pokes(press_map, data.presses_uT)
        if len(data.even_uT):
            press_map = see_even(press_map, data.even_uT)
        return self._set_press_map(press_map, data)

    def _set_press_map(self, press_map: SkinMap, data: CalibrationData) -> "Universal":
        """Take a map that knows the unlabelled presses, and add the labels."""
        self._press_map, self._data, labels = press_map, data, data.labels
        self._press_reader, self._calibrated, self._power = None, None, None
        self.skin = press_map
        if len(labels.place_mm):
            self._read_press_map()  # misfits are those of a map without labels
            self.skin = see_labelled(press_map, labels.place_mm, labels.force_N, labels.db_uT)
        return self

    def _read_press_map(self) -> Reader:
        """Return the reader of the map without labels, and compute the misfit of presses that have none yet."""
        if self._press_reader is None:
            self._press_reader = Reader(self._press_map)
        new = np.isnan(self._misfits)
        if new.any():  # a press misfits the map that has first learnt from it
            self._misfits[new] = self._press_reader.weigh(self._data.presses_uT[new]).misfit()
        return self._press_reader

    def _calibrate(self) -> Calibrated:
        """Return map and networks, ready to read; kept until the calibration data change."""
        if self._calibrated is None:
            labels, reader = self._data.labels, self._read_press_map()
            networks = self._shift_networks(self._condition_networks(), labels.place_mm, labels.db_uT)
            self._calibrated = Calibrated(Reader(self.skin) if len(labels.place_mm) else reader, networks)
        return self._calibrated

    def _condition_networks(self) -> list[Layers]:
        return [tell(weights, self._data.rest_uT, self._data.presses_uT) for weights in self.networks]

    def _shift_networks(
        self, networks: Sequence[Layers], place_mm: Float[np.ndarray, "m 2"], db_uT: Float[np.ndarray, "m ch"]
    ) -> list[Layers]:
        """Shift the networks' places towards the middle, if presses lie evenly, then by the labels' mean error."""
        even_uT, estimated_mm = self._data.even_uT, ask(networks, db_uT).place_mm
        by_mm = -off_middle_mm(ask(networks, even_uT).place_mm, len(place_mm)) if len(even_uT) else np.zeros(2)
        by_mm = by_mm + told_mm(Labels(estimated_mm + by_mm, place_mm))
        return [moved(layers, by_mm) for layers in networks]


def load_universal(calibration: Path | str | None = None, *, file: Path = FILE) -> Universal:
    """Load the model that comes with the project; with a file that `save` wrote, calibrated to that skin."""
    model = Universal(*_read_parts(file))
    return model if calibration is None else model.remember(calibration)


@lru_cache(maxsize=2)
def _read_parts(file: Path) -> tuple[Tables, Sequence[Weights], LikelihoodPowers]:
    card_file = file.with_suffix(".json")
    card = io.read_json(card_file)
    form = card.get("format") if isinstance(card, dict) else None
    if form != FORMAT:
        remedy = "Take file and card of this version, or make them again: python -m pipeline.training.shipping"
        raise SchemaError(card_file, "format", FORMAT, form, remedy)
    parts, _ = io.read_tensors(file, digest_needed=True)
    of_map = {one.name: parts.pop(one.name).astype(float) for one in fields(Tables) if one.name != "names"}
    tables = Tables(names=tuple(card["spreads"]), **of_map)
    return tables, of_tensors(parts), LikelihoodPowers.from_card(card["sureness"])


def write(
    tables: Tables, networks: Sequence[Weights], powers: LikelihoodPowers, about: Mapping[str, Any], file: Path = FILE
) -> None:
    """Write the map's prior in single precision, the networks, and a card: how they were made, powers, spreads."""
    parts = [one.name for one in fields(tables) if one.name != "names"]
    of_map = {name: getattr(tables, name).astype(np.float32) for name in parts}
    io.write_tensors(file, of_map | to_tensors(networks), {})
    spreads = dict(zip(tables.names, tables.spreads.tolist(), strict=True))
    card = {"format": FORMAT, **about, "sureness": powers.to_card(), "spreads": spreads}
    io.write_json(file.with_suffix(".json"), card)
