"""What time and contacts do to a skin: relaxation, memory of the field, wear and warmth."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, model_validator

from reskin.config import Strict
from reskin.errors import ParamsError


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
    change_T: Float[np.ndarray, "n p k 3"], how: Memory
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n p k 3"]]:
    """Give what earlier pokes leave in each no-load reading, and what has been added to it at every stop of a poke.

    q' = (share dB - q) / tau while a poke is held, q' = -q / tau after it, exactly; none before the first poke.
    A stop has no known time: there the poke counts as held for `contact_s`, with the mean dB of the stops so far.
    """
    so_far_T = change_T.cumsum(axis=1) / np.arange(1, change_T.shape[1] + 1)[:, None, None]
    before_T, added_T = np.zeros_like(change_T[:, 0]), np.zeros_like(change_T)
    for share, tau_s in zip(how.share, how.tau_s, strict=True):
        held, rested = np.exp(-how.contact_s / tau_s), np.exp(-how.rest_s / tau_s)
        crept_T = -np.expm1(-how.contact_s / tau_s) * share * so_far_T
        left_T = np.zeros_like(before_T)  # q before poke i + 1 is what poke i left at its end, rested
        for i in range(len(change_T) - 1):
            left_T[i + 1] = rested * crept_T[i, -1] + held * rested * left_T[i]
        before_T += left_T
        added_T += crept_T - (1 - held) * left_T[:, None]
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


SETTLING_CONTACTS = 300  # the first softening is over after a few times as many
AGEING_CONTACTS = 1e3


class Ageing(Strict):
    """How fast a skin softens and its field at rest drifts."""

    settling: Annotated[float, Field(ge=0, le=0.5)]  # force lost in the first contacts
    ageing: Annotated[float, Field(ge=0, le=0.1)]  # force lost with each decade of contacts
    fading_per_decade: Annotated[float, Field(ge=0, le=0.1)]  # of the field at rest
    wandering_uT: Annotated[float, Field(ge=0, le=10)]  # sd a contact and channel


def softening(contacts_n: Int[np.ndarray, " n"], *, settling: float, ageing: float) -> Float[np.ndarray, " n"]:
    """Give force over the force of the fresh skin: 1 - settling (1 - exp(-N/300)) - ageing log10(1 + N/1000)."""
    _refuse_counts(contacts_n)
    settled = -np.expm1(-contacts_n / SETTLING_CONTACTS)
    left = 1 - settling * settled - ageing * np.log10(1 + contacts_n / AGEING_CONTACTS)
    if not (left > 0).all():
        got = f"{left.min():.3g} after {contacts_n.max()} contacts"
        raise ParamsError("wear", "stiffness left", "above 0", got, "Lower settling or ageing.")
    return left


def fading(contacts_n: Int[np.ndarray, " n"], *, per_decade: float) -> Float[np.ndarray, " n"]:
    """Give what a skin's field at rest loses, as a share of it: per_decade log10(1 + N)."""
    _refuse_counts(contacts_n)
    return per_decade * np.log10(1 + contacts_n)


def wandering(
    contacts_n: Int[np.ndarray, " n"], channels_n: int, *, step_T: float, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw the random walk of each channel's baseline, one normal step of sd `step_T` for every contact, in tesla.

    `contacts_n` must not fall; contacts that nobody looks at are walked all the same.
    """
    _refuse_counts(contacts_n)
    new_n = np.diff(contacts_n, prepend=0)
    if (new_n < 0).any():
        raise ParamsError("wear", "contact count", "never falling", f"{new_n.min()}", "Sort the contacts.")
    steps_T = step_T * np.sqrt(new_n)[:, None] * rng.standard_normal((len(contacts_n), channels_n))
    return np.cumsum(steps_T, axis=0)


def _refuse_counts(contacts_n: Int[np.ndarray, " n"]) -> None:
    if contacts_n.size and contacts_n.min() < 0:
        raise ParamsError("wear", "contact count", "0 or more", f"{contacts_n.min()}", "Count from 0.")
