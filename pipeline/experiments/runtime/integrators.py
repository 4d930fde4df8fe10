"""Error of the relaxed force over integrators. In: stiffness ratios, settings. Out: rows, and calls for the stopwatch.

Each starts anew where the force bends, as any of them should. What diverges or works too long is listed as failed.
Refuses to know clocks and pictures.
"""

from collections.abc import Callable
from functools import partial
from math import ceil
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.integrate import solve_ivp

from pipeline.experiments.runtime.rows import Contestant, Precision
from pipeline.experiments.runtime.trials import Positive
from pipeline.experiments.verification.relaxation import hereditary
from reskin.config import Strict
from reskin.physics.aging import SKIN, Prony, relax

EXACT, EULER = "exact update", "explicit Euler"
SOLVERS = ("Radau", "BDF", "LSODA", "RK45")  # of scipy.integrate
IMPLICIT = ("Radau", "BDF", "LSODA")  # these are given the Jacobian, which is constant
ATOL = 1e-3  # of the relative tolerance: states are shares, a few percent, of a force of 1
DIVERGED = 1.0  # an error as large as the force itself
PERIOD_S = 1.5  # twenty pokes take the 30 s of PHYSICS 5
DOWN_S, HELD_S = 0.3, 0.7

Forces = Float[np.ndarray, " u"]  # with memory, relative to the peak of the elastic one; at the end of straight pieces
State = Float[np.ndarray, " p"]
History = tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]  # times in s, elastic forces: straight between them
Rates = Callable[[float, State], State]
Piece = Callable[[Rates, float, State], State]
Run = Callable[["Counter"], Forces]


class Failed(Exception):
    """An integrator that gave up, or was stopped."""


class Integrators(Strict):
    """Stiffness ratios, relative tolerances of the solvers, and steps of the explicit one."""

    ratios: Annotated[tuple[Annotated[float, Field(gt=1, le=1e12)], ...], Field(min_length=1)]
    tolerances: Annotated[tuple[Positive, ...], Field(min_length=1)]
    euler_steps_s: Annotated[tuple[Positive, ...], Field(min_length=1)]
    pokes_n: Annotated[int, Field(ge=1, le=1000)]
    calls_per_poke_max_n: Annotated[int, Field(ge=1)]  # right-hand sides; more is a failure


class Counter:
    """Counts calls of the right-hand side, and stops an integrator that makes too many."""

    def __init__(self, calls_max_n: int) -> None:
        self.calls_n, self.calls_max_n = 0, calls_max_n

    def rates(self, prony: Prony, speed: float) -> Rates:
        """Give q' = -q / tau + share e' for one straight piece of e."""
        driven = prony.share * speed

        def rates(_: float, state: State) -> State:
            if self.calls_n == self.calls_max_n:
                raise Failed(f"stopped after {self.calls_max_n} right-hand sides")
            self.calls_n += 1
            return driven - state / prony.tau_s

        return rates


def study_integrators(tried: Integrators) -> tuple[list[Precision], list[Contestant]]:
    """Compare every integrator with 50 digits at every stiffness ratio; those that did not fail may be timed."""
    history, calls_max_n = poke_often(tried.pokes_n), tried.pokes_n * tried.calls_per_poke_max_n
    rows, contestants = [], []
    for ratio in tried.ratios:
        prony = stiff(ratio)
        truth = hereditary(*history, prony)[1:]
        for method, setting, run in _entries(history, prony, tried):
            counter = Counter(calls_max_n)
            error, failure = _judge(run, counter, truth)
            rows.append(Precision(study(ratio), method, setting, counter.calls_n, error, failure))
            if failure is None:
                contestants.append(Contestant(rows[-1].key, partial(_fresh, run, calls_max_n), tried.pokes_n))
    return rows, contestants


def study(ratio: float) -> str:
    """Name the study of one stiffness ratio."""
    return f"relaxation, stiffness {ratio:.0e}"


def poke_often(pokes_n: int) -> History:
    """Press to a force of 1, hold and let go, again and again.

    Every poke asks the same of an integrator, so that error and time of a poke hardly depend on how many there are.
    """
    knots_s = np.array([DOWN_S, DOWN_S + HELD_S, PERIOD_S])
    times_s = (PERIOD_S * np.arange(pokes_n)[:, None] + knots_s).ravel()
    return np.append(0.0, times_s), np.append(0.0, np.tile([1.0, 1.0, 0.0], pokes_n))


def stiff(ratio: float) -> Prony:
    """Spread the skin's relaxation times over another ratio of slowest to fastest: 1e7 gives the skin's own.

    The slowest stays, so that the fastest goes below any step of an explicit method; shares are the skin's.
    """
    slowest_s, fastest_s = SKIN.tau_s.max(), SKIN.tau_s.min()
    power = np.log(ratio) / np.log(slowest_s / fastest_s)
    return Prony(slowest_s * (SKIN.tau_s / slowest_s) ** power, SKIN.share)


def integrate(history: History, prony: Prony, piece: Piece, counter: Counter) -> Forces:
    """Carry the states over each straight piece of the history; give the force with memory at the end of each."""
    (time_s, elastic), state = history, np.zeros_like(prony.tau_s)
    forces = np.empty(len(time_s) - 1)
    for i, (length_s, change) in enumerate(zip(np.diff(time_s), np.diff(elastic), strict=True)):
        state = piece(counter.rates(prony, float(change / length_s)), float(length_s), state)
        forces[i] = (1 - prony.share.sum()) * elastic[i + 1] + state.sum()
    return forces


def euler(rates: Rates, length_s: float, state: State, *, step_s: float) -> State:
    """Take equal explicit Euler steps of at most `step_s`; stable only below twice the shortest relaxation time."""
    steps_n = ceil(length_s / step_s - 1e-9)
    with np.errstate(over="ignore", invalid="ignore"):  # a state that grows without bound is judged at the end
        for _ in range(steps_n):
            state = state + length_s / steps_n * rates(0.0, state)
    return state


def solve(rates: Rates, length_s: float, state: State, *, method: str, tolerance: float, prony: Prony) -> State:
    """Let one of SciPy's solvers choose its steps."""
    jacobian = np.diag(-1 / prony.tau_s)
    more = {"jac": lambda _, __: jacobian} if method in IMPLICIT else {}
    span_s = (0.0, length_s)
    found = solve_ivp(rates, span_s, state, method=method, rtol=tolerance, atol=ATOL * tolerance, **more)
    if not found.success:
        raise Failed(found.message)
    return found.y[:, -1]


def _entries(history: History, prony: Prony, tried: Integrators) -> list[tuple[str, str, Run]]:
    pieces: list[tuple[str, str, Piece]] = [
        (method, f"{tolerance:.0e}", partial(solve, method=method, tolerance=tolerance, prony=prony))
        for method in SOLVERS
        for tolerance in tried.tolerances
    ]
    pieces += [(EULER, f"{step_s:.0e} s", partial(euler, step_s=step_s)) for step_s in tried.euler_steps_s]
    entries: list[tuple[str, str, Run]] = [(EXACT, "", lambda _: relax(*history, prony)[1:])]
    return entries + [(method, setting, partial(integrate, history, prony, piece)) for method, setting, piece in pieces]


def _fresh(run: Run, calls_max_n: int) -> Forces:
    return run(Counter(calls_max_n))


def _judge(run: Run, counter: Counter, truth: Forces) -> tuple[float | None, str | None]:
    # rms error over rms force, or why there is none
    try:
        found = run(counter)
    except Failed as failure:
        return None, str(failure)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
    return (error, None) if error < DIVERGED else (None, f"diverged: error {error:.0e} of the force")
