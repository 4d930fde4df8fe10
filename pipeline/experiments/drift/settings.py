"""Section drift of a scene. Refuses to know captures."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.core.config import Strict
from pipeline.learning.recipe import Training

Count = Annotated[int, Field(ge=1)]
Policy = Literal["initial", "regular", "each"]  # no-load reading: once, every so often, before each contact


class Drift(Strict):
    """Train on the first of a skin's contacts, test on those after every so many (paper section 4, figure 5)."""

    unit: Literal["indentation", "pass"]  # what the numbers below count
    train_n: Count
    test_n: Count
    every_n: Count
    policies: Annotated[tuple[Policy, ...], Field(min_length=1)]
    regular_n: Count | None = None  # indentations from one no-load reading of policy `regular` to its next
    training: Training

    @model_validator(mode="after")
    def _windows_follow_each_other(self) -> "Drift":
        if self.test_n > self.every_n:
            raise ValueError(f"test_n is at most every_n, {self.every_n}, so that windows do not overlap")
        if self.train_n > self.every_n:
            raise ValueError(f"train_n is at most every_n, {self.every_n}, after which the first test follows")
        if ("regular" in self.policies) != (self.regular_n is not None):
            raise ValueError("regular_n stands there if and only if policies holds regular")
        if len(set(self.policies)) < len(self.policies):
            raise ValueError(f"policies names each policy once, not {list(self.policies)}")
        return self
