"""Calibration data of one skin, checks of it, the likelihood powers, and which press to label next."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from reskin import io
from reskin.errors import SchemaError
from reskin.universal.map import Estimate, NOISE_uT, SkinMap, between, kernel
from reskin.universal.network import FULL_SET_N

CHANNELS_N = 15  # of five chips, three axes each
FIELD_MAX_uT = 1e6  # 20 times what a chip can measure: no poke, and single precision holds its square
LABELS_MAX_N = 2000  # pokes at once: memory grows with their square, time faster


def rows_of(b_uT: Float[np.ndarray, "..."]) -> Float[np.ndarray, "f ch"]:
    """Take one reading or several; raise SchemaError on those of another board."""
    rows_uT = np.atleast_2d(np.asarray(b_uT, float))
    if rows_uT.ndim != 2 or rows_uT.shape[1] != CHANNELS_N:
        rule, remedy = f"the {CHANNELS_N} of five chips", "Load a model of such boards."
        raise SchemaError("fields", "channels", rule, f"shape {np.shape(b_uT)}", remedy)
    return rows_uT


def learnt_rows_of(b_uT: Float[np.ndarray, "..."]) -> Float[np.ndarray, "f ch"]:
    """Take readings to learn from; raise SchemaError on one that is no number, or that no chip measures."""
    rows_uT = rows_of(b_uT)
    _need("fields", "readings to learn from", "finite numbers of uT", rows_uT, np.isfinite(rows_uT))
    rule = f"at most {FIELD_MAX_uT:,.0f} uT in size"
    _need("fields", "readings to learn from", rule, rows_uT, np.abs(rows_uT) <= FIELD_MAX_uT)
    return rows_uT


def labels_of(
    place_mm: Float[np.ndarray, "..."],
    force_N: Float[np.ndarray, "..."],
    rows_n: int,
    reach_mm: Float[np.ndarray, "2 2"],
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Take one label or several, as many as readings: places within `reach_mm` (least, most), forces above 0 N."""
    places_mm, forces_N = np.atleast_2d(place_mm), np.atleast_1d(force_N)
    got = f"places {places_mm.shape}, forces {forces_N.shape}, readings ({rows_n}, {CHANNELS_N})"
    if places_mm.shape != (rows_n, 2) or forces_N.shape != (rows_n,):
        rule, remedy = "x and y, a force and a reading of each poke", "Give arrays [m, 2], [m] and [m, 15]."
        raise SchemaError("labels", "shapes", rule, got, remedy)
    if rows_n > LABELS_MAX_N:
        raise SchemaError("labels", "their number", f"at most {LABELS_MAX_N}", rows_n, "Take some of them.")
    least_mm, most_mm = reach_mm
    on_skin = (places_mm >= least_mm) & (places_mm <= most_mm)
    _need("labels", "places", f"on the skin, {least_mm.tolist()} to {most_mm.tolist()} mm", places_mm, on_skin)
    _need("labels", "forces", "above 0 N", forces_N, forces_N > 0)
    _need("labels", "forces", "finite", forces_N, np.isfinite(forces_N))
    return places_mm, forces_N


def _need(where: str, what: str, rule: str, got: np.ndarray, holds: Bool[np.ndarray, "..."]) -> None:
    if not holds.all():
        wrong = np.argwhere(~holds)[0]
        raise SchemaError(where, what, rule, str(got[tuple(wrong)]), "Leave it out.")


FORMAT = "reskin-skin-1"
SHAPES: Mapping[str, tuple[int, ...]] = {  # behind the number of pokes
    "pokes_uT": (CHANNELS_N,),
    "even_uT": (CHANNELS_N,),
    "labelled_mm": (2,),
    "labelled_N": (),
    "labelled_uT": (CHANNELS_N,),
}
FILE_BYTES_MAX_N = 2**20  # a full set of pokes and LABELS_MAX_N labels take a third of it
REMEDY = "Take a file that `save` wrote."

Labelled = tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"], Float[np.ndarray, "m ch"]]  # mm, N, uT


def none() -> Float[np.ndarray, "0 ch"]:
    """Give no poke."""
    return np.zeros((0, CHANNELS_N))


@dataclass(frozen=True)
class Shown:
    """What experts are told of a skin: its field at rest, pokes (at most a full set), and labelled ones."""

    rest_uT: Float[np.ndarray, " ch"]
    pokes_uT: Float[np.ndarray, "c ch"] = field(default_factory=none)
    even_uT: Float[np.ndarray, "e ch"] = field(default_factory=none)  # those that lie evenly over the skin
    labelled: Labelled = field(default_factory=lambda: (np.zeros((0, 2)), np.zeros(0), none()))


def write_shown(shown: Shown, file: Path) -> None:
    """Write it as safetensors; the model that learns from it is not in the file."""
    values = (shown.pokes_uT, shown.even_uT, *shown.labelled)
    io.write_tensors(file, {"rest_uT": shown.rest_uT, **dict(zip(SHAPES, values, strict=True))}, {"format": FORMAT})


def is_shown(file: Path) -> bool:
    """Say whether `write_shown` wrote a file; raise SchemaError on a small one that is damaged or no safetensors."""
    return file.stat().st_size <= FILE_BYTES_MAX_N and io.read_tensors(file)[1].get("format") == FORMAT


def read_shown(file: Path, reach_mm: Float[np.ndarray, "2 2"]) -> Shown:
    """Read it again; raise SchemaError on what no skin within `reach_mm` of its middle was ever told."""
    if file.is_file() and (bytes_n := file.stat().st_size) > FILE_BYTES_MAX_N:
        raise SchemaError(file, "a saved skin", f"at most {FILE_BYTES_MAX_N:,} bytes", f"{bytes_n:,}", REMEDY)
    found, words = io.read_tensors(file, digest_needed=True)
    if words.get("format") != FORMAT:
        raise SchemaError(file, "format", FORMAT, words.get("format"), REMEDY)
    got = {name: values.shape for name, values in sorted(found.items())}
    counts_n = {name: shape[0] for name, shape in got.items() if shape and name != "rest_uT"}
    of_skin = {"rest_uT": (CHANNELS_N,)} | {name: (counts_n.get(name, 0), *shape) for name, shape in SHAPES.items()}
    if got != of_skin or max(counts_n["pokes_uT"], counts_n["even_uT"]) > FULL_SET_N:
        rule = f"rest_uT, {', '.join(SHAPES)} of {CHANNELS_N} channels and at most {FULL_SET_N} unlabelled pokes"
        raise SchemaError(file, "arrays", rule, got, REMEDY)
    fields_uT = {name: learnt_rows_of(values) for name, values in found.items() if values.shape[1:] == (CHANNELS_N,)}
    labels_n = len(fields_uT["labelled_uT"])
    place_mm, force_N = labels_of(
        found["labelled_mm"].astype(float), found["labelled_N"].astype(float), labels_n, reach_mm
    )
    rest_uT = learnt_rows_of(found["rest_uT"])[0]
    return Shown(rest_uT, fields_uT["pokes_uT"], fields_uT["even_uT"], (place_mm, force_N, fields_uT["labelled_uT"]))


Pokes = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, " _"]]  # places in mm from the board's middle, log F


def worth(skin: SkinMap, place_mm: Float[np.ndarray, "c 2"], force_N: Float[np.ndarray, " c"]) -> np.ndarray:
    """Give what each poke is expected to take from the variance of fields, relative to |dB|: the mean over places.

    All channels together, under the middle one of the map's forces. Errors of the law that labels have shown are known.
    """
    of, error_cov, known = skin.hypotheses, skin.error_cov, []
    every = slice(len(of.log_N) // 2, None, len(of.log_N))
    mean_uT, slope_uT = (part[every].astype(float) for part in (of.mean_uT, of.slope_uT))
    of_all = slope_uT / np.linalg.norm(mean_uT, axis=1)[:, None, None] @ skin.cov
    at_mm, at_log_N = (part[every] for part in of.at)
    poke_uT, poke_slope_uT, _ = between(skin, place_mm, force_N)
    poke_log_N = np.log(force_N)
    shared = open_errors(skin, (at_mm, at_log_N), (place_mm, poke_log_N))
    for i, length_uT in enumerate(np.linalg.norm(poke_uT, axis=1)):
        one = slice(i, i + 1)
        slope = poke_slope_uT[i] / length_uT
        own = open_errors(skin, (place_mm[one], poke_log_N[one]), (place_mm[one], poke_log_N[one]))[0, 0]
        cov = slope @ skin.cov @ slope.T + (own + skin.residual.noise) * error_cov
        cov += (NOISE_uT / length_uT) ** 2 * np.eye(len(cov))
        with_all = (of_all @ slope.T + shared[:, i, None, None] * error_cov).reshape(-1, len(cov))
        known.append(float(((with_all @ np.linalg.inv(cov)) * with_all).sum() / len(at_mm)))
    return np.array(known)


def open_errors(skin: SkinMap, a: Pokes, b: Pokes) -> Float[np.ndarray, "n m"]:
    """Give how the law's errors vary together at two sets of pokes, given those that labels have shown."""
    alike, shown = kernel(a[0], b[0], a[1], b[1]), skin.labelled
    if shown is None:
        return alike
    to_a, to_b = (kernel(one[0], shown.place_mm, one[1], shown.log_N) for one in (a, b))
    return alike - to_a @ shown.inverse @ to_b.T


PARTS_N = 5  # of the labelled pokes: each is left out in its turn
PRIOR_N = 40.0  # coordinates as far off as is said, beside those of labels: told on simulated skins (docs/learning.md)
NORMAL_MEAN = math.sqrt(2 / math.pi)  # of |z|

Parts = Sequence[tuple[Sequence[Estimate], Float[np.ndarray, "_ 2"]]]  # under each temper, and where pokes were, in mm


@dataclass(frozen=True)
class Sureness:
    """Tempers at a misfit of 1, told on simulated skins: by unlabelled pokes and by labels; and where pokes lie evenly.

    Between told numbers of labels they lie between; of pokes, what fewer were told counts.
    """

    anywhere: Mapping[int, Mapping[int, float]]
    even: Mapping[int, float]

    def of(self, pokes_n: int, labels_n: int, *, even: bool) -> float:
        """Give the temper for so many pokes and labels."""
        told = self.even if even else self.anywhere[max(n for n in self.anywhere if n <= pokes_n)]
        labels_told_n = sorted(told)
        return float(np.exp(np.interp(labels_n, labels_told_n, np.log([told[n] for n in labels_told_n]))))

    def of_misfit(self, pokes_n: int) -> bool:
        """Say whether so many pokes are enough for their misfit to count."""
        return any(0 < n <= pokes_n for n in self.anywhere)

    def to_card(self) -> dict[str, dict[str, Any]]:
        """Write it as JSON has it."""
        anywhere = {str(pokes_n): _named(of) for pokes_n, of in self.anywhere.items()}
        return {"anywhere": anywhere, "even": _named(self.even)}

    @classmethod
    def of_card(cls, card: Mapping[str, Mapping[str, Any]]) -> "Sureness":
        """Read what `to_card` wrote."""
        anywhere = {int(pokes_n): _numbered(of) for pokes_n, of in card["anywhere"].items()}
        return cls(anywhere, _numbered(card["even"]))


def _named(told: Mapping[int, float]) -> dict[str, float]:
    return {str(n): temper for n, temper in told.items()}


def _numbered(told: Mapping[str, float]) -> dict[int, float]:
    return {int(n): temper for n, temper in told.items()}


def by_misfit(sureness: float, misfit: float) -> float:
    """Believe experts the less the worse pokes fit; sure at most as they say themselves."""
    return min(1.0, sureness / misfit)


def by_residuals(temper: float, ratio: float) -> float:
    """Believe experts the less the farther labels are off; sure at most as they say themselves."""
    return min(1.0, temper / ratio)


def left_out(labels_n: int) -> list[tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " l"]]]:
    """Leave out every fifth label, then those after them: which are told, and which are left out."""
    part = np.arange(labels_n) % PARTS_N
    return [(np.flatnonzero(part != i), np.flatnonzero(part == i)) for i in range(min(PARTS_N, labels_n))]


def ratios(tempers_n: int, parts: Parts) -> list[float]:
    """Give by what variances are larger than was said of labels that were left out, under each temper."""
    found = []
    for i in range(tempers_n):
        off = [np.abs(of_part[i].place_mm - at_mm) / of_part[i].sd_mm for of_part, at_mm in parts]
        found.append(ratio(np.concatenate([np.zeros((0, 2)), *off])))
    return found


def ratio(off: Float[np.ndarray, "m 2"]) -> float:
    """Give the same of coordinates' absolute residuals in standard deviations, by their mean.

    One poke that is far off counts once, not squared.
    """
    return ((PRIOR_N + float(off.sum()) / NORMAL_MEAN) / (PRIOR_N + off.size)) ** 2
