"""What stage audit asks of models and settings: cards and scalers on disk -> checks. Knows no argv."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core import io
from pipeline.evaluation.choice import settings_of, trimmed
from pipeline.experiments.audit.checks import Check
from pipeline.experiments.audit.collapse import audit_collapse
from pipeline.experiments.audit.settings import audit_choice, audit_scaler
from pipeline.experiments.audit.sides import Sides
from pipeline.experiments.audit.tuning import audit_tuning
from pipeline.learning.inputs import FIT, VIEW
from pipeline.learning.recipe import HEADLINE
from pipeline.trials.data import SceneData

Fits = dict[tuple[str, str, str, str, int], dict[str, np.ndarray]]  # by fold, view, scaling and rows


def model_checks(data: SceneData, sides: dict[tuple[str, str], Sides], models: Path) -> Iterator[Check]:
    """Fit the scaler of every network again, from its fold's training rows, and look at what it was adapted with."""
    views = {name: view(data.rows.db_uT) for name, view in VIEW.items()}
    fits: Fits = {}
    keys: dict[tuple[str, int], set[str]] = {}  # of the networks that may be adapted, by fold and seed
    for arm in data.settings.plan("models"):
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
    recipes = {arm: trimmed(_headline(models / arm)) for arm in data.settings.plan("models")}
    held_out = np.unique(np.concatenate([fold.test for fold in data.folds]))
    return audit_choice(
        io.read_json(choice), recipes, source=data.settings.words("source"), seed=data.settings.seed,
        test_boards=np.unique(data.rows.board[held_out]).tolist(),
        test_skins=np.unique(data.rows.skin[held_out]).tolist(),
    )  # fmt: skip


def _headline(models: Path) -> dict[str, Any]:
    """Read the settings of a stage's headline: its networks' cards say what they were trained with."""
    cards = (io.read_json(file) for file in sorted(models.glob("*.json")))
    return settings_of(next(card for card in cards if card["recipe_name"] == HEADLINE))
