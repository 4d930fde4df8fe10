"""How much experts on a skin are to be believed: misfits of pokes, residuals of labelled ones -> a temper.

Birge's ratio, twice: variances are taken to be larger by what pokes misfit the map, then by how far labelled pokes lie
from where experts that were told the other labels read them. Refuses to know how experts are told and how they read.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int64

from pipeline.twin.skin_map import Estimate

PARTS_N = 5  # of the labelled pokes: each is left out in its turn
PRIOR_N = 40.0  # coordinates as far off as is said, beside those of labels: told on simulated skins (docs/learning.md)
NORMAL_MEAN = math.sqrt(2 / math.pi)  # of |z|

Parts = Sequence[tuple[Sequence[Estimate], Float[np.ndarray, "m 2"]]]  # under each temper, and where pokes were, in mm


def of_labels(sureness: Mapping[int, float], labels_n: int) -> float:
    """Give the temper at a misfit of 1 for so many labels, between those at which it was told."""
    told_n = sorted(sureness)
    return float(np.exp(np.interp(labels_n, told_n, np.log([sureness[n] for n in told_n]))))


def by_misfit(sureness: float, misfit: float) -> float:
    """Believe experts the less the worse pokes fit; sure at most as they say themselves."""
    return min(1.0, sureness / misfit)


def left_out(labels_n: int) -> list[tuple[Int64[np.ndarray, " k"], Int64[np.ndarray, " l"]]]:
    """Leave out every fifth label, and every other fifth: those that are told, and those that are left out."""
    part = np.arange(labels_n) % PARTS_N
    return [(np.flatnonzero(part != i), np.flatnonzero(part == i)) for i in range(min(PARTS_N, labels_n))]


def by_labels(tempers: Sequence[float], parts: Parts) -> list[float]:
    """Believe experts by how far labelled pokes were off that were left out, under each temper; without any, as told.

    Residuals in standard deviations, on the mean of their absolute values: one poke that is far off counts once.
    """
    if not parts:
        return list(tempers)
    found = []
    for i, temper in enumerate(tempers):
        off = np.concatenate([np.abs(of_part[i].place_mm - at_mm) / of_part[i].sd_mm for of_part, at_mm in parts])
        found.append(min(1.0, temper / ratio(off)))
    return found


def ratio(off: Float[np.ndarray, "m 2"]) -> float:
    """Give by what variances are larger than was said, of coordinates' absolute residuals in standard deviations."""
    return ((PRIOR_N + off.sum() / NORMAL_MEAN) / (PRIOR_N + off.size)) ** 2
