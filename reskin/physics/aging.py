"""Models of effects that change a skin's response over time.

The effects are the relaxation of the force during an indentation, the hysteresis of the field, the wear of the skin,
and the influence of the temperature.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, model_validator

from reskin.config import Strict
from reskin.errors import ParamsError


@dataclass(frozen=True)
class Prony:
    """A relaxation function, which is represented by a Prony series.

    The relaxation function is the force at the time t after a sudden indentation to a constant depth, divided by the
    force at t = 0. Its Prony series is relaxation(t) = 1 - sum_i share_i (1 - exp(-t / tau_i)).
    """

    tau_s: Float[np.ndarray, " p"]  # time constant of each term
    share: Float[np.ndarray, " p"]  # fraction of the initial force that each term loses over time

    def __post_init__(self) -> None:
        """Check the terms of the series.

        Raises
        ------
        ParamsError
            If a time constant is not positive and finite, a share is negative, or the sum of the shares is above 1.
        """
        if not (np.isfinite(self.tau_s) & (self.tau_s > 0)).all():
            raise ParamsError(
                "prony", "every time constant tau", "above 0 s and finite", f"{self.tau_s}", "State tau_s in s."
            )
        if not ((self.share >= 0).all() and self.share.sum() <= 1):
            rule = "0 or more, and the sum of all shares must be at most 1"
            raise ParamsError("prony", "every share", rule, f"{self.share}", "Change the values of `share`.")


SKIN_RELAXATION = Prony(  # assumed values
    tau_s=np.array([1e-3, 1e-1, 1e1, 1e3, 1e4]), share=np.array([0.05, 0.05, 0.05, 0.03, 0.02])
)


class Relaxation(Strict):
    """Settings of the relaxation of the force: the times of the two phases of an indentation.

    In the first phase, the tip moves to the depth of the indentation at constant speed. In the second phase, the tip
    stays at this depth. The skin is assumed to be fully relaxed before the indentation.
    """

    approach_s: Annotated[float, Field(ge=0, le=100)]
    hold_s: Annotated[float, Field(ge=0, le=100)]  # time from the end of the approach to the middle of the readings


class Memory(Strict):
    """Settings of the hysteresis of the field, that is, of the influence of earlier indentations on the field.

    An indentation adds to the elastic field change dB a second field change, which builds up slowly during the
    indentation and decays slowly after it. On recorded boards, 5 to 8 % of dB remains in the no-load reading before the
    next indentation. With the nominal settings, about the same fraction remains. How this fraction is divided among the
    time constants is assumed.
    """

    # for each time constant: the field change that the hysteresis would add during a very long indentation, as a
    # fraction of dB
    share: tuple[Annotated[float, Field(ge=0, le=1)], ...]
    # time constants with which the added field change builds up and decays
    tau_s: tuple[Annotated[float, Field(gt=0, le=1e6)], ...]
    contact_s: Annotated[float, Field(ge=0, le=1e4)]  # time from the start of an indentation to the end of its readings
    rest_s: Annotated[float, Field(ge=0, le=1e4)]  # time from the end of the readings to the next no-load reading

    @model_validator(mode="after")
    def _check_lengths(self) -> "Memory":
        if len(self.share) != len(self.tau_s):
            raise ValueError("tau_s must have one time for each share")
        return self


def field_memory(
    change_T: Float[np.ndarray, "n p k 3"], memory: Memory
) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n p k 3"]]:
    """Return the field change in T due to hysteresis, given the field change dB without hysteresis at each stop.

    Each of n indentations has p stops, at which the tip rests and the k chips are read. For each time constant tau, the
    hysteresis has a state q, which is a field and starts at 0. It follows the equation q' = (share dB - q) / tau during
    an indentation, and q' = -q / tau after it. The field change due to hysteresis is the sum of q over all time
    constants.

    The times of the stops are not known. The state q at a stop is therefore computed as if the indentation had lasted
    for `contact_s` and as if dB had been constant during this time. The value of this constant is the mean of dB over
    the stops up to and including this stop.

    Returns
    -------
    before_T : sum of q in the no-load reading before each indentation; this sum is due to earlier indentations
    added_T : sum of q at each stop, minus the sum of q in the no-load reading before the same indentation
    """
    running_mean_T = change_T.cumsum(axis=1) / np.arange(1, change_T.shape[1] + 1)[:, None, None]
    before_T, added_T = np.zeros_like(change_T[:, 0]), np.zeros_like(change_T)
    for share, tau_s in zip(memory.share, memory.tau_s, strict=True):
        contact_decay, rest_decay = np.exp(-memory.contact_s / tau_s), np.exp(-memory.rest_s / tau_s)
        crept_T = -np.expm1(-memory.contact_s / tau_s) * share * running_mean_T
        # The state q before an indentation is the state at the end of the previous indentation, reduced by its decay
        # during the rest between the two indentations.
        left_T = np.zeros_like(before_T)
        for i in range(len(change_T) - 1):
            left_T[i + 1] = rest_decay * crept_T[i, -1] + contact_decay * rest_decay * left_T[i]
        before_T += left_T
        added_T += crept_T - (1 - contact_decay) * left_T[:, None]
    return before_T, added_T


def relaxed_share(relaxation: Relaxation) -> float:
    """Return the force of a skin when an indentation is read, divided by the force of an elastic skin at this time.

    The result is below 1, because the force of the skin relaxes during the approach and the hold of the tip.
    """
    time_s, elastic = np.cumsum([0.0, relaxation.approach_s, relaxation.hold_s]), np.array([0.0, 1.0, 1.0])
    return float(relax(time_s, elastic, SKIN_RELAXATION)[-1])


def advance(state: Float[np.ndarray, " p"], change: float, dt_s: float, prony: Prony) -> Float[np.ndarray, " p"]:
    """Integrate q' = -q / tau + share e' over one time step, and return the new state q.

    The state has one value of q for each term of the Prony series. With x = dt / tau, the new value is
    exp(-x) q + share change (1 - exp(-x)) / x. This value is exact if the elastic force e changes linearly during the
    step (Taylor, Pister & Goudreau 1970).

    Parameters
    ----------
    state : the values of q before the step
    change : change of the elastic force e during the step
    dt_s : duration of the step; 0 for a sudden change of the elastic force
    prony : the time constants tau and the shares
    """
    if not (np.isfinite(dt_s) and dt_s >= 0):
        rule = "0 s or more and finite"
        raise ParamsError("relaxation", "time step", rule, f"{dt_s}", "Sort the times in ascending order.")
    x = dt_s / prony.tau_s
    return np.exp(-x) * state + prony.share * change * _mean_decay(x)


def relax(time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony) -> Float[np.ndarray, " t"]:
    """Return the force of a viscoelastic skin at each time, given the force of an elastic skin at these times.

    The elastic force is assumed to start from 0 and to change linearly between the given times. The force at the time t
    is the integral of relaxation(t - s) d elastic(s) over all times s before t (Lee & Radok 1960). This solution is
    valid only as long as the contact area does not shrink.
    """
    state = np.zeros_like(prony.tau_s)
    relaxed = np.empty_like(elastic)
    steps_s, changes = np.diff(time_s, prepend=time_s[:1]), np.diff(elastic, prepend=0.0)
    for step_i, (dt_s, change) in enumerate(zip(steps_s, changes, strict=True)):
        state = advance(state, float(change), float(dt_s), prony)
        relaxed[step_i] = (1 - prony.share.sum()) * elastic[step_i] + state.sum()
    return relaxed


def _mean_decay(x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    # Return (1 - exp(-x)) / x. The function expm1 is used because subtracting exp(-x) from 1 loses all digits for small
    # x: the relative error would be 11 % at x = 1e-16.
    return np.where(x > 0, -np.expm1(-x) / np.where(x > 0, x, 1.0), 1.0)


ROOM_DEGC = 25.0  # temperature of the skin and of the chips at time 0
REMANENCE_PER_K = -0.12e-2  # relative change of the remanence of NdFeB powder per kelvin


class Temperature(Strict):
    """Settings of the temperature over time, and of the change of the chips' sensitivity with the temperature."""

    warming_K: Annotated[float, Field(ge=0, le=40)]  # temperature rise from power-on to thermal equilibrium
    warming_s: Annotated[float, Field(gt=0, le=1e5)]  # time constant of the warming
    swing_K: Annotated[float, Field(ge=0, le=20)]  # amplitude of the variation of room temperature
    swing_s: Annotated[float, Field(gt=0, le=1e6)]  # period of the variation of room temperature
    # standard deviation over chips of the relative change of sensitivity per kelvin
    chip_sensitivity_per_K: Annotated[float, Field(ge=0, le=0.01)]


def temperature_rise_K(time_s: Float[np.ndarray, "..."], temperature: Temperature) -> Float[np.ndarray, "..."]:
    """Return the temperature rise in K since time 0, at which the board was switched on.

    The rise is warming (1 - exp(-t / tau)) + swing sin(2 pi t / period). The first term is the warming of the board,
    and the second term is the variation of the room temperature.
    """
    warming = -temperature.warming_K * np.expm1(-time_s / temperature.warming_s)
    return warming + temperature.swing_K * np.sin(2 * np.pi * time_s / temperature.swing_s)


def relative_remanence(rise_K: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the skin's magnetisation after a temperature rise, divided by the magnetisation at time 0.

    Both the no-load field and all field changes must be multiplied by this factor, because they are proportional to the
    magnetisation.
    """
    return 1 + REMANENCE_PER_K * rise_K


SETTLING_CONTACTS = 300  # number of contacts after which 63 % (1 - 1/e) of the initial softening has occurred
AGEING_CONTACTS = 1e3  # beyond about this number of contacts, the softening grows with the logarithm of the number


class Ageing(Strict):
    """Settings of the wear of a skin: how fast the skin softens, and how its no-load field fades and drifts."""

    settling: Annotated[float, Field(ge=0, le=0.5)]  # fraction of the force lost in the first contacts
    ageing: Annotated[float, Field(ge=0, le=0.1)]  # fraction of the force lost per decade of contacts
    # fraction of the no-load field lost per decade of contacts
    fading_per_decade: Annotated[float, Field(ge=0, le=0.1)]
    wandering_uT: Annotated[float, Field(ge=0, le=10)]  # standard deviation of the random step of a channel per contact


def softening(contacts_n: Int[np.ndarray, " n"], *, settling: float, ageing: float) -> Float[np.ndarray, " n"]:
    """Return the force after N contacts, divided by the force of a new skin at the same depth.

    The result is 1 - settling (1 - exp(-N/300)) - ageing log10(1 + N/1000). The second term is the softening in the
    first contacts, and the third term is the softening over many contacts.
    """
    _check_counts(contacts_n)
    settled = -np.expm1(-contacts_n / SETTLING_CONTACTS)
    remaining = 1 - settling * settled - ageing * np.log10(1 + contacts_n / AGEING_CONTACTS)
    if not (remaining > 0).all():
        got = f"{remaining.min():.3g} after {contacts_n.max()} contacts"
        raise ParamsError("wear", "remaining force", "above 0", got, "Reduce the settings settling and ageing.")
    return remaining


def fading(contacts_n: Int[np.ndarray, " n"], *, per_decade: float) -> Float[np.ndarray, " n"]:
    """Return the fraction of the no-load field that is lost after N contacts: per_decade log10(1 + N)."""
    _check_counts(contacts_n)
    return per_decade * np.log10(1 + contacts_n)


def baseline_walk(
    contacts_n: Int[np.ndarray, " n"], channels_n: int, *, step_T: float, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw the drift of the no-load field in T for each reading and channel.

    The drift is a random walk: at each contact, the no-load field of a channel changes by a normally distributed step
    with the standard deviation `step_T`. `contacts_n` is the number of contacts before each reading, and must not
    decrease. If there are several contacts between two readings, the walk takes one step for each of these contacts.
    """
    _check_counts(contacts_n)
    new_n = np.diff(contacts_n, prepend=0)
    if (new_n < 0).any():
        raise ParamsError(
            f"wear: the contact count decreases by {-new_n.min()} between readings. "
            "Sort the readings by their contact count."
        )
    steps_T = step_T * np.sqrt(new_n)[:, None] * rng.standard_normal((len(contacts_n), channels_n))
    return np.cumsum(steps_T, axis=0)


def _check_counts(contacts_n: Int[np.ndarray, " n"]) -> None:
    if contacts_n.size and contacts_n.min() < 0:
        raise ParamsError("wear", "contact count", "0 or more", f"{contacts_n.min()}", "Start to count at 0.")
