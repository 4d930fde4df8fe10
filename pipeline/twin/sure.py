"""How much experts on a skin are to be believed: misfits of pokes, residuals of labelled ones -> a temper.

Birge's ratio, twice: variances are taken to be larger by what pokes misfit the map, then by how far labelled pokes lie
from where experts that were told the other labels read them. Refuses to know how experts are told and how they read.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from pipeline.twin.skin_map import Estimate

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
