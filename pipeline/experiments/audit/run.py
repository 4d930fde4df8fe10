"""Stage audit: does a result rest on test rows? Folds, scalers and the choice of settings, looked at once more."""

from pathlib import Path

from pipeline.core import io
from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.errors import LeakError
from pipeline.core.seeds import rng_for
from pipeline.core.stage import run, say
from pipeline.experiments.audit.checks import holds, to_words
from pipeline.experiments.audit.collapse import COLLAPSE
from pipeline.experiments.audit.models import model_checks, settings_checks
from pipeline.experiments.audit.settings import NOT_CHOSEN
from pipeline.experiments.audit.sides import Labels, Sides, audit_fold
from pipeline.learning.recipe import AuditSettings
from pipeline.trials.data import read_data


def read(settings: Settings) -> AuditSettings:
    """Read section audit."""
    return settings.section(AuditSettings, "audit")


def audit(scene: str, files: Files, indentations: Path, folds: Path, models: Path, choice: Path, answer: Path) -> None:
    """Check every fold, the scaler of every network and the settings; a leak fails the stage and names itself."""
    data = read_data(read_settings("audit", scene, files), indentations, folds)
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
            f"audit of {scene}, {first.where}", first.what, first.rule, first.found, "Look at who is held out."
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
