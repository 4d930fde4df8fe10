"""Stage audit: does a result rest on test rows? Folds, scalers and the choice of settings, looked at once more."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from pipeline import io
from pipeline.errors import LeakError, complain
from pipeline.evaluation.audit.checks import Check, holds, to_words
from pipeline.evaluation.audit.settings import audit_choice, audit_scaler
from pipeline.evaluation.audit.sides import Labels, Sides, audit_fold
from pipeline.evaluation.choice import BUDGET
from pipeline.learning.inputs import VIEW
from pipeline.learning.recipe import HEADLINE
from pipeline.learning.standardise import FIT
from pipeline.params import modelled
from pipeline.seeds import rng_for
from pipeline.stages._run import run, say
from pipeline.stages._train import Scenery, read_scenery


def audit(
    scene: str, settings: Path, indentations: Path, folds: Path, models: Path, choice: Path, answer: Path
) -> None:
    """Check every fold, the scaler of every network and the settings; a leak fails the stage and names itself."""
    at = read_scenery(scene, settings, indentations, folds)
    labels = Labels(at.rows.board, at.rows.skin, at.rows.indentation, at.rows.capture)
    sides = [Sides(fold.question, fold.name, fold.train, fold.pool, fold.test) for fold in at.folds]
    checks = [
        check
        for side in sides
        for check in audit_fold(
            side, labels, db_uT=at.rows.db_uT, rng=rng_for(at.asked.seed, "audit", side.question, side.name)
        )
    ]
    checks += list(_scalers(at, {(side.question, side.name): side for side in sides}, models))
    checks += _settings(at, choice) if at.asked.audit and at.asked.audit.settings == "chosen" else []
    if not holds(checks):
        first = next(check for check in checks if not (check.holds or check.known))
        raise LeakError(
            complain(
                f"audit of {scene}, {first.where}", first.what, first.rule, first.found, "Look at who is held out."
            )
        )
    io.write_json(answer, to_words(checks))
    say(f"{scene}: {len(checks)} checks, no leak; {sum(check.known for check in checks)} known, the paper's own")


def _scalers(at: Scenery, sides: dict[tuple[str, str], Sides], models: Path) -> Iterator[Check]:
    """Fit the scaler of every network that was trained from nothing again; an adapted one keeps its base's."""
    for arm in modelled(at.asked):
        for file in sorted((models / arm).glob("*.json")):
            card = io.read_json(file)
            if "tuning" in card:
                continue
            question = "lobo" if card["question"] == "triplet" else card["question"]
            view = VIEW[card["recipe"]["inputs"]]
            yield audit_scaler(
                file.stem, io.read_tensors(file.with_suffix(".safetensors"))[0], db_uT=view(at.rows.db_uT),
                target=at.rows.target, sides=sides[question, card["fold"]],
                fit=partial(_fit, card["recipe"]["scaling"]),
            )  # fmt: skip


def _fit(scaling: str, db_uT: np.ndarray, target: np.ndarray) -> dict[str, np.ndarray]:
    return FIT[scaling](db_uT, target).arrays()


def _settings(at: Scenery, choice: Path) -> list[Check]:
    sections = {arm: getattr(at.asked, arm) for arm in ("train_multi", "train_triplet", "adapt")}
    recipes = {
        arm: {k: v for k, v in section.recipes[HEADLINE].model_dump(mode="json").items() if k not in BUDGET}
        for arm, section in sections.items()
        if section is not None
    }
    held_out = np.unique(np.concatenate([fold.test for fold in at.folds]))
    return audit_choice(
        io.read_json(choice), recipes, source=at.asked.source, seed=at.asked.seed,
        test_boards=np.unique(at.rows.board[held_out]).tolist(), test_skins=np.unique(at.rows.skin[held_out]).tolist(),
    )  # fmt: skip


if __name__ == "__main__":
    run(audit)
