"""Whether axes are mirrored, chips exchanged or the skin flipped: recorded and nominal fields -> one sentence.

Every way to read labels, chips and skin is tried; one that departs from the scene is named if it pays. By cosines over
all pokes together: those of single files mislead. Refuses to know what is fitted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

# What a departure must add to the sum over chips of the cosines to be named. Assumed: chips that are read wrongly lose
# 0.5 and more each, and a skin that sits 0.5 mm aside moves no cosine by so much.
PENALTY = 0.1
AXES = "xyz"
AS_SAID = "Labels, chips and skin lie as the scene says."


@dataclass(frozen=True)
class Turn:
    """A quarter turn about z, after axes of a chip changed sign."""

    quarters: int
    signs: tuple[int, int, int]

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        return quarter_turn(self.quarters) @ np.diag(self.signs)

    def say(self) -> str:
        """Say what differs from the scene, of a chip."""
        mirrored = " and ".join(axis for axis, sign in zip(AXES, self.signs, strict=True) if sign < 0)
        words = [f"turned by {90 * self.quarters} degrees more than the scene says"] * bool(self.quarters)
        return " and ".join(words + [f"mirrored along {mirrored}"] * bool(mirrored))


# Each of 16 ways once, in few words: a mirrored x turned by a half is a mirrored y. The first is the scene's own; the
# first eight leave z alone, as labels do.
PLAIN = [(quarters, 1, 1) for quarters in range(4)] + [(0, -1, 1), (0, 1, -1), (1, -1, 1), (1, 1, -1)]
TURNS = [Turn(quarters, (x, y, z)) for z in (1, -1) for quarters, x, y in PLAIN]


def quarter_turn(quarters: int) -> Float[np.ndarray, "3 3"]:
    """Rotate by so many quarters about z."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Found:
    """The best way to read a recording; `chips` is where each recorded chip sits, by the scene's numbers."""

    labels: Turn
    flipped: bool
    chips: Int[np.ndarray, " k"]
    turns: tuple[Turn, ...]
    cosines: Float[np.ndarray, " k"]
    as_written: Float[np.ndarray, " k"]
    worth: float

    @property
    def sentence(self) -> str:
        """Name what departs from the scene."""
        words = [f"the labels are {self.labels.say()}"] * (self.labels != TURNS[0])
        words += ["the skin is flipped: every field has the other sign"] * self.flipped
        words += _exchanged(self.chips)
        for turn in dict.fromkeys(self.turns):
            own = [i for i, found in enumerate(self.turns) if found == turn]
            if turn != TURNS[0]:
                words.append(f"{_name(own, len(self.turns))} {turn.say()}")
        if not words:
            return AS_SAID
        return f"Against the scene, {'; '.join(words)}."


def _name(chips: Sequence[int], chips_n: int) -> str:
    if len(chips) == chips_n:
        return "all chips are"
    return f"chip {chips[0]} is" if len(chips) == 1 else f"chips {', '.join(map(str, chips))} are"


def _exchanged(at: Int[np.ndarray, " k"]) -> list[str]:
    moved = np.flatnonzero(at != np.arange(len(at))).tolist()
    if len(moved) == 2:
        return [f"chips {moved[0]} and {moved[1]} are exchanged"]
    places = ", ".join(f"{i} sits at {at[i]}" for i in moved)
    return [f"chips are exchanged ({places})"] if moved else []


def check(
    place_mm: Float[np.ndarray, "n 2"],
    read_uT: Float[np.ndarray, "n k 3"],
    chips_turn: Float[np.ndarray, "k 3 3"],
    nominal: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n k 3"]],
) -> Found:
    """Find the best way to read pokes, their places on the board and their changes of field in the chips' axes.

    The scene has the chips' turns; `nominal` simulates places, in the board's axes. A chip that sits at another's place
    is taken to be turned as that one.
    """
    turns = np.stack([turn.matrix for turn in TURNS])
    as_written, found = np.empty(0), []
    for labels in TURNS[:8]:
        simulated_uT = nominal(place_mm @ labels.matrix[:2, :2].T)
        # [k recorded, k simulated, turn]: the cosine over all pokes of a recorded chip, turned, with a simulated one.
        at_chips_uT = np.einsum("kij,nki->nkj", chips_turn, simulated_uT)
        moments = np.einsum("nka,nlb->klab", read_uT, at_chips_uT)
        sizes = np.linalg.norm(read_uT, axis=(0, 2))[:, None] * np.linalg.norm(simulated_uT, axis=(0, 2))
        cosine = np.einsum("klab,tba->klt", moments, turns) / sizes[..., None]
        if labels == TURNS[0]:
            as_written = np.diagonal(cosine[..., 0]).copy()
        ways = product((False, True), TURNS)
        found += [_best(labels, flipped, common, cosine, as_written) for flipped, common in ways]
    return max(found, key=lambda one: one.worth)


def _best(
    labels: Turn, flipped: bool, common: Turn, cosine: Float[np.ndarray, "k l t"], as_written: np.ndarray
) -> Found:
    # What all chips have in common is one departure, a little larger: a flipped skin reads as such a turn, too.
    signed = -cosine if flipped else cosine
    worth = signed - PENALTY * np.array([turn != common for turn in TURNS])
    of_pair = worth.max(axis=2) - PENALTY * (1 - np.eye(len(worth)))
    own, at = linear_sum_assignment(of_pair, maximize=True)
    turn_i = worth[own, at].argmax(axis=1)
    total = of_pair[own, at].sum() - PENALTY * ((labels != TURNS[0]) + flipped + 1.5 * (common != TURNS[0]))
    turns = tuple(TURNS[i] for i in turn_i)
    return Found(labels, flipped, at, turns, signed[own, at, turn_i], as_written, float(total))
