"""Pokes scattered over a whole skin, of any size. In: a section of a scene, the skin's sides. Out: a `Plan` of stops.

Places are labels: mm from the skin's corner, so its middle is at half of its sides. Refuses to know boards and fields.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from pipeline.core.errors import ParamsError
from pipeline.synthesis.plans import Count, Depth_mm, Plan, Shared


class Scatter(Shared):
    """Pokes anywhere on the skin, each place as likely as any other (section 6, arm sleeve)."""

    kind: Literal["scatter"]
    pokes_n: Count
    depth_mm: tuple[Depth_mm, Depth_mm]  # from, to: anything between them, each as likely
    margin_mm: Annotated[float, Field(ge=0)]  # so far from every edge

    @model_validator(mode="after")
    def _depths_rise(self) -> "Scatter":
        if not self.depth_mm[0] <= self.depth_mm[1]:
            raise ValueError(f"depth_mm goes from the shallower to the deeper, not {self.depth_mm}")
        return self


def scatter(asked: Scatter, skin_mm: tuple[float, float], rng: np.random.Generator) -> Plan:
    """Draw places and depths, uniform within the margin."""
    if not 2 * asked.margin_mm < min(skin_mm):
        rule = f"less than half of the skin's shorter side, {min(skin_mm) / 2:g} mm"
        raise ParamsError("protocol scatter", "margin_mm", rule, asked.margin_mm, "Lower it.")
    most_mm = np.array(skin_mm) - asked.margin_mm
    place_mm = rng.uniform(asked.margin_mm, most_mm, size=(asked.pokes_n, 2))
    return Plan(
        pass_i=np.zeros(asked.pokes_n, np.int32),
        x_mm=place_mm[:, :1],
        y_mm=place_mm[:, 1:],
        depth_mm=rng.uniform(*asked.depth_mm, size=(asked.pokes_n, 1)),
        tilt=np.zeros((asked.pokes_n, 2)),
        labelled=True,
        words=f"{asked.pokes_n} pokes scattered over {skin_mm[0]:g} x {skin_mm[1]:g} mm, {asked.margin_mm:g} mm from "
        "its edges",
        centre_mm=(skin_mm[0] / 2, skin_mm[1] / 2),
    )
