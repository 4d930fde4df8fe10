"""Data to which the universal model is calibrated: their checks, and the file of a saved skin.

The data of one skin are its no-load field, presses at unknown places, and labelled presses (presses with known places
and, if they were measured, forces).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.distance import cdist

from reskin import io
from reskin.data.contact import CONTACT_SDS
from reskin.errors import SchemaError
from reskin.universal.layout import BoardLayout

# Largest accepted field, which is 20 times the range of a chip. The square of this value can be represented in single
# precision.
FIELD_MAX_uT = 1e6
NOISE_uT = 5.0  # a field change that is smaller at every chip is noise
RANGE_FACTOR = 1.25  # a label's force may be outside the model's range by this factor; the model cannot learn others
QUIET_MIN_N = 20  # readings from which on their noise is known
# Largest number of labels: the time to calibrate the forces grows with the third power of it.
LABELS_MAX_N = 1000
UNLABELLED_MAX_N = 65  # a calibration uses the latest presses at unknown places, at most this number


def check_shape(b_uT: Float[np.ndarray, "..."], channels_n: int) -> Float[np.ndarray, "f ch"]:
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


def check_readings(b_uT: Float[np.ndarray, "..."], channels_n: int) -> Float[np.ndarray, "f ch"]:
    """Return calibration readings as a 2-D array with one row per reading.

    Raises SchemaError if the shape is wrong, if a value is not finite, or if a magnitude exceeds `FIELD_MAX_uT`.
    """
    rows_uT = check_shape(b_uT, channels_n)
    _need("fields", "calibration readings", "finite numbers of uT", rows_uT, np.isfinite(rows_uT))
    rule = f"at most {FIELD_MAX_uT:,.0f} uT in magnitude"
    _need("fields", "calibration readings", rule, rows_uT, np.abs(rows_uT) <= FIELD_MAX_uT)
    return rows_uT


def silent_chips(b_uT: Float[np.ndarray, "n ch"]) -> Bool[np.ndarray, "n k"]:
    """Return which chips do not answer in which readings.

    A chip does not answer if its three values are 0, or if they are equal in at least QUIET_MIN_N readings in which
    those of other chips change.
    """
    chips_uT = b_uT.reshape(len(b_uT), b_uT.shape[1] // 3, 3)
    silent: Bool[np.ndarray, "n k"] = (chips_uT == 0).all(axis=2)
    if len(b_uT) >= QUIET_MIN_N:
        still = (chips_uT == chips_uT[0]).all(axis=(0, 2))
        silent |= still & ~still.all()
    return silent


def check_chips(where: str, b_uT: Float[np.ndarray, "n ch"]) -> None:
    """Raise SchemaError if a chip does not answer; `where` is the name of the calling function."""
    silent = np.argwhere(silent_chips(b_uT))
    if len(silent) and b_uT.any():  # otherwise, the values are field changes, about which there is a warning
        reading_i, chip_i = silent[0]
        problem = f"chip {chip_i} does not answer in reading {reading_i}: its values are 0, or never change"
        raise SchemaError(f"{where}: {problem}. Check its connection, or omit the reading.")


OUTLIERS_SHARE = 0.01  # so few wrong readings move the mean by less than the noise of a reading; assumed


def check_quiet(b_uT: Float[np.ndarray, "n ch"]) -> None:
    """Raise SchemaError if more than `OUTLIERS_SHARE` of many readings differ from their median by more than noise."""
    away_uT = np.linalg.norm(b_uT - np.median(b_uT, axis=0), axis=1)
    usual_uT = float(np.median(away_uT))
    limit_uT = max(usual_uT * (1 + CONTACT_SDS / b_uT.shape[1] ** 0.5), NOISE_uT)
    if (touched_n := int((away_uT > limit_uT).sum())) > OUTLIERS_SHARE * len(b_uT):
        problem = f"{touched_n} of {len(b_uT)} readings differ from the others by up to {away_uT.max():.3g} uT"
        rule = f"the noise explains at most {limit_uT:.3g} uT. Take all of them again while nothing touches the skin"
        raise SchemaError(f"zero: {problem}; {rule}.")


def check_labels(
    place_mm: Float[np.ndarray, "..."],
    force_N: Float[np.ndarray, "..."],
    rows_n: int,
    reach_mm: Float[np.ndarray, "2 2"],
    range_N: tuple[float, float],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Return the places and forces of labelled presses as arrays; raise SchemaError if they are invalid.

    There must be one place and one force for each of the `rows_n` readings, and at most LABELS_MAX_N labels. Places
    must be within `reach_mm`, whose first row has the smallest x and y and whose second row has the largest x and y.
    Forces must be finite, above 0 N, and within the model's range up to RANGE_FACTOR.
    """
    places_mm, forces_N = np.atleast_2d(place_mm), np.atleast_1d(force_N)
    got = f"places {places_mm.shape}, forces {forces_N.shape}, readings ({rows_n})"
    if places_mm.shape != (rows_n, 2) or forces_N.shape != (rows_n,):
        raise SchemaError(
            f"labels: each press needs x and y, a force and a reading; got {got}. Pass arrays of shapes "
            "[m, 2], [m] and [m, channels]."
        )
    least_mm, most_mm = reach_mm
    on_skin = (places_mm >= least_mm) & (places_mm <= most_mm)
    _need("labels", "places", f"on the skin, from {least_mm.tolist()} to {most_mm.tolist()} mm", places_mm, on_skin)
    _need("labels", "forces", "above 0 N", forces_N, ~(forces_N <= 0))
    _need("labels", "forces", "finite", forces_N, ~np.isinf(forces_N))
    least_N, most_N = range_N
    inside = ~((forces_N < least_N / RANGE_FACTOR) | (forces_N > RANGE_FACTOR * most_N))
    rule = f"in N and about {least_N:.3g} to {most_N:.3g} N, which is the force range of the model"
    _need("labels", "forces", rule, forces_N, inside)
    return places_mm, forces_N


# Users may pass field changes where readings are needed. Readings of presses are near the no-load reading, but field
# changes are near 0. Values are refused if their distance to 0, divided by their distance to the no-load reading, is
# below this limit. On the boards of scene lab, the median of this ratio is 0.15 to 0.22 for field changes, and 4 or
# more for readings.
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


def _median_norm(values_uT: Float[np.ndarray, "m ch"]) -> float:
    return float(np.median(np.linalg.norm(values_uT, axis=1))) if len(values_uT) else 0.0


def _need(where: str, what: str, rule: str, got: np.ndarray, valid: Bool[np.ndarray, "..."]) -> None:
    if not valid.all():
        wrong = np.argwhere(~valid)[0]
        raise SchemaError(where, what, rule, str(got[tuple(wrong)]), "Omit the press or reading with this value.")


FORMAT = "reskin-skin-5"
ARRAYS = ("rest_uT", "presses_uT", "labelled_mm", "labelled_N", "labelled_uT")
REFINED = "refined."  # prefix of the names of the weights of a network that was refined on the skin
FILE_BYTES_MAX_N = 2**24  # larger files are refused; with LABELS_MAX_N labels on 64 chips, a file has 5 MB
REMEDY = "Use a skin that `Universal.save` or the page of `reskin live` saved. If another version did, calibrate again."


@dataclass(frozen=True)
class LabelledPresses:
    """Presses at known places, with their forces (NaN if unknown) and field changes.

    Places are relative to the board's centre.
    """

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]

    def __len__(self) -> int:
        return len(self.force_N)

    def __getitem__(self, which: slice | np.ndarray) -> "LabelledPresses":
        """Return some of the presses, selected by a slice or by their indices."""
        return LabelledPresses(self.place_mm[which], self.force_N[which], self.db_uT[which])

    def joined_to(self, other: "LabelledPresses") -> "LabelledPresses":
        """Return these presses after `other`."""
        return LabelledPresses(
            np.concatenate([other.place_mm, self.place_mm]), np.concatenate([other.force_N, self.force_N]),
            np.concatenate([other.db_uT, self.db_uT]),
        )  # fmt: skip

    def distinct(self, noise_uT: float) -> "LabelledPresses":
        """Return each press once: a press repeats an earlier one if only noise distinguishes their readings and labels.

        Raises SchemaError if equal readings have different labels, or if there are more than LABELS_MAX_N labels.
        """
        if not len(self):
            return self
        if len(self) > LABELS_MAX_N:
            rule = f"At most {LABELS_MAX_N} labels can be used, including those that are kept"
            raise SchemaError(f"labels: {len(self)} labels are too many. {rule}. Select some of them.")
        away_uT = cdist(self.db_uT, self.db_uT)
        same_place = (self.place_mm[:, None] == self.place_mm).all(axis=2)
        off_N = self.force_N[:, None] - self.force_N  # NaN if one of two forces is unknown
        wrong = np.argwhere((away_uT == 0) & ~(same_place & ~(np.abs(off_N) > 0)))
        if len(wrong):
            problem = "presses {} and {} have equal readings but different labels".format(*wrong[0])
            raise SchemaError(f"label: {problem}. Pass a reading of its own for each press.")
        unknown = np.isnan(self.force_N)
        same_label = same_place & ((off_N == 0) | (unknown[:, None] & unknown))
        return self[(same_label & (away_uT <= noise_uT)).argmax(axis=1) == np.arange(len(self))]


@dataclass(frozen=True)
class SkinData:
    """All that is known of one skin, along the axes of the board and relative to its centre.

    Parameters
    ----------
    rest_uT : no-load field
    presses_uT : field changes of at most `UNLABELLED_MAX_N` presses at unknown places
    labels : presses at known places
    refined : weights of the network after it was refined on this skin; empty if it was not
    """

    rest_uT: Float[np.ndarray, " ch"]
    presses_uT: Float[np.ndarray, "u ch"]
    labels: LabelledPresses
    refined: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def at_rest(cls, rest_uT: Float[np.ndarray, " ch"]) -> "SkinData":
        """Return the data of a skin of which only the no-load field is known."""
        none = np.zeros((0, len(rest_uT)))
        return cls(rest_uT, none, LabelledPresses(np.zeros((0, 2)), np.zeros(0), none))

    def and_seen(self, db_uT: Float[np.ndarray, "n ch"]) -> "SkinData":
        """Add presses at unknown places. Equal ones count once; the oldest ones are dropped if there are too many."""
        presses_uT = np.concatenate([self.presses_uT, db_uT])
        first = np.sort(np.unique(presses_uT, axis=0, return_index=True)[1])
        return replace(self, presses_uT=presses_uT[first][-UNLABELLED_MAX_N:])


def write_skin(data: SkinData, file: Path, board: str) -> None:
    """Write the data of a skin and the name of the model's board to a safetensors file."""
    labels = data.labels
    values = (data.rest_uT, data.presses_uT, labels.place_mm, labels.force_N, labels.db_uT)
    refined = {REFINED + name: value for name, value in data.refined.items()}
    io.write_tensors(file, dict(zip(ARRAYS, values, strict=True)) | refined, {"format": FORMAT, "board": board})


def is_skin(file: Path) -> bool:
    """Return whether a file is a saved skin, of this or another version.

    A file that is too large to be one is not read. Raises SchemaError if a smaller file is damaged.
    """
    small = file.stat().st_size <= FILE_BYTES_MAX_N
    return small and io.read_tensors(file)[1].get("format", "").startswith(FORMAT.rstrip("0123456789"))


def read_skin_file(file: Path, layout: BoardLayout, shapes: Mapping[str, tuple[int, ...]]) -> SkinData:
    """Read the data of a skin from a file that `write_skin` wrote.

    Parameters
    ----------
    file : the file
    layout : the board of the model
    shapes : shapes of the weights of the model's network

    Raises
    ------
    SchemaError : the file is not a saved skin, is of another board or of an older version, or a value is invalid
    """
    tensors, metadata = io.read_tensors(file)
    form, channels_n = metadata.get("format"), layout.channels_n
    if form != FORMAT:
        raise SchemaError(file, "format", FORMAT, form, REMEDY)
    if (own := metadata.get("board")) != layout.name:
        remedy = f"Use this skin with the model that was made for board {own}."
        raise SchemaError(file, "the board", f"{layout.name}, the board of the model", own, remedy)
    refined = {name.removeprefix(REFINED): tensors.pop(name) for name in list(tensors) if name.startswith(REFINED)}
    got = {name: values.shape for name, values in sorted(tensors.items())}
    presses_n, labels_n = (got.get(name, (0,))[0] for name in ("presses_uT", "labelled_uT"))
    fields = {"rest_uT": (channels_n,), "presses_uT": (presses_n, channels_n), "labelled_uT": (labels_n, channels_n)}
    expected = fields | {"labelled_mm": (labels_n, 2), "labelled_N": (labels_n,)}
    if got != expected or presses_n > UNLABELLED_MAX_N:
        rule = f"{', '.join(ARRAYS)} of {channels_n} channels and at most {UNLABELLED_MAX_N} unlabelled presses"
        raise SchemaError(file, "arrays", rule, got, REMEDY)
    io.check_arrays(file, refined, shapes if refined else {})
    rest_uT, presses_uT, labelled_uT = (check_readings(tensors[name], channels_n) for name in fields)
    place_mm, force_N = check_labels(
        tensors["labelled_mm"].astype(float), tensors["labelled_N"].astype(float), labels_n, layout.reach_mm,
        layout.force_N,
    )  # fmt: skip
    return SkinData(rest_uT[0], presses_uT, LabelledPresses(place_mm, force_N, labelled_uT).distinct(0.0), refined)
