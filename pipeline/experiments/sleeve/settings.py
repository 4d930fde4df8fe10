"""Section sleeve of a scene. Refuses to know captures."""

from typing import Annotated

from pydantic import Field

from pipeline.core.config import Strict
from pipeline.learning.recipe import Training

Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Sleeve(Strict):
    """Many boards under one skin (paper section 6); the last part of the pokes is held out."""

    test_fraction: Fraction
    neighbours_n: Count  # of the k nearest neighbours that stand beside the networks
    training: Training
