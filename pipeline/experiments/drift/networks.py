"""What stage drift trains: parts of captures -> trials, and their answers window by window. Knows no argv."""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from pipeline.core.schema import Readings
from pipeline.dataset import baseline
from pipeline.dataset.rows import Selection
from pipeline.dataset.windows import TRAIN, Part, Policy, Windows, check_one_each, lay_parts, lay_windows
from pipeline.experiments.drift.settings import Drift
from pipeline.experiments.drift.windows import Answers, force_left
from pipeline.learning.trial import Trained, Trial

UNIT = {"indentation": "indentation", "pass": "pass_i"}


def cut(captures: Sequence[Readings], asked: Drift, selection: Selection) -> tuple[Windows, list[Part]]:
    """Lay the windows that all captures have, and their rows under every policy."""
    check_one_each(captures)
    units = [baseline.rank(getattr(one, UNIT[asked.unit])) for one in captures]
    units_n = [1 + int(own.max()) for own in units]
    windows = lay_windows(units_n, train_n=asked.train_n, test_n=asked.test_n, every_n=asked.every_n)
    known: dict[str, Policy] = {"initial": baseline.initial, "each": baseline.each}
    if asked.regular_n is not None:
        known["regular"] = partial(baseline.regular, regular_n=asked.regular_n)
    policies: dict[str, Policy] = {policy: known[policy] for policy in asked.policies}
    laid = lay_parts(list(zip(captures, units, strict=True)), policies, windows=windows, selection=selection)
    return windows, laid


def trials(parts: Sequence[Part], asked: Drift, seed: int) -> Iterator[tuple[Trial, list[Part]]]:
    """Make a trial of every recipe, skin, policy and seed, beside its test windows."""
    starts = [i for i, part in enumerate(parts) if part.window_i == TRAIN]
    for start, end in pairwise([*starts, len(parts)]):
        train, tests = parts[start], list(parts[start + 1 : end])
        fold, test = f"{train.readings.skin}-{train.policy}", np.concatenate([part.row_i for part in tests])
        for name, recipe in asked.training.recipes.items():
            for seed_i in range(asked.training.seeds_n):
                yield Trial("drift", name, recipe, fold, seed, seed_i, train.row_i, test), tests


def answers(trial: Trial, trained: Trained, tests: Sequence[Part]) -> Iterator[Answers]:
    """Cut a network's answers into its windows."""
    cuts = np.cumsum([len(part.rows) for part in tests])[:-1]
    for part, predicted in zip(tests, np.split(trained.predicted, cuts), strict=True):
        yield Answers(
            part.policy, part.readings.board, part.readings.skin, trial.seed_i, part.window_i,
            int(part.readings.n_contacts[0]), part.noload_off_uT, part.rows.indentation, part.rows.target, predicted,
        )  # fmt: skip


def force_left_pct(parts: Sequence[Part], policy: str, window_i: int) -> float | None:
    """Give force in a window over that in training, at equal places and depths, mean over skins; None if unknown."""
    own = {(part.readings.skin, part.window_i): part.readings for part in parts if part.policy == policy}
    left = [force_left(own[skin, TRAIN], late) for (skin, i), late in own.items() if i == window_i]
    return None if None in left else float(np.mean([one for one in left if one is not None]))
