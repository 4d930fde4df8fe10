"""The universal model: estimates places and forces on a new skin without training on that skin.

The model has two parts, which estimate independently: a map (`reskin.universal.map`), which is a probabilistic model
based on a physical law, and networks (`reskin.universal.network`). Both were computed from simulated skins. Their
estimates are combined.

Three classes contain both parts at different stages of calibration:

- `PriorModel`: before calibration, for any skin;
- `PressCalibration`: conditioned on the no-load field of one skin, and on presses at unknown places;
- `CalibratedModel`: also conditioned on labelled presses, which are presses with known places and forces.

These three classes use the frame and the axes of the board, and work for any board. `Universal` is the class for users.
It is made for the board of one layout (`reskin.universal.layout`); the model that comes with the project is for the
paper's board. `Universal` takes readings along the axes of the chips. Its places are in the frame of the labels. In
this frame, the centre of the board is at the layout's `centre_mm`.

A likelihood power is the exponent to which a likelihood is raised. A power below 1 increases standard deviations. It is
used where likelihoods are multiplied as if errors were independent although they are correlated.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.constants import milli
from scipy.special import logsumexp

from reskin import io
from reskin.display import one_line
from reskin.errors import SchemaError
from reskin.physics import external
from reskin.physics.magnet import cubes_along
from reskin.recordings.units import WEAKEST_uT
from reskin.universal import network
from reskin.universal.calibration import (
    CalibrationData,
    LabelledPresses,
    LikelihoodPowers,
    check_is_reading,
    check_labels,
    check_number,
    check_presses,
    check_range,
    check_readings,
    check_shape,
    folds_of_labels,
    join_labels,
    lower_by_misfit,
    lower_by_residuals,
    no_presses,
    read_calibration,
    variance_inflations,
    write_calibration,
)
from reskin.universal.force import ESTIMATORS, FEW_N, ForceLine, fit_line, prior_line
from reskin.universal.kernels import products
from reskin.universal.layout import BoardLayout, as_layout, paper_layout
from reskin.universal.map import (
    ROUNDS_N,
    Estimate,
    Likelihoods,
    MapEvaluator,
    Residual,
    SkinMap,
    Tables,
    begin_day,
    concatenate,
    condition_on_even_presses,
    condition_on_labels,
    condition_on_noload,
    condition_on_presses,
    expected_gain,
    kernel,
    move_places,
    new_map,
    shift_onto_area,
)
from reskin.universal.mounting import LABELS_MIN_N, LabelFrame, Mounting, find_label_frame, find_mounting
from reskin.universal.network import FULL_SET_N, Layers, NetworkEstimate, Weights, shift_places

# Likelihood power of the map when it is combined with the networks. It is below 1, because the errors of channels are
# correlated. It is not fitted to any board.
MAP_POWER = 0.6
# Power of the map's probabilities of forces if the map alone estimates forces. It is below 1, because the map
# underestimates the uncertainty of forces. The value was the best of four values on simulated skins
# (docs/learning.md).
FORCE_POWER = 0.6
SD_MIN_MM, SD_MIN_LOG_N = 0.5, 0.3  # smallest standard deviations of the networks' estimates
# `network_offsets_mm` corrects the places of the networks twice. The first correction, from unlabelled presses, loses
# weight as labels are added: it is divided by 1 + this value * number of labels.
FADES_PER_LABEL = 0.15
# The error of the networks in place is assumed to be the sum of two parts: a part that is the same for all presses on a
# skin, with the first standard deviation, and a part that differs from press to press, with the second standard
# deviation.
OFFSET_SD_MM, LABEL_SD_MM = 0.3, 1.0
# A warning is given if chi^2 per channel exceeds this assumed value. For skins like those in training, it is about 1.
MISFIT_MAX = 4.0
# If the no-load field differs from that of the saved calibration by more than this fraction, a warning says that this
# may be another skin. In scene lab, recordings of one board differ by at most 5 %, and recordings of different boards
# by 65 %.
OTHER_SKIN_MIN = 0.25
BLOCK_N = 200  # readings are evaluated in blocks of this size, which limits the memory
# With external fields, the errors of map and networks are more strongly correlated. The likelihood power is therefore
# divided by 1 + external_uT / (POWER_uT + POWER_PER_LABEL_uT * labels). Both values were chosen so that 90 % intervals
# contain 90 % of the true values on simulated skins.
POWER_uT, POWER_PER_LABEL_uT = 110.0, 10.0
EXTERNAL_MAX_uT = 1000.0  # largest allowed external field; much larger ones would require double precision

# File of the model that comes with the project. Its model card, which describes the model, is universal.json.
FILE = Path(__file__).with_name("universal.safetensors")
FORMAT, FORMAT_3 = "reskin-universal-4", "reskin-universal-3"
# A shift of all places is caused by these two parameters. Their spreads therefore give the standard deviation of the
# prior of the shift.
OFFSETS_ALONG_X = ("seat_x_mm", "label_x_mm")
# Presses of a new day show whether the skin still slides as on the day before. If the log odds for this are at least
# this value, the slide is assumed to be unchanged. Otherwise, a change is assumed, because an unnoticed change costs
# more accuracy than a wrongly assumed one. The value was chosen on simulated skins.
SAME_SLIDE_LOG_ODDS_MIN = 2.0
# Fields of `Tables` that model files do not contain, because the model card determines them.
UNSTORED = ("names", "area")
RESIDUAL = tuple(field.name for field in fields(Residual))  # each is stored as `residual.<name>`
CHOICE_EVERY_N = 3  # to propose the next labelled press, only every third place of the lattice is considered


@dataclass(frozen=True)
class Evaluation:
    """Outputs of map and networks for some readings, from which estimates with any likelihood power are computed.

    The likelihood power affects standard deviations and, in `by_map`, also places and forces.

    `line` calibrates the forces (`reskin.universal.force`). If only few forces are known, they are used in two ways:
    `likelihoods` comes from the map that is conditioned on the presses with known forces, and `unlabelled` from a map
    that is not conditioned on these presses. `few` contains the presses.
    """

    evaluator: MapEvaluator
    likelihoods: Likelihoods
    network: NetworkEstimate
    line: ForceLine
    few: "FewForces | None" = None
    unlabelled: Likelihoods | None = None

    __repr__ = one_line

    def by_map(self, power: float) -> Estimate:
        """Estimate with the map alone: places and forces are means over its hypotheses, weighted by probability."""
        return self.evaluator.mean(self.likelihoods, power)

    def by_network(self, power: float) -> Estimate:
        """Estimate with the networks alone. The misfits are NaN, because networks do not determine a misfit."""
        own, unknown = self.network, np.full(len(self.network.log_N), np.nan)
        return Estimate(own.place_mm, own.sd_mm / np.sqrt(power), np.exp(own.log_N), unknown, unknown)

    def combined(self, power: float) -> Estimate:
        """Combine map and networks: multiply their probability distributions of places and of forces.

        The errors of map and networks are correlated, because both use the same field changes. Therefore, the product
        is raised to the likelihood power `power` before the standard deviations are computed. The line of this skin
        calibrates the forces. If only few forces are known, the line is used only far from the presses with known
        forces. Close to these presses, the force comes from the map that is conditioned on them.
        """
        place_mm, sd_mm, by_estimator = self._products(self.likelihoods, power)
        selected = ESTIMATORS.index(self.line.estimator)
        log_N, sd_log_N = self.line.apply((self._unlabelled_log_forces or by_estimator)[selected])
        if self.few is not None:
            near = kernel(place_mm, self.few.place_mm, log_N, self.few.log_N).max(axis=1)
            log_N = near * by_estimator[selected] + (1 - near) * log_N
        return Estimate(place_mm, sd_mm, np.exp(log_N), self.likelihoods.misfit(), sd_log_N)

    def log_forces(self) -> Sequence[Float[np.ndarray, " n"]]:
        """Return the logarithms of the forces before calibration, once for each of `ESTIMATORS`."""
        return self._unlabelled_log_forces or self._products(self.likelihoods, 1.0)[2]

    @property
    def _unlabelled_log_forces(self) -> Sequence[Float[np.ndarray, " n"]] | None:
        """Logarithms of the forces from the map that is not conditioned on the few known forces, if there is one."""
        return None if self.unlabelled is None else self._products(self.unlabelled, 1.0)[2]

    def _products(
        self, likelihoods: Likelihoods, power: float
    ) -> tuple[np.ndarray, np.ndarray, Sequence[Float[np.ndarray, " n"]]]:
        normals = np.empty((len(self.network.log_N), 6))
        normals[:, :2], normals[:, 4] = self.network.place_mm, self.network.log_N
        np.maximum(self.network.sd_mm, SD_MIN_MM, out=normals[:, 2:4])
        np.maximum(self.network.sd_log_N, SD_MIN_LOG_N, out=normals[:, 5])
        place_mm, sd_mm, force_N, map_log_N = products(
            likelihoods.deviance, likelihoods.best, self.evaluator.lattice, normals, MAP_POWER, power, FORCE_POWER
        )
        return place_mm, sd_mm, (np.log(force_N), map_log_N)


@dataclass(frozen=True)
class FewForces:
    """A few presses with known forces, with places in the board's frame, and a map that is not conditioned on them."""

    skin: SkinMap
    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]

    __repr__ = one_line


@dataclass(frozen=True)
class CalibratedModel:
    """Map and networks, calibrated to one skin.

    The corrections `offsets_mm` are added to the places of the networks. `line` calibrates the forces. `few` contains
    the presses with known forces if there are only few of them.
    """

    skin: SkinMap
    networks: Sequence[Layers]
    offsets_mm: Sequence[Float[np.ndarray, "2"]]
    line: ForceLine = field(default_factory=prior_line)
    few: FewForces | None = None

    __repr__ = one_line

    def with_offsets_in_biases(self) -> "CalibratedModel":
        """Return the same model, with its offsets added to the biases of the networks' last layers.

        This makes estimates faster. However, the offsets are then added in single precision.
        """
        offset_mm = sum(self.offsets_mm, np.zeros(2))
        return replace(self, networks=[shift_places(layers, offset_mm) for layers in self.networks], offsets_mm=())

    def estimate(self, db_uT: Float[np.ndarray, "n ch"], powers: Sequence[float]) -> list[Estimate]:
        """Combine map and networks to estimate places and forces, once for each likelihood power."""
        return self.estimate_by(lambda evaluation: [evaluation.combined(power) for power in powers], db_uT)

    def estimate_by(
        self, method: Callable[[Evaluation], Sequence[Estimate]], db_uT: Float[np.ndarray, "n ch"]
    ) -> list[Estimate]:
        """Estimate places and forces, one block of readings at a time, which limits the memory.

        `method` computes one or several estimates from the evaluation of a block.
        """
        if len(db_uT) <= BLOCK_N:
            return list(method(self.evaluate(db_uT)))
        by_block = [method(self.evaluate(db_uT[i : i + BLOCK_N])) for i in range(0, len(db_uT), BLOCK_N)]
        return [concatenate(parts) for parts in zip(*by_block, strict=True)]

    def evaluate(self, db_uT: Float[np.ndarray, "n ch"]) -> Evaluation:
        """Evaluate map and networks on a block of readings.

        The networks receive readings from which the external field that the map expects has been subtracted.
        """
        evaluator, few = self.skin.evaluator, self.few
        likelihoods = evaluator.evaluate(db_uT)
        networks = self.evaluate_networks(evaluator.without_external(db_uT, likelihoods))
        own = evaluator, likelihoods, networks, self.line
        return Evaluation(*own, few, None if few is None else few.skin.evaluator.evaluate(db_uT))

    def evaluate_networks(self, db_uT: Float[np.ndarray, "n ch"]) -> NetworkEstimate:
        """Estimate places and forces with the networks alone, and add the offsets to the places."""
        estimate = network.evaluate(self.networks, db_uT)
        for offset_mm in self.offsets_mm:
            estimate = replace(estimate, place_mm=estimate.place_mm + offset_mm)
        return estimate


class HeldOutLabels(NamedTuple):
    """Labelled presses, and their evaluation by a model that was calibrated without them."""

    labels: LabelledPresses
    evaluation: Evaluation


def line_of_labels(folds: Sequence[HeldOutLabels]) -> ForceLine:
    """Fit the line that calibrates forces (`reskin.universal.force`) to the labels whose force is known."""
    if not any(fold.labels.known.any() for fold in folds):
        return prior_line()
    log_forces = [[log_N[fold.labels.known] for log_N in fold.evaluation.log_forces()] for fold in folds]
    true_N = np.concatenate([fold.labels.force_N[fold.labels.known] for fold in folds])
    return fit_line([np.concatenate(parts) for parts in zip(*log_forces, strict=True)], np.log(true_N))


@dataclass(frozen=True)
class PressCalibration:
    """Map and networks, calibrated to a skin's no-load field and to its presses at unknown places.

    How the skin slides under a press can change from day to day. If it has changed, `earlier` is the calibration to the
    last day before the change. In this case, the map `skin` is also conditioned on the unlabelled presses of all
    earlier days, but the networks only on the presses in `data`.
    """

    skin: SkinMap
    networks: Sequence[Weights]
    data: CalibrationData
    earlier: "PressCalibration | None" = None

    __repr__ = one_line

    @cached_property
    def layers(self) -> list[Layers]:
        """The networks, conditioned on the skin's no-load field and its presses at unknown places."""
        return [network.condition(weights, self.data.rest_uT, self.data.presses_uT) for weights in self.networks]

    @cached_property
    def even_mm(self) -> Float[np.ndarray, "e 2"]:
        """Places of the evenly spread presses as estimated by the networks."""
        return network.evaluate(self.layers, self.data.even_uT).place_mm

    @cached_property
    def centre_mm(self) -> Float[np.ndarray, "2"]:
        """Shift that is added to the places of the networks, estimated from unlabelled presses.

        If the presses are at random places all over the area of presses, the shift moves their estimated places onto
        this area. If they are evenly spread, it moves their mean place to the centre.
        """
        if self.spread is not self:
            return self.spread.centre_mm
        if len(self.data.area_uT):
            estimate = CalibratedModel(self.skin, self.layers, ()).estimate(self.data.area_uT, [MAP_POWER])[0]
            pairs = zip(self.skin.tables.names, self.skin.tables.spreads, strict=True)
            sd_mm = math.hypot(*(float(sd) for name, sd in pairs if name in OFFSETS_ALONG_X))
            return shift_onto_area(estimate, sd_mm, self.skin.tables.area)
        return -self.even_mm.mean(axis=0) if len(self.even_mm) else np.zeros(2)

    @cached_property
    def moved(self) -> SkinMap:
        """The map, with its places moved by the same shift as the places of the networks.

        The map is moved only if the shift was estimated from presses at random places all over the area of presses.
        Otherwise, this is `skin`.
        """
        return move_places(self.skin, self.centre_mm) if len(self.spread.data.area_uT) else self.skin

    @property
    def spread(self) -> "PressCalibration":
        """The calibration from which the shift of places is computed.

        This is the latest calibration, of this or an earlier day, for which the user has stated where the presses are:
        that they are spread evenly around the centre, or that they cover the whole area.
        """
        known = len(self.data.even_uT) or len(self.data.area_uT)
        return self if known or self.earlier is None else self.earlier.spread

    def with_labels(self, labels: LabelledPresses, *, few: bool | None = None) -> CalibratedModel:
        """Condition the map on labelled presses, and compute the offsets of the networks' places from them.

        `labels` are the labelled presses since the skin last changed the way in which it slides on the board. Labels
        from before this change are added to them. If `few` is True, a second map is made that is not conditioned on the
        presses with known forces. Far from these presses, forces are estimated with the second map, and a straight line
        that is fitted to the known forces corrects them. With the first map, the known forces would be used twice: for
        the map, and for the line. By default, `few` is True if 1 to `FEW_N` - 1 forces are known.
        """
        by_day = self.labels_by_day(labels)
        days_ago = np.repeat(np.arange(len(by_day)), [len(day) for day, _ in by_day])
        estimated_mm = np.concatenate([network.evaluate(layers, day.db_uT).place_mm for day, layers in by_day])
        labels = reduce(join_labels, (day for day, _ in by_day))
        few = has_few(labels) if few is None else few
        few_forces = None
        if few:
            known_i, rest_i = np.flatnonzero(labels.known), np.flatnonzero(~labels.known)
            known, rest = labels[known_i], labels[rest_i]
            without = condition_on_labels(self.moved, rest.place_mm, rest.force_N, rest.db_uT, days_ago[rest_i])
            few_forces = FewForces(without, known.place_mm, np.log(known.force_N)) if len(known) else None
        skin = condition_on_labels(self.moved, labels.place_mm, labels.force_N, labels.db_uT, days_ago)
        offsets_mm = network_offsets_mm(self.centre_mm, estimated_mm, labels.place_mm)
        return CalibratedModel(skin, self.layers, offsets_mm, few=few_forces)

    def labels_by_day(self, labels: LabelledPresses) -> list[tuple[LabelledPresses, Sequence[Layers]]]:
        """Group the labels by period between changes of the slide, latest period first.

        Each group comes with the networks that are conditioned on the presses of its period.
        """
        earlier = self.earlier
        return [(labels, self.layers), *([] if earlier is None else earlier.labels_by_day(earlier.data.labels))]

    def held_out(self, labels: LabelledPresses, *, few: bool | None = None) -> Iterator[HeldOutLabels]:
        """Evaluate the labelled presses by cross-validation.

        The labels are split into folds. The presses of each fold are evaluated with a model that is calibrated to the
        labels of all other folds. `few` has the same meaning as in `with_labels`.
        """
        few = has_few(reduce(join_labels, (day for day, _ in self.labels_by_day(labels)))) if few is None else few
        for kept, held_out in folds_of_labels(len(labels)):
            model = self.with_labels(labels[kept], few=few).with_offsets_in_biases()
            yield HeldOutLabels(labels[held_out], model.evaluate(labels.db_uT[held_out]))

    def held_out_earlier(self, few: bool) -> list[HeldOutLabels]:
        """Evaluate the labelled presses from before the last change of the slide, by cross-validation.

        These presses are grouped by period between changes of the slide. The presses of each group are evaluated with
        the calibration to their own period.
        """
        if (day := self.earlier) is None:
            return []
        return [*day.held_out(day.data.labels, few=few), *day.held_out_earlier(few)]

    def same_slide_log_odds(self, db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, " n"]:
        """Return, for each press of a later day, the log odds that the skin still slides as on the day of this object.

        Two maps are compared: one for an unchanged slide, and one for a changed slide. The log odds are the log
        likelihood of the press under the first map minus its log likelihood under the second map. A likelihood is the
        sum over all places and forces, because the place and the force of the press are unknown. Both maps are
        conditioned on the labels of the day of this object.
        """
        same, changed = (
            logsumexp(-0.5 * skin.evaluator.evaluate(db_uT).deviance.astype(float), axis=1)
            for skin in self._next_day_maps
        )
        return same - changed

    @cached_property
    def _next_day_maps(self) -> tuple[SkinMap, SkinMap]:
        unpressed = CalibrationData.at_rest(self.data.rest_uT)
        changed = PressCalibration(begin_day(self.skin), self.networks, unpressed, self)
        return self.with_labels(self.data.labels).skin, changed.with_labels(unpressed.labels).skin


def calibrate_day(
    noload_map: SkinMap, networks: Sequence[Weights], data: CalibrationData, last: PressCalibration | None
) -> PressCalibration:
    """Calibrate to the presses at unknown places of one day.

    `last` is the calibration to the days before, or None if there is no earlier day. If the skin slides as on the last
    of these days, the presses of both days are treated as presses of one day. Otherwise, the earlier presses determine
    only those properties of the skin that do not change from day to day.
    """
    if last is not None:
        pressed_uT = np.concatenate([data.presses_uT, data.labels.db_uT])
        data, last = join_day(data, last, same=is_same_slide(last.same_slide_log_odds(pressed_uT)))
    return PressCalibration(condition_on_unlabelled(start_day(noload_map, last), data), networks, data, last)


def join_day(
    data: CalibrationData, last: PressCalibration | None, *, same: bool
) -> tuple[CalibrationData, PressCalibration | None]:
    """Return the data since the last change of the slide, and the calibration to the days before this change.

    `data` are the data of the current day, and `last` is the calibration to the days before it. If `same` is True, the
    skin slides on the current day as on the last day, so the data of these two days are joined.
    """
    return (data.joined_to(last.data), last.earlier) if same and last is not None else (data, last)


def start_day(noload_map: SkinMap, earlier: PressCalibration | None) -> SkinMap:
    """Return the map with which a period after a change of the slide begins.

    The map is not yet conditioned on the presses of this period. If there are earlier days, it contains what their
    presses tell about the constant properties of the skin.
    """
    return noload_map if earlier is None else begin_day(earlier.skin)


def is_same_slide(log_odds: Float[np.ndarray, " n"]) -> bool:
    """Return whether the skin is assumed to slide as on the last day.

    `log_odds` contains the log odds from each press (`PressCalibration.same_slide_log_odds`). Their sum is compared
    with `SAME_SLIDE_LOG_ODDS_MIN`.
    """
    return float(log_odds.sum()) >= SAME_SLIDE_LOG_ODDS_MIN


class Slide(NamedTuple):
    """Comparison of how the skin slides under presses today and on the last day of its calibration.

    `same` is True if the skin is assumed to slide as on that day. `log_odds` are the log odds for this.
    """

    same: bool
    log_odds: float


def has_few(labels: LabelledPresses) -> bool:
    """Return whether some forces are known, but too few to condition the map on them."""
    return 0 < int(labels.known.sum()) < FEW_N


@dataclass(frozen=True)
class PriorModel:
    """Map and networks before they are calibrated to any skin."""

    skin: SkinMap
    networks: Sequence[Weights]

    __repr__ = one_line

    def calibrate(self, data: CalibrationData) -> PressCalibration:
        """Calibrate to the no-load field and the unlabelled presses of a skin.

        The labels in `data` are not used here. `PressCalibration.with_labels` adds them to the result.
        """
        noload_map = condition_on_noload(self.skin, data.rest_uT)
        return PressCalibration(condition_on_unlabelled(noload_map, data), self.networks, data)


def condition_on_unlabelled(noload_map: SkinMap, data: CalibrationData) -> SkinMap:
    """Condition a map on presses at unknown places.

    If the data contain presses that are spread evenly over the skin, the mean of their places is the centre of the
    skin. The map is then also conditioned on this.
    """
    skin = noload_map
    if len(data.presses_uT):
        skin = condition_on_presses(skin, data.presses_uT)
    if len(data.even_uT):
        skin = condition_on_even_presses(skin, data.even_uT)
    return skin


def network_offsets_mm(
    centre_mm: Float[np.ndarray, "2"], estimated_mm: Float[np.ndarray, "m 2"], place_mm: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return two corrections that are to be added to the places that the networks estimate.

    The first correction is the shift `centre_mm`, which was estimated from unlabelled presses, divided by a number that
    grows with the number of labels. The second correction is computed from the labelled presses, whose estimated and
    true places are `estimated_mm` and `place_mm`. It is the mean error that the first correction leaves, shrunk towards
    zero by a Gaussian prior.
    """
    centre_mm = centre_mm / (1 + FADES_PER_LABEL * len(place_mm))
    off_mm = place_mm - (estimated_mm + centre_mm)
    return centre_mm, off_mm.sum(axis=0) / (len(off_mm) + (LABEL_SD_MM / OFFSET_SD_MM) ** 2)


@dataclass
class Universal:
    """The universal model for the board of one layout. It can be calibrated to a skin during use.

    First call `zero` with readings without contact. Then call `see` with presses at unknown places and `label` with
    presses at known places, in any order and any number of times. Each of these three methods changes the model in
    place and returns it. `predict` works at any time after `zero`. Fields are in uT along the chips' axes. Do not
    calibrate a model in one thread while another thread uses it.

    Parameters
    ----------
    tables : tables of simulated fields, which are the prior of the map
    networks : weights of each network
    powers : likelihood powers, tabulated by the number of presses and the number of labels
    layout : the board and the skin that the model was made for
    card : model card, which states how the model was trained and what it must not be used for
    external_uT : expected size of external fields (see `load_universal`)
    residual : predicted errors of the law, for a model that was made with other boards of the same rig; otherwise None
    """

    tables: Tables
    networks: Sequence[Weights]
    powers: LikelihoodPowers
    layout: BoardLayout = field(default_factory=paper_layout)
    card: Mapping[str, Any] = field(default_factory=dict)
    external_uT: float = 0.0
    residual: Residual | None = None

    def __post_init__(self) -> None:
        """Start without any calibration data; raise SchemaError if `external_uT` is out of range."""
        if not 0 <= self.external_uT <= EXTERNAL_MAX_uT:
            rule = f"0 to {EXTERNAL_MAX_uT:,.0f} uT"
            remedy = "Pass the expected change of the external field, for example 30 uT for the earth's field."
            raise SchemaError("universal model", "external_uT", rule, self.external_uT, remedy)
        self._noload_uT: np.ndarray | None = None
        self._turned_given = False  # whether the user stated the orientation of the skin
        # If a saved calibration was loaded, this is the no-load reading in its file.
        self._saved_uT: Float[np.ndarray, " ch"] | None = None
        self._centre_mm = np.array(self.layout.centre_mm)
        # Matrix that converts readings along the chips' axes to the board's axes. Each estimate needs it.
        self._board_from_chips = self.layout.to_board(np.eye(self.channels_n))
        self._prior_map = new_map(self.tables, self.residual, self.external_cov)
        self._noload_map: SkinMap
        self._data: CalibrationData
        # `_last` is the calibration to the earlier days. For each press of the current day, `_press_odds` (presses at
        # unknown places) and `_label_odds` (labelled presses) are the log odds that the skin slides as on the last day.
        # `_same_slide` tells whether the skin is assumed to slide as on the last day.
        self._last: PressCalibration | None
        self._press_odds: np.ndarray
        self._label_odds: np.ndarray
        self._same_slide: bool
        self._misfits: np.ndarray  # misfit of each unlabelled press
        self._calibration: PressCalibration
        self._model: CalibratedModel
        # The following three, which require cross-validation if there are labels, are None until they are needed.
        self._folds: list[HeldOutLabels] | None
        self._power: float | None
        self._calibrated: CalibratedModel | None
        self._restart(self._prior_map, CalibrationData.at_rest(self.tables.rest_uT))

    def __repr__(self) -> str:
        noload = "no no-load reading" if self._noload_uT is None else "no-load reading taken"
        noload += ", skin turned by a quarter" if self._data.turned else ""
        noload += f", earlier days: {len(self._data.earlier)}" if self._data.earlier else ""
        presses_n, labels_n = len(self._data.presses_uT), len(self._data.labels)
        board = f"board {self.layout.name}, {len(self.layout.chips)} chips"
        return (
            f"Universal({board}, trained on simulated skins, {noload}, "
            f"{presses_n} presses at unknown places, {labels_n} labelled"
            f"{f', external fields of {self.external_uT:g} uT' if self.external_uT else ''})"
        )

    @property
    def channels_n(self) -> int:
        """Number of values in one reading, which has three values per chip."""
        return self.layout.channels_n

    @property
    def skin(self) -> SkinMap:
        """The map, conditioned on all calibration data."""
        return self._model.skin

    @property
    def calibrated(self) -> CalibratedModel:
        """Map and networks, conditioned on all calibration data, in the board's frame."""
        calibrated = self._calibrated
        if calibrated is None:
            labels = [day for day, _ in self._calibration.labels_by_day(self._calibration.data.labels)]
            earlier = self._calibration.held_out_earlier(has_few(reduce(join_labels, labels)))
            calibrated = replace(self._model, line=line_of_labels([*self._held_out(), *earlier]))
            self._calibrated = calibrated
        return calibrated

    @property
    def external_cov(self) -> Float[np.ndarray, "ch ch"] | None:
        """Covariance of external fields along the board's axes; None if no external fields are expected."""
        return external.covariance(self.layout.chips_mm, self.external_uT) if self.external_uT else None

    def suppressor(self, noise_uT: float) -> Float[np.ndarray, "ch ch"] | None:
        """Return a matrix that shrinks the external fields in readings to the size of noise.

        Multiply field changes along the chips' axes (one per row) by this matrix to detect contacts. The magnitude |dB|
        alone is not sufficient, because an external field can make it as large as a contact does. After the
        multiplication, the part of an external field is as small as the noise. The result is None if `external_uT` is
        0.
        """
        cov = self.external_cov
        return None if cov is None else self._board_from_chips @ external.suppressor(cov, noise_uT)

    @property
    def noload_uT(self) -> Float[np.ndarray, " ch"]:
        """The baseline, which is the no-load field that is subtracted from readings, along the chips' axes.

        Raises SchemaError if `zero` has not been called yet.
        """
        if self._noload_uT is None:
            raise SchemaError("the model has no no-load reading. First call zero with readings without contact.")
        return self._noload_uT

    @property
    def zeroed(self) -> bool:
        """Whether the model has a no-load reading, from a call of `zero` or from a saved calibration."""
        return self._noload_uT is not None

    @property
    def turnable(self) -> bool:
        """Whether a quarter turn of the skin reverses the sign of its fields.

        This is so for a square skin that is magnetised as a checkerboard with an even number of cubes along each side.
        """
        side_x_mm, side_y_mm = self.layout.skin.size_mm
        even = side_x_mm == side_y_mm and cubes_along(side_x_mm * milli) % 2 == 0
        return self.layout.skin.polarity == "checkerboard" and even

    @property
    def mounting(self) -> Mounting:
        """The orientation of the skin on the board, and the log odds of this orientation.

        Raises SchemaError if `zero` has not been called yet.
        """
        if not self.zeroed:
            raise SchemaError(
                "mounting: the model has no no-load reading. First call zero with readings without contact."
            )
        rest_uT, turned = self._data.rest_uT, self._data.turned
        return find_mounting(self.tables, -rest_uT if turned else rest_uT, turned=turned)

    @property
    def label_frame(self) -> LabelFrame | None:
        """The best alternative to the orientation of the labels' axes that the user has given.

        If the user has turned or mirrored the axes by mistake, the labelled places fit the estimated places better in
        another orientation. This is the most probable of the other orientations, with its log odds. It is determined
        from the labels of the current day, and is None if there are fewer than `LABELS_MIN_N` of them. The axes of
        earlier days' labels are assumed to be right.
        """
        labels, data = self._data.labels, self._calibration.data
        if len(labels) < LABELS_MIN_N:
            return None
        # If the slide has not changed since the last day, `data` contains the labels of earlier days, followed by those
        # of the current day.
        earlier = data.labels[: len(data.labels) - len(labels)]
        power = self.powers.power_for(len(data.presses_uT), len(earlier), even=len(data.even_uT) > 0)
        without_current = self._calibration.with_labels(earlier)
        return find_label_frame(without_current.estimate(labels.db_uT, [power])[0], labels.place_mm)

    @property
    def warnings(self) -> list[str]:
        """Warnings about a wrong unit, another skin, or a wrong orientation of the skin or of the labels."""
        if not self.zeroed:
            return []
        usual_uT = float(np.median(np.linalg.norm(self.noload_uT.reshape(-1, 3), axis=1)))
        if usual_uT < WEAKEST_uT:
            return [
                f"the no-load field is weaker than the earth's field: its median over the chips is {usual_uT:.3g} uT. "
                "Convert readings in mT or G to uT, and do not subtract the no-load reading from them."
            ]
        found = self.mounting.warnings(turnable=self.turnable)
        if self._saved_uT is not None:
            changed = float(np.linalg.norm(self.noload_uT - self._saved_uT) / np.linalg.norm(self._saved_uT))
            if changed > OTHER_SKIN_MIN:
                found.append(
                    f"the no-load field differs by {changed:.0%} from the no-load field in the saved calibration. If "
                    "this is another skin, load the calibration of this skin, or calibrate the model without a saved "
                    "one."
                )
        frame = self.label_frame
        of_labels = None if frame is None else frame.warning()
        return [*found, *([of_labels] if of_labels else [])]

    @property
    def reach_mm(self) -> Float[np.ndarray, "2 2"]:
        """The edges of the skin in the frame of the labels.

        The first row contains the smallest x and y, the second row the largest x and y.
        """
        return self._centre_mm + self.layout.reach_mm

    @property
    def presses_n(self) -> int:
        """Number of presses to which the model is calibrated: labelled or not, on all days."""
        return self._data.presses_n

    @property
    def slide(self) -> Slide | None:
        """Whether presses of the current day show that the skin slides as on the last day of the calibration.

        None if the calibration has no earlier day.
        """
        if self._last is None:
            return None
        return Slide(self._same_slide, float(self._press_odds.sum() + self._label_odds.sum()))

    @property
    def labels_n(self) -> int:
        """Number of labelled presses to which the model is calibrated, on all days."""
        return self._data.labels_n

    @property
    def misfit(self) -> float:
        """Median of the misfits (chi^2 per channel) of the unlabelled presses.

        The misfit is about 1 if the skin is like the skins in training, and larger otherwise. If there are too few
        presses to determine it, this property is 1.
        """
        return float(np.median(self._misfits)) if self.powers.are_enough(len(self._misfits)) else 1.0

    @property
    def power(self) -> float:
        """The likelihood power for this skin, which determines how large the standard deviations of places are.

        With a power of 1, map and networks are trusted fully. With a smaller power, standard deviations are larger. The
        model card gives a power for each number of presses and labels. This power is divided by `misfit` and, if there
        are labels, by their variance inflation (see `variance_inflations`). It is reduced further if external fields
        are expected.
        """
        if self._power is None:
            data = self._calibration.data
            tabulated = self.powers.power_for(len(data.presses_uT), len(data.labels), even=len(data.even_uT) > 0)
            power = lower_by_misfit(tabulated, self.misfit)
            if len(data.labels):
                power = lower_by_residuals(power, *self.variance_inflations([power]))
            if self.external_uT:
                power /= 1 + self.external_uT / (POWER_uT + POWER_PER_LABEL_uT * len(data.labels))
            self._power = power
        return self._power

    @property
    def line(self) -> ForceLine:
        """The line that calibrates the forces, fitted to the labelled presses whose force is known."""
        return self.calibrated.line

    def zero(self, b_uT: Float[np.ndarray, "*f ch"], *, keep: bool = False, turned: bool | None = None) -> "Universal":
        """Set the no-load field to the mean of readings without contact, and condition the map on this field.

        The model is changed in place and returned.

        Parameters
        ----------
        b_uT : readings without contact
        keep : whether presses from earlier calls of `see` and `label` are kept. By default, they are discarded. Set
            `keep` to correct the drift of a skin to which the model is already calibrated.
        turned : whether the skin is turned by 90°. If this is None, the orientation is determined from the no-load
            field (see `mounting`), unless presses are kept, whose orientation is then kept as well.

        Raises
        ------
        SchemaError : there is no reading, or a reading is not finite, is out of range, or has the wrong number of
            values; `turned` is True, but a quarter turn does not reverse the fields of the layout's skin; or `keep` is
            True, and `turned` contradicts the earlier calibration
        """
        noload_uT = check_readings(b_uT, self.channels_n)
        if not len(noload_uT):
            raise SchemaError("zero: the array of readings is empty. Pass readings that were taken without contact.")
        if turned and not self.turnable:
            problem = f"a quarter turn does not reverse the fields of skin {self.layout.name}"
            raise SchemaError(f"zero: {problem}. Call zero without the argument `turned`.")
        kept = keep and self.zeroed
        # If there are presses to keep, or the user has stated the orientation, the orientation must stay the same.
        # Otherwise, this may be another skin, whose orientation is determined again.
        bound = kept and (self.presses_n > 0 or self._turned_given)
        if bound and turned not in (None, self._data.turned):
            raise SchemaError(
                "zero: the calibration to keep is of a skin in the other orientation. To keep it, omit the argument "
                "`turned`; to start a new calibration, omit `keep`."
            )
        noload_uT = noload_uT.mean(axis=0)
        rest_uT = self.layout.to_board(noload_uT[None])[0]
        self._turned_given = turned is not None or (kept and self._turned_given)
        self._saved_uT = self._saved_uT if kept else None
        if turned is None:
            found = self.turnable and find_mounting(self.tables, rest_uT).turned
            turned = self._data.turned if bound else found
        self._noload_uT, rest_uT = noload_uT, -rest_uT if turned else rest_uT
        data = replace(self._data if kept else CalibrationData.at_rest(rest_uT), rest_uT=rest_uT, turned=bool(turned))
        return self._restart(condition_on_noload(self._prior_map, rest_uT), data)

    def see(self, b_uT: Float[np.ndarray, "*n ch"], *, even: bool = False, area: bool = False) -> "Universal":
        """Calibrate to presses at unknown places, given as one reading per press.

        Use dozens of presses all over the skin, in one or several calls. The first call makes several rounds of
        expectation maximisation with its presses. Each later call makes one round. The model is changed in place and
        returned.

        Parameters
        ----------
        b_uT : fields as the board sends them. They are not field changes, because this method subtracts the no-load
            reading.
        even : set this if these and all earlier presses together are evenly spread over the skin, for example on a grid
            with one press per place. The mean of their places is then assumed to be the centre of the skin.
        area : set this if these and all earlier presses are at random places all over the layout's area of presses. For
            the paper's board, this area is an octagon 16 mm wide. Estimated places are then moved onto this area.
        """
        if even and area:
            raise SchemaError(
                "see: presses are either evenly spread or at random places. Set only one of `even` and `area`."
            )
        db_uT, data = self._check_change("see", check_readings(b_uT, self.channels_n)), self._data
        if not len(db_uT):
            return self
        presses_uT, none = np.concatenate([data.presses_uT, db_uT])[-FULL_SET_N:], no_presses(self.channels_n)
        if even or area:
            even_uT, area_uT = (presses_uT, none) if even else (none, presses_uT)
            return self._begin(replace(data, presses_uT=presses_uT, even_uT=even_uT, area_uT=area_uT))
        data = replace(data, presses_uT=presses_uT, area_uT=none)
        press_odds = np.concatenate([self._press_odds, self._log_odds(db_uT)])[-FULL_SET_N:]
        if self._decide(press_odds, self._label_odds) != self._same_slide:
            return self._begin(data)
        self._press_odds = press_odds
        rounds_n = 1 if len(self._calibration.data.presses_uT) else ROUNDS_N
        press_map = condition_on_presses(self._calibration.skin, db_uT, rounds_n)
        self._misfits = np.concatenate([self._misfits, np.full(len(db_uT), np.nan)])[-FULL_SET_N:]
        return self._set(press_map, data)

    def label(
        self,
        place_mm: Float[np.ndarray, "*m 2"] | Sequence[Any],
        force_N: Float[np.ndarray, "*m"] | Sequence[float] | float | None,
        b_uT: Float[np.ndarray, "*m ch"],
        *,
        keep: bool = False,
    ) -> "Universal":
        """Calibrate to one or several labelled presses, which have known places and known forces.

        A single press of known force, such as a weight on the middle of the skin, calibrates the forces of the whole
        skin. The model is changed in place and returned.

        Parameters
        ----------
        place_mm : places of the presses in the frame of the labels
        force_N : forces of the presses, or None if only the places are known
        b_uT : fields as the board sends them, one reading per press
        keep : whether earlier labels of the same day are kept. By default, they are discarded.

        Raises
        ------
        SchemaError : `zero` was not called; no field change exceeds the noise; a place is outside the skin; a force is
            not above 0 N; a force is outside the model's range by a factor of 2 or more; or there are too many labels.
            The model is not changed if this error is raised.
        """
        readings_uT = check_readings(b_uT, self.channels_n)
        known = force_N is not None
        if force_N is None:
            force_N = np.clip(self.estimate(readings_uT).force_N, *self.tables.force_N[[0, -1]])
        places_mm, forces_N = check_labels(
            np.asarray(place_mm, float),
            np.asarray(force_N, float),
            len(readings_uT),
            self.reach_mm,
        )
        check_range(forces_N, self.tables.force_N)
        db_uT, before = self._check_change("label", readings_uT), self._data.labels
        labels = LabelledPresses(places_mm - self._centre_mm, forces_N, db_uT, np.full(len(forces_N), known))
        if keep:
            labels = join_labels(before, labels)
        data = replace(self._data, labels=labels)
        check_number(data.labels_n)
        label_odds = self._log_odds(labels.db_uT)
        if self._decide(self._press_odds, label_odds) != self._same_slide:
            return self._begin(data)
        self._label_odds, press_map = label_odds, self._calibration.skin
        if len(before):  # use all unlabelled presses again, so that the order of `see` and `label` does not matter
            joined, earlier = join_day(data, self._last, same=self._same_slide)
            press_map = condition_on_unlabelled(start_day(self._noload_map, earlier), joined)
        return self._set(press_map, data)

    def next_place(self, force_N: float = 2.0) -> Float[np.ndarray, "2"]:
        """Return the place in mm at which the next labelled press should be made.

        This is the place at which a press with about this force would reduce the uncertainty about the whole skin most.

        Raises
        ------
        SchemaError : the force is not finite or not above 0 N
        """
        if not (np.isfinite(force_N) and force_N > 0):
            raise SchemaError("next_place", "the force", "finite and above 0 N", force_N, "Try: 2.0")
        place_mm = self.skin.hypotheses.place_mm[::CHOICE_EVERY_N]
        gain = expected_gain(self.skin, place_mm, np.full(len(place_mm), force_N))
        return place_mm[gain.argmax()] + self._centre_mm

    def predict(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and the normal force in N for readings in contact."""
        estimate = self.estimate(b_uT)
        return np.column_stack([estimate.place_mm, estimate.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "*f ch"]) -> Estimate:
        """Estimate places and forces with their standard deviations, and misfits.

        Misfits far above 1 mean that the skin is unlike the skins on which the model was trained.
        """
        return self.estimates(b_uT, [self.power])[0]

    def estimates(self, b_uT: Float[np.ndarray, "*f ch"], powers: Sequence[float]) -> list[Estimate]:
        """Return one estimate of all readings for each likelihood power.

        The estimates differ only in the standard deviations of places.
        """
        estimates = self.calibrated.estimate(self._change(b_uT), powers)
        return [replace(estimate, place_mm=estimate.place_mm + self._centre_mm) for estimate in estimates]

    def variance_inflations(self, powers: Sequence[float]) -> list[float]:
        """Estimate the variance inflation for each likelihood power by cross-validation over the labelled presses.

        A likelihood power is the exponent to which the likelihoods of map and networks are raised. The variance
        inflation is the factor by which the variances of the places must be multiplied to match the errors of the
        labelled presses that were held out.
        """
        folds = [
            ([fold.evaluation.combined(power) for power in powers], fold.labels.place_mm) for fold in self._held_out()
        ]
        return variance_inflations(len(powers), folds)

    def _held_out(self) -> list[HeldOutLabels]:
        if self._folds is None:  # cross-validation is slow, so it runs only when needed, and once per set of labels
            self._folds = list(self._calibration.held_out(self._calibration.data.labels))
        return self._folds

    def save(self, file: Path | str) -> None:
        """Write this skin's calibration data to a file; `load_universal(file)` restores the calibrated model from it.

        Raises SchemaError if `zero` was not called before, because the model then has no no-load reading.
        """
        if self._noload_uT is None:
            raise SchemaError("save: the model has no no-load reading. First call zero with readings without contact.")
        write_calibration(self._data, Path(file), self.layout.name)

    def export_onnx(self, file: Path | str, quiet_uT: Float[np.ndarray, "*f ch"] | None = None) -> None:
        """Write the calibrated model as an ONNX file, so that programs without Python can use it (docs/robots.md).

        The input `db_uT` contains changes of the field since the no-load reading, along the axes of the chips, with
        shape [f, ch] and in double precision. There is one output for each attribute of an `Estimate`, and the output
        `change_uT`, which is the magnitude of the change, |dB|. If `quiet_uT` is given, there is also the output
        `contact`. quiet_uT: readings without contact. Their noise determines the threshold above which a reading
        counts as contact, as in `reskin.open`. This method requires the package onnx. It raises SchemaError if `zero`
        was not called before.
        """
        from reskin.universal import export

        export.write_onnx(export.skin_function(self, quiet_uT), Path(file))

    def export_c(self, file: Path | str, quiet_uT: Float[np.ndarray, "*f ch"] | None = None) -> None:
        """Write the calibrated model as C99 code for programs without Python (docs/robots.md).

        The code is a header file without dependencies, such as `skin.h`. Inputs, outputs and `quiet_uT` are those of
        `export_onnx`. Raises SchemaError if `zero` was not called before.
        """
        from reskin.universal import export

        export.write_c(export.skin_function(self, quiet_uT), Path(file))

    def remember(self, file: Path | str, *, new_day: bool = False) -> "Universal":
        """Replace all calibration data by those in a file that `save` wrote.

        Afterwards, call `zero(b_uT, keep=True)` with new readings without contact, to correct the drift since the file
        was written. `new_day` has the same meaning as in `load_universal`.
        """
        data = read_calibration(Path(file), self.layout.reach_mm, self.channels_n, self.layout.name)
        if data.turned and not self.turnable:
            rule = f"false, because a quarter turn does not reverse the fields of skin {self.layout.name}"
            raise SchemaError(file, "turned", rule, "true", "Calibrate the skin again.")
        self._noload_uT = (-1 if data.turned else 1) * self.layout.to_chips(data.rest_uT[None])[0]
        self._saved_uT = self._noload_uT
        return self._restart(condition_on_noload(self._prior_map, data.rest_uT), data.next_day() if new_day else data)

    def __call__(self, db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and force_N from field changes.

        The project's trained networks can be called in the same way.
        """
        return self.predict(check_shape(db_uT, self.channels_n) + self.noload_uT).astype(np.float32)

    def _change(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f ch"]:
        """Subtract the no-load reading from readings, and return the field changes along the board's axes.

        Raises SchemaError if `zero` has not been called yet.
        """
        db_uT = (check_shape(b_uT, self.channels_n) - self.noload_uT) @ self._board_from_chips
        return -db_uT if self._data.turned else db_uT

    def _check_change(self, where: str, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f ch"]:
        """Return the field changes of presses along the board's axes.

        Raises SchemaError if the values are probably in another unit, or if they are field changes instead of readings.
        `where` is the name of the calling method, for the error message.
        """
        db_uT = check_presses(self._change(b_uT))
        check_is_reading(where, np.atleast_2d(b_uT), self.noload_uT)
        return db_uT

    def _restart(self, noload_map: SkinMap, data: CalibrationData) -> "Universal":
        """Calibrate to all days from scratch.

        `noload_map` is a map that is conditioned on the no-load field only.
        """
        self._noload_map, self._last = noload_map, None
        for day in data.earlier:
            self._last = calibrate_day(noload_map, self.networks, day, self._last)
        return self._begin(data)

    def _begin(self, data: CalibrationData) -> "Universal":
        """Calibrate to the current day from scratch, starting from the calibration to the earlier days."""
        self._press_odds, self._label_odds = self._log_odds(data.presses_uT), self._log_odds(data.labels.db_uT)
        self._same_slide = self._decide(self._press_odds, self._label_odds)
        joined, earlier = join_day(data, self._last, same=self._same_slide)
        self._misfits = np.full(len(joined.presses_uT), np.nan)
        return self._set(condition_on_unlabelled(start_day(self._noload_map, earlier), joined), data)

    def _log_odds(self, db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, " n"]:
        return np.zeros(len(db_uT)) if self._last is None else self._last.same_slide_log_odds(db_uT)

    def _decide(self, press_odds: Float[np.ndarray, " n"], label_odds: Float[np.ndarray, " m"]) -> bool:
        """Return whether the skin is assumed to slide as on the last day, from the log odds of today's presses."""
        return self._last is not None and is_same_slide(np.concatenate([press_odds, label_odds]))

    def _set(self, press_map: SkinMap, data: CalibrationData) -> "Universal":
        """Replace the calibration; `press_map` is conditioned on all data except the labels, which are added here."""
        joined, earlier = join_day(data, self._last, same=self._same_slide)
        missing = np.isnan(self._misfits)
        if missing.any():  # the misfit of a press is computed only once, with the first map that is conditioned on it
            self._misfits[missing] = press_map.evaluator.evaluate(joined.presses_uT[missing]).misfit()
        self._data = data
        self._calibration = PressCalibration(press_map, self.networks, joined, earlier)
        self._model = self._calibration.with_labels(joined.labels).with_offsets_in_biases()
        self._folds = self._power = self._calibrated = None
        return self


def load_universal(
    calibration: Path | str | None = None,
    *,
    file: Path | str = FILE,
    external_uT: float = 0.0,
    new_day: bool = False,
) -> Universal:
    """Load a universal model and, if a calibration is given, calibrate it to the skin of this calibration.

    Parameters
    ----------
    calibration : file that `Universal.save` wrote. If it is None, the model is not calibrated to any skin.
    file : file of a model that `reskin model make` wrote. By default, this is the model for the paper's board, which
        comes with the project.
    external_uT : for a skin on a moving robot, the expected change of the external field since the no-load reading,
        given as the standard deviation of each component. Use about 30 for the earth's field, and 100 or more if other
        skins or magnets move nearby. Each reading is then assumed to contain an unknown external field that is nearly
        uniform over the board (`reskin.physics.external`). With 0, no external field is expected. If there is indeed
        none, estimates are more accurate with 0.
    new_day : set this if the skin may slide under presses in another way than when the calibration was saved, for
        example because it was saved on an earlier day. New presses are then compared with those of the calibration (see
        `Universal.slide`). If the skin slides in the same way, all presses are used together. If it does not, the
        earlier presses are used only for the constant properties of the skin. Until there are new presses, the skin is
        assumed to slide in another way.

    Raises
    ------
    SchemaError : a file is damaged, `external_uT` is not from 0 to `EXTERNAL_MAX_uT`, or `new_day` is set without a
        calibration
    """
    tables, networks, powers, layout, card, residual = _read_parts(Path(file))
    model = Universal(tables, networks, powers, layout, card, external_uT, residual)
    if calibration is not None:
        return model.remember(calibration, new_day=new_day)
    if new_day:
        raise SchemaError(
            "new_day: there is no calibration of an earlier day. Pass a file with a saved calibration, or omit new_day."
        )
    return model


def is_model(file: Path) -> bool:
    """Return whether a file is a universal model, according to its model card.

    The model card is the JSON file of the same name. The result is False if there is no model card.
    """
    card_file = file.with_suffix(".json")
    if file.suffix != FILE.suffix or not card_file.is_file():
        return False
    return _format_of(io.read_json(card_file)).startswith(FORMAT.rpartition("-")[0])


def _format_of(card: Any) -> str:
    return str(card.get("format")) if isinstance(card, dict) else "none"


@lru_cache(maxsize=2)
def _read_parts(
    file: Path,
) -> tuple[Tables, Sequence[Weights], LikelihoodPowers, BoardLayout, Mapping[str, Any], Residual | None]:
    card_file = file.with_suffix(".json")
    if file.is_file() and not card_file.is_file():
        problem = f"{file}: its model card {card_file.name} is missing. Copy the card to the same folder"
        raise SchemaError(f"{problem}. If this file is a saved calibration, pass it as `calibration`, not as `file`.")
    card = io.read_json(card_file)
    form = _format_of(card)
    if form not in (FORMAT, FORMAT_3):
        remedy = (
            "Use a model that was made with this version of reskin, or make the model again with `reskin model make`."
        )
        raise SchemaError(card_file, "format", FORMAT, form, remedy)
    parts, _ = io.read_tensors(file, digest_needed=True)
    map_arrays = {
        field.name: parts.pop(field.name).astype(float) for field in fields(Tables) if field.name not in UNSTORED
    }
    of_residual = {name: parts.pop(key) for name in RESIDUAL if (key := f"residual.{name}") in parts}
    residual = None
    if of_residual:
        noise = float(of_residual.pop("noise").item())
        residual = Residual(**{name: values.astype(float) for name, values in of_residual.items()}, noise=noise)
    layout = as_layout(card["layout"], f"{card_file}: layout")
    tables = Tables(names=tuple(card["spreads"]), **map_arrays, area=layout.places)
    if len(tables.rest_uT) != layout.channels_n:
        chips_n, remedy = len(tables.rest_uT) // 3, "Use the card that was written with the model."
        raise SchemaError(card_file, "layout", f"of {chips_n} chips", f"{len(layout.chips)} chips", remedy)
    powers = LikelihoodPowers.from_card(card["sureness" if form == FORMAT_3 else "likelihood_powers"])
    return tables, network.from_tensors(parts), powers, layout, card, residual


def write(
    tables: Tables,
    networks: Sequence[Weights],
    powers: LikelihoodPowers,
    layout: BoardLayout,
    about: Mapping[str, Any],
    file: Path = FILE,
    residual: Residual | None = None,
) -> None:
    """Write a universal model to a file, and its model card to a JSON file of the same name.

    The model file contains the prior of the map (in single precision), the networks and, if it is given, the residual,
    which predicts errors of the law (in single precision). The card contains the items of
    `about`, the layout, the likelihood powers, and the spreads of the parameters.
    """
    names = [field.name for field in fields(tables) if field.name not in UNSTORED]
    map_arrays = {name: getattr(tables, name).astype(np.float32) for name in names}
    if residual is not None:
        map_arrays |= {f"residual.{name}": np.asarray(getattr(residual, name), np.float32) for name in RESIDUAL}
    io.write_tensors(file, map_arrays | network.to_tensors(networks), {})
    spreads = dict(zip(tables.names, tables.spreads.tolist(), strict=True))
    own = layout.model_dump(mode="json")
    card = {"format": FORMAT, **about, "layout": own, "likelihood_powers": powers.to_card(), "spreads": spreads}
    io.write_json(file.with_suffix(".json"), card)
