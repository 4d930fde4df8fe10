"""Settings of what stands beside the paper's networks: classical methods, and a few labels of a new skin. No data."""

from typing import Annotated

from pydantic import Field, model_validator

from pipeline.learning.classical import Classical
from pipeline.learning.recipe import AugmentedRecipe, FineTuning, Labelling, Name, Recipe
from pipeline.strict import Strict


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
