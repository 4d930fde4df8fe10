"""How the skin's force relaxes. In: the elastic force at some times. Out: the force with memory, same unit.

Displacement is prescribed, so the field does not relax while the contact grows (PHYSICS 0), only the force.
Refuses to know where the elastic force comes from.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError


@dataclass(frozen=True)
class Prony:
    """Relaxation 1 - sum of share (1 - exp(-t / tau)): stiff at once, softer by the sum of the shares in the end."""

    tau_s: Float[np.ndarray, " p"]
    share: Float[np.ndarray, " p"]

    def __post_init__(self) -> None:
        """Refuse times that are no times, and shares that leave nothing or add to the force."""
        if not (np.isfinite(self.tau_s) & (self.tau_s > 0)).all():
            raise ParamsError("prony", "every tau", "above 0 s and finite", f"{self.tau_s}", "Check its unit.")
        if not ((self.share >= 0).all() and self.share.sum() <= 1):
            raise ParamsError("prony", "share", "0 or more, 1 in sum", f"{self.share}", "Lower the shares.")


SKIN = Prony(tau_s=np.array([1e-3, 1e-1, 1e1, 1e3, 1e4]), share=np.array([0.05, 0.05, 0.05, 0.03, 0.02]))  # assumed


class Relaxation(Strict):
    """How long a real indentation takes, frames or not: the tip goes down evenly, then holds; a rested skin."""

    approach_s: Annotated[float, Field(ge=0, le=100)]
    hold_s: Annotated[float, Field(ge=0, le=100)]  # until the middle of the readings


def force_left(how: Relaxation, prony: Prony = SKIN) -> float:
    """Give the force when an indentation is read, over that of a skin without memory."""
    elastic = np.array([0.0, 1.0, 1.0])
    return float(relax(np.cumsum([0.0, how.approach_s, how.hold_s]), elastic, prony)[-1])


def advance(state: Float[np.ndarray, " p"], change: float, dt_s: float, prony: Prony) -> Float[np.ndarray, " p"]:
    """Carry q' = -q / tau + share e' over `dt_s`, while e grows evenly by `change`; exact for any dt / tau.

    q <- exp(-x) q + share change (1 - exp(-x)) / x, x = dt / tau (Taylor, Pister & Goudreau 1970). No time is a
    jump: without change it leaves the state as it is.
    """
    if not (np.isfinite(dt_s) and dt_s >= 0):
        rule = "0 s or more and finite"
        raise ParamsError("relaxation", "time step", rule, f"{dt_s}", "Sort the times.")
    x = dt_s / prony.tau_s
    return np.exp(-x) * state + prony.share * change * _mean_decay(x)


def relax(time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony) -> Float[np.ndarray, " t"]:
    """Give the force with memory at each time, for an elastic one that runs straight between them from 0 before all.

    Lee & Radok 1960: force = integral of relaxation(t - s) d elastic(s), true as long as the contact does not shrink.
    """
    state = np.zeros_like(prony.tau_s)
    relaxed = np.empty_like(elastic)
    steps_s, changes = np.diff(time_s, prepend=time_s[:1]), np.diff(elastic, prepend=0.0)
    for step_i, (dt_s, change) in enumerate(zip(steps_s, changes, strict=True)):
        state = advance(state, float(change), float(dt_s), prony)
        relaxed[step_i] = (1 - prony.share.sum()) * elastic[step_i] + state.sum()
    return relaxed


def _mean_decay(x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    # (1 - exp(-x)) / x; written so, it is 11 % off at x = 1e-16, and expm1 is not.
    return np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)
