"""Stage drift: one network a no-load policy, trained on a skin's first contacts, tested on later ones (section 4)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.stage import run
from pipeline.dataset.rows import Selection
from pipeline.dataset.windows import Part, stack
from pipeline.evaluation.scores import tally
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.drift import networks as work
from pipeline.experiments.drift.findings import findings
from pipeline.experiments.drift.settings import Drift
from pipeline.experiments.drift.windows import (
    Answers,
    boards_of,
    field_sizes,
    last_window,
    late_force,
    late_window,
    of_networks,
    over_windows,
    pace,
)  # fmt: skip
from pipeline.learning.card import collapse_record
from pipeline.learning.recipe import HEADLINE, with_training
from pipeline.trials.data import SceneData, train_all


def read(settings: Settings) -> Drift:
    """Read section drift."""
    return with_training(settings, Drift, "drift")


def drift(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Train and test under every no-load policy, on every capture of a folder."""
    settings = read_settings("drift", scene, files)
    section, selection = read(settings), settings.section(Selection, "selection")
    captures = read_folder(indentations, tuple(settings.captures_in(indentations)))
    windows, parts = work.cut(captures, section, selection)
    pairs = list(work.trials(parts, section, settings.seed))
    data = SceneData(scene, settings, stack(parts), [])
    said: dict[str, list[Answers]] = {}
    trained = train_all(data, [trial for trial, _ in pairs], "drift")
    for (trial, tests), one in zip(pairs, trained, strict=True):
        said.setdefault(trial.recipe_name, []).extend(work.answers(trial, one, tests))
    rows: dict[str, dict[str, Any]] = {
        name: {policy: over_windows(own, policy) for policy in section.policies} for name, own in said.items()
    }
    told, drawn = _tell(section, said[HEADLINE], rows[HEADLINE], parts, field_sizes(captures))
    counts = {"skins_n": len(captures), "seeds_n": section.training.seeds_n, "dropped": data.rows.dropped}
    words = section.model_dump(mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"})
    numbers = {name: value for name, value in words.items() if value is not None} | counts | pace(captures)
    variants = {name: own for name, own in rows.items() if name != HEADLINE}
    numbers |= {"left_out_units_n": windows.left_out_units_n} | told | ({"variants": variants} if variants else {})
    write_answer(
        answer, numbers, drawn, read_losses(indentations, numbers["dropped"]), tally(map(collapse_record, trained))
    )


def _tell(
    asked: Drift, said: Sequence[Answers], rows: dict[str, Any], parts: Sequence[Part], field: dict[str, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Put the windows together with late forces and findings; the paper does not say of which policy figure 5b is."""
    policy = "regular" if "regular" in rows else asked.policies[0]
    window_i = late_window(rows[policy])
    numbers, drawn, late = rows | {"field": field}, {}, late_force(said, policy, window_i)
    if late is not None:
        left_pct = work.force_left_pct(parts, policy, window_i)
        where = {"policy": policy, "contacts_n": rows[policy][window_i]["contacts_n"]}
        numbers["late"] = where | late[0] | ({} if left_pct is None else {"force_left_pct": left_pct})
        drawn = {"late": late[1]}
    networks: dict[str, Any] = {name: of_networks(said, name) for name in asked.policies}
    boards = boards_of(said, policy)
    found = findings(rows, networks, boards=boards, field=field, late=numbers.get("late"))
    last = {name: last_window(said, name) for name in asked.policies}
    return numbers | {"findings": found, "last_window": last}, drawn


if __name__ == "__main__":
    run(drift)
