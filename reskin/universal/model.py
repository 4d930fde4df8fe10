"""The universal model: it estimates places and forces on a skin for which it was not trained.

A network (`reskin.universal.network`) reads the skin from what is known of it: its no-load field, presses at unknown
places, and labelled presses. `Calibrated` is the network with the context of one skin, in the frame and the axes of the
board. `Universal` is the class for users. It is made for the board of one layout (`reskin.universal.layout`), and takes
readings along the axes of the chips. Its places are in the frame of the labels, in which the centre of the board is at
the layout's `centre_mm`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from reskin import io
from reskin.data.contact import contact_threshold_uT
from reskin.display import one_line
from reskin.errors import SchemaError, require
from reskin.physics import external
from reskin.recordings.units import WEAKEST_uT
from reskin.universal import network
from reskin.universal.calibration import (
    QUIET_MIN_N,
    LabelledPresses,
    NOISE_uT,
    SkinData,
    check_chips,
    check_is_reading,
    check_labels,
    check_presses,
    check_quiet,
    check_readings,
    check_shape,
    read_skin_file,
    silent_chips,
    write_skin,
)
from reskin.universal.force import NORMAL_90, ForceHead, conformal
from reskin.universal.layout import BoardLayout, as_layout, paper_layout
from reskin.universal.likeness import PRESSES_MIN_N, Likeness
from reskin.universal.network import Context, Normals, Weights

# File of the model that comes with the project. Its model card, which describes the model, is universal.json.
FILE = Path(__file__).with_name("universal.safetensors")
FORMAT = "reskin-universal-5"
KIND = FORMAT.rpartition("-")[0]
CONTEXT_LABELS_N = 100  # labels in the context, at most; more of them are thinned out evenly
FOLDS_N = 10  # folds of the cross-validation over labels
INTERVAL_MIN_N = 5  # with fewer labels, the widths of intervals of places come from simulated skins
INTERVAL_FORCES_MIN_N = (
    9  # the same for forces; 90 % intervals need nine errors, because the largest of n holds for n / (n + 1)
)
# Labels may be in cm or m if their estimates span more than this multiple of their span.
OTHER_UNIT_SPAN = 5.0
REFINE_MIN_N = 20  # labels from which on a refinement is offered
# If the no-load field differs from that of the saved skin by more than this fraction, a warning says that this may be
# another skin. In scene lab, recordings of one board differ by at most 5 %, and those of different boards by 65 %.
OTHER_SKIN_MIN = 0.25
LABELS_MIN_N = 5  # with fewer labels, it is not checked whether they contradict the estimates
EXTERNAL_MAX_uT = 1000.0  # largest allowed external field
WEIGHTS, LIKENESS = "network.", "likeness."  # prefixes of the arrays in the file of a model
MISFIT_MAX = 1.0  # readings with a larger misfit are unlike those of simulated skins


@dataclass(frozen=True)
class Estimate:
    """Places and forces of readings, with standard deviations.

    An interval of plus or minus 1.645 standard deviations is meant to contain the true value in 90 % of the readings. A
    reading is not usable, and its values are NaN, if a value is missing or a chip does not answer.
    """

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    sd_N: Float[np.ndarray, " n"]
    usable: Bool[np.ndarray, " n"]
    contact: Bool[np.ndarray, " n"] | None = None  # whether anything touches the skin; None if the noise is unknown

    __repr__ = one_line


@dataclass(frozen=True)
class References:
    """What the errors of a model are on simulated skins: factors of standard deviations, and a limit for labels.

    Parameters
    ----------
    sd_mm, sd_log_N : factors by which the standard deviations of the network are multiplied without labels
    labels_mm : largest median distance between labelled places and estimates without labels, on 99.5 % of the skins
    """

    sd_mm: float = 1.0
    sd_log_N: float = 1.0
    labels_mm: float = 4.0


@dataclass(frozen=True)
class Calibrated:
    """The network with what is known of one skin, in the frame and the axes of the board.

    If the network was refined with labels of the skin, the refined network estimates places. What is compared with the
    labels still comes from the network that does not know them: standard deviations, and forces with their correction.
    """

    weights: Weights
    compiled: network.Compiled
    data: SkinData
    references: References
    external_uT: float = 0.0
    judged: "Judge | None" = None  # the result of an earlier comparison with the same labels, which is used again

    __repr__ = one_line

    @cached_property
    def context(self) -> Context:
        """What the network knows of the skin, with all labels."""
        return self._read(thin(self.data.labels, CONTEXT_LABELS_N))

    @cached_property
    def unlabelled_context(self) -> Context:
        """What the network knows of the skin without its labels."""
        return self._read(self.data.labels[:0])

    @cached_property
    def refined(self) -> "Calibrated | None":
        """The refined network with the skin; None if there is none."""
        if not (weights := self.data.refined):
            return None
        data = replace(self.data, refined={})
        return replace(self, weights=weights, compiled=network.compile_weights(weights), data=data)

    @cached_property
    def judge(self) -> "Judge":
        """Widths of intervals, and the correction of forces."""
        return self.judged or Judge.of(self)

    def estimate(self, db_uT: Float[np.ndarray, "n ch"]) -> Estimate:
        """Estimate places and forces from field changes."""
        found, judge = network.estimate(self.compiled, self.context, db_uT), self.judge
        force_N, sd_N = judge.forces(found, db_uT)
        place_mm, refined = found.place_mm, self.refined
        if refined is not None:
            place_mm = network.estimate(refined.compiled, refined.context, db_uT).place_mm
        return Estimate(place_mm, judge.sd_mm * found.sd_mm, force_N, sd_N, np.isfinite(db_uT).all(axis=1))

    @cached_property
    def held_out(self) -> Normals:
        """Estimates of the labelled presses, each by the unrefined network with the labels of other folds."""
        labels, parts = self.data.labels, []
        folds = folds_of(len(labels))
        for kept, tested in folds:
            context = self._read(thin(labels[kept], CONTEXT_LABELS_N)) if len(kept) else self.unlabelled_context
            parts.append(network.estimate(self.compiled, context, labels.db_uT[tested]))
        order = np.argsort(np.concatenate([tested for _, tested in folds])) if folds else np.zeros(0, int)
        none = network.estimate(self.compiled, self.unlabelled_context, labels.db_uT[:0])
        return Normals(*(np.concatenate(values)[order] for values in zip(*(parts or [none]), strict=True)))

    def _read(self, labels: LabelledPresses) -> Context:
        return network.read_skin(self.weights, replace(self.data, labels=labels), self.external_uT)


@dataclass(frozen=True)
class Judge:
    """How well the estimates on one skin agree with its labels, and what follows for intervals and forces.

    Parameters
    ----------
    sd_mm, sd_log_N : factors by which the standard deviations of the network are multiplied
    head : correction of forces; None if no force is known
    enough : whether so many forces are known that the head also gives the standard deviations of forces
    """

    sd_mm: float
    sd_log_N: float
    head: ForceHead | None
    enough: bool

    @classmethod
    def of(cls, skin: Calibrated) -> "Judge":
        """Compare the held-out estimates of a skin's labels with the labels."""
        labels, references = skin.data.labels, skin.references
        held_out, known = skin.held_out, np.flatnonzero(np.isfinite(labels.force_N))
        sd_mm, head = references.sd_mm, None
        if len(labels) >= INTERVAL_MIN_N:
            off_sd = np.abs(held_out.place_mm - labels.place_mm) / held_out.sd_mm
            sd_mm = conformal(off_sd.ravel()) / NORMAL_90
        if len(known):
            head = ForceHead.fit(held_out.log_N[known], labels.db_uT[known], labels.force_N[known])
        return cls(sd_mm, references.sd_log_N, head, len(known) >= INTERVAL_FORCES_MIN_N)

    def forces(self, found: Normals, db_uT: Float[np.ndarray, "n ch"]) -> tuple[np.ndarray, np.ndarray]:
        """Return forces and their standard deviations."""
        force_N = np.exp(found.log_N) if self.head is None else self.head.force_N(found.log_N, db_uT)
        if self.head is not None and self.enough:
            return force_N, self.head.sd_N(force_N)
        return force_N, force_N * self.sd_log_N * found.sd_log_N  # to first order


def thin(labels: LabelledPresses, most_n: int) -> LabelledPresses:
    """Select at most this number of labels, evenly distributed over their order."""
    if len(labels) <= most_n:
        return labels
    return labels[np.linspace(0, len(labels) - 1, most_n).round().astype(int)]


def folds_of(labels_n: int) -> list[tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " l"]]]:
    """Split labels into folds; return the labels outside and inside each fold. Label i is in fold i modulo FOLDS_N."""
    fold = np.arange(labels_n) % FOLDS_N
    return [(np.flatnonzero(fold != i), np.flatnonzero(fold == i)) for i in range(min(FOLDS_N, labels_n))]


@dataclass
class Universal:
    """The universal model for the board of one layout. It can be calibrated to a skin during use.

    First call `zero` with readings without contact. Then call `see` with presses at unknown places and `label` with
    presses at known places, in any order and any number of times. Each of these three methods changes the model in
    place and returns it. `predict` works at any time after `zero`. Fields are in uT along the chips' axes. Do not
    calibrate a model in one thread while another thread uses it.

    Parameters
    ----------
    weights : weights of the network
    likeness : tells whether a skin is like the simulated skins
    references : errors of the network on simulated skins
    layout : the board and the skin that the model was made for
    card : model card, which states how the model was trained and what it must not be used for
    external_uT : expected size of external fields (see `load_universal`)
    """

    weights: Weights
    likeness: Likeness
    references: References = field(default_factory=References)
    layout: BoardLayout = field(default_factory=paper_layout)
    card: Mapping[str, Any] = field(default_factory=dict)
    external_uT: float = 0.0

    def __post_init__(self) -> None:
        """Start without any calibration data; raise SchemaError if `external_uT` is out of range."""
        if not 0 <= self.external_uT <= EXTERNAL_MAX_uT:
            rule = f"0 to {EXTERNAL_MAX_uT:,.0f} uT"
            remedy = "Pass the expected change of the external field, for example 30 uT for the earth's field."
            raise SchemaError("universal model", "external_uT", rule, self.external_uT, remedy)
        self._centre_mm = np.array(self.layout.centre_mm)
        # Matrix that converts readings along the chips' axes to the board's axes. Each estimate needs it.
        self._board_from_chips = self.layout.to_board(np.eye(self.channels_n))
        self._compiled = network.compile_weights(self.weights)
        self._noload_uT: Float[np.ndarray, " ch"] | None = None
        self._contact_uT: float | None = None  # larger field changes are contacts; None if the noise is unknown
        self._saved_uT: Float[np.ndarray, " ch"] | None = None  # no-load reading of the skin that was loaded
        # The network with the skin to which it is calibrated, in the frame and the axes of the board.
        self.skin: Calibrated
        self._set(SkinData.at_rest(np.array(self.weights["usual_rest"], float)))

    def __repr__(self) -> str:
        noload = "no-load reading taken" if self.zeroed else "no no-load reading"
        labels_n, refined = self.labels_n, ", refined" if self.skin.data.refined else ""
        external_uT = f", external fields of {self.external_uT:g} uT" if self.external_uT else ""
        return (
            f"Universal(board {self.layout.name}, {len(self.layout.chips)} chips, {noload}, "
            f"{self.presses_n - labels_n} presses at unknown places, {labels_n} labelled{refined}{external_uT})"
        )

    @property
    def channels_n(self) -> int:
        """Number of values in one reading, which has three values per chip."""
        return self.layout.channels_n

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
        """Whether the model has a no-load reading, from a call of `zero` or from a saved skin."""
        return self._noload_uT is not None

    @property
    def presses_n(self) -> int:
        """Number of presses to which the model is calibrated, labelled or not."""
        return len(self.skin.data.presses_uT) + self.labels_n

    @property
    def labels_n(self) -> int:
        """Number of labelled presses to which the model is calibrated."""
        return len(self.skin.data.labels)

    @property
    def refinable(self) -> bool:
        """Whether there are enough labels with known forces for `refine`."""
        return int(np.isfinite(self.skin.data.labels.force_N).sum()) >= REFINE_MIN_N

    @property
    def reach_mm(self) -> Float[np.ndarray, "2 2"]:
        """The edges of the skin in the frame of the labels: smallest x and y, then largest x and y."""
        return self._centre_mm + self.layout.reach_mm

    @property
    def warnings(self) -> list[str]:
        """Warnings about a wrong unit, an unusual or another skin, or labels that contradict the estimates."""
        if not self.zeroed:
            return []
        usual_uT = float(np.median(np.linalg.norm(self.noload_uT.reshape(-1, 3), axis=1)))
        if usual_uT < WEAKEST_uT:
            return [
                f"the no-load field is weaker than the earth's field: its median over the chips is {usual_uT:.3g} uT. "
                "Convert readings in mT or G to uT, and do not subtract the no-load reading from them."
            ]
        found, data = [], self.skin.data
        sign = network.sign_of(self.weights, data.rest_uT)
        pressed_uT = np.concatenate([data.presses_uT, data.labels.db_uT])
        misfit = self.likeness.skin_misfit(sign * data.rest_uT, sign * pressed_uT)
        if misfit > MISFIT_MAX:
            found.append(
                f"this skin is unlike the skins on which the model was trained (misfit {misfit:.1f}, limit "
                f"{MISFIT_MAX:g}). Check the order of the chips in the readings and whether each chip works, and use a "
                "model for this kind of skin."
            )
        chips_uT = np.linalg.norm(pressed_uT.reshape(len(pressed_uT), self.channels_n // 3, 3), axis=2).max(
            axis=0, initial=0.0
        )
        if len(pressed_uT) >= PRESSES_MIN_N and (silent := np.flatnonzero(chips_uT < NOISE_uT).tolist()):
            found.append(
                f"chip {', '.join(map(str, silent))} does not respond to any of {len(pressed_uT)} presses. Check its "
                "connection, and whether all of the skin was pressed."
            )
        if self._saved_uT is not None:
            changed = float(np.linalg.norm(self.noload_uT - self._saved_uT) / np.linalg.norm(self._saved_uT))
            if changed > OTHER_SKIN_MIN:
                found.append(
                    f"the no-load field differs by {changed:.0%} from the no-load field of the saved skin. If this is "
                    "another skin, load that one, or calibrate the model anew."
                )
        if len(data.labels) < LABELS_MIN_N:
            return found
        place_mm = data.labels.place_mm
        estimated_mm = network.estimate(self._compiled, self.skin.unlabelled_context, data.labels.db_uT).place_mm
        off_mm = float(np.median(np.linalg.norm(estimated_mm - place_mm, axis=1)))
        span_mm, estimated_span_mm = (float(np.ptp(places, axis=0).max()) for places in (place_mm, estimated_mm))
        if off_mm <= self.references.labels_mm:
            return found
        if span_mm * OTHER_UNIT_SPAN < estimated_span_mm:
            return [
                *found,
                f"the labels span {span_mm:.2g} mm, but their estimates {estimated_span_mm:.2g} mm. If the places are "
                "in cm or m, convert them to mm.",
            ]
        return [
            *found,
            f"the labels contradict the estimates: the median distance is {off_mm:.1f} mm, and at most "
            f"{self.references.labels_mm:.1f} mm on simulated skins. Check whether the axes of the labels are turned, "
            "mirrored or shifted, and whether each label belongs to its reading.",
        ]

    def suppressor(self, noise_uT: float) -> Float[np.ndarray, "ch ch"] | None:
        """Return a matrix that shrinks the external fields in readings to the size of noise.

        Multiply field changes along the chips' axes (one per row) by this matrix to detect contacts. The magnitude |dB|
        alone is not sufficient, because an external field can make it as large as a contact does. The result is None if
        `external_uT` is 0.
        """
        if not self.external_uT:
            return None
        covariance = external.covariance(self.layout.chips_mm, self.external_uT)
        return self._board_from_chips @ external.suppressor(covariance, noise_uT)

    def zero(self, b_uT: Float[np.ndarray, "*f ch"], *, keep: bool = False) -> "Universal":
        """Set the no-load field to the mean of readings without contact, and the threshold of contact from their noise.

        Parameters
        ----------
        b_uT : readings without contact
        keep : whether presses from earlier calls of `see` and `label` are kept. By default, they are discarded. Set
            `keep` to correct the drift of a skin to which the model is already calibrated.

        Raises
        ------
        SchemaError : there is no reading, or a reading is not finite, is out of range, or has the wrong number of
            values; a chip does not answer; or some readings differ from the others, as if the skin was touched
        """
        readings_uT = check_readings(b_uT, self.channels_n)
        if not len(readings_uT):
            raise SchemaError("zero: the array of readings is empty. Pass readings that were taken without contact.")
        check_chips("zero", readings_uT)
        if enough := len(readings_uT) >= QUIET_MIN_N:
            check_quiet(readings_uT)
        kept = keep and self.zeroed
        self._noload_uT = readings_uT.mean(axis=0)
        self._contact_uT = contact_threshold_uT(readings_uT - self._noload_uT, None) if enough else None
        self._saved_uT = self._saved_uT if kept else None
        rest_uT = self.layout.to_board(self._noload_uT[None])[0]
        self._set(replace(self.skin.data, rest_uT=rest_uT) if kept else SkinData.at_rest(rest_uT))
        return self

    def see(self, b_uT: Float[np.ndarray, "*n ch"], *, changes: bool = False) -> "Universal":
        """Calibrate to presses at unknown places, given as one reading per press.

        Use dozens of presses all over the skin, in one or several calls. Equal readings count once. If there are
        labels, the widths of intervals and the correction of forces stay as they are until the next call of `label`.

        b_uT : fields as the board sends them. They are not field changes, because this method subtracts the no-load
        reading, unless `changes` is set.
        """
        db_uT = self._check_change("see", check_readings(b_uT, self.channels_n), changes)
        self._set(self.skin.data.and_seen(db_uT), self.skin.judge if self.labels_n else None)
        return self

    def label(
        self,
        place_mm: Float[np.ndarray, "*m 2"] | Sequence[Any],
        force_N: Float[np.ndarray, "*m"] | Sequence[float] | float | None,
        b_uT: Float[np.ndarray, "*m ch"],
        *,
        keep: bool = False,
        changes: bool = False,
    ) -> "Universal":
        """Calibrate to one or several labelled presses, which have known places and known forces.

        A single press of known force, such as a weight on the middle of the skin, calibrates the forces of the whole
        skin. Readings that differ only by noise and have equal labels count as one press.

        Parameters
        ----------
        place_mm : places of the presses in the frame of the labels
        force_N : forces of the presses; None, or NaN for a press, if only the place is known
        b_uT : fields as the board sends them, one reading per press
        keep : whether earlier labels are kept. By default, they are discarded.
        changes : whether `b_uT` contains field changes, from which no no-load reading is subtracted

        Raises
        ------
        SchemaError : `zero` was not called; a reading is one without contact or of a chip that does not answer; equal
            readings have different labels; a place is outside the skin; a force is outside the model's range; or there
            are too many labels. The model is not changed if this error is raised.
        """
        readings_uT = check_readings(b_uT, self.channels_n)
        forces = np.full(len(readings_uT), np.nan) if force_N is None else np.asarray(force_N, float)
        places_mm, forces_N = check_labels(
            np.asarray(place_mm, float), forces, len(readings_uT), self.reach_mm, self.layout.force_N
        )
        db_uT = self._check_change("label", readings_uT, changes)
        labels = LabelledPresses(places_mm - self._centre_mm, forces_N, db_uT)
        data = self.skin.data
        if keep:
            labels = labels.joined_to(data.labels)
        else:
            data = replace(data, refined={})
        self._set(replace(data, labels=labels.distinct(self._contact_uT or 0.0)))
        return self

    def refine(self) -> "Universal":
        """Train the network further on this skin's labelled presses, mixed with simulated skins.

        This takes about 20 s, and improves the estimates of places if there are many labels all over the skin. On sides
        of the skin without labels, they get worse. It requires PyTorch. The
        refined network belongs to this skin: it is saved with it, and is dropped by `zero` and `label` without `keep`.
        The model is changed in place and returned.

        Raises
        ------
        SchemaError : there are fewer than `REFINE_MIN_N` labels with known forces
        """
        data = self.skin.data
        known = np.flatnonzero(np.isfinite(data.labels.force_N))
        if len(known) < REFINE_MIN_N:
            rule = f"at least {REFINE_MIN_N} labels with known forces"
            raise SchemaError(
                "refine", "the number of labels", rule, len(known), "Label more presses, all over the skin."
            )
        require("torch", "Universal.refine")
        from reskin.universal.making import refine

        return self.use_refined(refine(self.weights, self.layout, data.rest_uT, data.labels[known]))

    def use_refined(self, weights: Weights) -> "Universal":
        """Use a network that `refine` trained for this skin; the model is changed in place and returned."""
        self._set(replace(self.skin.data, refined=weights))
        return self

    def predict(self, b_uT: Float[np.ndarray, "*f ch"]) -> Float[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and the normal force in N for readings in contact; NaN for unusable readings."""
        estimate = self.estimate(b_uT)
        return np.column_stack([estimate.place_mm, estimate.force_N])

    def estimate(self, b_uT: Float[np.ndarray, "*f ch"], *, changes: bool = False) -> Estimate:
        """Estimate places and forces with their standard deviations, and whether anything touches the skin.

        With `changes`, `b_uT` contains field changes, from which no no-load reading is subtracted.

        Contact is unknown if `zero` got fewer than `QUIET_MIN_N` readings, or if external fields are expected. Without
        contact, place and force mean nothing. Before `label` got about ten forces, `sd_N` is too small on recorded
        boards (docs/learning.md, Intervals).
        """
        db_uT = self._change(b_uT, changes)
        estimate = self.skin.estimate(db_uT)
        return replace(estimate, place_mm=estimate.place_mm + self._centre_mm, contact=self._contact(db_uT))

    def misfit(self, b_uT: Float[np.ndarray, "*f ch"], *, changes: bool = False) -> Float[np.ndarray, " f"]:
        """Return how unlike those of simulated skins readings in contact are: above `MISFIT_MAX`, they are unusual."""
        sign = network.sign_of(self.weights, self.skin.data.rest_uT)
        return self.likeness.misfit(sign * self._change(b_uT, changes))

    def save(self, file: Path | str) -> None:
        """Write what is known of this skin to a file; `load_universal(file)` restores the calibrated model from it.

        Raises SchemaError if `zero` was not called before, because the model then has no no-load reading.
        """
        if not self.zeroed:
            raise SchemaError("save: the model has no no-load reading. First call zero with readings without contact.")
        write_skin(self.skin.data, Path(file), self.layout.name)
        self._set(self.skin.data)  # from now on, estimates are those of a model that reads the file

    def export_onnx(self, file: Path | str, quiet_uT: Float[np.ndarray, "*f ch"] | None = None) -> None:
        """Write the calibrated model as an ONNX file, so that programs without Python can use it (docs/python.md).

        The input `db_uT` contains changes of the field since the no-load reading, along the axes of the chips, with
        shape [f, ch] and in double precision. There is one output for each attribute of an `Estimate`, and the output
        `change_uT`, which is the magnitude of the change, |dB|. If `quiet_uT` is given, there is also the output
        `contact`. quiet_uT: readings without contact. Their noise determines the threshold above which a reading
        counts as contact, as in `reskin.open`. This method requires the package onnx. It raises SchemaError if `zero`
        was not called before.
        """
        from reskin.universal import export

        export.write_onnx(self, Path(file), quiet_uT)

    def remember(self, file: Path | str) -> "Universal":
        """Replace all calibration data by those in a file that `save` wrote.

        Afterwards, call `zero(b_uT, keep=True)` with new readings without contact, to correct the drift since the file
        was written.
        """
        shapes = {name: value.shape for name, value in self.weights.items()}
        data = read_skin_file(Path(file), self.layout, shapes)
        self._noload_uT = self._saved_uT = self.layout.to_chips(data.rest_uT[None])[0]
        self._contact_uT = None
        self._set(data)
        return self

    def _change(self, b_uT: Float[np.ndarray, "*f ch"], changes: bool = False) -> Float[np.ndarray, "f ch"]:
        """Return the field changes along the board's axes, from readings or from changes along the chips' axes.

        They are NaN in readings in which a chip does not answer. Raises SchemaError if `zero` has not been called yet.
        """
        rows_uT = check_shape(b_uT, self.channels_n)
        if changes:
            return rows_uT @ self._board_from_chips
        noload_uT = self.noload_uT
        db_uT = (rows_uT - noload_uT) @ self._board_from_chips
        if noload_uT.any() and (silent := silent_chips(rows_uT).any(axis=1)).any():
            db_uT[silent] = np.nan
        return db_uT

    def _contact(self, db_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, " f"] | None:
        """Return whether field changes are contacts; None if that is unknown."""
        if self._contact_uT is None or self.external_uT:
            return None
        return np.linalg.norm(db_uT, axis=1) > self._contact_uT

    def _check_change(self, where: str, b_uT: Float[np.ndarray, "*f ch"], changes: bool) -> Float[np.ndarray, "f ch"]:
        """Return the field changes of presses along the board's axes.

        Raises SchemaError if the values are probably in another unit, if they are field changes instead of readings, or
        if a reading is one without contact. `where` is the name of the calling method, for the error message.
        """
        db_uT = check_presses(self._change(b_uT, changes))
        if not changes:
            check_is_reading(where, np.atleast_2d(b_uT), self.noload_uT)
            check_chips(where, np.atleast_2d(b_uT))
        contact = self._contact(db_uT)
        if contact is not None and not contact.all():
            first, rule = int(contact.argmin()), f"its field change is within the noise, {self._contact_uT:.3g} uT"
            problem = f"{(~contact).sum()} of {len(contact)} readings are not of presses; the first is reading {first}"
            raise SchemaError(f"{where}: {problem}: {rule}. Omit them, or press harder.")
        return db_uT

    def _set(self, data: SkinData, judged: Judge | None = None) -> None:
        self.skin = Calibrated(self.weights, self._compiled, data, self.references, self.external_uT, judged)


def load_universal(skin: Path | str | None = None, *, file: Path | str = FILE, external_uT: float = 0.0) -> Universal:
    """Load a universal model and, if a saved skin is given, calibrate it to this skin (see `reskin.load_universal`)."""
    file = Path(file)
    weights, likeness, references, layout, card = _read_parts(file, file.stat().st_mtime_ns if file.exists() else 0)
    model = Universal(weights, likeness, references, layout, card, external_uT)
    return model if skin is None else model.remember(skin)


def is_model(file: Path) -> bool:
    """Return whether a file is a universal model, according to its model card, the JSON file of the same name."""
    card_file = io.card_of(file)
    return file.suffix == FILE.suffix and card_file.is_file() and _format_of(card_file).startswith(KIND)


def _format_of(card_file: Path) -> str:
    card = io.read_json(card_file)
    return str(card.get("format")) if isinstance(card, dict) else "none"


@lru_cache(maxsize=2)
def _read_parts(file: Path, changed_ns: int) -> tuple[Weights, Likeness, References, BoardLayout, Mapping[str, Any]]:
    card_file = io.card_of(file)
    if file.is_file() and not card_file.is_file():
        problem = f"{file}: its model card {card_file.name} is missing. Copy the card to the same folder"
        raise SchemaError(f"{problem}. If this file is a saved skin, pass it as `skin`, not as `file`.")
    if (form := _format_of(card_file)) != FORMAT:
        raise SchemaError(card_file, "format", FORMAT, form, "Make the model again with `reskin model make`.")
    card = io.read_json(card_file)
    tensors = io.read_model(file, card)
    layout = as_layout(card["layout"], f"{card_file}: layout")
    shapes = {WEIGHTS + name: shape for name, shape in network.shapes(layout.channels_n).items()}
    shapes |= {LIKENESS + name: shape for name, shape in Likeness.shapes(layout.channels_n).items()}
    io.check_arrays(file, tensors, shapes)
    weights = {name.removeprefix(WEIGHTS): value for name, value in tensors.items() if name.startswith(WEIGHTS)}
    of_likeness = {each.name: tensors[LIKENESS + each.name].astype(float) for each in fields(Likeness)}
    return weights, Likeness(**of_likeness), References(**card["references"]), layout, card


def write(model: Universal, about: Mapping[str, Any], file: Path = FILE) -> None:
    """Write a universal model to a file, and its model card to a JSON file of the same name.

    The card contains the items of `about`, the layout, and the references.
    """
    card = {"format": FORMAT, **about, "layout": model.layout.model_dump(mode="json")}
    card["references"] = {each.name: getattr(model.references, each.name) for each in fields(References)}
    tensors = {WEIGHTS + name: value for name, value in model.weights.items()}
    tensors |= {
        LIKENESS + each.name: getattr(model.likeness, each.name).astype(np.float32) for each in fields(Likeness)
    }
    io.write_model(file, tensors, card)
