"""Did scalers or settings see test rows? In: a model's scaler, the record of the study of settings. Out: `Check`s.

A scaler is fitted again on the training rows and compared; settings must come from skins that the scene does not test
on, and what the study did not choose is stated. Refuses to know how a scaler is fitted: the function is passed in.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.core.config import Strict, parse
from pipeline.core.errors import SchemaError
from pipeline.experiments.audit.checks import Check
from pipeline.experiments.audit.sides import Sides

# The same rows give the same scaler but for the order of float64 sums, and that turns the last bit of a float32 at
# most; 4 of them are 5e-7. One foreign row in 100,000 moves a mean by some 1e-5 of its deviation.
SCALER_TOLERANCE = 4 * float(np.finfo(np.float32).eps)

NOT_CHOSEN = "not chosen by the study"  # begins what is stated of such a setting

Arrays = Mapping[str, np.ndarray]
Words = Mapping[str, Any]


SAME_AS = {"train_single": "train_multi"}  # one recipe for networks of one skin and of many


class Choice(Strict, extra="allow"):
    """The record of a study of settings: on whose readings, and the recipe chosen for each arm."""

    scene: str
    source: str
    seed: int
    boards: tuple[str, ...]
    skins: tuple[str, ...]
    chosen: dict[str, dict[str, Any]]


def audit_scaler(
    where: str,
    arrays: Arrays,
    *,
    db_uT: Float[np.ndarray, "f ch"],
    target: Float[np.ndarray, "f 3"],
    sides: Sides,
    fit: Callable[[np.ndarray, np.ndarray], Arrays],
) -> Check:
    """Fit the scaler again on the training rows, and on those of the test too: the model's must be the former."""
    both = np.concatenate([sides.train, sides.test])
    honest, leaky = (_gap(where, arrays, fit(db_uT[side], target[side])) for side in (sides.train, both))
    found = f"off by {honest:.2g} from training rows alone, by {leaky:.2g} from both sides"
    rule = f"that of the training rows, to {SCALER_TOLERANCE:.2g}"
    return Check("scaler", where, rule, found, holds=honest <= SCALER_TOLERANCE and honest <= leaky, known=False)


def audit_choice(
    choice: Words,
    recipes: Mapping[str, Words],
    *,
    source: str,
    seed: int,
    test_boards: Sequence[str],
    test_skins: Sequence[str],
) -> list[Check]:
    """Check that settings were chosen on other boards and skins, and state which headlines are not the chosen ones.

    Simulated skins of another seed are others, whatever their names; recorded ones are known by name.
    """
    record = parse(Choice, dict(choice), "record of the study of settings")
    same_draw = record.source == source and (source == "recorded" or record.seed == seed)
    checks = []
    for what, studied, tested in (("boards", record.boards, test_boards), ("skins", record.skins, test_skins)):
        shared = sorted(set(studied) & set(tested)) if same_draw else []
        found = f"{len(shared)} of {len(set(tested))} tested were chosen on{': ' if shared else ''}{', '.join(shared)}"
        rule = f"none of those that scene {record.scene} chose on (of its source and seed)"
        checks.append(Check(f"settings: {what}", "all folds", rule, found, holds=not shared, known=False))
    return checks + [_as_chosen(arm, recipe, record) for arm, recipe in recipes.items()]


def _as_chosen(arm: str, recipe: Words, record: Choice) -> Check:
    """State how a recipe differs from the chosen one: that is no leak, whoever set it."""
    rule = f"the recipe chosen on scene {record.scene}, or one that is stated here"
    studied = SAME_AS.get(arm, arm)
    chosen = record.chosen.get(studied, {})
    pairs = {key: (_said(recipe, key), _said(chosen, key)) for key in sorted({*recipe, *chosen})}
    differing = [f"{key} {used} (study: {best})" for key, (used, best) in pairs.items() if used != best]
    found = f"{NOT_CHOSEN}: {', '.join(differing)}" if differing else "equal"
    found = found if studied in record.chosen else f"{NOT_CHOSEN}: it chose none for this"
    return Check("settings: recipe", arm, rule, found, holds=True, known=False)


def _said(words: Words, key: str) -> str:
    return repr(words[key]) if key in words else "absent"


def _gap(where: str, arrays: Arrays, fitted: Arrays) -> float:
    """Give the largest difference, as a part of the value fitted (or bare, where that is 0); NaN if any is."""
    gaps = []
    for name, value in fitted.items():
        if name not in arrays or arrays[name].shape != value.shape:
            raise SchemaError(
                where, f"scaler array {name}", f"there, of shape {value.shape}", "none", "Train it again."
            )
        size = np.where(value == 0, 1.0, np.abs(value))
        gaps.append(np.max(np.abs(arrays[name].astype(np.float64) - value) / size))
    return float(np.max(gaps))
