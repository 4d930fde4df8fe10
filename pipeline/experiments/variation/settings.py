"""Section variation of a scene. Refuses to know captures."""

from typing import Annotated

from pydantic import Field

from pipeline.core.config import Strict

Count = Annotated[int, Field(ge=1)]
Place_mm = tuple[float, float]


class Variation(Strict):
    """How the field of equal pokes differs over time and from skin to skin (paper figure 4)."""

    places_mm: Annotated[tuple[Place_mm, ...], Field(min_length=1, max_length=4)]
    depth_mm: Annotated[float, Field(gt=0)]
    skins_n: Count
    contacts_n: Count  # over so many contacts of one skin
