"""Stage audit: do results rest on test rows? Folds, scalers, adaptations and the choice of settings, checked again.

Refuses to mend what it finds: it fails the stage on a leak, and tells the rest.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.experiments.audit.sides import Check, Labels, Sides, audit_fold, holds, to_words
from pipeline.report.choice import settings_of, trimmed
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training.trainings import SceneData, read_data
from reskin import io
from reskin.config import Strict, parse
from reskin.errors import LeakError, SchemaError
from reskin.models.inputs import FIT, VIEW
from reskin.models.recipe import HEADLINE
from reskin.seeds import rng_for
from reskin.simulation.fingerprint import fingerprint

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
    physics: str = "not recorded"
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
    physics: str,
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
    found = "equal" if record.physics == physics else f"{NOT_CHOSEN}: {record.physics}, now {physics}; run it again"
    rule = f"the simulated skin that scene {record.scene} chose on has the fingerprint of today's"
    checks.append(Check("settings: physics", "all arms", rule, found, holds=True, known=False))
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


def audit_tuning(
    where: str, tuning: Mapping[str, Any], *, bases: set[str], sides: Sides, indentation: Int[np.ndarray, " f"]
) -> list[Check]:
    """Check a card's `tuning`; `bases` are the keys of the networks of its fold and seed."""
    own = np.array(tuning["indentations"], np.int64)
    tested = np.intersect1d(own, indentation[sides.test])
    strange = np.setdiff1d(own, indentation[sides.pool])
    base = "one of this fold and seed" if tuning["from"] in bases else "another"
    pokes = f"{len(tested)} of {len(own)} are tested, {len(strange)} are not of the pool"
    return [
        Check("base", where, "a network of its fold and seed", base, holds=tuning["from"] in bases, known=False),
        Check(
            "pokes",
            where,
            "of the pool, and none tested",
            pokes,
            holds=not len(tested) and not len(strange),
            known=False,
        ),
    ]


COLLAPSE = "collapse"


def audit_collapse(arm: str, cards: Sequence[Mapping[str, Any]]) -> Check:
    """Count the networks of an arm that answer nearly the same to any input, and trainings that were done again."""
    kept = [
        f"{one['question']}.{one['recipe_name']}.{one['fold']}.seed{one['seed_i']}" for one in cards if one["collapsed"]
    ]
    again_n = sum(one["collapsed_before_n"] for one in cards)
    found = f"{len(kept)} of {len(cards)} collapsed{': ' if kept else ''}{', '.join(kept)}; {again_n} trained again"
    rule = "no network answers nearly the same to any input"
    return Check(COLLAPSE, arm, rule, found, holds=not kept, known=bool(kept))


Fits = dict[tuple[str, str, str, str, int], dict[str, np.ndarray]]  # by fold, view, scaling and rows


def model_checks(data: SceneData, sides: dict[tuple[str, str], Sides], models: Path) -> Iterator[Check]:
    """Fit the scaler of every network again, from its fold's training rows, and look at what it was adapted with."""
    views = {name: view(data.rows.db_uT) for name, view in VIEW.items()}
    fits: Fits = {}
    keys: dict[tuple[str, int], set[str]] = {}  # of the networks that may be adapted, by fold and seed
    for arm in data.settings.models:
        cards = {file: io.read_json(file) for file in sorted((models / arm).glob("*.json"))}
        yield audit_collapse(arm, list(cards.values()))
        for file, card in cards.items():
            question = "lobo" if card["question"] in ("triplet", "adapt") else card["question"]
            inputs, scaling = card["recipe"]["inputs"], card["recipe"]["scaling"]
            yield audit_scaler(
                file.stem, io.read_tensors(file.with_suffix(".safetensors"))[0], db_uT=views[inputs],
                target=data.rows.target, sides=sides[question, card["fold"]],
                fit=partial(_fit_once, fits, (question, card["fold"], inputs, scaling)),
            )  # fmt: skip
            bases = keys.setdefault((card["fold"], card["seed_i"]), set())
            if "tuning" in card:
                side = sides[question, card["fold"]]
                yield from audit_tuning(
                    file.stem, card["tuning"], bases=bases, sides=side, indentation=data.rows.indentation
                )
            elif card["question"] == "triplet":
                bases.add(card["key"])


def _fit_once(
    fits: Fits, key: tuple[str, str, str, str], db_uT: np.ndarray, target: np.ndarray
) -> dict[str, np.ndarray]:
    of = (*key, len(db_uT))  # a fold's training rows are fewer than those of both sides
    if of not in fits:
        fits[of] = FIT[key[-1]](db_uT, target).arrays()
    return fits[of]


def settings_checks(data: SceneData, choice: Path, models: Path) -> list[Check]:
    """Compare the headline recipes that were trained with the record of what was chosen, and where."""
    recipes = {arm: trimmed(_headline(models / arm)) for arm in data.settings.models}
    held_out = np.unique(np.concatenate([fold.test for fold in data.folds]))
    return audit_choice(
        io.read_json(choice), recipes, source=data.settings["source"], seed=data.settings.seed,
        test_boards=np.unique(data.rows.board[held_out]).tolist(),
        test_skins=np.unique(data.rows.skin[held_out]).tolist(),
        physics=fingerprint(data.settings.shared),
    )  # fmt: skip


def _headline(models: Path) -> dict[str, Any]:
    """Read the settings of a stage's headline: its networks' cards say what they were trained with."""
    cards = (io.read_json(file) for file in sorted(models.glob("*.json")))
    return settings_of(next(card for card in cards if card["recipe_name"] == HEADLINE))


class AuditSettings(Strict):
    """Section audit: were the scene's settings chosen, so that a study must vouch for them, or are they for speed?"""

    settings: Literal["chosen", "for speed"]


def read(settings: Settings) -> AuditSettings:
    """Read section audit."""
    return settings.section(AuditSettings, "audit")


def audit(settings: Settings, indentations: Path, folds: Path, models: Path, choice: Path, answer: Path) -> None:
    """Check every fold, the scaler of every network and the settings; a leak fails the stage and names itself."""
    data = read_data(settings, indentations, folds)
    labels = Labels(data.rows.board, data.rows.skin, data.rows.indentation, data.rows.capture)
    sides = [Sides(fold.question, fold.name, fold.train, fold.pool, fold.test) for fold in data.folds]
    checks = [
        check
        for side in sides
        for check in audit_fold(
            side, labels, db_uT=data.rows.db_uT, rng=rng_for(data.settings.seed, "audit", side.question, side.name)
        )
    ]
    checks += list(model_checks(data, {(side.question, side.name): side for side in sides}, models))
    checks += settings_checks(data, choice, models) if read(data.settings).settings == "chosen" else []
    if not holds(checks):
        first = next(check for check in checks if not (check.holds or check.known))
        raise LeakError(
            f"audit of {settings.scene}, {first.where}", first.what, first.rule, first.found, "Look at who is held out."
        )
    io.write_json(answer, to_words(checks))
    unchosen_n = sum(check.found.startswith(NOT_CHOSEN) for check in checks)
    dead_n = sum(check.known and check.what == COLLAPSE for check in checks)
    papers_n = sum(check.known for check in checks) - dead_n
    say(
        f"{settings.scene}: {len(checks)} checks, no leak; {papers_n} known, the paper's own; "
        f"{dead_n} arms with collapsed networks; {unchosen_n} settings that the study did not choose"
    )
