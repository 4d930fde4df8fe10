"""Stage audit: does a result rest on test rows? Folds, scalers and the choice of settings, looked at once more."""

from pathlib import Path

from pipeline import io
from pipeline.errors import LeakError, complain
from pipeline.evaluation.audit.checks import holds, to_words
from pipeline.evaluation.audit.collapse import COLLAPSE
from pipeline.evaluation.audit.settings import NOT_CHOSEN
from pipeline.evaluation.audit.sides import Labels, Sides, audit_fold
from pipeline.seeds import rng_for
from pipeline.settings import Files, read_settings
from pipeline.stages._audit import model_checks, settings_checks
from pipeline.stages._run import run, say
from pipeline.stages._train import read_scenery


def audit(scene: str, files: Files, indentations: Path, folds: Path, models: Path, choice: Path, answer: Path) -> None:
    """Check every fold, the scaler of every network and the settings; a leak fails the stage and names itself."""
    at = read_scenery(read_settings("audit", scene, files), indentations, folds)
    labels = Labels(at.rows.board, at.rows.skin, at.rows.indentation, at.rows.capture)
    sides = [Sides(fold.question, fold.name, fold.train, fold.pool, fold.test) for fold in at.folds]
    checks = [
        check
        for side in sides
        for check in audit_fold(
            side, labels, db_uT=at.rows.db_uT, rng=rng_for(at.asked.seed, "audit", side.question, side.name)
        )
    ]
    checks += list(model_checks(at, {(side.question, side.name): side for side in sides}, models))
    checks += settings_checks(at, choice, models) if at.asked.audit.settings == "chosen" else []
    if not holds(checks):
        first = next(check for check in checks if not (check.holds or check.known))
        raise LeakError(
            complain(
                f"audit of {scene}, {first.where}", first.what, first.rule, first.found, "Look at who is held out."
            )
        )
    io.write_json(answer, to_words(checks))
    unchosen_n = sum(check.found.startswith(NOT_CHOSEN) for check in checks)
    dead_n = sum(check.known and check.what == COLLAPSE for check in checks)
    papers_n = sum(check.known for check in checks) - dead_n
    say(
        f"{scene}: {len(checks)} checks, no leak; {papers_n} known, the paper's own; "
        f"{dead_n} arms with collapsed networks; {unchosen_n} settings that the study did not choose"
    )


if __name__ == "__main__":
    run(audit)
