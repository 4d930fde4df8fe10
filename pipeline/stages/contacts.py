"""Stage contacts: what a single-contact network makes of two contacts at once, and whether they can be told."""

from pathlib import Path
from typing import Any

from pipeline.evaluation.contacts import over_boards
from pipeline.evaluation.superposition import superposition
from pipeline.settings import Files, read_settings
from pipeline.stages._contacts import SAME_PLACE, on_board
from pipeline.stages._experiment import write_answer
from pipeline.stages._networks import networks_without
from pipeline.stages._run import run
from pipeline.stages._simulated import synthesis_of
from pipeline.stages._train import read_scenery

# The networks behind two of the detectors were trained on all that the held-out board leaves, so on this part as well.
KEPT_ASIDE = (
    "training contacts of a {} among which detectors look no neighbours up; the networks behind `residual` and "
    "`networks disagree` were trained on them"
)


def contacts(scene: str, files: Files, folds: Path, indentations: Path, models: Path, answer: Path) -> None:
    """Add pokes of every held-out board in pairs, and ask the networks that never saw it."""
    at = read_scenery(read_settings("contacts", scene, files), indentations, folds)
    asked = at.asked.contacts
    boards, drawn = zip(
        *(on_board(at, fold, asked, networks_without(models, fold.name)) for fold in at.of("lobo")), strict=True
    )
    stats = over_boards(boards)
    numbers: dict[str, Any] = {
        "pairs_n": asked.pairs_n,
        "boards_n": len(boards),
        "threshold_set_on": KEPT_ASIDE.format(drawn[0]["kept_aside"]),
        "noise": "that of two readings",
        "by_separation": [_row(stats, separation_mm) for separation_mm in asked.separations_mm],
        "same_place": _row(stats, SAME_PLACE),
        "false_alarm_pct": {
            detector: {"asked": 100 * asked.false_alarm_fraction, "realised": realised}
            for detector, realised in stats["false_alarm_pct"].items()
        },
        "auc": stats["auc"],
    }
    if "simulate" in at.asked.own:
        numbers["superposition"] = superposition(synthesis_of(at.asked), asked.separations_mm, seed=at.asked.seed)
    along = {s: [value for one in drawn for value in one["along"][s]] for s in drawn[0]["along"]}
    write_answer(answer, numbers, {"along": along})


def _row(stats: dict[str, Any], separation_mm: float) -> dict[str, Any]:
    return {"separation_mm": separation_mm, **stats["falls"][separation_mm], **stats["by_separation"][separation_mm]}


if __name__ == "__main__":
    run(contacts)
