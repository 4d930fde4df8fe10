"""Section contacts of a scene. Refuses to know captures."""

from typing import Annotated

from pydantic import Field

from pipeline.core.config import Strict

Count = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(gt=0, lt=1)]


class Contacts(Strict):
    """Two contacts at once, as sums of two pokes of a held-out skin (paper section 7)."""

    pairs_n: Count
    separations_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    false_alarm_fraction: Fraction
