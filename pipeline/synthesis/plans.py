"""What every protocol has: settings that all share, and the plan of stops that it becomes. In and out: plain values.

Refuses to know any one protocol, robots' errors, clocks and fields.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64, Int32
from pydantic import Field

from pipeline.core.config import Strict
from pipeline.dataset.grid import CENTRE_MM

Count = Annotated[int, Field(ge=1, le=100_000)]
Depth_mm = Annotated[float, Field(gt=0, le=10)]
Duration_s = Annotated[float, Field(gt=0, le=100)]
Rate_hz = Annotated[float, Field(gt=0, le=1e4)]


class Shared(Strict):
    """What the settings of every protocol say."""

    boards: str  # the kind of board, one of `boards` of the scene
    skins_n: Count  # so many, the first skin of each board before the second of any
    terms: tuple[Literal["ageing", "friction", "relaxation", "temperature"], ...]  # physics that it needs (PHYSICS 8)
    rate_hz: Rate_hz | None = None  # the rig's unless given: more chips take longer


@dataclass(frozen=True)
class Plan:
    """Stops in order of time, axes n indentations and p stops of each; `tilt` is the stylus' lean, x and y over z.

    A depth below zero is a stop above the skin; where a weight is commanded, the depth is unknown: NaN. `centre_mm` is
    the label of the skin's middle.
    """

    pass_i: Int32[np.ndarray, " n"]
    x_mm: Float64[np.ndarray, "n p"]
    y_mm: Float64[np.ndarray, "n p"]
    depth_mm: Float64[np.ndarray, "n p"]
    tilt: Float64[np.ndarray, "n 2"]
    labelled: bool  # whether anybody knows places, depths and forces
    words: str
    weight_N: Float64[np.ndarray, "n p"] | None = None
    centre_mm: tuple[float, float] = (CENTRE_MM, CENTRE_MM)

    def __len__(self) -> int:
        return len(self.pass_i)
