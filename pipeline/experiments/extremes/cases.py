"""A case, which is one measured error with its limit, and the world in which the cases are measured."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from reskin.config import parse
from reskin.physics.board import Board, Spreads, draw_board
from reskin.physics.layer import IndentedLayer
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import Skin, SkinDesign, draw_skin
from reskin.physics.slide import HoldDesign
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import SimulationSettings

COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)  # nodes of a skin for laws that hold with any nodes


@dataclass(frozen=True)
class World:
    """The first board and skin of a scene, without manufacturing spreads, and the seed of the scene."""

    simulation: SimulationSettings
    seed: int

    @property
    def design(self) -> SkinDesign:
        return self.simulation.skin

    @property
    def indented(self) -> IndentedLayer:
        """The layer and the tip of the scene."""
        return IndentedLayer(self.design.thickness_mm * milli, self.design.tip_radius_mm * milli, self.design.base)

    @cached_property
    def exact(self) -> Spreads:
        zeros = dict.fromkeys(set(Spreads.model_fields) - {"skin_filler_length_mm"}, 0.0)
        return self.simulation.spreads.model_copy(update=zeros)

    @cached_property
    def board(self) -> Board:
        return draw_board(self.simulation.main_boards.design, self.exact, seed=self.seed, name="b0")

    def draw(self, rule: Quadrature = COARSE, **changes: object) -> Skin:
        """Return the skin with some properties of its design changed."""
        design = self.design.model_copy(update=changes)
        return draw_skin(design, self.exact, seed=self.seed, name="b0_s0", rule=rule)

    @cached_property
    def skin(self) -> Skin:
        return self.draw()

    def draw_held(self, **changes: object) -> Skin:
        """Return the skin with some properties changed; if it does not slide on its base, with the nominal base."""
        if self.design.hold is None:
            changes |= {"base": "slipping", "hold": parse(HoldDesign, nominal("skin")["hold"], "hold")}
        return self.draw(COARSE, **changes)


@dataclass(frozen=True)
class Case:
    """A law of physics, or a stiff, extreme or broken case: an error is measured, and must be at most `limit`.

    - area: `physics`, `chip`, `serial` or `learning`.
    - name: key of the case in numbers.json.
    - what: the tested quantity and situation.
    - reference: the law, the independent computation or the behaviour with which it is compared.
    - measure: computes the error, in `unit`.
    - limit, reason: the largest accepted error, and why it is this large.
    - full: whether only the full sweep of scene `paper` contains the case.
    """

    area: str
    name: str
    what: str
    reference: str
    measure: Callable[[World], float]
    limit: float
    reason: str
    unit: str = "1"
    full: bool = False

    def row(self, world: World) -> dict[str, object]:
        """Measure the error. If this raises an exception, or the error is not finite, `message` says so."""
        try:
            error = float(self.measure(world))
            message = "" if np.isfinite(error) else f"error is {error}"
        except Exception as raised:  # The other cases must still be measured.
            error, message = np.nan, f"{type(raised).__name__}: {raised}"
        described = {name: getattr(self, name) for name in ("area", "what", "reference", "unit", "limit", "reason")}
        outcome = {"error": None if message else error, "message": message, "holds": bool(error <= self.limit)}
        return {"case": self.name} | outcome | described


def largest(*errors: float) -> float:
    """Return the largest error, or NaN if any error is NaN, which Python's `max` can drop."""
    return float(np.max(errors))


def max_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"] | float) -> float:
    """Return the largest absolute error."""
    return float(np.abs(found - truth).max())


def relative_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return the largest relative error of an element."""
    return float(np.abs(found / truth - 1).max())


def scaled_error(found: Float[np.ndarray, "*any"], truth: Float[np.ndarray, "*any"]) -> float:
    """Return largest absolute error / largest absolute true value."""
    return float(np.abs(found - truth).max() / np.abs(truth).max())
