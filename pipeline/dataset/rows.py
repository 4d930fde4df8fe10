"""The rows that a model may see: readings of many captures, selected and stacked. In: `Readings`. Out: `Rows`.

A row is a reading with a known place (and enough force, where force is known). What is left out is counted.
Refuses to know folds, networks and files.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError
from pipeline.core.schema import Readings
from pipeline.dataset.baseline import subtract

TARGETS = ("x_mm", "y_mm", "Fz_N")
SHEAR_TARGETS = ("x_mm", "y_mm", "Fx_N", "Fy_N", "Fz_N")  # of dragged lines (paper section 4)


class Selection(Strict):
    """Which readings count as a contact: those with a known place and, where it is known, at least this force."""

    force_min_N: float


@dataclass(frozen=True)
class Rows:
    """Stacked rows of a scene, captures in order of name.

    `db_uT` is the change of field against the no-load reading of the same indentation; `target` holds x_mm, y_mm and
    Fz_N (NaN where a recording has no force), unless others were gathered; `pass_i` counts on over the captures of one
    skin; `indentation` counts on over the captures of the scene, and the readings of one indentation share it.
    """

    capture: np.ndarray
    board: np.ndarray
    skin: np.ndarray
    db_uT: Float32[np.ndarray, "f ch"]
    target: Float32[np.ndarray, "f t"]
    pass_i: Int32[np.ndarray, " f"]
    indentation: Int64[np.ndarray, " f"]
    dropped: dict[str, int]

    def __len__(self) -> int:
        return len(self.db_uT)

    @classmethod
    def of_labels(cls, boards: Sequence[str], skins: Sequence[str], pass_i: Sequence[int] | None = None) -> "Rows":
        """Rows without readings, one an indentation, for showing how folds are drawn; one pass unless told."""
        f = len(boards)
        empty, passes = np.zeros((f, 3), np.float32), np.array(pass_i if pass_i is not None else [0] * f, np.int32)
        labels = np.array(["c"] * f), np.array(boards), np.array(skins)
        return cls(*labels, empty, empty, passes, np.arange(f), {})


def gather(captures: Sequence[Readings], selection: Selection, *, targets: Sequence[str] = TARGETS) -> Rows:
    """Stack the captures of a scene into rows, and count what is no contact; `targets` name columns of `Readings`."""
    if not captures:
        raise ParamsError("the scene", "captures", "one or more", "none", "Add one with `reskin add`.")
    _check_one_kind(captures)
    captures = sorted(captures, key=lambda one: one.capture)
    kept = [_contacts(one, selection) for one in captures]
    for one, keep in zip(captures, kept, strict=True):
        if not keep.any():
            raise ParamsError(
                    f"capture {one.capture}", f"readings with a known place and at least {selection.force_min_N} N",
                    "one or more", f"none of {len(one)}", "Look at its places and at the sign of its force.",
                )  # fmt: skip
    passes_n: dict[str, int] = {}
    pass_i = []
    for one, keep in zip(captures, kept, strict=True):
        before_n = passes_n.get(one.skin, 0)
        pass_i.append(one.pass_i[keep] + np.int32(before_n))
        passes_n[one.skin] = before_n + int(one.pass_i.max()) + 1
    places_unknown_n = sum(int(np.isnan(one.x_mm).sum()) for one in captures)
    all_n, kept_n = sum(map(len, captures)), sum(int(keep.sum()) for keep in kept)
    return Rows(
        capture=_repeat([one.capture for one in captures], kept),
        board=_repeat([one.board for one in captures], kept),
        skin=_repeat([one.skin for one in captures], kept),
        db_uT=np.concatenate(
            [subtract(o.b_uT[keep], o.noload_uT[keep]) for o, keep in zip(captures, kept, strict=True)]
        ),
        target=np.concatenate([_targets(one, targets)[keep] for one, keep in zip(captures, kept, strict=True)]),
        pass_i=np.concatenate(pass_i),
        indentation=_count_on([one.indentation[keep] for one, keep in zip(captures, kept, strict=True)]),
        dropped={"no_contact_rows_n": places_unknown_n, "low_force_rows_n": all_n - kept_n - places_unknown_n},
    )


def _contacts(one: Readings, selection: Selection) -> np.ndarray:
    placed = ~(np.isnan(one.x_mm) | np.isnan(one.y_mm))
    weak = one.Fz_N < selection.force_min_N  # unknown force (NaN) is not weak
    return placed & ~weak


def _targets(one: Readings, names: Sequence[str]) -> Float32[np.ndarray, "f t"]:
    return np.stack([getattr(one, name) for name in names], axis=1)


def _repeat(labels: list[str], kept: list[np.ndarray]) -> np.ndarray:
    return np.repeat(np.array(labels), [int(keep.sum()) for keep in kept])


def _count_on(indentations: list[np.ndarray]) -> Int64[np.ndarray, " f"]:
    """Number the indentations of each capture after those of the one before."""
    before_n, counted = 0, []
    for own in indentations:
        distinct, own_i = np.unique(own, return_inverse=True)
        counted.append(before_n + own_i)
        before_n += len(distinct)
    return np.concatenate(counted)


def _check_one_kind(captures: Sequence[Readings]) -> None:
    first = captures[0]
    boards: dict[str, str] = {}
    for one in captures:
        if one.chips_n != first.chips_n:
            raise ParamsError(
                    f"capture {one.capture}", "chips of a scene's captures", f"the {first.chips_n} of {first.capture}",
                    one.chips_n, "Add it to a scene of its own.",
                )  # fmt: skip
        if one.source != first.source:
            raise ParamsError(
                    f"capture {one.capture}", "source", f"{first.source}, as {first.capture} is", one.source,
                    "Simulated and recorded captures belong to different scenes.",
                )  # fmt: skip
        if boards.setdefault(one.skin, one.board) != one.board:
            raise ParamsError(
                    f"capture {one.capture}", f"the board of skin {one.skin}", f"{boards[one.skin]}, as before",
                    one.board,
                    "A skin moved to another board is a new skin here: give it a new name.",
                )  # fmt: skip
