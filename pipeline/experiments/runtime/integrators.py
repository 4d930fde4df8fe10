"""Error of the relaxed force over integrators. In: stiffness ratios, settings. Out: rows, and calls for the stopwatch.

Each starts anew where the force bends, as any of them should. What diverges or works too long is listed as failed.
Refuses to know clocks and pictures.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
from jaxtyping import Float
from scipy.integrate import solve_ivp

from pipeline.experiments.runtime.history import History, exact_forces, poke_often, stiff
from pipeline.experiments.runtime.rows import Contestant, Precision
from pipeline.physics.viscoelastic import Prony, relax

EXACT, EULER = "exact update", "explicit Euler"
SOLVERS = ("Radau", "BDF", "LSODA", "RK45")  # of scipy.integrate
IMPLICIT = ("Radau", "BDF", "LSODA")  # these are given the Jacobian, which is constant
ATOL = 1e-3  # of the relative tolerance: states are shares, a few percent, of a force of 1
DIVERGED = 1.0  # an error as large as the force itself


class Failed(Exception):
    """An integrator that gave up, or was stopped."""


@dataclass(frozen=True)
class Sweep:
    """What the integrators are tried with."""

    ratios: tuple[float, ...]
    tolerances: tuple[float, ...]
    euler_steps_s: tuple[float, ...]
    pokes_n: int
    calls_per_poke_max_n: int  # of the right-hand side; more is a failure


Rates = Callable[[float, Float[np.ndarray, " p"]], Float[np.ndarray, " p"]]
Piece = Callable[[Rates, float, Float[np.ndarray, " p"]], Float[np.ndarray, " p"]]


class Counter:
    """Counts calls of the right-hand side, and stops an integrator that makes too many."""

    def __init__(self, calls_max_n: int) -> None:
        self.calls_n, self.calls_max_n = 0, calls_max_n

    def rates(self, prony: Prony, speed: float) -> Rates:
        """Give q' = -q / tau + share e' for one straight piece of e."""
        driven = prony.share * speed

        def rates(_: float, state: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
            if self.calls_n == self.calls_max_n:
                raise Failed(f"stopped after {self.calls_max_n} right-hand sides")
            self.calls_n += 1
            return driven - state / prony.tau_s

        return rates


def study_integrators(sweep: Sweep) -> tuple[list[Precision], list[Contestant]]:
    """Compare every integrator with 50 digits at every stiffness ratio; those that did not fail may be timed."""
    history, calls_max_n = poke_often(sweep.pokes_n), sweep.pokes_n * sweep.calls_per_poke_max_n
    rows, contestants = [], []
    for ratio in sweep.ratios:
        prony = stiff(ratio)
        truth = exact_forces(history, prony)
        for method, setting, run in _entries(history, prony, sweep):
            counter = Counter(calls_max_n)
            error, failure = _judge(run, counter, truth)
            rows.append(Precision(study(ratio), method, setting, counter.calls_n, error, failure))
            if failure is None:
                call = partial(_fresh, run, calls_max_n)
                contestants.append(Contestant(rows[-1].key, call, sweep.pokes_n))
    return rows, contestants


def study(ratio: float) -> str:
    """Name the study of one stiffness ratio."""
    return f"relaxation, stiffness {ratio:.0e}"


def integrate(history: History, prony: Prony, piece: Piece, counter: Counter) -> Float[np.ndarray, " u"]:
    """Carry the states over each straight piece of the history; give the force with memory at the end of each."""
    state, forces = np.zeros_like(prony.tau_s), np.empty(len(history.time_s) - 1)
    lengths_s, changes = np.diff(history.time_s), np.diff(history.elastic)
    for i, (length_s, change) in enumerate(zip(lengths_s, changes, strict=True)):
        state = piece(counter.rates(prony, float(change / length_s)), float(length_s), state)
        forces[i] = (1 - prony.share.sum()) * history.elastic[i + 1] + state.sum()
    return forces


def euler(rates: Rates, length_s: float, state: Float[np.ndarray, " p"], *, step_s: float) -> Float[np.ndarray, " p"]:
    """Take equal explicit Euler steps of at most `step_s`; stable only below twice the shortest relaxation time."""
    steps_n = ceil(length_s / step_s - 1e-9)
    with np.errstate(over="ignore", invalid="ignore"):  # a state that grows without bound is judged at the end
        for _ in range(steps_n):
            state = state + length_s / steps_n * rates(0.0, state)
    return state


def solve(
    rates: Rates, length_s: float, state: Float[np.ndarray, " p"], *, method: str, tolerance: float, prony: Prony
) -> Float[np.ndarray, " p"]:
    """Let one of SciPy's solvers choose its steps."""
    jacobian = np.diag(-1 / prony.tau_s)
    more = {"jac": lambda _, __: jacobian} if method in IMPLICIT else {}
    span_s = (0.0, length_s)
    found = solve_ivp(rates, span_s, state, method=method, rtol=tolerance, atol=ATOL * tolerance, **more)
    if not found.success:
        raise Failed(found.message)
    return found.y[:, -1]


Run = Callable[[Counter], Float[np.ndarray, " u"]]


def _entries(history: History, prony: Prony, sweep: Sweep) -> list[tuple[str, str, Run]]:
    entries: list[tuple[str, str, Run]] = [
        (EXACT, "", lambda _: relax(history.time_s, history.elastic, prony)[1:]),
    ]
    for method in SOLVERS:
        for tolerance in sweep.tolerances:
            piece: Piece = partial(solve, method=method, tolerance=tolerance, prony=prony)
            entries.append((method, f"{tolerance:.0e}", partial(integrate, history, prony, piece)))
    for step_s in sweep.euler_steps_s:
        entries.append((EULER, f"{step_s:.0e} s", partial(integrate, history, prony, partial(euler, step_s=step_s))))
    return entries


def _fresh(run: Run, calls_max_n: int) -> Float[np.ndarray, " u"]:
    return run(Counter(calls_max_n))


def _judge(run: Run, counter: Counter, truth: Float[np.ndarray, " u"]) -> tuple[float | None, str | None]:
    # rms error over rms force, or why there is none
    try:
        found = run(counter)
    except Failed as failure:
        return None, str(failure)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
    return (error, None) if error < DIVERGED else (None, f"diverged: error {error:.0e} of the force")
