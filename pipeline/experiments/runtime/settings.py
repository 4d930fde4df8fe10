"""Section `runtime` of a scene: what the studies of error against run time try. In: plain values. Out: their bundles.

Refuses to know how a study is done.
"""

from typing import Annotated

from pydantic import Field
from scipy.constants import milli

from pipeline.core.config import Strict
from pipeline.experiments.runtime.integrators import Sweep
from pipeline.experiments.runtime.trials import Pokes
from pipeline.physics.nodes import Quadrature

Cell_mm = Annotated[float, Field(gt=0, le=20)]
Layers = Annotated[int, Field(ge=1, le=100)]
Positive = Annotated[float, Field(gt=0)]


class Quadratures(Strict):
    """Pokes seen from the skin's middle, and (cell, layers) of every rule of every method."""

    skins_n: Annotated[int, Field(ge=1, le=100)]
    places_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]
    rules: Annotated[dict[str, tuple[tuple[Cell_mm, Layers], ...]], Field(min_length=1)]

    def pokes(self) -> Pokes:
        """Give the pokes of every trial."""
        return Pokes(self.places_mm, self.depths_mm)

    def rules_of(self) -> dict[str, list[Quadrature]]:
        """Give the rules of every method."""
        return {name: [Quadrature(milli * cell, n) for cell, n in rules] for name, rules in self.rules.items()}


class Integrators(Strict):
    """Stiffness ratios, relative tolerances of the solvers, and steps of the explicit one."""

    ratios: Annotated[tuple[Annotated[float, Field(gt=1, le=1e12)], ...], Field(min_length=1)]
    tolerances: Annotated[tuple[Positive, ...], Field(min_length=1)]
    euler_steps_s: Annotated[tuple[Positive, ...], Field(min_length=1)]
    pokes_n: Annotated[int, Field(ge=1, le=1000)]
    calls_per_poke_max_n: Annotated[int, Field(ge=1)]  # right-hand sides; more is a failure

    def sweep(self) -> Sweep:
        """Give the sweep."""
        return Sweep(**self.model_dump())


class RunTime(Strict):
    """Section `runtime`: both studies, and how often each call is timed."""

    quadratures: Quadratures
    integrators: Integrators
    repeats_n: Annotated[int, Field(ge=1, le=1000)]
