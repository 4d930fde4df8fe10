"""What 90 % intervals hold where no board is known, on simulated skins that the law misses in ways it was not told of.

`RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_intervals_benchmark.py`,
three minutes of processor time. The network is
that of scene lab, simulated alone. For every family: the misfit of the unlabelled pokes; then by labels what intervals
hold of map | map and network under the temper that is assumed, and (half width behind it) under that which misfit and
labels tell; and the accuracy. Nothing is asserted but that intervals widen with what is missed.
"""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.training import universal
from pipeline.training.universal import (
    AS_TAUGHT,
    ASSUMED_TEMPER,
    MISSES,
    REACH,
    Experts,
    by_own_labels,
    covered,
    read_both,
    ready,
    skins_of_prior,
    tell_sureness,
    told_of,
)
from reskin.universal import training
from reskin.universal.map import NOMINAL, OF_NOMINAL, tabulate
from reskin.universal.population import Population
from reskin.universal.training import Lessons, Syllabus, add_error, teach
from tests.benchmarks import FULL, size
from tests.universal.skins import SETUP

SEED, LESSONS = 2021, Lessons(skins_n=size(500, 4), steps_n=size(1200, 3), seeds_n=1)  # as scene lab
SKINS_N, LABELS_N = size(12, 1), size((0, 5, 10, 20, 40), (0,))
Miss = Callable[[Population, np.random.Generator], np.ndarray]


def missed(part: float, over_mm: tuple[float, float] = training.ERROR_MM) -> Miss:
    """As networks are taught, but so large, over so many mm."""

    def miss(skins: Population, rng: np.random.Generator) -> np.ndarray:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(training, "ERROR_MM", over_mm)
            return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (part, part), rng)

    return miss


def chips_mixed(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """Every chip's gain matrix is off by a quarter."""
    gain = np.eye(3) + 0.25 * rng.standard_normal((len(skins), 5, 3, 3))
    return np.einsum("skij,snkj->snki", gain, skins.db_uT.reshape(*skins.db_uT.shape[:2], 5, 3))


def remembered(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """A poke leaves 15 % of its change of field to the next, wherever that is."""
    order = [rng.permutation(skins.db_uT.shape[1]) for _ in range(len(skins))]
    return np.stack([db_uT - 0.15 * db_uT[one] for db_uT, one in zip(skins.db_uT, order, strict=True)])


def one_by_one(skins: Population, rng: np.random.Generator) -> np.ndarray:
    """Every poke is off by itself, by 0.3 of |dB| and heavy tails: no neighbour tells of it."""
    length_uT = np.linalg.norm(skins.db_uT, axis=2, keepdims=True) / np.sqrt(skins.db_uT.shape[2])
    return skins.db_uT + 0.3 * length_uT * rng.standard_t(3, skins.db_uT.shape)


FAMILIES: dict[str, Miss] = {
    "nothing missed": missed(0.0), "0.3 of |dB|": missed(0.3), "0.5": missed(0.5), "0.6": missed(0.6),
    "0.8": missed(0.8), "0.5 over 1.2 to 2 mm": missed(0.5, (1.2, 2.0)),
    "0.5 over 6 to 12 mm": missed(0.5, (6.0, 12.0)), "chips mixed": chips_mixed, "remembered": remembered,
    "one by one": one_by_one,
}  # fmt: skip


@pytest.mark.timeout(3600)
def test_intervals_of_skins_that_the_law_misses_in_other_ways(monkeypatch):
    if not FULL:
        monkeypatch.setattr(universal, "FURTHER_N", 1)
    syllabus = Syllabus("nominal", NOMINAL, OF_NOMINAL, SETUP)
    nominal = Experts(tabulate(NOMINAL, OF_NOMINAL, SETUP), teach(syllabus, LESSONS, SEED), None, syllabus)
    by_labels = tell_sureness(nominal, LABELS_N, SEED)
    print(
        "\nsureness (map, map and network) by labels:",
        {n: [round(of, 2) for of in one] for n, one in by_labels.items()},
    )
    widths_mm = {}
    for name, miss in {"of the prior": MISSES[AS_TAUGHT], **size(FAMILIES, dict([*FAMILIES.items()][:1]))}.items():
        skins = skins_of_prior(nominal, SKINS_N, SEED, "asked", miss)
        told = [told_of(nominal, skins, i, SEED) for i in range(SKINS_N)]
        print(f"{name}: misfit {np.round(np.quantile([one.misfit for one, _ in told], (0, 0.5, 1)), 2)}")
        for n in LABELS_N:
            found = np.array([_scores(*one, n, by_labels[n]) for one in told]).mean(axis=0)
            print(f"  {n:2} labels: " + " | ".join(
                f"{100 * assumed:.0f} -> {100 * held:.0f} % ({mm:.2f} mm), accuracy {100 * within:.0f} %"
                for assumed, held, mm, within in found
            ))  # fmt: skip
            widths_mm[name, n] = found[1, 2]
    assert not FULL or widths_mm["nothing missed", 0] < widths_mm["0.5", 0] < widths_mm["0.8", 0]


def _scores(told, asked, labels_n, sureness):
    tempers = [(ASSUMED_TEMPER, ASSUMED_TEMPER), *by_own_labels(told, labels_n, [told.tempers(sureness)])]
    assumed, found = read_both(ready(told, labels_n), asked.db_uT, tempers)
    within = [(np.abs(one.place_mm - asked.place_mm) <= 1).all(axis=1).mean() for one in found]
    return [
        (covered(before, asked.place_mm), covered(after, asked.place_mm), REACH * np.median(after.sd_mm), right)
        for before, after, right in zip(assumed, found, within, strict=True)
    ]
