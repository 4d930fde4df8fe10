"""Check whether a recorded board is oriented as stated, by comparing it with the nominal skin in other orientations.

Recordings and the nominal skin are compared with mirrored or rotated labels, with exchanged, mirrored or rotated chips,
and with a flipped skin. An orientation that agrees clearly better than the stated one suggests a mistake.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from pipeline.fitting.axes import BoardAxes
from pipeline.fitting.law_fit import AlignedPresses
from pipeline.fitting.presses import pool, thin
from reskin.schema import Readings
from reskin.universal.law import simulate_uT

# For each chip, a cosine tells how well the directions of the recorded and the simulated fields agree. An orientation
# that differs from the stated one is reported only if it raises the sum of the chips' cosines by this much. The value
# is assumed. Wrong axes lower the cosine of a chip by 0.5 or more, which is enough to be reported. A skin that is
# displaced by 0.5 mm changes each cosine by less than 0.1.
PENALTY = 0.1
AXES = "xyz"
AS_SAID = "Labels, chips and skin are oriented as {} states."
# This force replaces unknown forces. Only the directions of fields are compared, which hardly depend on the force.
ASSUMED_N = 1.0


@dataclass(frozen=True)
class Turn:
    """Orientation of a chip's axes or of the labels' axes, relative to the stated axes.

    The stated axes are first multiplied by `signs`, and then rotated by `quarters` quarter turns about z.
    """

    quarters: int
    signs: tuple[int, int, int]

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return quarter_turn(self.quarters) @ np.diag(self.signs)

    def describe(self, stated_by: str = "the scene") -> str:
        """Describe how this orientation differs from the stated one.

        Returns an empty string if there is no difference.
        """
        mirrored = " and ".join(axis for axis, sign in zip(AXES, self.signs, strict=True) if sign < 0)
        turned = [f"turned by {90 * self.quarters} degrees more than {stated_by} says"] * bool(self.quarters)
        return " and ".join(turned + [f"mirrored along {mirrored}"] * bool(mirrored))


# The 16 different orientations. Some combinations of turns and signs are left out, because they are equal to others:
# mirroring x and rotating by a half turn is the same as mirroring y. The first orientation is the stated one. The first
# eight orientations leave z unchanged; only these are possible for labels.
PLAIN = [(quarters, 1, 1) for quarters in range(4)] + [(0, -1, 1), (0, 1, -1), (1, -1, 1), (1, 1, -1)]
TURNS = [Turn(quarters, (x, y, z)) for z in (1, -1) for quarters, x, y in PLAIN]


def quarter_turn(quarters: int) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that rotates by this number of quarter turns about z."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Frames:
    """The orientations of labels, skin and chips with which recordings and the nominal skin agree best.

    - labels: orientation of the labels' axes.
    - flipped: whether all magnetic poles of the skin are swapped.
    - chips: element i is the number, in the stated list of chips, of the position where recorded chip i was found.
    - turns: element i is the orientation of recorded chip i.
    - cosines: cosine between recorded and simulated fields of each chip, in the orientations found.
    - as_written: the same cosines in the stated orientations.
    - worth: sum of `cosines`, minus a penalty for each difference from the stated orientations.
    """

    labels: Turn
    flipped: bool
    chips: Int[np.ndarray, " k"]
    turns: tuple[Turn, ...]
    cosines: Float[np.ndarray, " k"]
    as_written: Float[np.ndarray, " k"]
    worth: float

    @property
    def as_stated(self) -> bool:
        """Whether the orientations are the stated ones."""
        in_place = bool((self.chips == np.arange(len(self.chips))).all())
        return in_place and not self.flipped and {self.labels, *self.turns} == {TURNS[0]}

    def sentence(self, stated_by: str = "the scene") -> str:
        """Describe all differences from the stated orientations."""
        if self.as_stated:
            return AS_SAID.format(stated_by)
        differences = [f"the labels are {self.labels.describe(stated_by)}"] * (self.labels != TURNS[0])
        differences += ["the skin is flipped: every field has the opposite sign"] * self.flipped
        differences += _describe_exchanges(self.chips)
        for turn in dict.fromkeys(self.turns):
            chips = [i for i, chip_turn in enumerate(self.turns) if chip_turn == turn]
            if turn != TURNS[0]:
                differences.append(f"{_name_chips(chips, len(self.turns))} {turn.describe(stated_by)}")
        return f"Contrary to {stated_by}, {'; '.join(differences)}."


def _name_chips(chips: Sequence[int], chips_n: int) -> str:
    if len(chips) == chips_n:
        return "all chips are"
    return f"chip {chips[0]} is" if len(chips) == 1 else f"chips {', '.join(map(str, chips))} are"


def _describe_exchanges(positions: Int[np.ndarray, " k"]) -> list[str]:
    moved = np.flatnonzero(positions != np.arange(len(positions))).tolist()
    if len(moved) == 2:
        return [f"chips {moved[0]} and {moved[1]} are exchanged"]
    places = ", ".join(f"chip {i} is at the position of chip {positions[i]}" for i in moved)
    return [f"chips are exchanged ({places})"] if moved else []


def frames_of(aligned: AlignedPresses, axes: BoardAxes) -> Frames:
    """Find the orientations of a recorded board. `ASSUMED_N` replaces unknown forces."""
    recorded = aligned.recorded
    force_N = recorded.force_N if recorded.forces_known else np.full(len(recorded), ASSUMED_N)
    return find_frames(
        aligned.place_mm, recorded.db_uT, axes.rotations,
        lambda places_mm: simulate_uT(axes.nominal, axes.setup, places_mm, force_N),
    )  # fmt: skip


def describe_outside(place_mm: Float[np.ndarray, "n 2"], axes: BoardAxes) -> str | None:
    """Describe the presses whose stated places are outside the skin.

    Returns None if all presses are on the skin. `place_mm` are places relative to the board's centre. If presses seem
    to be outside the skin, their places are wrong, so the orientations that agree best with them mean nothing.
    """
    outside_n = int((np.abs(place_mm) > np.array(axes.setup.skin_mm) / 2).any(axis=1).sum())
    if not outside_n:
        return None
    (x_mm, y_mm), (width_mm, height_mm) = axes.labels_middle_mm, axes.setup.skin_mm
    ranges = [
        f"{axis} from {low:.3g} to {high:.3g} mm"
        for axis, low, high in zip(AXES, place_mm.min(axis=0), place_mm.max(axis=0), strict=False)
    ]
    key = "centre_mm"
    return (
        f"{outside_n} of {len(place_mm)} presses are outside the skin ({width_mm:g} x {height_mm:g} mm) that "
        f"{axes.stated_by} states: relative to {key} [{x_mm:g}, {y_mm:g}], all presses have "
        f"{' and '.join(ranges)}. Correct {key}, the size of the skin or the places of the presses."
    )


def find_frames(
    place_mm: Float[np.ndarray, "n 2"],
    read_uT: Float[np.ndarray, "n k 3"],
    chips_turn: Float[np.ndarray, "k 3 3"],
    nominal: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n k 3"]],
) -> Frames:
    """Find the orientations of labels, skin and chips with which recordings and the nominal skin agree best.

    Parameters
    ----------
    place_mm
        Places of the pokes.
    read_uT
        Recorded changes of field in the chips' axes.
    chips_turn
        Stated rotations of the chips.
    nominal
        Function that simulates pokes of the nominal skin at places in the board's axes.

    If a chip is found at the position of another chip, its rotation is assumed to be the rotation that is stated for
    this position.
    """
    turns = np.stack([turn.matrix for turn in TURNS])
    as_written, candidate_frames = np.empty(0), []
    for labels in TURNS[:8]:
        simulated_uT = nominal(place_mm @ labels.matrix[:2, :2].T)
        # Entry [k, l, t] of `cosine` is the cosine, over all pokes, between two fields. One is the field of recorded
        # chip k, transformed by orientation t. The other is the field that is simulated at the position of chip l.
        rotated_uT = np.einsum("kij,nki->nkj", chips_turn, simulated_uT)
        moments = np.einsum("nka,nlb->klab", read_uT, rotated_uT)
        sizes = np.linalg.norm(read_uT, axis=(0, 2))[:, None] * np.linalg.norm(simulated_uT, axis=(0, 2))
        cosine = np.einsum("klab,tba->klt", moments, turns) / sizes[..., None]
        if labels == TURNS[0]:
            as_written = np.diagonal(cosine[..., 0]).copy()
        candidates = product((False, True), TURNS)
        candidate_frames += [_best_chips(labels, flipped, common, cosine, as_written) for flipped, common in candidates]
    return max(candidate_frames, key=lambda frames: frames.worth)


def _best_chips(
    labels: Turn, flipped: bool, common: Turn, cosine: Float[np.ndarray, "k l t"], as_written: np.ndarray
) -> Frames:
    """Find the best positions and orientations of the chips for given orientations of labels and skin.

    `common` is a candidate for the orientation that most chips share. Only chips whose orientation differs from
    `common` get a penalty. If `common` itself differs from the stated orientation, one further penalty is subtracted.
    It is 1.5 times as large as the other penalties, because a flipped skin can look like a common turn of all chips,
    and a flipped skin shall then be preferred.
    """
    signed = -cosine if flipped else cosine
    worth = signed - PENALTY * np.array([turn != common for turn in TURNS])
    pair_worth = worth.max(axis=2) - PENALTY * (1 - np.eye(len(worth)))
    chips, positions = linear_sum_assignment(pair_worth, maximize=True)
    turn_i = worth[chips, positions].argmax(axis=1)
    total = pair_worth[chips, positions].sum() - PENALTY * ((labels != TURNS[0]) + flipped + 1.5 * (common != TURNS[0]))
    turns = tuple(TURNS[i] for i in turn_i)
    return Frames(labels, flipped, positions, turns, signed[chips, positions, turn_i], as_written, float(total))


CHIPS_MIN_N = 4  # orientations are checked only on boards with at least four chips, on all sides of the middle
# With fewer pokes, the check is unreliable. With more pokes, it takes seconds and is no more reliable: in scene lab,
# every third of 65 places is enough.
POKES_MIN_N, POKES_MAX_N = 20, 70


def find_departure(blocks: Sequence[Readings], axes: BoardAxes) -> str | None:
    """Describe how a capture contradicts what is stated about labels, chips and skin.

    If presses are outside the skin, these presses are described. Otherwise, orientations that differ from the stated
    ones are described. Returns None if there is no difference, or if the data are too few to decide. `blocks` are the
    readings of the capture.
    """
    if not any(_pressed_rows(block).any() for block in blocks):
        return None
    all_pokes = pool(blocks, with_force=False)
    if outside := describe_outside(axes.align(all_pokes).place_mm, axes):
        return outside
    chips_mm = axes.setup.chips_mm
    surrounded = len(chips_mm) >= CHIPS_MIN_N and (chips_mm.min(axis=0) < 0).all() and (chips_mm.max(axis=0) > 0).all()
    pokes = thin(all_pokes, POKES_MAX_N)
    if not surrounded or len(pokes) < POKES_MIN_N or not (np.linalg.norm(pokes.db_uT, axis=(0, 2)) > 0).all():
        return None
    frames = frames_of(axes.align(pokes), axes)
    return None if frames.as_stated else frames.sentence(axes.stated_by)


def _pressed_rows(readings: Readings) -> np.ndarray:
    pressed = (readings.Fz_N > 0) | np.isnan(readings.Fz_N)
    return np.isfinite(readings.x_mm) & np.isfinite(readings.y_mm) & pressed
