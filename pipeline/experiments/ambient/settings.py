"""Section ambient of a scene. Refuses to know captures."""

from typing import Annotated

from pydantic import Field

from pipeline.core.config import Strict


class Iron(Strict):
    """A ball of soft iron near the skin, right above its middle."""

    radius_mm: Annotated[float, Field(gt=0, le=100)]
    distances_mm: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]  # skin's top to its surface


class Ambient(Strict):
    """What a field from outside that comes up after the no-load reading does (paper section 7)."""

    fields_uT: Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1)]
    iron: Iron
