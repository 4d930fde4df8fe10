"""Presses on a recorded board, and statistics that compare them with a simulation.

The statistics are:

- the cosine of the angle between recorded and simulated field changes;
- the fraction of the recorded field change that the simulation explains;
- the growth of the field change with force.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from reskin.errors import SchemaError
from reskin.schema import AXES_PER_CHIP_N, Readings

# If a capture has more depths than this, the depths were arbitrary, so only few presses have the same depth.
DEPTHS_MAX_N = 10
SPREAD_MIN = 0.2  # places with a smaller range of the logarithm of the force are not used to estimate the growth


@dataclass(frozen=True)
class RecordedPresses:
    """Recorded presses of one skin on its board.

    All values are means over the readings of a press. Fields are along the chips' axes. Presses belong to groups: a
    group consists of the presses of one capture or, if depths are known, of the presses at one depth of a capture. If a
    capture has more than `DEPTHS_MAX_N` depths, its presses are divided into three groups of equal size by depth.

    Parameters
    ----------
    board : name of the board
    groups : names of the groups
    group_i : index of the group of each press
    place_mm, force_N : place and force of each press
    db_uT, noload_uT : field change of each press, and the no-load reading before it
    forces_known : False if no press has a known force. In this case, `force_N` is NaN.
    """

    board: str
    groups: tuple[str, ...]
    group_i: Int[np.ndarray, " n"]
    place_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    db_uT: Float[np.ndarray, "n k 3"]
    noload_uT: Float[np.ndarray, "n k 3"]
    forces_known: bool = True

    def __len__(self) -> int:
        return len(self.force_N)


def pool(captures: Sequence[Readings], *, with_force: bool = True) -> RecordedPresses:
    """Combine the presses of all captures of one skin on one board, in the order of the captures.

    Presses without a known place and a known force above 0 N are excluded. If `with_force` is False and no force is
    known at all, all presses with a known place are kept. Raises SchemaError if no press is left.
    """
    parts = [_means(readings) for readings in captures]
    groups, group_i = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    place_mm, force_N, db_uT, noload_uT = (
        np.concatenate([part[i] for part in parts]).astype(float) for i in range(1, 5)
    )
    placed = np.isfinite(place_mm).all(axis=1)
    forces_known = with_force or bool(np.isfinite(force_N).any())
    known = placed & (force_N > 0) if forces_known else placed
    if not known.any():
        what = f"board {captures[0].board} has no press with a known place and force"
        raise SchemaError(
            f"experiment compare: {what}. Record the places and forces of presses, or remove "
            "the experiment from the scene."
        )
    return RecordedPresses(
        board=captures[0].board, groups=tuple(groups.tolist()), group_i=group_i.ravel()[known],
        place_mm=place_mm[known], force_N=force_N[known], db_uT=db_uT[known], noload_uT=noload_uT[known],
        forces_known=forces_known,
    )  # fmt: skip


def pool_skins(captures: Sequence[Readings], *, with_force: bool = True) -> dict[str, RecordedPresses]:
    """Combine the captures of each skin (see `pool`).

    The keys of the result are names of boards, or `board/skin` for boards with several skins.
    """
    skins: dict[str, list[Readings]] = {}
    for capture in captures:
        skins.setdefault(f"{capture.board}/{capture.skin}", []).append(capture)
    boards = [name.partition("/")[0] for name in skins]
    names = {name: board if boards.count(board) == 1 else name for name, board in zip(skins, boards, strict=True)}
    return {names[name]: pool(captures_of_skin, with_force=with_force) for name, captures_of_skin in skins.items()}


def thin(presses: RecordedPresses, most_n: int) -> RecordedPresses:
    """Select at most `most_n` presses, evenly distributed over the recording."""
    kept = np.unique(np.linspace(0, len(presses) - 1, most_n).round().astype(int))
    names = ("group_i", "place_mm", "force_N", "db_uT", "noload_uT")
    return replace(presses, **{name: getattr(presses, name)[kept] for name in names})


def _means(readings: Readings) -> tuple[np.ndarray, ...]:
    """Return means over the readings of each press.

    The result contains, for each press, the name of its group, its place, its force, its field change and its
    no-load reading.
    """
    _, first, press_i, counts = np.unique(
        readings.indentation, return_index=True, return_inverse=True, return_counts=True
    )
    chips = (len(first), readings.chips_n, AXES_PER_CHIP_N)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.zeros((len(first), *values.shape[1:]))
        np.add.at(total, press_i.ravel(), values)
        return total / counts.reshape(-1, *[1] * (values.ndim - 1))

    b_uT, noload_uT = readings.b_uT.astype(float), readings.noload_uT[first].astype(float)
    mean_uT = mean(b_uT)
    group = _name_groups(readings.capture, readings.depth_mm[first])
    place_mm = np.stack([readings.x_mm[first], readings.y_mm[first]], axis=1)
    fields = [values.reshape(chips) for values in (mean_uT - noload_uT, noload_uT)]
    return group, place_mm, mean(readings.Fz_N.astype(float)), *fields


def _name_groups(capture: str, depths_mm: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return the name of the group of each press. `RecordedPresses` explains groups."""
    known = np.isfinite(depths_mm)
    names = [f" {mm:g} mm" for mm in depths_mm]
    if len(np.unique(depths_mm[known])) > DEPTHS_MAX_N:
        limits_mm = np.quantile(depths_mm[known], [0, 1 / 3, 2 / 3, 1])
        thirds = [f" {low:.3g} to {high:.3g} mm" for low, high in pairwise(limits_mm)]
        names = [thirds[i] for i in np.searchsorted(limits_mm[1:-1], depths_mm)]
    return np.array([capture + (name if is_known else "") for name, is_known in zip(names, known, strict=True)])


def magnitudes_uT(db_uT: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Return |dB| of each press, which is the norm of the field change over all channels."""
    return np.linalg.norm(db_uT.reshape(len(db_uT), -1), axis=1)


def cosines(one_uT: Float[np.ndarray, "n k 3"], other_uT: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Return the cosine of the angle between two field changes of each press, as vectors of all channels."""
    return (one_uT * other_uT).sum(axis=(1, 2)) / (magnitudes_uT(one_uT) * magnitudes_uT(other_uT))


def explained(simulated_uT: Float[np.ndarray, "n k 3"], recorded_uT: Float[np.ndarray, "n k 3"]) -> np.ndarray:
    """Return the fraction of the recorded field change of each press that the simulation explains.

    This fraction is 1 - |simulated - recorded|^2 / |recorded|^2.
    """
    return 1 - (magnitudes_uT(simulated_uT - recorded_uT) / magnitudes_uT(recorded_uT)) ** 2


def growth(presses: RecordedPresses, db_uT: Float[np.ndarray, "n k 3"]) -> float | None:
    """Return how the field change |dB| grows with the force F: the exponent n in |dB| ~ F^n.

    At each place, n is the slope of log|dB| against log F. The result is the median over places. Places at which the
    force varies too little are skipped. The result is None if all places are skipped.
    """
    log_F, log_uT = np.log(presses.force_N), np.log(magnitudes_uT(db_uT))
    slopes = []
    for place in np.unique(presses.place_mm.round(2), axis=0):
        at_place: Bool[np.ndarray, " n"] = (np.abs(presses.place_mm - place) < 0.01).all(axis=1)
        x, y = log_F[at_place] - log_F[at_place].mean(), log_uT[at_place] - log_uT[at_place].mean()
        if np.ptp(x) > SPREAD_MIN:
            slopes.append(float(x @ y / (x @ x)))
    return float(np.median(slopes)) if slopes else None
