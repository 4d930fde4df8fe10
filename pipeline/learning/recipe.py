"""A recipe: one row of settings for the one training loop. Knows no data and no network."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.strict import Strict

HEADLINE = "paper"  # the recipe whose numbers stand beside the paper's; others are variants


class Recipe(Strict):
    """What the paper leaves open is written here: optimiser settings, batch, length, scaling.

    `architecture` is the paper's text or the network that its authors released (FACTS: ReLU after layer 2 and on the
    output); `scaling` is per-channel standardisation or the released one (5 sd without mean; x/16, y/16, F/3). The
    optimiser is AdamW under a one-cycle rate whose peak is `rate_max`.
    """

    architecture: Literal["paper", "released"]
    scaling: Literal["standard", "released"]
    epochs_n: Annotated[int, Field(ge=1)]
    batch_n: Annotated[int, Field(ge=1)]
    rate_max: Annotated[float, Field(gt=0)]
    weight_decay: Annotated[float, Field(ge=0)]


class Training(Strict):
    """What a training stage runs: every recipe on every fold with every seed."""

    recipes: dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")], Recipe]  # a name is part of file names
    seeds_n: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _has_a_headline(self) -> "Training":
        if HEADLINE not in self.recipes:
            raise ValueError(f"recipes hold a recipe named {HEADLINE}, which stands beside the paper's numbers")
        return self
