"""Rows of the paper's table 2, with their titles and the paper's scores."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.formatting import TITLES
from pipeline.paper import ADAPTED_POKES_N, TABLE_2, TABLE_2_ROWS, Number

Results = Mapping[str, Any]  # numbers.json of one scene
CONTROL = "Control: fine-tuned equally long, but without pokes of the new skin (ours)"
ONE_TRAINING_SKIN = "Leave-one-board-out, one training skin"


@dataclass(frozen=True)
class Model:
    """A row of table 2: title, short title, and the paper's scores (empty if the paper has no such row)."""

    title: str
    short: str
    paper: Mapping[str, Number]


def models(numbers: Results) -> dict[str, Model]:
    """Return the rows of table 2 in the paper's order.

    If networks had only one training skin, the title of their row says so.
    """
    titles = TABLE_2_ROWS | {"control": CONTROL}
    if "adapt" in numbers and numbers["adapt"]["pokes_n"] != ADAPTED_POKES_N:
        pokes = f"{numbers['adapt']['pokes_n']} indentations (paper: {ADAPTED_POKES_N})"
        titles["adapted"] = titles["adapted"].replace(f"{ADAPTED_POKES_N} indentations", pokes)
    named = {row: Model(title, TITLES[row], TABLE_2.get(row, {})) for row, title in titles.items()}
    if is_pooled(numbers):
        return named
    one_skin = {row: titles[row].replace("Multi-sensor", ONE_TRAINING_SKIN) for row in ("triplet", "adapted")}
    return named | {
        "multi": Model(f"{ONE_TRAINING_SKIN} (paper: single-sensor)", "one training skin", TABLE_2["single"]),
        "triplet": Model(one_skin["triplet"], "one training skin + triplet", {}),
        "adapted": Model(one_skin["adapted"], TITLES["adapted"], {}),
    }


def table_2_rows(numbers: Results) -> dict[str, tuple[Model, Mapping[str, Any]]]:
    """Return the computed rows of table 2 in the paper's order; the control, which the paper lacks, comes last."""
    ours = numbers["table2"] | control_of(numbers)
    return {row: (model, ours[row]) for row, model in models(numbers).items() if row in ours}


def control_of(numbers: Results) -> dict[str, Any]:
    """Return the control's row under its name; return an empty dict if there is no control."""
    return {name: row for name, row in numbers.get("adapt", {}).items() if name == "control"}


def is_pooled(numbers: Results) -> bool:
    """Return whether any leave-one-board-out model was trained on several skins; True if there are no such models."""
    boards = numbers["lobo"]["by_board"].values() if "lobo" in numbers else ()
    return not boards or max(board["trained_on_skins_n"] for board in boards) > 1
