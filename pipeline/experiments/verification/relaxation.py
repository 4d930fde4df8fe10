"""Laws of the force's memory, against 50 digits. In: times, relaxations. Out: checks.

Refuses to know skins and fields: the displacement is prescribed, so only the force relaxes.
"""

from itertools import product

import mpmath
import numpy as np
from jaxtyping import Float

from pipeline.experiments.verification.checks import Check, worst
from reskin.physics.aging import SKIN, Prony, advance, relax

POKES_N, CYCLE_S, RAMP_S, HOLD_S = 20, 1.5, 0.3, 0.7  # 20 pokes over 30 s (PHYSICS 5)
NAME = "relaxation of the force"
STATE = np.array([0.7, -0.2, 0.4])
RATIOS = (1e3, 1e4, 1e5, 1e6, 1e7, 1e8)  # of the slowest relaxation to the fastest, which takes 1 ms
STEPS = (1e-16, 1e-9, 1e-3, 1.0, 40.0, 1e8)  # over the fastest relaxation
ROUNDING = 1e-14  # a few dozen operations on doubles


def check_relaxation() -> list[Check]:
    """Check pokes in a row, single steps of any stiffness, and a held poke."""
    steps = [step_error(1e-3 * dt, stiff(ratio)) for ratio, dt in product(RATIOS, STEPS)]
    return [
        many_pokes(),
        Check(NAME, "one step, tau_max / tau_min 1e3-1e8, dt / tau_min 1e-16-1e8", "its formula in 50 digits (mpmath)",
              float(np.max(steps)), "1", ROUNDING, "a few dozen operations on doubles"),
        held(np.geomspace(1e-5, 1e6, 200) - 1e-5),
    ]  # fmt: skip


def stiff(ratio: float) -> Prony:
    """Give three relaxations: of 1 ms, of `ratio` times as long, and between them."""
    return Prony(np.array([1e-3, 1e-3 * np.sqrt(ratio), 1e-3 * ratio]), np.array([0.3, 0.2, 0.1]))


def many_pokes() -> Check:
    starts_s = CYCLE_S * np.arange(POKES_N)
    time_s = np.sort(np.concatenate([starts_s, starts_s + RAMP_S, starts_s + RAMP_S + HOLD_S]))
    elastic = np.tile([0.0, 2.0, 2.0], POKES_N)
    error = worst(relax(time_s, elastic, SKIN), hereditary(time_s, elastic, SKIN))
    return Check(NAME, f"{POKES_N} pokes over {POKES_N * CYCLE_S:g} s", "hereditary integral in 50 digits (mpmath)",
                 error, "1", 1e-13, "60 exact steps add up rounding")  # fmt: skip


def held(time_s: Float[np.ndarray, " t"]) -> Check:
    closed = 3.0 * (1 - (SKIN.share * -np.expm1(-time_s[:, None] / SKIN.tau_s)).sum(axis=1))
    return Check(NAME, "a held poke, 10 us to 12 days", "1 - sum of shares (1 - exp(-t / tau))",
                 worst(relax(time_s, np.full(len(time_s), 3.0), SKIN), closed), "1", 1e-13,
                 "200 steps add up their rounding")  # fmt: skip


def step_error(dt_s: float, prony: Prony) -> float:
    """Compare a step of `viscoelastic.advance` with its formula in 50 digits."""
    with mpmath.workdps(50):
        truth = []
        for q, tau, share in zip(STATE.tolist(), prony.tau_s.tolist(), prony.share.tolist(), strict=True):
            x = mpmath.mpf(dt_s) / mpmath.mpf(tau)
            mean = (1 - mpmath.exp(-x)) / x
            truth.append(float(mpmath.exp(-x) * mpmath.mpf(q) + mpmath.mpf(share) * mpmath.mpf(1.3) * mean))
    return worst(advance(STATE, 1.3, dt_s, prony), np.array(truth))


def hereditary(
    time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony
) -> Float[np.ndarray, " t"]:
    """Give Lee & Radok's integral of relaxation(t - s) d elastic(s) in 50 digits, every ramp from its start anew.

    No state is carried from ramp to ramp, as `viscoelastic` does.
    """
    with mpmath.workdps(50):
        t, e, tau, share = (
            [mpmath.mpf(value) for value in values.tolist()] for values in (time_s, elastic, prony.tau_s, prony.share)
        )
        force = []
        for now_i, now in enumerate(t):
            ramps = [(e[i + 1] - e[i], t[i], t[i + 1]) for i in range(now_i) if e[i + 1] != e[i]]
            memory = sum(
                g * rise * tau_p / (b - a) * (mpmath.exp(-(now - b) / tau_p) - mpmath.exp(-(now - a) / tau_p))
                for rise, a, b in ramps
                for g, tau_p in zip(share, tau, strict=True)
            )
            force.append(float((1 - sum(share)) * e[now_i] + memory))
    return np.array(force)
