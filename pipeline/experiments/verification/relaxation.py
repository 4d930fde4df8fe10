"""The force's memory against 50 digits. In: nothing but the skin's own relaxation. Out: checks.

Refuses to know skins and fields: the displacement is prescribed, so only the force relaxes.
"""

import numpy as np
from jaxtyping import Float

from pipeline.experiments.verification.checks import Check, worst
from pipeline.physics.viscoelastic import SKIN, Prony, advance, relax

POKES_N, CYCLE_S, RAMP_S, HOLD_S = 20, 1.5, 0.3, 0.7  # 20 pokes over 30 s (PHYSICS 5)


def check_relaxation() -> list[Check]:
    """Check pokes in a row, single steps of any stiffness, and a held poke."""
    held_s = np.geomspace(1e-5, 1e6, 200) - 1e-5
    closed = 3.0 * (1 - (SKIN.share * -np.expm1(-held_s[:, None] / SKIN.tau_s)).sum(axis=1))
    return [
        Check("relaxation of the force", f"{POKES_N} pokes over {POKES_N * CYCLE_S:g} s",
              "hereditary integral in 50 digits (mpmath)", _pokes(), "1", 1e-13, "60 exact steps add up rounding"),
        Check("relaxation of the force", "one step, tau_max / tau_min 1e3-1e8, dt / tau_min 1e-16-1e8",
              "its formula in 50 digits (mpmath)", _steps(), "1", 1e-14, "a few dozen operations on doubles"),
        Check("relaxation of the force", "a held poke, 10 us to 12 days", "1 - sum of shares (1 - exp(-t / tau))",
              worst(relax(held_s, np.full(200, 3.0), SKIN), closed), "1", 1e-13, "200 steps add up their rounding"),
    ]  # fmt: skip


def in_50_digits(state: Float[np.ndarray, " p"], change: float, dt_s: float, prony: Prony) -> Float[np.ndarray, " p"]:
    """Carry the state over a step as `viscoelastic.advance` does, from its formula in 50 digits."""
    import mpmath

    with mpmath.workdps(50):
        new = []
        for q, tau, share in zip(state.tolist(), prony.tau_s.tolist(), prony.share.tolist(), strict=True):
            x = mpmath.mpf(dt_s) / mpmath.mpf(tau)
            mean = (1 - mpmath.exp(-x)) / x
            new.append(float(mpmath.exp(-x) * mpmath.mpf(q) + mpmath.mpf(share) * mpmath.mpf(change) * mean))
    return np.array(new)


def _pokes() -> float:
    starts_s = CYCLE_S * np.arange(POKES_N)
    time_s = np.sort(np.concatenate([starts_s, starts_s + RAMP_S, starts_s + RAMP_S + HOLD_S]))
    elastic = np.tile([0.0, 2.0, 2.0], POKES_N)
    return worst(relax(time_s, elastic, SKIN), _hereditary(time_s, elastic, SKIN))


def _hereditary(
    time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony
) -> Float[np.ndarray, " t"]:
    # Lee & Radok's integral of relaxation(t - s) d elastic(s), every ramp from its start anew: no state is carried.
    import mpmath

    with mpmath.workdps(50):
        t, e = ([mpmath.mpf(value) for value in values.tolist()] for values in (time_s, elastic))
        parts = [
            (mpmath.mpf(g), mpmath.mpf(tau)) for g, tau in zip(prony.share.tolist(), prony.tau_s.tolist(), strict=True)
        ]
        stays = 1 - sum(g for g, _ in parts)
        force = []
        for now_i, now in enumerate(t):
            ramps = [(e[i + 1] - e[i], t[i], t[i + 1]) for i in range(now_i) if e[i + 1] != e[i]]
            memory = sum(
                g * rise * tau / (b - a) * (mpmath.exp(-(now - b) / tau) - mpmath.exp(-(now - a) / tau))
                for rise, a, b in ramps
                for g, tau in parts
            )
            force.append(float(stays * e[now_i] + memory))
    return np.array(force)


def _steps() -> float:
    state, errors = np.array([0.7, -0.2, 0.4]), []
    for ratio in (1e3, 1e4, 1e5, 1e6, 1e7, 1e8):
        prony = Prony(np.array([1e-3, 1e-3 * np.sqrt(ratio), 1e-3 * ratio]), np.array([0.3, 0.2, 0.1]))
        for dt_over_fastest in (1e-16, 1e-9, 1e-3, 1.0, 40.0, 1e8):
            dt_s = 1e-3 * dt_over_fastest
            truth = in_50_digits(state, 1.3, dt_s, prony)
            errors.append(worst(advance(state, 1.3, dt_s, prony), truth))
    return float(np.max(errors))
