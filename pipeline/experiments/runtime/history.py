"""A history of pokes and the exact relaxation of its force. In: number of pokes, a Prony series. Out: times and forces.

Refuses to know the integrators that are compared with it.
"""

from dataclasses import dataclass

import mpmath
import numpy as np
from jaxtyping import Float

from pipeline.physics.viscoelastic import SKIN, Prony

PERIOD_S = 1.5  # twenty pokes take the 30 s of PHYSICS 5
DOWN_S, HELD_S = 0.3, 0.7
DIGITS = 50


@dataclass(frozen=True)
class History:
    """An elastic force, relative to its peak, that runs straight between these times."""

    time_s: Float[np.ndarray, " t"]
    elastic: Float[np.ndarray, " t"]


def poke_often(pokes_n: int) -> History:
    """Press, hold and let go, again and again.

    Every poke asks the same of an integrator, so that error and time of a poke hardly depend on how many there are.
    """
    knots_s = np.array([DOWN_S, DOWN_S + HELD_S, PERIOD_S])
    times_s = (PERIOD_S * np.arange(pokes_n)[:, None] + knots_s).ravel()
    return History(np.append(0.0, times_s), np.append(0.0, np.tile([1.0, 1.0, 0.0], pokes_n)))


def stiff(ratio: float) -> Prony:
    """Spread the skin's relaxation times over another ratio of slowest to fastest: 1e7 gives the skin's own.

    The slowest stays, so that the fastest goes below any step of an explicit method; shares are the skin's.
    """
    slowest_s, fastest_s = SKIN.tau_s.max(), SKIN.tau_s.min()
    power = np.log(ratio) / np.log(slowest_s / fastest_s)
    return Prony(slowest_s * (SKIN.tau_s / slowest_s) ** power, SKIN.share)


def exact_forces(history: History, prony: Prony) -> Float[np.ndarray, " u"]:
    """Give the force with memory at the end of each straight piece, in 50 digits, rounded at last."""
    with mpmath.workdps(DIGITS):
        forces = []
        taus, shares = [[mpmath.mpf(float(one)) for one in part] for part in (prony.tau_s, prony.share)]
        states = [mpmath.mpf(0)] * len(taus)
        time_s, elastic = [[mpmath.mpf(float(one)) for one in part] for part in (history.time_s, history.elastic)]
        for i in range(1, len(time_s)):
            change = elastic[i] - elastic[i - 1]
            for p, (tau, share) in enumerate(zip(taus, shares, strict=True)):
                x = (time_s[i] - time_s[i - 1]) / tau
                states[p] = mpmath.exp(-x) * states[p] - share * change * mpmath.expm1(-x) / x
            forces.append(float((1 - mpmath.fsum(shares)) * elastic[i] + mpmath.fsum(states)))
    return np.array(forces)
