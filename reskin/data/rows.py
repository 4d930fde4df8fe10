"""The rows of a dataset, which are selected readings of several captures.

A capture is one recording of a skin on a board. Only readings in contact become rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, Int64

from reskin import io
from reskin.config import Strict
from reskin.display import one_line
from reskin.errors import ParamsError
from reskin.schema import Readings

TARGETS = ("x_mm", "y_mm", "Fz_N")
# Columns that `stack` concatenates without changes. Column `indentation` is not among them, because it is renumbered.
UNCHANGED_COLUMNS = ("capture", "board", "skin", "db_uT", "target", "pass_i")
SHEAR_TARGETS = ("x_mm", "y_mm", "Fx_N", "Fy_N", "Fz_N")  # targets for recordings with shear forces (paper section 4)


class Selection(Strict):
    """Criterion by which readings in contact are selected.

    A reading is in contact if its place is known and its force is unknown or at least `force_min_N`.
    """

    force_min_N: float


@dataclass(frozen=True)
class Rows:
    """The readings in contact from all captures of a scene, one reading per row. Captures are sorted by name.

    Parameters
    ----------
    capture, board, skin : names of the capture, of the board and of the skin of each row
    db_uT : field change relative to the no-load reading before the same indentation
    target : columns x_mm, y_mm and Fz_N, or the other targets that were passed to `gather`. Fz_N is NaN if a recording
        has no force.
    pass_i : number of the pass, counted over all captures of a skin
    indentation : number of the indentation, counted over all captures of the scene. All readings of an indentation have
        the same number.
    dropped : number of readings that were left out because they are not in contact, by reason
    """

    capture: np.ndarray
    board: np.ndarray
    skin: np.ndarray
    db_uT: Float32[np.ndarray, "f ch"]
    target: Float32[np.ndarray, "f t"]
    pass_i: Int32[np.ndarray, " f"]
    indentation: Int64[np.ndarray, " f"]
    dropped: dict[str, int]

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self.db_uT)

    @classmethod
    def of_labels(cls, boards: Sequence[str], skins: Sequence[str], pass_i: Sequence[int] | None = None) -> "Rows":
        """Create rows for doctests of folds.

        There is one row per indentation. Its field change and its targets are 0. Without `pass_i`, all rows are in
        pass 0.
        """
        f = len(boards)
        zeros, passes = np.zeros((f, 3), np.float32), np.array(pass_i if pass_i is not None else [0] * f, np.int32)
        labels = np.array(["c"] * f), np.array(boards), np.array(skins)
        return cls(*labels, zeros, zeros, passes, np.arange(f), {})


def load_rows(files: Sequence[Path], selection: Selection) -> Rows:
    """Read the captures of a scene from files, and combine their readings in contact to rows (see `gather`)."""
    return gather([io.read_readings(file) for file in files], selection)


def gather(captures: Sequence[Readings], selection: Selection, *, targets: Sequence[str] = TARGETS) -> Rows:
    """Combine the readings in contact from all captures of a scene to rows.

    The other readings are counted in `Rows.dropped`. `targets` are the names of the columns of `Readings` that become
    `Rows.target`.
    """
    if not captures:
        raise ParamsError("the scene has no captures. Add a capture with `reskin add`.")
    _check_one_kind(captures)
    captures = sorted(captures, key=lambda readings: readings.capture)
    kept = [contacts(readings, selection) for readings in captures]
    pairs = list(zip(captures, kept, strict=True))
    for readings, keep in pairs:
        if not keep.any():
            what = f"none of {len(readings)} readings has a known place and at least {selection.force_min_N} N"
            raise ParamsError(
                f"capture {readings.capture}: {what}. Check the places of the capture and the sign of its forces."
            )
    passes_n: dict[str, int] = {}
    pass_i = []
    for readings, keep in pairs:
        before_n = passes_n.get(readings.skin, 0)
        pass_i.append(readings.pass_i[keep] + np.int32(before_n))
        passes_n[readings.skin] = before_n + int(readings.pass_i.max()) + 1
    kept_n = [int(keep.sum()) for keep in kept]
    places_unknown_n = sum(int((np.isnan(readings.x_mm) | np.isnan(readings.y_mm)).sum()) for readings in captures)
    weak_n = sum(map(len, captures)) - sum(kept_n) - places_unknown_n
    columns = [np.stack([getattr(readings, name) for name in targets], axis=1)[keep] for readings, keep in pairs]
    return Rows(
        capture=np.repeat(np.array([readings.capture for readings in captures]), kept_n),
        board=np.repeat(np.array([readings.board for readings in captures]), kept_n),
        skin=np.repeat(np.array([readings.skin for readings in captures]), kept_n),
        db_uT=np.concatenate([readings.db_uT[keep] for readings, keep in pairs]),
        target=np.concatenate(columns),
        pass_i=np.concatenate(pass_i),
        indentation=_number_consecutively([readings.indentation[keep] for readings, keep in pairs]),
        dropped={"no_contact_rows_n": places_unknown_n, "low_force_rows_n": weak_n},
    )


def stack(above: Rows, below: Rows) -> Rows:
    """Append the rows `below` to the rows `above`.

    The row numbers of `above` do not change. The indentations of `below` are renumbered, so that their numbers follow
    those of `above`. `dropped` is copied from `above`.
    """
    if below.db_uT.shape[1:] != above.db_uT.shape[1:]:
        above_n, below_n = above.db_uT.shape[1], below.db_uT.shape[1]
        raise ParamsError(
            f"capture {below.capture[0]}: {below_n} channels, but {above.capture[0]} has {above_n}. Use "
            "boards with the same number of chips."
        )
    stacked = {name: np.concatenate([getattr(above, name), getattr(below, name)]) for name in UNCHANGED_COLUMNS}
    indentation = np.concatenate([above.indentation, below.indentation + above.indentation.max() + 1])
    return Rows(**stacked, indentation=indentation, dropped=above.dropped)


def contacts(readings: Readings, selection: Selection) -> np.ndarray:
    """Return whether each reading is in contact according to `selection`."""
    placed = ~(np.isnan(readings.x_mm) | np.isnan(readings.y_mm))
    weak = readings.Fz_N < selection.force_min_N  # False for an unknown force (NaN)
    return placed & ~weak


def _number_consecutively(indentations: list[np.ndarray]) -> Int64[np.ndarray, " f"]:
    """Number the indentations of all captures from 0, where each capture continues the numbers of the previous one."""
    before_n, renumbered = 0, []
    for numbers in indentations:
        distinct, index = np.unique(numbers, return_inverse=True)
        renumbered.append(before_n + index)
        before_n += len(distinct)
    return np.concatenate(renumbered)


def _check_one_kind(captures: Sequence[Readings]) -> None:
    """Raise ParamsError if the captures cannot be in the same scene.

    All captures must have the same number of chips and the same source, which is a recording or a simulation. Each skin
    must be on only one board.
    """
    first = captures[0]
    boards: dict[str, str] = {}
    for readings in captures:
        where, skin = f"capture {readings.capture}", readings.skin
        if readings.chips_n != first.chips_n:
            what = f"{readings.chips_n} chips, but {first.capture} in the same scene has {first.chips_n}"
            raise ParamsError(f"{where}: {what}. Add this capture to a separate scene.")
        if readings.source != first.source:
            rule = f"{first.source}, as {first.capture} is"
            remedy = "Put simulated and recorded captures into different scenes."
            raise ParamsError(where, "source", rule, readings.source, remedy)
        if boards.setdefault(skin, readings.board) != readings.board:
            remedy = "A skin that is moved to another board counts as a new skin: give it a new name."
            rule = f"{boards[skin]}, as in another capture"
            raise ParamsError(where, f"the board of skin {skin}", rule, readings.board, remedy)
