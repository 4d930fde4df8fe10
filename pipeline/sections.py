"""Sections of a scene's file for the paper's further experiments, one model each. In: plain words. Out: checked ones.

Refuses to know scenes, stages and data.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.learning.recipe import Training
from pipeline.strict import Strict

Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Place_mm = tuple[float, float]
Policy = Literal[
    "initial", "regular", "each"
]  # no-load reading: once at the start, every so often, before each contact


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


class Variation(Strict):
    """How the field of equal pokes differs over time and from skin to skin (paper figure 4)."""

    places_mm: Annotated[tuple[Place_mm, ...], Field(min_length=1, max_length=4)]
    depth_mm: Annotated[float, Field(gt=0)]
    skins_n: Count
    contacts_n: Count  # over so many contacts of one skin


class Shear(Strict):
    """Dragged lines: place and all three forces (paper section 4)."""

    test_fraction: Fraction
    repeats_n: Count
    training: Training


class Sleeve(Strict):
    """Many boards under one skin (paper section 6); the last part of the pokes is held out."""

    test_fraction: Fraction
    neighbours_n: Count  # of the k nearest neighbours that stand beside the networks
    training: Training


class Contacts(Strict):
    """Two contacts at once, as sums of two pokes of a held-out skin (paper section 7)."""

    pairs_n: Count
    separations_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    false_alarm_fraction: Fraction


class Iron(Strict):
    """A ball of soft iron near the skin, right above its middle."""

    radius_mm: Annotated[float, Field(gt=0, le=100)]
    distances_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]  # skin's top to its surface


class Ambient(Strict):
    """What a field from outside that comes up after the no-load reading does (paper section 7)."""

    fields_uT: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)]
    iron: Iron
