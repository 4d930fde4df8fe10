"""Stage drift: a network for each no-load policy, trained on first contacts, tested on later ones (section 4).

Refuses to know how a skin ages (`physics`).
"""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.drift.findings import findings
from pipeline.experiments.drift.wander import over_steps, walked
from pipeline.experiments.drift.windows import (
    Answers,
    boards_of,
    field_sizes,
    force_left,
    last_window,
    late_force,
    late_window,
    of_networks,
    over_windows,
    pace,
)  # fmt: skip
from pipeline.report.statistics import tally
from pipeline.settings import Settings, Training
from pipeline.training.trainings import SceneData, collapse_record, prepare_training, train_all
from reskin.config import Strict
from reskin.data import baseline
from reskin.data.rows import Selection
from reskin.data.windows import TRAIN, Part, Policy, Windows, check_one_each, lay_parts, lay_windows, stack
from reskin.errors import ParamsError
from reskin.models.recipe import HEADLINE
from reskin.models.trial import Trained, Trial
from reskin.schema import Readings

Count = Annotated[int, Field(ge=1)]
# No-load reading: once, every so often, before each contact, or whenever a reading is judged free of contact.
PolicyName = Literal["initial", "regular", "each", "free"]


class Drift(Strict):
    """Train on the first of a skin's contacts, test on those after every so many (paper section 4, figure 5)."""

    unit: Literal["indentation", "pass"]  # what the numbers below count
    train_n: Count
    test_n: Count
    every_n: Count
    policies: Annotated[tuple[PolicyName, ...], Field(min_length=1)]
    regular_n: Count | None = None  # indentations from one no-load reading of policy `regular` to its next
    wander_uT: tuple[
        Annotated[float, Field(ge=0, le=1000)], ...
    ] = ()  # added after training, sd a contact; simulated only
    training: Training

    @model_validator(mode="after")
    def _windows_follow_each_other(self) -> "Drift":
        if self.test_n > self.every_n:
            raise ValueError(f"test_n is at most every_n, {self.every_n}, so that windows do not overlap")
        if self.train_n > self.every_n:
            raise ValueError(f"train_n is at most every_n, {self.every_n}, after which the first test follows")
        if ("regular" in self.policies) != (self.regular_n is not None):
            raise ValueError("regular_n stands there if and only if policies holds regular")
        if len(set(self.policies)) < len(self.policies):
            raise ValueError(f"policies names each policy once, not {list(self.policies)}")
        return self


UNIT = {"indentation": "indentation", "pass": "pass_i"}


def cut(captures: Sequence[Readings], section: Drift, selection: Selection) -> tuple[Windows, list[Part]]:
    """Lay the windows that all captures have, and their rows under every policy."""
    check_one_each(captures)
    units = [baseline.rank(getattr(one, UNIT[section.unit])) for one in captures]
    units_n = [1 + int(own.max()) for own in units]
    windows = lay_windows(units_n, train_n=section.train_n, test_n=section.test_n, every_n=section.every_n)
    policies: dict[str, Policy] = {policy: partial(_choose, policy, section) for policy in section.policies}
    laid = lay_parts(list(zip(captures, units, strict=True)), policies, windows=windows, selection=selection)
    return windows, laid


def _choose(policy: PolicyName, section: Drift, readings: Readings) -> np.ndarray:
    fields = readings.noload_uT, readings.indentation
    if policy == "regular":
        assert section.regular_n is not None
        return baseline.regular(*fields, regular_n=section.regular_n)
    if policy == "free":
        trained_on = baseline.rank(getattr(readings, UNIT[section.unit])) < section.train_n
        within_uT = baseline.alike_within_uT(*(of[trained_on] for of in fields))
        return baseline.free(readings.b_uT, *fields, within_uT=within_uT)
    return (baseline.initial if policy == "initial" else baseline.each)(*fields)


def trials(parts: Sequence[Part], section: Drift, seed: int) -> Iterator[tuple[Trial, list[Part]]]:
    """Make a trial of every recipe, skin, policy and seed, beside its test windows."""
    starts = [i for i, part in enumerate(parts) if part.window_i == TRAIN]
    for start, end in pairwise([*starts, len(parts)]):
        train, tests = parts[start], list(parts[start + 1 : end])
        fold, test = f"{train.readings.skin}-{train.policy}", np.concatenate([part.row_i for part in tests])
        for name, recipe in section.training.recipes.items():
            for seed_i in range(section.training.seeds_n):
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


def read(settings: Settings) -> Drift:
    """Read section drift."""
    return settings.with_training(Drift, "drift")


def drift(settings: Settings, indentations: Path, answer: Path) -> None:
    """Train and test under every no-load policy, on every capture of a folder."""
    prepare_training()
    section, selection = read(settings), settings.section(Selection, "selection")
    captures = read_folder(indentations, tuple(settings.captures_in(indentations)))
    windows, parts = cut(captures, section, selection)
    if section.wander_uT and captures[0].source != "simulated":
        rule = "none in a recorded scene: a walk would be added to what was recorded"
        raise ParamsError(settings.where, "drift.wander_uT", rule, list(section.wander_uT), "Take it out.")
    pairs = list(trials(parts, section, settings.seed))
    data = SceneData(settings.scene, settings, stack(parts), [])
    answered: dict[str, list[Answers]] = {}
    trained = train_all(data, [trial for trial, _ in pairs], "drift")
    for (trial, tests), one in zip(pairs, trained, strict=True):
        answered.setdefault(trial.recipe_name, []).extend(answers(trial, one, tests))
    rows: dict[str, dict[str, Any]] = {
        name: {policy: over_windows(own, policy) for policy in section.policies} for name, own in answered.items()
    }
    found, drawn = _tell(section, answered[HEADLINE], rows[HEADLINE], parts, field_sizes(captures))
    counts = {"skins_n": len(captures), "seeds_n": section.training.seeds_n, "dropped": data.rows.dropped}
    words = section.model_dump(mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"})
    numbers = {name: value for name, value in words.items() if value is not None} | counts | pace(captures)
    if section.wander_uT:
        numbers["wander"] = _wander(
            section, selection, captures, parts, list(zip(pairs, trained, strict=True)), settings.seed
        )
    variants = {name: own for name, own in rows.items() if name != HEADLINE}
    numbers |= {"left_out_units_n": windows.left_out_units_n} | found | ({"variants": variants} if variants else {})
    write_answer(
        answer, numbers, drawn, read_losses(indentations, numbers["dropped"]), tally(map(collapse_record, trained))
    )


def _wander(
    section: Drift,
    selection: Selection,
    captures: Sequence[Readings],
    parts: Sequence[Part],
    trained: Sequence[tuple[tuple[Trial, list[Part]], Trained]],
    seed: int,
) -> dict[str, Any]:
    """Test the networks of the headline's recipe again on their last window, of captures that wander further."""
    at = {part.first_row_i: i for i, part in enumerate(parts)}
    last = [(trial, one, at[tests[-1].first_row_i]) for (trial, tests), one in trained if trial.recipe_name == HEADLINE]
    trained_on = baseline.rank(getattr(captures[0], UNIT[section.unit])) < section.train_n
    after_n = 1 + int(baseline.rank(captures[0].indentation)[trained_on].max())

    def parts_at(step_uT: float) -> list[Part]:
        return cut([walked(one, step_uT, after_n=after_n, seed=seed) for one in captures], section, selection)[1]

    return over_steps(last, section.wander_uT, parts_at)


def _tell(
    section: Drift, answered: Sequence[Answers], rows: dict[str, Any], parts: Sequence[Part], field: dict[str, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Put the windows together with late forces and findings; the paper does not say of which policy figure 5b is."""
    policy = "regular" if "regular" in rows else section.policies[0]
    window_i = late_window(rows[policy])
    numbers, drawn, late = rows | {"field": field}, {}, late_force(answered, policy, window_i)
    if late is not None:
        left_pct = force_left_pct(parts, policy, window_i)
        where = {"policy": policy, "contacts_n": rows[policy][window_i]["contacts_n"]}
        numbers["late"] = where | late[0] | ({} if left_pct is None else {"force_left_pct": left_pct})
        drawn = {"late": late[1]}
    networks: dict[str, Any] = {name: of_networks(answered, name) for name in section.policies}
    boards = boards_of(answered, policy)
    found = findings(rows, networks, boards=boards, field=field, late=numbers.get("late"))
    last = {name: last_window(answered, name) for name in section.policies}
    return numbers | {"findings": found, "last_window": last}, drawn
