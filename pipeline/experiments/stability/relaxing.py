"""Stiff and impossible times for the force's memory (PHYSICS 10). In: nothing. Out: cases.

Refuses to know skins: the state is a handful of numbers.
"""

from functools import partial

import numpy as np
from scipy.constants import micro

from pipeline.experiments.stability.cases import Case, measured, refused, told
from pipeline.experiments.verification.checks import worst
from pipeline.experiments.verification.relaxation import in_50_digits
from pipeline.physics.viscoelastic import SKIN, Prony, advance

AREA = "time"
STIFF = Prony(np.array([1e-3, 1e1, 1e5]), np.array([0.3, 0.2, 0.1]))  # tau_max / tau_min 1e8
STATE = np.array([0.7, -0.2, 0.4])
ROUNDING = 1e-14  # a few dozen operations on doubles


def survey_relaxing() -> list[Case]:
    """Try steps that no explicit integrator survives, steps of no length, and times that are none."""
    return [
        _step("tau_max / tau_min 1e8, dt / tau_min 1e8", 1e8, "as in 50 digits (mpmath), and finite"),
        _step("dt / tau_min 1e-16", 1e-16, "as in 50 digits: (1 - exp(-x)) / x by expm1; plainly it is 11 % off"),
        _no_time(),
        *(
            refused(AREA, f"a time step of {dt_s:g} s", should="refused, with the step named",
                    attempt=partial(advance, STATE, 1.0, dt_s, STIFF))
            for dt_s in (-1 * micro, np.nan, np.inf)
        ),
    ]  # fmt: skip


def _step(case: str, dt_over_fastest: float, should: str) -> Case:
    dt_s = dt_over_fastest * float(STIFF.tau_s[0])
    found = advance(STATE, 1.3, dt_s, STIFF)
    error = worst(found, in_50_digits(STATE, 1.3, dt_s, STIFF))
    happened = f"relative error {error:.1e}, {np.count_nonzero(np.isfinite(found))} of {len(found)} values finite"
    return measured(AREA, case, should=should, happened=happened, error=error, limit=ROUNDING)


def _no_time() -> Case:
    state = np.array([1 / 3, -2e-308, 7e15, 0.0, -0.1])
    same_n = int(np.count_nonzero(advance(state, 0.0, 0.0, SKIN).view(np.int64) == state.view(np.int64)))
    happened = f"{same_n} of {len(state)} values identical bit for bit"
    return told(AREA, "dt = 0", should="the state, bit for bit", happened=happened, holds=same_n == len(state))
