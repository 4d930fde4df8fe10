"""Settings of what stands beside the paper's networks: classical methods, and a few labels of a new skin. No data."""

from typing import Annotated

from pydantic import Field, model_validator

from pipeline.core.config import Settings, Strict, parse
from pipeline.learning.classical import Classical
from pipeline.learning.recipe import AugmentedRecipe, FineTuning, Labelling, Name, Recipe, Steps, Variants


class Baselines(Strict):
    """Section train_classical: methods on the folds of question lobo, each on at most so many training rows."""

    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]


class FewLabels(Strict):
    """Section few_labels: networks and classical methods with so many labelled pokes of the held-out board.

    `adapted` names the recipes that are also adapted by their unlabelled pokes, as `adapting` says.
    """

    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    recipes: dict[Name, Recipe | AugmentedRecipe]
    adapted: tuple[Name, ...]
    adapting: FineTuning
    labelling: Labelling
    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]

    @model_validator(mode="after")
    def _adapts_what_it_trains(self) -> "FewLabels":
        if unknown := set(self.adapted) - set(self.recipes):
            raise ValueError(f"adapted names recipes of few_labels, not {sorted(unknown)}")
        return self


class BaselinesRow(Strict):
    """Section train_classical as a scene writes it: `methods` names a set of params.yaml."""

    rows_max_n: Steps
    methods: Name


class AdaptingRow(Strict):
    """A shared adaptation, so many steps of it."""

    adaptation: Name
    steps_n: Steps


class LabellingRow(Strict):
    """A shared labelling, so many steps of it."""

    labelling: Name
    steps_n: Steps


class FewLabelsRow(Strict):
    """Section few_labels as a scene writes it: `recipes` say what each does differently from the shared `recipe`."""

    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    recipe: Name
    steps_n: Steps
    recipes: Variants
    adapted: tuple[Name, ...]
    adapting: AdaptingRow
    labelling: LabellingRow
    rows_max_n: Steps
    methods: Name


def baselines(settings: Settings) -> Baselines:
    """Read section train_classical, with the set of methods that it names."""
    words, where = settings.words("train_classical"), f"{settings.where}: train_classical"
    row = parse(BaselinesRow, words, where)
    return parse(Baselines, dict(words) | {"methods": settings.row("methods", row.methods)}, where)


def few_labels(settings: Settings) -> FewLabels:
    """Read section few_labels, with the rows that it names."""
    words, where = settings.words("few_labels"), f"{settings.where}: few_labels"
    row = parse(FewLabelsRow, words, where)
    base = settings.row("recipes", row.recipe) | {"steps_n": row.steps_n}
    full = {name: words[name] for name in ("labels_n", "adapted", "rows_max_n")}
    full["recipes"] = {name: base | changes for name, changes in row.recipes.items()}
    full["adapting"] = settings.row("adaptations", row.adapting.adaptation) | {"steps_n": row.adapting.steps_n}
    full["labelling"] = settings.row("labellings", row.labelling.labelling) | {"steps_n": row.labelling.steps_n}
    return parse(FewLabels, full | {"methods": settings.row("methods", row.methods)}, where)
