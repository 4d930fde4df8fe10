"""Effects of time and contacts on a skin: relaxation, hysteresis of the field, wear and temperature."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, model_validator

from reskin.config import Strict
from reskin.errors import ParamsError


@dataclass(frozen=True)
class Prony:
    """Prony series of the relaxation function, 1 - sum over terms of share (1 - exp(-t / tau))."""

    tau_s: Float[np.ndarray, " p"]
    share: Float[np.ndarray, " p"]

    def __post_init__(self) -> None:
        """Raise `ParamsError` for impossible times or shares."""
        if not (np.isfinite(self.tau_s) & (self.tau_s > 0)).all():
            raise ParamsError("prony", "every tau", "above 0 s and finite", f"{self.tau_s}", "Check its unit.")
        if not ((self.share >= 0).all() and self.share.sum() <= 1):
            raise ParamsError("prony", "share", "0 or more, 1 in sum", f"{self.share}", "Lower the shares.")


SKIN_RELAXATION = Prony(  # assumed
    tau_s=np.array([1e-3, 1e-1, 1e1, 1e3, 1e4]), share=np.array([0.05, 0.05, 0.05, 0.03, 0.02])
)


class Relaxation(Strict):
    """Duration of an indentation of a rested skin: the tip approaches at constant speed, then holds."""

    approach_s: Annotated[float, Field(ge=0, le=100)]
    hold_s: Annotated[float, Field(ge=0, le=100)]  # until the middle of the readings


class Memory(Strict):
    """Hysteresis of the field: dB creeps while an indentation is held, and decays after it.

    The part of dB that remains in the next no-load reading is as recorded (5 to 8 %); its distribution over time
    constants is assumed.
    """

    share: tuple[Annotated[float, Field(ge=0, le=1)], ...]  # share of dB that a very long indentation adds
    tau_s: tuple[Annotated[float, Field(gt=0, le=1e6)], ...]
    contact_s: Annotated[float, Field(ge=0, le=1e4)]  # duration of an indentation, until the end of its readings
    rest_s: Annotated[float, Field(ge=0, le=1e4)]  # from there to the next no-load reading

    @model_validator(mode="after")
    def _each_share_has_a_time(self) -> "Memory":
        if len(self.share) != len(self.tau_s):
            raise ValueError("tau_s needs one time for each share")
        return self


def field_memory(
    change_T: Float[np.ndarray, "n p k 3"], how: Memory
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n p k 3"]]:
    """Return the hysteresis of the field in T, from dB at the stops of every indentation.

    Each state follows q' = (share dB - q) / tau during an indentation and q' = -q / tau after it, integrated exactly;
    q = 0 before the first. The times of stops are not known: at each stop, the indentation is assumed to have been held
    for `contact_s` at the mean dB of its stops so far.

    Returns
    -------
    before_T : hysteresis in each no-load reading, from earlier indentations.
    added_T : hysteresis at each stop, relative to that in the no-load reading of its indentation.
    """
    so_far_T = change_T.cumsum(axis=1) / np.arange(1, change_T.shape[1] + 1)[:, None, None]
    before_T, added_T = np.zeros_like(change_T[:, 0]), np.zeros_like(change_T)
    for share, tau_s in zip(how.share, how.tau_s, strict=True):
        held, rested = np.exp(-how.contact_s / tau_s), np.exp(-how.rest_s / tau_s)
        crept_T = -np.expm1(-how.contact_s / tau_s) * share * so_far_T
        left_T = np.zeros_like(before_T)  # q before indentation i + 1: that at the end of i, decayed
        for i in range(len(change_T) - 1):
            left_T[i + 1] = rested * crept_T[i, -1] + held * rested * left_T[i]
        before_T += left_T
        added_T += crept_T - (1 - held) * left_T[:, None]
    return before_T, added_T


def relaxed_share(how: Relaxation, prony: Prony = SKIN_RELAXATION) -> float:
    """Return the force at the readings of an indentation, relative to that of an elastic skin."""
    elastic = np.array([0.0, 1.0, 1.0])
    return float(relax(np.cumsum([0.0, how.approach_s, how.hold_s]), elastic, prony)[-1])


def advance(state: Float[np.ndarray, " p"], change: float, dt_s: float, prony: Prony) -> Float[np.ndarray, " p"]:
    """Integrate q' = -q / tau + share e' over `dt_s`, for e that grows linearly by `change`; exact for any dt / tau.

    q <- exp(-x) q + share change (1 - exp(-x)) / x, x = dt / tau (Taylor, Pister & Goudreau 1970). dt = 0 is a jump of
    e; without a change, the state stays the same.
    """
    if not (np.isfinite(dt_s) and dt_s >= 0):
        rule = "0 s or more and finite"
        raise ParamsError("relaxation", "time step", rule, f"{dt_s}", "Sort the times.")
    x = dt_s / prony.tau_s
    return np.exp(-x) * state + prony.share * change * _mean_decay(x)


def relax(time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony) -> Float[np.ndarray, " t"]:
    """Return the relaxed force at each time, for an elastic force that is linear between the times and starts from 0.

    Lee & Radok 1960: force = integral of relaxation(t - s) d elastic(s), valid while the contact does not shrink.
    """
    state = np.zeros_like(prony.tau_s)
    relaxed = np.empty_like(elastic)
    steps_s, changes = np.diff(time_s, prepend=time_s[:1]), np.diff(elastic, prepend=0.0)
    for step_i, (dt_s, change) in enumerate(zip(steps_s, changes, strict=True)):
        state = advance(state, float(change), float(dt_s), prony)
        relaxed[step_i] = (1 - prony.share.sum()) * elastic[step_i] + state.sum()
    return relaxed


def _mean_decay(x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    # (1 - exp(-x)) / x; without expm1 the error is 11 % at x = 1e-16.
    return np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)


ROOM_DEGC = 25.0
REMANENCE_PER_K = -0.12e-2  # NdFeB powder: Br falls by 0.12 % for each kelvin


class Temperature(Strict):
    """Temperature over time, and how the chips' sensitivity depends on it."""

    warming_K: Annotated[float, Field(ge=0, le=40)]  # from switching on to thermal equilibrium
    warming_s: Annotated[float, Field(gt=0, le=1e5)]
    swing_K: Annotated[float, Field(ge=0, le=20)]  # amplitude of the room temperature
    swing_s: Annotated[float, Field(gt=0, le=1e6)]
    chip_sensitivity_per_K: Annotated[float, Field(ge=0, le=0.01)]  # sd between chips


def temperature_rise_K(time_s: Float[np.ndarray, "..."], how: Temperature) -> Float[np.ndarray, "..."]:
    """Return the temperature rise since the start: warming (1 - exp(-t / tau)) + swing sin(2 pi t / period)."""
    warming = -how.warming_K * np.expm1(-time_s / how.warming_s)
    return warming + how.swing_K * np.sin(2 * np.pi * time_s / how.swing_s)


def relative_remanence(rise_K: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the magnetisation relative to that at the start; no-load fields and dB are proportional to it."""
    return 1 + REMANENCE_PER_K * rise_K


SETTLING_CONTACTS = 300  # scale of the initial softening
AGEING_CONTACTS = 1e3


class Ageing(Strict):
    """Rates of softening and of the drift of the no-load field."""

    settling: Annotated[float, Field(ge=0, le=0.5)]  # force lost in the first contacts
    ageing: Annotated[float, Field(ge=0, le=0.1)]  # force lost with each decade of contacts
    fading_per_decade: Annotated[float, Field(ge=0, le=0.1)]  # of the no-load field
    wandering_uT: Annotated[float, Field(ge=0, le=10)]  # sd per contact and channel


def softening(contacts_n: Int[np.ndarray, " n"], *, settling: float, ageing: float) -> Float[np.ndarray, " n"]:
    """Return the force relative to a fresh skin: 1 - settling (1 - exp(-N/300)) - ageing log10(1 + N/1000)."""
    _check_counts(contacts_n)
    settled = -np.expm1(-contacts_n / SETTLING_CONTACTS)
    left = 1 - settling * settled - ageing * np.log10(1 + contacts_n / AGEING_CONTACTS)
    if not (left > 0).all():
        got = f"{left.min():.3g} after {contacts_n.max()} contacts"
        raise ParamsError("wear", "stiffness left", "above 0", got, "Lower settling or ageing.")
    return left


def fading(contacts_n: Int[np.ndarray, " n"], *, per_decade: float) -> Float[np.ndarray, " n"]:
    """Return the relative loss of the no-load field: per_decade log10(1 + N)."""
    _check_counts(contacts_n)
    return per_decade * np.log10(1 + contacts_n)


def baseline_walk(
    contacts_n: Int[np.ndarray, " n"], channels_n: int, *, step_T: float, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw the random walk of each channel's no-load field in T, with a normal step of sd `step_T` at each contact.

    `contacts_n` must not decrease; the walk includes the contacts between the given counts.
    """
    _check_counts(contacts_n)
    new_n = np.diff(contacts_n, prepend=0)
    if (new_n < 0).any():
        raise ParamsError(f"wear: the contact count falls by {-new_n.min()}. Sort the contacts.")
    steps_T = step_T * np.sqrt(new_n)[:, None] * rng.standard_normal((len(contacts_n), channels_n))
    return np.cumsum(steps_T, axis=0)


def _check_counts(contacts_n: Int[np.ndarray, " n"]) -> None:
    if contacts_n.size and contacts_n.min() < 0:
        raise ParamsError("wear", "contact count", "0 or more", f"{contacts_n.min()}", "Count from 0.")
