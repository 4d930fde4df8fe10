"""Stage contacts: what a single-contact network makes of two contacts at once, and whether they can be told."""

from pathlib import Path
from typing import Any

from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.stage import run
from pipeline.experiments.answer import write_answer
from pipeline.experiments.contacts.on_board import SAME_PLACE, on_board
from pipeline.experiments.contacts.pairs import summarise_nested
from pipeline.experiments.contacts.settings import Contacts
from pipeline.experiments.contacts.superposition import superposition
from pipeline.synthesis.settings import synthesis_of
from pipeline.trials.data import read_data
from pipeline.trials.networks import networks_without

# The networks behind two of the detectors were trained on all that the held-out board leaves, so on this part as well.
KEPT_ASIDE = (
    "training contacts of a {} among which detectors look no neighbours up; the networks behind `residual` and "
    "`networks disagree` were trained on them"
)


def read(settings: Settings) -> Contacts:
    """Read section contacts."""
    return settings.section(Contacts, "contacts")


def contacts(scene: str, files: Files, folds: Path, indentations: Path, models: Path, answer: Path) -> None:
    """Add pokes of every held-out board in pairs, and ask the networks that never saw it."""
    data = read_data(read_settings("contacts", scene, files), indentations, folds)
    settings, held_out = data.settings, data.folds_of("lobo")
    asked = read(settings)
    boards, drawn = zip(
        *(on_board(data, fold, asked, networks_without(models, fold.name)) for fold in held_out),
        strict=True,
    )
    stats = summarise_nested(boards)
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
    if "simulate" in settings.of_scene:
        numbers["superposition"] = superposition(
            synthesis_of(data.settings), asked.separations_mm, seed=data.settings.seed
        )
    along = {s: [value for one in drawn for value in one["along"][s]] for s in drawn[0]["along"]}
    write_answer(answer, numbers, {"along": along})


def _row(stats: dict[str, Any], separation_mm: float) -> dict[str, Any]:
    return {"separation_mm": separation_mm, **stats["falls"][separation_mm], **stats["by_separation"][separation_mm]}


if __name__ == "__main__":
    run(contacts)
