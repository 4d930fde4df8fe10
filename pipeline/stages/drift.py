"""Stage drift: one network a no-load policy, trained on a skin's first contacts, tested on later ones (section 4)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.dataset.parts import Part, stack
from pipeline.evaluation.drift import (
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
from pipeline.evaluation.drift_findings import findings
from pipeline.evaluation.tally import tally
from pipeline.learning.card import went
from pipeline.learning.recipe import HEADLINE
from pipeline.sections import Drift
from pipeline.settings import Files, read_settings
from pipeline.stages import _drift as work
from pipeline.stages._experiment import read_folder, read_losses, write_answer
from pipeline.stages._run import run
from pipeline.stages._train import Scenery, train_all


def drift(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Train and test under every no-load policy, on every capture of a folder."""
    asked = read_settings("drift", scene, files)
    captures = read_folder(indentations, tuple(asked.captures_in(indentations)))
    windows, parts = work.cut(captures, asked.drift, asked.selection)
    pairs = list(work.cells(parts, asked.drift, asked.seed))
    at = Scenery(scene, asked, stack(parts), [])
    said: dict[str, list[Answers]] = {}
    trained = train_all(at, [cell for cell, _ in pairs], "drift")
    for (cell, tests), one in zip(pairs, trained, strict=True):
        said.setdefault(cell.recipe_name, []).extend(work.answers(cell, one, tests))
    rows: dict[str, dict[str, Any]] = {
        name: {policy: over_windows(own, policy) for policy in asked.drift.policies} for name, own in said.items()
    }
    told, drawn = _tell(asked.drift, said[HEADLINE], rows[HEADLINE], parts, field_sizes(captures))
    counts = {"skins_n": len(captures), "seeds_n": asked.drift.training.seeds_n, "dropped": at.rows.dropped}
    words = asked.drift.model_dump(mode="json", include={"unit", "train_n", "test_n", "every_n", "regular_n"})
    numbers = {name: value for name, value in words.items() if value is not None} | counts | pace(captures)
    variants = {name: own for name, own in rows.items() if name != HEADLINE}
    numbers |= {"left_out_units_n": windows.left_out_units_n} | told | ({"variants": variants} if variants else {})
    write_answer(answer, numbers, drawn, read_losses(indentations, numbers["dropped"]), tally(map(went, trained)))


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
