"""Section shear of a scene. Refuses to know captures."""

from typing import Annotated

from pydantic import Field

from pipeline.core.config import Strict
from pipeline.learning.recipe import Training

Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Shear(Strict):
    """Dragged lines: place and all three forces (paper section 4)."""

    test_fraction: Fraction
    repeats_n: Count
    training: Training
