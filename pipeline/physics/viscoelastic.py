"""How the skin's force relaxes, and what its field remembers. In: force or change of field. Out: the same with memory.

Displacement is prescribed, so the field does not relax while the contact grows (PHYSICS 0), only the force; but a held
poke goes on creeping, and part of its change stands in the next no-load readings. Refuses to know where either is from.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

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


class Memory(Strict):
    """How a poke's change of field creeps while it is held, and fades after it; times are those of a real rig.

    What stands in the next no-load reading is as recorded (5 to 8 %, FACTS 6); how it is shared among times is assumed.
    """

    share: tuple[Annotated[float, Field(ge=0, le=1)], ...]  # of the change, that a poke held for ever would add
    tau_s: tuple[Annotated[float, Field(gt=0, le=1e6)], ...]
    contact_s: Annotated[float, Field(ge=0, le=1e4)]  # how long a poke is held, until the end of its readings
    rest_s: Annotated[float, Field(ge=0, le=1e4)]  # from there to the next no-load reading

    @model_validator(mode="after")
    def _each_share_has_a_time(self) -> "Memory":
        if len(self.share) != len(self.tau_s):
            raise ValueError("tau_s needs one time for each share")
        return self


def remembered(
    change_T: Float[np.ndarray, "n k 3"], how: Memory
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k 3"]]:
    """Give what earlier pokes leave in each no-load reading, and what has been added to it when the poke is read.

    q' = (share dB - q) / tau while a poke is held, q' = -q / tau after it, exactly; none before the first poke.
    """
    before_T, added_T = np.zeros_like(change_T), np.zeros_like(change_T)
    for share, tau_s in zip(how.share, how.tau_s, strict=True):
        held, rested = np.exp(-how.contact_s / tau_s), np.exp(-how.rest_s / tau_s)
        crept_T = -np.expm1(-how.contact_s / tau_s) * share * change_T
        left_T = np.zeros_like(change_T)  # q before poke i + 1 is what poke i left at its end, rested
        for i in range(len(change_T) - 1):
            left_T[i + 1] = rested * crept_T[i] + held * rested * left_T[i]
        before_T += left_T
        added_T += crept_T - (1 - held) * left_T
    return before_T, added_T


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
