"""Data to which the universal model is calibrated, and the likelihood powers of a calibrated model.

The data of one skin are its no-load field, presses at unknown places, and labelled presses (presses with known places
and forces). This module checks these data, writes them to a file, and reads them.

A likelihood power is the exponent to which a likelihood is raised. A power below 1 increases the standard deviations of
estimates. Cross-validation over the labelled presses shows whether the standard deviations match the errors.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from reskin import io
from reskin.errors import SchemaError
from reskin.universal.map import Estimate, NOISE_uT
from reskin.universal.network import FULL_SET_N

CHANNELS_N = 15  # values in one reading of the paper's board, which has five chips with three axes each
# Largest accepted field, which is 20 times the range of a chip. The square of this value can be represented in single
# precision.
FIELD_MAX_uT = 1e6
RANGE_FACTOR = 2.0  # a force that is outside the model's range by this factor or more is probably in a wrong unit
# Largest number of labels. There is a limit because the memory grows with the square of the number of labels, and the
# computing time grows even faster.
LABELS_MAX_N = 2000


def check_shape(b_uT: Float[np.ndarray, "..."], channels_n: int = CHANNELS_N) -> Float[np.ndarray, "f ch"]:
    """Return one or several readings as a 2-D array with one row per reading.

    Raises SchemaError if the values are not an array of numbers of this shape.
    """
    needed = f"This model needs {channels_n} numbers per reading: Bx, By, Bz of each of {channels_n // 3} chips."
    try:
        rows_uT = np.atleast_2d(np.asarray(b_uT, float))
    except (TypeError, ValueError):  # text, or rows of different lengths
        got = " ".join(repr(b_uT).split())[:60]
        raise SchemaError(f"b_uT: {got} is not an array of numbers. {needed}") from None
    if rows_uT.ndim != 2 or rows_uT.shape[1] != channels_n:
        got = f"{rows_uT.size} numbers" if np.ndim(b_uT) < 2 else f"shape {rows_uT.shape}"
        raise SchemaError(f"b_uT has {got}. {needed}")
    return rows_uT


def check_readings(b_uT: Float[np.ndarray, "..."], channels_n: int = CHANNELS_N) -> Float[np.ndarray, "f ch"]:
    """Return calibration readings as a 2-D array with one row per reading.

    Raises SchemaError if the shape is wrong, if a value is not finite, or if a magnitude exceeds `FIELD_MAX_uT`.
    """
    rows_uT = check_shape(b_uT, channels_n)
    _need("fields", "calibration readings", "finite numbers of uT", rows_uT, np.isfinite(rows_uT))
    rule = f"at most {FIELD_MAX_uT:,.0f} uT in magnitude"
    _need("fields", "calibration readings", rule, rows_uT, np.abs(rows_uT) <= FIELD_MAX_uT)
    return rows_uT


def check_labels(
    place_mm: Float[np.ndarray, "..."],
    force_N: Float[np.ndarray, "..."],
    rows_n: int,
    reach_mm: Float[np.ndarray, "2 2"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Return the places and forces of labelled presses as arrays; raise SchemaError if they are invalid.

    There must be one place and one force for each of the `rows_n` readings, and at most LABELS_MAX_N labels. Places
    must be within `reach_mm`, whose first row has the smallest x and y and whose second row has the largest x and y.
    Forces must be finite and above 0 N.
    """
    places_mm, forces_N = np.atleast_2d(place_mm), np.atleast_1d(force_N)
    got = f"places {places_mm.shape}, forces {forces_N.shape}, readings ({rows_n})"
    if places_mm.shape != (rows_n, 2) or forces_N.shape != (rows_n,):
        raise SchemaError(
            f"labels: each press needs x and y, a force and a reading; got {got}. Pass arrays of shapes "
            "[m, 2], [m] and [m, channels]."
        )
    check_number(rows_n)
    least_mm, most_mm = reach_mm
    on_skin = (places_mm >= least_mm) & (places_mm <= most_mm)
    _need("labels", "places", f"on the skin, from {least_mm.tolist()} to {most_mm.tolist()} mm", places_mm, on_skin)
    _need("labels", "forces", "above 0 N", forces_N, forces_N > 0)
    _need("labels", "forces", "finite", forces_N, np.isfinite(forces_N))
    return places_mm, forces_N


def check_number(labels_n: int) -> None:
    """Raise SchemaError if there are more than LABELS_MAX_N labels."""
    if labels_n > LABELS_MAX_N:
        rule = f"At most {LABELS_MAX_N} labels can be used, including the labels of earlier days"
        raise SchemaError(f"labels: {labels_n} labels are too many. {rule}. Select some of them.")


def check_range(force_N: Float[np.ndarray, " m"], range_N: Float[np.ndarray, " q"]) -> None:
    """Raise SchemaError if the force of a label is outside the model's range by a factor of `RANGE_FACTOR` or more."""
    least_N, most_N = float(range_N.min()), float(range_N.max())
    inside = (force_N > least_N / RANGE_FACTOR) & (force_N < RANGE_FACTOR * most_N)
    if not inside.all():
        got = f"{force_N[~inside][0]:.6g} N"
        rule = f"about {least_N:.3g} to {most_N:.3g} N, which is the force range of the model"
        remedy = "Convert forces in other units to N. Omit presses with forces outside the range."
        raise SchemaError("labels", "forces", rule, got, remedy)


# Users may pass field changes where readings are needed, or readings where field changes are needed. Such mistakes are
# detected by comparing two distances: readings of presses are near the no-load reading, but field changes are near 0.
# Each kind of value therefore has a point to which it should be near (the no-load reading or 0), and a point from which
# it should be far. Values are refused if their distance to the second point, divided by their distance to the first
# point, is below this limit. On the boards of scene lab, the median of this ratio is 0.15 to 0.22 for values of the
# wrong kind, and 4 or more for values of the right kind.
NEAR_MAX = 0.5


def check_presses(db_uT: Float[np.ndarray, "m ch"]) -> Float[np.ndarray, "m ch"]:
    """Return the field changes; raise SchemaError if all of them are smaller than the noise.

    This happens for example if readings are in mT.
    """
    strongest_uT = float(np.linalg.norm(db_uT.reshape(len(db_uT), db_uT.shape[1] // 3, 3), axis=2).max(initial=0.0))
    if len(db_uT) and strongest_uT < NOISE_uT:
        rule = f"{NOISE_uT:g} uT or more at one chip at least"
        remedy = "Convert fields in mT or G to uT. If they are in uT, press the skin harder."
        raise SchemaError("presses", "field changes", rule, f"at most {strongest_uT:.3g} uT", remedy)
    return db_uT


def check_is_reading(where: str, b_uT: Float[np.ndarray, "m ch"], noload_uT: Float[np.ndarray, " ch"]) -> None:
    """Raise SchemaError if `b_uT` contains field changes instead of readings of presses.

    `where` is the name of the calling function, for the error message.
    """
    if _median_norm(b_uT) < NEAR_MAX * _median_norm(b_uT - noload_uT):
        problem = (
            f"{where}: the values seem to be field changes, because they are nearer to 0 uT than to the no-load reading"
        )
        raise SchemaError(f"{problem}. Pass the readings themselves: do not subtract the no-load reading from them.")


def check_is_change(where: str, db_uT: Float[np.ndarray, "m ch"], noload_uT: Float[np.ndarray, " ch"]) -> None:
    """Raise SchemaError if `db_uT` contains readings of presses instead of field changes.

    `where` is the name of the calling function, for the error message.
    """
    if _median_norm(db_uT - noload_uT) < NEAR_MAX * _median_norm(db_uT):
        problem = (
            f"{where}: the values seem to be readings, because they are nearer to the no-load reading than to 0 uT"
        )
        raise SchemaError(f"{problem}. Pass field changes: subtract the no-load reading from the readings.")


def _median_norm(values_uT: Float[np.ndarray, "m ch"]) -> float:
    return float(np.median(np.linalg.norm(values_uT, axis=1))) if len(values_uT) else 0.0


def _need(where: str, what: str, rule: str, got: np.ndarray, valid: Bool[np.ndarray, "..."]) -> None:
    if not valid.all():
        wrong = np.argwhere(~valid)[0]
        raise SchemaError(where, what, rule, str(got[tuple(wrong)]), "Omit the press or reading with this value.")


# Formats of calibration files, newest first. Files in older formats can still be read, but contain less: format 1 does
# not state which forces are known. Formats 1 and 2 do not state how the skin is mounted; the skin is then assumed not
# to be turned. Formats 1 to 3 contain the data of only one day.
FORMAT, FORMAT_3, FORMAT_2, FORMAT_1 = "reskin-skin-4", "reskin-skin-3", "reskin-skin-2", "reskin-skin-1"
# Prefix of the array names of an earlier day in a file. The placeholder is the number of the day; the oldest day has
# the number 0.
EARLIER_DAY = "earlier_{}_"
DAYS_MAX_N = 5  # largest number of days in a calibration file, including the current day
ARRAYS = ("pokes_uT", "even_uT", "area_uT", "labelled_mm", "labelled_N", "labelled_uT", "force_known")
UNLABELLED = ("pokes_uT", "even_uT", "area_uT")
# Larger files are refused. The largest calibration (five full days with all labels, on a board with 64 chips) has a
# size of 4.1 MB.
FILE_BYTES_MAX_N = 2**23
REMEDY = "Use a calibration that `Universal.save` or the page of `reskin live` has saved."
# A file states the name of its board under the first key. If it does not, it is for the board of the second name.
BOARD, PAPER_BOARD = "board", "reskin"


@dataclass(frozen=True)
class LabelledPresses:
    """Presses at known places, with their forces and field changes. Places are relative to the board's centre.

    A force is either a known true value or, if the user stated only the place, an estimate. `force_known` is True for
    the forces that are true values. By default, all forces are.
    """

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]
    force_known: Bool[np.ndarray, " m"] | None = None

    def __len__(self) -> int:
        return len(self.force_N)

    @property
    def known(self) -> Bool[np.ndarray, " m"]:
        """Whether each force is a true value (True) or an estimate (False)."""
        return np.ones(len(self), bool) if self.force_known is None else self.force_known

    def __getitem__(self, which: slice | Int64[np.ndarray, " k"]) -> "LabelledPresses":
        """Return some of the presses, selected by a slice or by their indices."""
        known = None if self.force_known is None else self.force_known[which]
        return LabelledPresses(self.place_mm[which], self.force_N[which], self.db_uT[which], known)


def join_labels(one: LabelledPresses, other: LabelledPresses) -> LabelledPresses:
    """Append the labelled presses `other` to `one`."""
    return LabelledPresses(
        np.concatenate([one.place_mm, other.place_mm]), np.concatenate([one.force_N, other.force_N]),
        np.concatenate([one.db_uT, other.db_uT]), np.concatenate([one.known, other.known]),
    )  # fmt: skip


def no_presses(channels_n: int = CHANNELS_N) -> Float[np.ndarray, "0 ch"]:
    return np.zeros((0, channels_n))


def no_labels(channels_n: int = CHANNELS_N) -> LabelledPresses:
    return LabelledPresses(np.zeros((0, 2)), np.zeros(0), no_presses(channels_n))


@dataclass(frozen=True)
class CalibrationData:
    """All calibration data of one skin, in the board's frame and axes.

    By default, there are no presses, and the board is the paper's board.

    Parameters
    ----------
    rest_uT : no-load field
    presses_uT : field changes of at most `FULL_SET_N` presses at unknown places
    even_uT : field changes of presses that are evenly spread over the skin
    area_uT : field changes of presses at random places all over the area of presses
    labels : presses at known places
    turned : whether the skin is turned by a quarter. If it is, all fields in this object have the opposite sign of the
        fields on the board, as if the skin were not turned.
    earlier : the data of earlier days in order of time. Each element contains the presses of one day only.
    """

    rest_uT: Float[np.ndarray, " ch"]
    presses_uT: Float[np.ndarray, "c ch"] = field(default_factory=no_presses)
    even_uT: Float[np.ndarray, "e ch"] = field(default_factory=no_presses)
    area_uT: Float[np.ndarray, "a ch"] = field(default_factory=no_presses)
    labels: LabelledPresses = field(default_factory=no_labels)
    turned: bool = False
    earlier: "tuple[CalibrationData, ...]" = ()

    @classmethod
    def at_rest(cls, rest_uT: Float[np.ndarray, " ch"]) -> "CalibrationData":
        """Return the data of a skin of which only the no-load field is known, on a board with any number of chips."""
        empty = no_presses(len(rest_uT))
        return cls(rest_uT, empty, empty, empty, no_labels(len(rest_uT)))

    @property
    def presses_n(self) -> int:
        """Number of presses on all days, including labelled presses."""
        return len(self.presses_uT) + len(self.labels) + sum(day.presses_n for day in self.earlier)

    @property
    def labels_n(self) -> int:
        """Number of labelled presses on all days."""
        return len(self.labels) + sum(day.labels_n for day in self.earlier)

    def next_day(self) -> "CalibrationData":
        """Return the data with which a new day begins.

        The new day has the same no-load field and no presses. The current day becomes an earlier day, if it has
        presses. At most `DAYS_MAX_N` - 1 earlier days are kept; if there are more, the oldest day is dropped.
        """
        pressed = len(self.presses_uT) + len(self.labels) > 0
        earlier = (*self.earlier, replace(self, earlier=())) if pressed else self.earlier
        data = CalibrationData.at_rest(self.rest_uT)
        return replace(data, turned=self.turned, earlier=earlier[-DAYS_MAX_N + 1 :])

    def joined_to(self, last: "CalibrationData") -> "CalibrationData":
        """Join these data and the data `last` of the last day as if all were of one day.

        This is used for a skin that slid in the same way on both days. The presses of the last day come first in the
        result. The `area_uT` of the last day is kept only if the current day has no presses at unknown places, because
        all presses together must be at random places. `Universal.see` follows the same rule within a day.
        """
        presses_uT = np.concatenate([last.presses_uT, self.presses_uT])[-FULL_SET_N:]
        even_uT = self.even_uT if len(self.even_uT) or len(self.area_uT) else last.even_uT
        area_uT = self.area_uT if len(self.presses_uT) else last.area_uT
        labels = join_labels(last.labels, self.labels)
        return replace(self, presses_uT=presses_uT, even_uT=even_uT, area_uT=area_uT, labels=labels, earlier=())


def write_calibration(data: CalibrationData, file: Path, board: str) -> None:
    """Write calibration data and the name of the model's board to a safetensors file, without the model itself."""
    tensors = _arrays(data)
    for i, day in enumerate(data.earlier):
        tensors |= {EARLIER_DAY.format(i) + name: values for name, values in _arrays(day).items()}
    about = {"format": FORMAT, "turned": str(data.turned).lower(), BOARD: board}
    io.write_tensors(file, tensors, about)


def _arrays(day: CalibrationData) -> dict[str, np.ndarray]:
    labels = day.labels
    labelled = labels.place_mm, labels.force_N, labels.db_uT, labels.known.astype(float)
    values = (day.presses_uT, day.even_uT, day.area_uT, *labelled)
    return {"rest_uT": day.rest_uT, **dict(zip(ARRAYS, values, strict=True))}


def is_calibration(file: Path) -> bool:
    """Return whether a file is a calibration that `write_calibration` wrote.

    A file that is too large to be a calibration is not read. Raises SchemaError if a smaller file is damaged.
    """
    formats = FORMAT, FORMAT_3, FORMAT_2, FORMAT_1
    return file.stat().st_size <= FILE_BYTES_MAX_N and io.read_tensors(file)[1].get("format") in formats


def read_calibration(
    file: Path, reach_mm: Float[np.ndarray, "2 2"], channels_n: int = CHANNELS_N, board: str = PAPER_BOARD
) -> CalibrationData:
    """Read calibration data from a file that `write_calibration` wrote.

    `reach_mm` contains the edges of the skin relative to the board's centre: the smallest x and y in the first row, the
    largest x and y in the second row. Raises SchemaError if the file is not a calibration, if the board in the file is
    not called `board`, or if a labelled place is outside `reach_mm`.
    """
    if file.is_file() and (bytes_n := file.stat().st_size) > FILE_BYTES_MAX_N:
        raise SchemaError(
            f"{file}: the file has {bytes_n:,} bytes, but a saved calibration has at most {FILE_BYTES_MAX_N:,}. "
            f"{REMEDY}"
        )
    tensors, metadata = io.read_tensors(file, digest_needed=True)
    if "rest_slope_uT" in tensors:
        remedy = "In Python, pass it to load_universal as the argument `file`."
        raise SchemaError(f"{file}: this file is a universal model, not a saved calibration. {remedy}")
    if (own := metadata.get(BOARD, PAPER_BOARD)) != board:
        remedy = f"Use this calibration with the model that was made for board {own}."
        raise SchemaError(file, "the calibrated board", f"{board}, the board of the model", own, remedy)
    if metadata.get("format") == FORMAT_1 and "labelled_N" in tensors:
        added = {"force_known": np.ones(len(tensors["labelled_N"])), "area_uT": no_presses(channels_n)}
        tensors = {**tensors, **added}
    elif metadata.get("format") not in (FORMAT, FORMAT_3, FORMAT_2):
        raise SchemaError(file, "format", FORMAT, metadata.get("format"), REMEDY)
    turned = metadata.get("turned", "false")
    if turned not in ("true", "false"):
        raise SchemaError(file, "turned", "true or false", turned, REMEDY)
    earlier: list[CalibrationData] = []
    while arrays := _take_day(tensors, EARLIER_DAY.format(len(earlier))):
        earlier.append(replace(_read_day(file, arrays, reach_mm, channels_n), turned=turned == "true"))
    data = replace(_read_day(file, tensors, reach_mm, channels_n), turned=turned == "true", earlier=tuple(earlier))
    if len(earlier) >= DAYS_MAX_N or data.labels_n > LABELS_MAX_N:
        rule, got = f"at most {DAYS_MAX_N} days with {LABELS_MAX_N} labels", f"{len(earlier) + 1} with {data.labels_n}"
        raise SchemaError(file, "days", rule, got, REMEDY)
    return data


def _take_day(tensors: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Remove the arrays whose names begin with a prefix from `tensors`.

    Returns these arrays by name, without the prefix.
    """
    return {name.removeprefix(prefix): tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}


def _read_day(
    file: Path, tensors: Mapping[str, np.ndarray], reach_mm: Float[np.ndarray, "2 2"], channels_n: int
) -> CalibrationData:
    """Check the arrays of one day that were read from a file, and return the data of this day."""
    got = {name: values.shape for name, values in sorted(tensors.items())}
    counts_n = {name: shape[0] for name, shape in got.items() if shape and name != "rest_uT"}
    shapes: dict[str, tuple[int, ...]] = {"labelled_mm": (2,), "labelled_N": (), "force_known": ()}
    expected = {"rest_uT": (channels_n,)} | {
        name: (counts_n.get(name, 0), *shapes.get(name, (channels_n,))) for name in ARRAYS
    }
    if got != expected or max(counts_n[name] for name in UNLABELLED) > FULL_SET_N:
        rule = f"rest_uT, {', '.join(ARRAYS)} of {channels_n} channels and at most {FULL_SET_N} unlabelled presses"
        raise SchemaError(file, "arrays", rule, got, REMEDY)
    fields_uT = {
        name: check_readings(values, channels_n)
        for name, values in tensors.items()
        if expected[name][1:] == (channels_n,)
    }
    labels_n = len(fields_uT["labelled_uT"])
    place_mm, force_N = check_labels(
        tensors["labelled_mm"].astype(float), tensors["labelled_N"].astype(float), labels_n, reach_mm
    )
    if counts_n["force_known"] != labels_n:
        known = f"{counts_n['force_known']} values for {labels_n} labels"
        raise SchemaError(file, "force_known", "one value per label", known, REMEDY)
    rest_uT = check_readings(tensors["rest_uT"], channels_n)[0]
    labels = LabelledPresses(place_mm, force_N, fields_uT["labelled_uT"], tensors["force_known"] != 0)
    presses_uT, even_uT, area_uT = (fields_uT[name] for name in UNLABELLED)
    return CalibrationData(rest_uT, presses_uT, even_uT, area_uT, labels)


FOLDS_N = 5  # folds of the cross-validation over labels
# The variance inflation is estimated with a prior, according to which it is 1. The prior has the same weight as this
# number of labelled coordinates, where each label has two coordinates (docs/learning.md).
PRIOR_N = 40.0
NORMAL_MEAN = math.sqrt(2 / math.pi)  # mean of |z| for a variable z with a standard normal distribution

# Labelled presses of one fold that were held out: their estimates with each likelihood power, and their true places.
HeldOut = tuple[Sequence[Estimate], Float[np.ndarray, "_ 2"]]


@dataclass(frozen=True)
class LikelihoodPowers:
    """Tables of likelihood powers, which were determined on simulated skins for a misfit of 1.

    `anywhere` contains powers by number of presses at unknown places, and for each of these numbers by number of
    labels. `even` contains powers by number of labels, for presses that are evenly spread over the skin. Between
    tabulated numbers of labels, the logarithm of the power is interpolated linearly. A number of presses that is not
    tabulated is rounded down to the next tabulated number.
    """

    anywhere: Mapping[int, Mapping[int, float]]
    even: Mapping[int, float]

    def power_for(self, presses_n: int, labels_n: int, *, even: bool) -> float:
        """Return the power for these numbers of presses and labels."""
        powers = self.even if even else self.anywhere[max(n for n in self.anywhere if n <= presses_n)]
        tabulated_n = sorted(powers)
        return float(np.exp(np.interp(labels_n, tabulated_n, np.log([powers[n] for n in tabulated_n]))))

    def are_enough(self, presses_n: int) -> bool:
        """Return whether there are so many presses that their misfit can be used."""
        return any(0 < n <= presses_n for n in self.anywhere)

    def to_card(self) -> dict[str, dict[str, Any]]:
        """Convert the powers to a JSON object for the model card."""
        anywhere = {str(presses_n): _named(powers) for presses_n, powers in self.anywhere.items()}
        return {"anywhere": anywhere, "even": _named(self.even)}

    @classmethod
    def from_card(cls, card: Mapping[str, Mapping[str, Any]]) -> "LikelihoodPowers":
        """Convert the JSON object that `to_card` returns to powers."""
        anywhere = {int(presses_n): _numbered(powers) for presses_n, powers in card["anywhere"].items()}
        return cls(anywhere, _numbered(card["even"]))


def _named(powers: Mapping[int, float]) -> dict[str, float]:
    return {str(n): power for n, power in powers.items()}


def _numbered(powers: Mapping[str, float]) -> dict[int, float]:
    return {int(n): power for n, power in powers.items()}


def lower_by_misfit(power: float, misfit: float) -> float:
    """Divide a likelihood power by the misfit of unlabelled presses, and limit the result to 1."""
    return min(1.0, power / misfit)


def lower_by_residuals(power: float, inflation: float) -> float:
    """Divide a likelihood power by the variance inflation of held-out labels, and limit the result to 1."""
    return min(1.0, power / inflation)


def folds_of_labels(labels_n: int) -> list[tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " l"]]]:
    """Split labels into folds for cross-validation.

    Label i is in fold i modulo `FOLDS_N`. Returns, for each fold, the indices of the labels outside the fold and the
    indices of the labels in the fold.
    """
    fold = np.arange(labels_n) % FOLDS_N
    return [(np.flatnonzero(fold != i), np.flatnonzero(fold == i)) for i in range(min(FOLDS_N, labels_n))]


def variance_inflations(powers_n: int, folds: Sequence[HeldOut]) -> list[float]:
    """Return the variance inflation for each of `powers_n` likelihood powers, from labels that were held out.

    The variance inflation is the factor by which the squared errors exceed the variances that were estimated with the
    likelihood power.
    """
    inflations = []
    for i in range(powers_n):
        errors_sd = [np.abs(estimates[i].place_mm - true_mm) / estimates[i].sd_mm for estimates, true_mm in folds]
        inflations.append(variance_inflation(np.concatenate([np.zeros((0, 2)), *errors_sd])))
    return inflations


def variance_inflation(errors_sd: Float[np.ndarray, "m 2"]) -> float:
    """Return the variance inflation for errors that have been divided by their estimated standard deviations.

    If the standard deviations are right, these ratios have a standard normal distribution. The inflation is therefore
    the square of the mean absolute ratio, divided by the mean absolute value of a standard normal variable. Absolute
    values are used because they are less sensitive to outliers than squares. A prior with the weight `PRIOR_N` moves
    the inflation towards 1.
    """
    return ((PRIOR_N + float(errors_sd.sum()) / NORMAL_MEAN) / (PRIOR_N + errors_sd.size)) ** 2
