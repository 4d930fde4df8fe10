"""Settings of what stands beside the paper's networks: classical methods, and a few labels of a new skin. No data."""

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import Field, model_validator

from pipeline.learning.classical import Classical
from pipeline.learning.recipe import AugmentedRecipe, FineTuning, Labelling, Name, Recipe, Steps, Variants, Words
from pipeline.strict import Strict, parse


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


Named = Callable[[str, str], Any]  # section and name -> a row of params.yaml


def resolve_baselines(words: Words, named: Named, where: str) -> Baselines:
    """Put the section and the set that it names together."""
    row = parse(BaselinesRow, words, where)
    return parse(Baselines, dict(words) | {"methods": named("methods", row.methods)}, where)


def resolve_few_labels(words: Words, named: Named, where: str) -> FewLabels:
    """Put the section and the rows that it names together."""
    row = parse(FewLabelsRow, words, where)
    base = named("recipes", row.recipe) | {"steps_n": row.steps_n}
    own = {name: words[name] for name in ("labels_n", "adapted", "rows_max_n")}
    own["recipes"] = {name: base | changes for name, changes in row.recipes.items()}
    own["adapting"] = named("adaptations", row.adapting.adaptation) | {"steps_n": row.adapting.steps_n}
    own["labelling"] = named("labellings", row.labelling.labelling) | {"steps_n": row.labelling.steps_n}
    return parse(FewLabels, own | {"methods": named("methods", row.methods)}, where)
