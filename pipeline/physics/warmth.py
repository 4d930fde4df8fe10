"""What warmth does to skin and chips. In: times. Out: temperatures, and factors of field and reading.

A board warms up after it is switched on, and the room goes up and down; skin and chips are as warm as each other.
Refuses to know fields and what else drifts (`wear`).
"""

from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field

from pipeline.core.config import Strict

ROOM_DEGC = 25.0
REMANENCE_PER_K = -0.12e-2  # NdFeB powder: Br falls by 0.12 % for each kelvin (PHYSICS 5)


class Temperature(Strict):
    """How the temperature runs, and how much the chips' sensitivity follows it."""

    warming_K: Annotated[float, Field(ge=0, le=40)]  # from switching on to the end
    warming_s: Annotated[float, Field(gt=0, le=1e5)]
    swing_K: Annotated[float, Field(ge=0, le=20)]  # of the room, up and down
    swing_s: Annotated[float, Field(gt=0, le=1e6)]
    chip_sensitivity_per_K: Annotated[float, Field(ge=0, le=0.01)]  # sd between chips


def warmer_K(time_s: Float[np.ndarray, "..."], how: Temperature) -> Float[np.ndarray, "..."]:
    """Give how much warmer than at the start it is: warming (1 - exp(-t / tau)) + swing sin(2 pi t / period)."""
    warming = -how.warming_K * np.expm1(-time_s / how.warming_s)
    return warming + how.swing_K * np.sin(2 * np.pi * time_s / how.swing_s)


def remanence(warmer_K: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Give magnetisation over that at the start; fields at rest and their changes scale alike."""
    return 1 + REMANENCE_PER_K * warmer_K
