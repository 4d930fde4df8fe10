"""Parse text tables of recordings: cells and numbers, with the line of whatever is wrong."""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Shaped

from reskin.board import faults
from reskin.errors import CaptureError
from reskin.recordings.columns import FIRST_ROW
from reskin.recordings.header import Header
from reskin.recordings.probe import ProbeLog
from reskin.schema import UNITS, Readings

# No reading, place or unix time of these recordings comes near it; float32 holds it without overflow.
MAGNITUDE_MAX = 1e10


def read_cells(path: Path, where: str, *, separator: str | None) -> list[list[str]]:
    """Split a text file into cells, one list a line and all of one length; `None` splits at any white space."""
    text = _read_text(path, where)
    if separator == "," and ";" in text.partition("\n")[0]:
        remedy = "Export it with commas between columns and points in numbers."
        raise CaptureError(where, "columns", "separated by commas", "semicolons in line 1", remedy)
    cells = [line.split(separator) for line in text.removesuffix("\n").split("\n")]
    for line_i, row in enumerate(cells):
        if len(row) != len(cells[0]):
            got = f"{len(row)} in line {line_i + 1}"
            raise CaptureError(where, "columns", f"{len(cells[0])}, as in line 1", got, "Was the file cut or edited?")
    return cells


def to_numbers(
    cells: list[list[str]], where: str, *, names: Sequence[str], first_line_n: int = 1
) -> Float64[np.ndarray, "f c"]:
    """Turn cells into finite numbers; `names` are the columns', `first_line_n` the file's line of `cells[0]`."""
    if cells and len(cells[0]) != len(names):
        rule = f"{len(names)} a line ({names[0]} ... {names[-1]})"
        raise CaptureError(where, "columns", rule, len(cells[0]), "Is the layout right, and the number of chips?")
    if not cells:
        raise CaptureError(where, "the file", "at least one row of numbers", "none", "Copy the recording again.")
    try:
        numbers = np.array(cells, dtype=np.float64)
    except ValueError:
        raise _first_fault(cells, where, names, first_line_n) from None
    if not (np.abs(numbers) < MAGNITUDE_MAX).all():
        raise _first_fault(cells, where, names, first_line_n)
    return numbers


def make_readings(
    header: Header, keep: Bool[np.ndarray, " rows"], **columns: Shaped[np.ndarray, "rows ..."]
) -> Readings:
    """Make readings of the rows to keep; a column that is not given is unknown, and `reading_i` 0."""
    no_degC = np.full((len(keep), header.chips_n), np.nan)
    columns = {"reading_i": np.zeros(len(keep)), "temperature_degC": no_degC, **columns}
    unknown = np.full(len(keep), np.nan)
    typed = {name: columns.get(name, unknown)[keep].astype(_dtype(name)) for name in UNITS}
    return Readings(capture=header.capture, board=header.board, skin=header.skin, source=header.source, **typed)


def mean_by_group(
    b_uT: Float64[np.ndarray, "f ch"], group_i: Int[np.ndarray, " f"], groups_n: int
) -> Float64[np.ndarray, "n ch"]:
    """Give the mean field of each group of rows; NaN for a group without rows."""
    sums_uT = np.zeros((groups_n, b_uT.shape[1]))
    np.add.at(sums_uT, group_i, b_uT)
    rows_n = np.bincount(group_i, minlength=groups_n)[:, None]
    return np.divide(sums_uT, rows_n, out=np.full(sums_uT.shape, np.nan), where=rows_n > 0)


def _dtype(name: str) -> type[np.generic]:
    if name == "t_s":
        return np.float64
    return np.int32 if UNITS[name] == "1" else np.float32


def _read_text(path: Path, where: str) -> str:
    try:
        text = path.read_bytes().decode("utf-8-sig")  # spreadsheets begin a file with a mark of byte order
    except UnicodeDecodeError as error:
        got = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise CaptureError(where, "the file", "text", got, "Is it another file under this name?") from None
    except OSError as error:
        raise CaptureError(where, "the file", "readable", error.strerror, "Copy the recording again.") from None
    if not text.endswith("\n"):
        got = "no bytes" if not text else f"{text[-12:]!r}"
        remedy = "Copy the recording again; if it is whole, end it with an empty line."
        raise CaptureError(where, "the last line", "complete and end in a line feed", got, remedy)
    return text


def _first_fault(cells: list[list[str]], where: str, names: Sequence[str], first_line_n: int) -> CaptureError:
    for row_i, row in enumerate(cells):
        for name, cell in zip(names, row, strict=True):
            if not _is_number(cell):
                place = f"{name} in line {first_line_n + row_i}"
                rule = f"a finite number below {MAGNITUDE_MAX:g}"
                return CaptureError(where, place, rule, repr(cell[:20]), "Mend or remove this row, then add it again.")
    raise AssertionError("numbers refused, though every cell is one")


def _is_number(cell: str) -> bool:
    try:
        return abs(float(cell)) < MAGNITUDE_MAX
    except ValueError:
        return False


PHASES = ("noload", "contact")


def count_chips_of(names: list[str]) -> int:
    """Count the chips that columns `T<i>`, `Bx<i>`, `By<i>`, `Bz<i>` are of."""
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"(?:T|Bx|By|Bz)(\d{1,3})", name))]
    return max(numbers, default=0) + 1


def check_columns(names: list[str], wanted: list[str], where: str, *, layout: str) -> None:
    """Raise for a column that is not there, and for one that is there twice."""
    missing = [name for name in wanted if name not in names]
    if missing:
        got = f"none named {', '.join(missing)}"
        raise CaptureError(
            where, "columns", "those of data/README.md", got, f"Is this layout {layout}, line 1 its names?"
        )
    twice = [name for name, times_n in Counter(names).items() if times_n > 1]
    if twice:
        raise CaptureError(where, "names of columns", "unique", f"{twice[0]} twice", "Remove one of the two.")


def contact_rows(phases: list[str], where: str, first_line_n: int) -> Bool[np.ndarray, " f"]:
    """Tell rows of contact from rows without; another word is an error, and so is a table without contact."""
    for row_i, phase in enumerate(phases):
        if phase not in PHASES:
            place = f"phase in line {first_line_n + row_i}"
            raise CaptureError(where, place, "noload or contact", repr(phase[:20]), "Mend the word.")
    if "contact" not in phases:
        raise CaptureError(where, "the file", "rows of phase contact", "none", "Was the recording cut?")
    return np.array([phase == "contact" for phase in phases])


def count_within(press: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Count 0, 1, 2 ... within each block of equal numbers."""
    begins = np.flatnonzero(np.diff(press, prepend=-1))
    return np.arange(len(press)) - np.repeat(begins, np.diff(begins, append=len(press)))


# MLX90393 data sheet, table 17: 16 bits of the coarsest step, 9.680 uT (z, GAIN_SEL 0, RES 3).
FULL_SCALE_uT = 32768 * 9.680
# The earth's field alone is 25-65 uT; a chip under a skin reads 200 to 9000 uT, which in mT or T is below this.
WEAKEST_uT = 20.0
# The strongest skin known, 13000 uT, would be 130 G: weaker fields on a grid finer than any of the chip's are gauss.
GAUSS_MAX = 200.0
NANO_STEP_MIN = 100.0  # the finest step is 150 nT, the coarsest 9.68 uT
# Forces on skins a few mm thick; a touch of 1 N read as grams would be 102.
FORCE_MAX_N = 100.0
FORCE_MIN_N = 0.05  # the strongest touch of any recording is above it; a touch of 0.4 N in kg is not
SAME_PLACE_mm = 0.002  # a robot that stands still says so to a few um
EXTENT_MIN_mm, EXTENT_MAX_mm = 1.0, 200.0
DEPTH_MIN_mm, DEPTH_MAX_mm = 0.05, 100.0


def check_fields(b_uT: Float[np.ndarray, "f ch"], where: str, *, first_line_n: int) -> None:
    """Raise if fields are beyond the chip's full scale, too weak for the earth, or on a grid that no chip has in uT.

    The grid shows only where values were not averaged; what is rounded to whole decimals shows none.
    """
    _check_full_scale(b_uT, where, first_line_n)
    usual_uT = float(np.median(np.linalg.norm(b_uT.reshape(len(b_uT), -1, 3).astype(np.float64), axis=2)))
    if usual_uT < WEAKEST_uT:
        rule = f"{WEAKEST_uT:g} uT or more at most chips, as the earth's field is"
        raise CaptureError(where, "field", rule, f"{usual_uT:.4g}", "Convert mT or G to uT.")
    step_uT = _find_step(b_uT)
    if step_uT > NANO_STEP_MIN or (usual_uT < GAUSS_MAX and step_uT < faults.STEP_MIN_uT):
        unit = "nT" if step_uT > NANO_STEP_MIN else "G"
        rule = "in the steps of an MLX90393, 0.15 to 9.68 uT"
        raise CaptureError(where, "field", rule, f"steps of {step_uT:.3g}", f"Convert {unit} to uT.")


def check_changes(db_uT: Float[np.ndarray, "f ch"], where: str, *, first_line_n: int) -> None:
    """Raise if changes of field are beyond the chip's full scale or in steps that no chip has; they may be weak."""
    _check_full_scale(db_uT, where, first_line_n)
    step_uT = _find_step(db_uT)
    if step_uT > NANO_STEP_MIN or step_uT < faults.STEP_MIN_uT:
        rule = "in the steps of an MLX90393, 0.15 to 9.68 uT"
        raise CaptureError(where, "change of field", rule, f"steps of {step_uT:.3g}", "Convert nT, mT or G to uT.")


def check_forces(force_N: Float[np.ndarray, " f"], where: str, *, first_line_n: int) -> None:
    """Raise if a force is more than these skins bear, as forces in grams are; NaN is no force and passes."""
    too_strong = np.flatnonzero(np.abs(force_N) > FORCE_MAX_N)
    if len(too_strong):
        got = f"{force_N[too_strong[0]]:.6g} in line {first_line_n + int(too_strong[0])}"
        raise CaptureError(where, "force", f"below {FORCE_MAX_N:g} N", got, "Convert grams or mN to N.")


def check_touch(force_N: Float[np.ndarray, "*f"], where: str) -> None:
    """Raise if forces are known, and none of them is one that a gauge can tell from none, as in kg or kN."""
    strongest_N = np.abs(force_N[np.isfinite(force_N)]).max(initial=0.0)
    if 0 < strongest_N < FORCE_MIN_N:
        got = f"{strongest_N:.3g} at most"
        rule = f"{FORCE_MIN_N:g} N or more somewhere in contact"
        raise CaptureError(where, "force", rule, got, "Convert kg or kN to N, or press the skin.")


def check_places(place_mm: Float[np.ndarray, "f axes"], where: str) -> None:
    """Raise if places that differ lie closer together or wider apart than a skin's; NaN is no place and passes."""
    known_mm = place_mm[np.isfinite(place_mm).all(axis=1)]
    extent_mm = float(np.ptp(known_mm, axis=0).max()) if len(known_mm) else 0.0
    if extent_mm > SAME_PLACE_mm and not EXTENT_MIN_mm <= extent_mm <= EXTENT_MAX_mm:
        rule = f"one, or spread over {EXTENT_MIN_mm:g} to {EXTENT_MAX_mm:g} mm"
        raise CaptureError(where, "places", rule, f"{extent_mm:.4g}", "Convert m or um to mm.")


def check_depths(depth_mm: Float[np.ndarray, " f"], where: str) -> None:
    """Raise if no depth is one that a robot presses, or one is deeper than a skin; 0 and NaN are none and pass."""
    deepest_mm = np.abs(depth_mm[np.isfinite(depth_mm)]).max(initial=0.0)
    if deepest_mm and not DEPTH_MIN_mm <= deepest_mm <= DEPTH_MAX_mm:
        rule = f"{DEPTH_MIN_mm:g} to {DEPTH_MAX_mm:g} mm where it is greatest"
        raise CaptureError(where, "depth", rule, f"{deepest_mm:.4g}", "Convert m or um to mm.")


def check_log(log: ProbeLog, where: str) -> None:
    """Raise if places, depths or forces of the contacts are not in mm and N, or compression is negative."""
    contact = log.contact
    force_N = np.stack([log.Fx_N, log.Fy_N, log.Fz_N], axis=1)
    for axis_N in force_N.T:
        check_forces(axis_N, where, first_line_n=FIRST_ROW)
    check_touch(force_N[contact], where)
    check_places(np.stack([log.x_mm, log.y_mm], axis=1)[contact], where)
    check_depths(log.depth_mm[contact], where)
    known_N = log.Fz_N[contact & np.isfinite(log.Fz_N)]
    if len(known_N) and np.median(known_N) < 0:
        got = f"{np.median(known_N):.4g} N"
        raise CaptureError(where, "the usual Fz_N in contact", "positive", got, "Turn its sign.")


def _check_full_scale(b_uT: Float[np.ndarray, "f ch"], where: str, first_line_n: int) -> None:
    b_max_uT = np.abs(b_uT).max(axis=1)
    if b_max_uT.max() > FULL_SCALE_uT:
        place = f"line {first_line_n + int(b_max_uT.argmax())}"
        rule = f"below the full scale of {FULL_SCALE_uT:.0f} uT"
        got = f"{b_max_uT.max():.6g} in {place}"
        raise CaptureError(where, "field", rule, got, "Are the columns in order, and in uT?")


def _find_step(b_uT: Float[np.ndarray, "f ch"]) -> float:
    """Give the usual step of the chips along x and y; NaN where none shows, or where it is that of rounded decimals."""
    steps_uT = faults.find_lsb(b_uT, step_min_uT=0.0, steps_min_n=faults.SURE_STEPS_MIN_N)[:, 0]
    steps_uT = steps_uT[np.isfinite(steps_uT)]
    if not len(steps_uT):
        return np.nan
    step_uT = float(np.median(steps_uT))
    decimals = np.log10(step_uT)
    rounded = step_uT < faults.STEP_MIN_uT and abs(decimals - round(decimals)) < 0.01
    return np.nan if rounded else step_uT
