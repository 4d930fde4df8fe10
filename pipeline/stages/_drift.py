"""What stage drift trains on: captures under every no-load policy -> one stack of rows, and cells. Knows no argv."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from pipeline.dataset import baseline
from pipeline.dataset.rows import Rows, Selection, gather
from pipeline.dataset.windows import Windows, lay_windows, take
from pipeline.evaluation.drift import Answers, force_left, rms
from pipeline.learning.cell import Cell, Trained
from pipeline.params import Scene
from pipeline.schema import Readings
from pipeline.sections import Drift
from pipeline.stages._train import Scenery

UNIT = {"indentation": "indentation", "pass": "pass_i"}


@dataclass(frozen=True)
class Part:
    """A window's rows in the stack of all, under one policy; window -1 is trained on."""

    policy: str
    window_i: int
    readings: Readings
    rows: Rows
    noload_off_uT: float
    first_row_i: int

    @property
    def row_i(self) -> np.ndarray:
        """The numbers of its rows in the stack."""
        return np.arange(self.first_row_i, self.first_row_i + len(self.rows))


def windows_of(captures: Sequence[Readings], asked: Drift) -> Windows:
    """Lay the windows that all captures have."""
    units_n = [1 + int(_unit(one, asked).max()) for one in captures]
    return lay_windows(units_n, train_n=asked.train_n, test_n=asked.test_n, every_n=asked.every_n)


def stack(captures: Sequence[Readings], asked: Drift, windows: Windows, selection: Selection) -> list[Part]:
    """Lay the rows of every skin, policy and window below each other."""
    parts: list[Part] = []
    next_i = 0
    for one in captures:
        unit_i = _unit(one, asked)
        for policy in asked.policies:
            changed = replace(one, noload_uT=_POLICY[policy](one, asked))
            for window_i, (start, end) in enumerate((windows.train, *windows.tests), -1):
                inside = (unit_i >= start) & (unit_i < end)
                own, off_uT = take(changed, inside), rms((changed.noload_uT - one.noload_uT)[inside])
                parts.append(Part(policy, window_i, own, gather([own], selection), off_uT, next_i))
                next_i += len(parts[-1].rows)
    return parts


def scenery(scene: str, asked: Scene, parts: Sequence[Part]) -> Scenery:
    """Make one stack of all parts, for the one training loop."""
    arrays = [field.name for field in fields(Rows) if field.name != "dropped"]
    stacked = {name: np.concatenate([getattr(part.rows, name) for part in parts]) for name in arrays}
    return Scenery(scene, asked, Rows(**stacked, dropped=dropped(parts)), [])


def dropped(parts: Sequence[Part]) -> dict[str, int]:
    """Count what the selection left out of the windows, once for all policies."""
    own = [part.rows.dropped for part in parts if part.policy == parts[0].policy]
    return {name: sum(one[name] for one in own) for name in own[0]}


def cells(parts: Sequence[Part], asked: Drift, seed: int) -> Iterator[tuple[Cell, list[Part]]]:
    """Make a cell of every recipe, skin, policy and seed, beside its test windows."""
    starts = [i for i, part in enumerate(parts) if part.window_i < 0]
    for start, end in pairwise([*starts, len(parts)]):
        train, tests = parts[start], list(parts[start + 1 : end])
        fold, test = f"{train.readings.skin}-{train.policy}", np.concatenate([part.row_i for part in tests])
        for name, recipe in asked.training.recipes.items():
            for seed_i in range(asked.training.seeds_n):
                yield Cell("drift", name, recipe, fold, seed, seed_i, train.row_i, test), tests


def answers(cell: Cell, trained: Trained, tests: Sequence[Part]) -> Iterator[Answers]:
    """Cut a network's answers into its windows."""
    cuts = np.cumsum([len(part.rows) for part in tests])[:-1]
    for part, predicted in zip(tests, np.split(trained.predicted, cuts), strict=True):
        yield Answers(
            part.policy, part.readings.skin, cell.seed_i, part.window_i, int(part.readings.n_contacts[0]),
            part.noload_off_uT, part.rows.indentation, part.rows.target, predicted,
        )  # fmt: skip


def force_left_pct(parts: Sequence[Part], policy: str, window_i: int) -> float | None:
    """Give force in a window over that in training, at equal places and depths, mean over skins; None if unknown."""
    left = []
    for skin in sorted({part.readings.skin for part in parts}):
        early, late = (
            next(p.readings for p in parts if (p.readings.skin, p.policy, p.window_i) == (skin, policy, i))
            for i in (-1, window_i)
        )
        names = ("x_mm", "y_mm", "depth_mm", "Fz_N")
        both = np.concatenate([np.stack([getattr(one, n) for n in names], axis=1) for one in (early, late)])
        known = ~np.isnan(both).any(axis=1)
        is_late = (np.arange(len(both)) >= len(early))[known]
        left.append(force_left(both[known, :3].astype(float), both[known, 3].astype(float), is_late))
    return None if None in left else float(np.mean([one for one in left if one is not None]))


def _unit(one: Readings, asked: Drift) -> np.ndarray:
    return baseline.rank(getattr(one, UNIT[asked.unit]))


def _regular(one: Readings, asked: Drift) -> np.ndarray:
    assert asked.regular_n is not None, "the section's own check"
    return baseline.regular(one.noload_uT, one.indentation, regular_n=asked.regular_n)


_POLICY: dict[str, Callable[[Readings, Drift], np.ndarray]] = {
    "initial": lambda one, asked: baseline.initial(one.noload_uT, one.indentation),
    "regular": _regular,
    "each": lambda one, asked: baseline.each(one.noload_uT, one.indentation),
}
