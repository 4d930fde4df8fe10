"""Errors and run times of two numerical methods of the simulator.

- *Quadratures*: the field of a magnetised skin is an integral over its volume. A quadrature rule replaces the integral
  by a sum over nodes, which are points with weights in the skin.
- *Integrators*: the force on the skin relaxes while a press is held. Its differential equation is integrated over time.

The experiment compares the simulator's methods with other methods.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from itertools import pairwise, product
from math import ceil
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from magpylib import getB
from magpylib.magnet import Cuboid
from magpylib.misc import Dipole
from pydantic import Field
from scipy.constants import milli, mu_0
from scipy.integrate import solve_ivp
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from pipeline.experiments.verification.signals import field_of, hereditary
from pipeline.provenance import SECONDS
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from reskin import io
from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics import deformation, layer, magnet, slide
from reskin.physics.aging import SKIN_RELAXATION, Prony, relax
from reskin.physics.board import Board, Spreads, draw_board
from reskin.physics.magnet import SEAMS_M, SKIN_SIDE_M, Nodes, Quadrature, change_of_field, place_nodes
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, press_motion
from reskin.simulation.capture import list_captures
from reskin.simulation.settings import MAIN, SimulationSettings

Changes = Float[np.ndarray, "n k 3"]


@dataclass(frozen=True)
class Prepared:
    """A computation that is ready to be run and timed.

    `call` computes dB (the change of the field) of all indentations of a trial, as a sum over `nodes_n` nodes.
    """

    nodes_n: int
    call: Callable[[], Changes]


@dataclass(frozen=True)
class Trial:
    """One simulated skin on its board, and the indentations of this skin, sorted by depth.

    `depths_mm` are the depths that the rig is commanded to reach. `pokes_m` has a row (x, y, depth) for each
    indentation.
    """

    board: Board
    design: SkinDesign
    skin: Skin
    depths_mm: tuple[float, ...]
    pokes_m: Float[np.ndarray, "n 3"]


Positive = Annotated[float, Field(gt=0)]


class Indentations(Strict):
    """Places and depths of indentations.

    Each place is pressed to each depth. Places are relative to the skin's centre.
    """

    places_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]


# Name of the method in the row for the reference. The error in this row is an upper bound of the reference's own error.
REFERENCE = "reference"
CANDIDATES = "Gauss in z"  # name of the method whose rules the simulator can use (`magnet.place_nodes`)
ERROR_MAX = 0.02  # largest acceptable error of dB
Key = tuple[str, str, str]  # study, method, setting


@dataclass(frozen=True)
class Row:
    """A row of the results, for one method with one setting in one study."""

    study: str
    method: str
    setting: str

    @property
    def key(self) -> Key:
        return (self.study, self.method, self.setting)


@dataclass(frozen=True)
class Precision(Row):
    """Relative error of one method with one setting, or the reason why it failed."""

    work_n: int  # number of nodes, or number of evaluations of the right-hand side
    error: float | None  # None if the method failed
    failure: str | None = None
    parts: dict[str, float] = field(default_factory=dict)  # error by depth; empty if the study has no depths


@dataclass(frozen=True)
class Seconds(Row):
    """Median run time per indentation of one method with one setting."""

    median_s: float
    repeats_n: int


@dataclass(frozen=True)
class TimedCall:
    """A call to time, and the number of indentations that it computes."""

    key: Key
    call: Callable[[], Any]
    indentations_n: int


@dataclass(frozen=True)
class Choice:
    """The cheapest acceptable quadrature rule, compared with the rule that the scene uses.

    - setting, nodes_n, error: name, number of nodes and error of the cheapest acceptable rule; None if no rule is
      acceptable.
    - used_setting: name of the rule that the scene uses.
    - used_nodes_n, used_error: its number of nodes and its error; None if this rule was not tried.
    - differs: whether the two rules differ.
    """

    setting: str | None
    nodes_n: int | None
    error: float | None
    used_setting: str
    used_nodes_n: int | None
    used_error: float | None
    differs: bool


def rule_name(rule: Quadrature) -> str:
    """Return the name of a quadrature rule in tables and figures: cell size x number of layers."""
    return f"{rule.cell_m / milli:.3g} mm x {rule.layers_n}"


def choose(rows: Sequence[Precision], *, used: Quadrature, error_max: float = ERROR_MAX) -> Choice:
    """Choose the rule with the fewest nodes among the rules whose error at the worst depth is below `error_max`.

    The number of nodes replaces the run time as the cost of a rule. The run time is proportional to it but, unlike the
    number of nodes, varies from one run of the experiment to the next.
    """
    candidates = {row.setting: row for row in rows if row.method == CANDIDATES}
    passing = [row for row in candidates.values() if row.error is not None and row.error < error_max]
    best = min(passing, key=lambda row: (row.work_n, row.error), default=None)
    in_use = candidates.get(rule_name(used))
    return Choice(
        setting=best.setting if best else None,
        nodes_n=best.work_n if best else None,
        error=best.error if best else None,
        used_setting=rule_name(used),
        used_nodes_n=in_use.work_n if in_use else None,
        used_error=in_use.error if in_use else None,
        differs=best is None or best.setting != rule_name(used),
    )


def time_calls(calls: Sequence[TimedCall], repeats_n: int) -> list[Seconds]:
    """Time all calls once in each of `repeats_n` rounds; return the median time per indentation of each call.

    Calls are timed in rounds, so that a busy period of the machine affects all calls equally. Each call has already
    been run to compute its error, so the times include neither compilation nor filling of caches.
    """
    if repeats_n < 1:
        raise ParamsError("runtime", "repeats_n", "1 or more", repeats_n, "Increase runtime.repeats_n.")
    times_s = np.empty((repeats_n, len(calls)))
    for round_i in range(repeats_n):
        # Every second round runs in reverse order, so that a call does not always follow the same call.
        for i in range(len(calls))[:: -1 if round_i % 2 else 1]:
            start_s = perf_counter()
            calls[i].call()
            times_s[round_i, i] = perf_counter() - start_s
    return [
        Seconds(*call.key, median_s=float(np.median(laps_s)) / call.indentations_n, repeats_n=repeats_n)
        for call, laps_s in zip(calls, times_s.T, strict=True)
    ]


STUDY = "dB of an indentation"
ALL = "all depths"
Cell_mm = Annotated[float, Field(gt=0, le=20)]
Layers = Annotated[int, Field(ge=1, le=100)]


class Quadratures(Indentations):
    """Settings of the study of quadratures.

    - skins_n: number of skins on which the rules are compared.
    - rules: the rules of each method. A rule is a pair of the cell size in mm and the number of layers.
    """

    skins_n: Annotated[int, Field(ge=1, le=100)]
    rules: Annotated[dict[str, tuple[tuple[Cell_mm, Layers], ...]], Field(min_length=1)]

    def rules_of(self) -> dict[str, list[Quadrature]]:
        """Return the quadrature rules of each method, in SI units."""
        return {name: [Quadrature(milli * cell, n) for cell, n in rules] for name, rules in self.rules.items()}


@dataclass(frozen=True)
class Reference:
    """The reference with which all quadrature rules are compared.

    The reference is a fine Gauss rule along x, y and z (`finer`). The difference between a coarser Gauss rule
    (`coarser`) and the reference is an upper bound of the reference's own error. Both rules have `per_cell_n` nodes per
    cell along x, and as many along y.

    Magnetised boxes that move with the material would be a more obvious reference, but rigid boxes overlap where the
    skin is compressed. As the boxes become smaller, their field converges to the field of this reference; the
    difference is proportional to the square of the cell size. It is 5-9 % at 0.4 mm x 20 layers, and below 1 % when it
    is extrapolated to cells of size 0.
    """

    coarser: Quadrature
    finer: Quadrature
    per_cell_n: int


FINE = Reference(coarser=Quadrature(0.7e-3, 8), finer=Quadrature(0.5e-3, 10), per_cell_n=3)


def study_quadratures(
    trials: Sequence[Trial], rules: Mapping[str, Sequence[Quadrature]], reference: Reference = FINE
) -> tuple[list[Precision], list[TimedCall]]:
    """Compare every rule of every method with the reference on all trials.

    Returns one row per rule, and the calls that are to be timed, which compute dB of the first trial. In a row, `parts`
    contains the largest error of any skin for each depth, and `error` is the largest value in `parts`.
    """
    if not trials or (unknown := set(rules) - set(METHODS)):
        got = unknown if trials else "no trial"
        raise ParamsError(STUDY, "methods", f"among {list(METHODS)}", got, "Correct runtime.quadratures.rules.")
    truths_T = [_reference(trial, reference.finer, reference.per_cell_n).call() for trial in trials]
    coarser = [_reference(trial, reference.coarser, reference.per_cell_n) for trial in trials]
    found_T = [prepared.call() for prepared in coarser]
    rows = [_row(REFERENCE, reference.coarser, coarser[0].nodes_n, errors(trials, found_T, truths_T))]
    calls = []
    for method, rule in ((method, rule) for method, of_method in rules.items() for rule in of_method):
        skins = [METHODS[method](trial, rule) for trial in trials]
        found_T = [prepared.call() for prepared in skins]
        rows.append(_row(method, rule, skins[0].nodes_n, errors(trials, found_T, truths_T)))
        calls.append(TimedCall(rows[-1].key, skins[0].call, len(trials[0].pokes_m)))
    return rows, calls


def errors(
    trials: Sequence[Trial],
    found_T: Sequence[Float[np.ndarray, "n k 3"]],
    truth_T: Sequence[Float[np.ndarray, "n k 3"]],
) -> dict[str, float]:
    """Return the relative error of dB (rms error / rms dB) for each depth, and for all depths together.

    The value of a depth is the largest relative error of any skin. The value of all depths is over all skins together.
    """
    depths_mm = trials[0].depths_mm
    shape = (len(trials), len(depths_mm), -1)
    true_T = np.stack(truth_T).reshape(shape)
    error_T = np.stack(found_T).reshape(shape) - true_T
    relative = np.linalg.norm(error_T, axis=2) / np.linalg.norm(true_T, axis=2)
    named = {f"{depth:.3g} mm": float(worst) for depth, worst in zip(depths_mm, relative.max(axis=0), strict=True)}
    return named | {ALL: float(np.linalg.norm(error_T) / np.linalg.norm(true_T))}


def _row(method: str, rule: Quadrature, nodes_n: int, parts: dict[str, float]) -> Precision:
    return Precision(STUDY, method, rule_name(rule), work_n=nodes_n, error=max(parts.values()), parts=parts)


def _reference(trial: Trial, rule: Quadrature, per_cell_n: int) -> Prepared:
    return prepare(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=per_cell_n))


EXACT, EULER = "exact update", "explicit Euler"
SOLVERS = ("Radau", "BDF", "LSODA", "RK45")  # methods of scipy.integrate.solve_ivp
IMPLICIT = ("Radau", "BDF", "LSODA")  # solvers that accept a Jacobian; here, the Jacobian is constant
# Ratio of the absolute to the relative tolerance of the solvers. The absolute tolerance must be small compared with the
# states that are integrated. These states are a few percent of the peak elastic force, which is 1.
ATOL = 1e-3
DIVERGED = 1.0  # an integrator with at least this relative error (as large as the force) counts as diverged
PERIOD_S = 1.5  # time from one press to the next; twenty presses take 30 s
# The tip is lowered for DOWN_S, held for HELD_S, and lifted for the rest of the period.
DOWN_S, HELD_S = 0.3, 0.7

# A history consists of times in s and the elastic forces at these times. Between two successive times, the elastic
# force changes linearly; this part of a history is called a linear piece.
History = tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]
Forces = Float[np.ndarray, " u"]  # relaxed force / peak elastic force, at the end of each linear piece
State = Float[np.ndarray, " p"]  # one state per relaxation time
Rates = Callable[[float, State], State]  # time, state -> derivative of the state
Piece = Callable[[Rates, float, State], State]  # rates, length of a linear piece in s, first state -> last state
Run = Callable[["Counter"], Forces]  # an integration of the whole history


class Failed(Exception):
    """An integrator reported a failure, or was stopped after too many evaluations of the right-hand side."""


class Integrators(Strict):
    """Settings of the study of integrators.

    - ratios: stiffness ratios, each of which is the ratio of the slowest to the fastest relaxation time.
    - tolerances: relative tolerances of SciPy's solvers.
    - euler_steps_s: steps of the explicit Euler method.
    - pokes_n: number of presses in the history that is integrated.
    """

    ratios: Annotated[tuple[Annotated[float, Field(gt=1, le=1e12)], ...], Field(min_length=1)]
    tolerances: Annotated[tuple[Positive, ...], Field(min_length=1)]
    euler_steps_s: Annotated[tuple[Positive, ...], Field(min_length=1)]
    pokes_n: Annotated[int, Field(ge=1, le=1000)]
    # Largest number of evaluations of the right-hand side per poke; an integrator that needs more counts as failed.
    calls_per_poke_max_n: Annotated[int, Field(ge=1)]


class Counter:
    """Counts evaluations of the right-hand side, and stops an integrator after `calls_max_n` evaluations."""

    def __init__(self, calls_max_n: int) -> None:
        self.calls_n, self.calls_max_n = 0, calls_max_n

    def rates(self, prony: Prony, speed: float) -> Rates:
        """Return the right-hand side of q' = -q / tau + share e' for one linear piece of the elastic force e.

        The states q are the parts of the force that relax, with one state for each term of the Prony series `prony`.
        tau is the relaxation time of a term, and share is its share of the elastic force. `speed` is e', the rate of
        change of the elastic force, which is constant within a linear piece.
        """
        driven = prony.share * speed

        def rates(_: float, state: State) -> State:
            if self.calls_n == self.calls_max_n:
                raise Failed(f"stopped after {self.calls_max_n} evaluations of the right-hand side")
            self.calls_n += 1
            return driven - state / prony.tau_s

        return rates


def study_integrators(tried: Integrators) -> tuple[list[Precision], list[TimedCall]]:
    """Compare every integrator with a 50-digit solution at every stiffness ratio.

    Returns one row per integrator and ratio, and the calls that did not fail, which are to be timed.
    """
    history, calls_max_n = repeated_presses(tried.pokes_n), tried.pokes_n * tried.calls_per_poke_max_n
    rows, calls = [], []
    for ratio in tried.ratios:
        prony = stiff(ratio)
        truth = hereditary(*history, prony)[1:]
        for method, setting, run in _entries(history, prony, tried):
            counter = Counter(calls_max_n)
            error, failure = _judge(run, counter, truth)
            rows.append(Precision(study_name(ratio), method, setting, counter.calls_n, error, failure))
            if failure is None:
                calls.append(TimedCall(rows[-1].key, partial(_run_with_new_counter, run, calls_max_n), tried.pokes_n))
    return rows, calls


def study_name(ratio: float) -> str:
    """Return the name, in tables and figures, of the study of one stiffness ratio."""
    return f"relaxation, stiffness {ratio:.0e}"


def repeated_presses(pokes_n: int) -> History:
    """Return a history of identical presses, each of which raises the elastic force to 1, holds it, and releases it.

    As the presses are identical, error and run time per press hardly depend on the number of presses.
    """
    knots_s = np.array([DOWN_S, DOWN_S + HELD_S, PERIOD_S])
    times_s = (PERIOD_S * np.arange(pokes_n)[:, None] + knots_s).ravel()
    return np.append(0.0, times_s), np.append(0.0, np.tile([1.0, 1.0, 0.0], pokes_n))


def stiff(ratio: float) -> Prony:
    """Return the skin's relaxation with another ratio of the slowest to the fastest relaxation time.

    The skin's real ratio is 1e7. The slowest time and the shares do not change. At large ratios, the fastest time is
    shorter than any practical step of an explicit method.
    """
    slowest_s, fastest_s = SKIN_RELAXATION.tau_s.max(), SKIN_RELAXATION.tau_s.min()
    power = np.log(ratio) / np.log(slowest_s / fastest_s)
    return Prony(slowest_s * (SKIN_RELAXATION.tau_s / slowest_s) ** power, SKIN_RELAXATION.share)


def integrate(history: History, prony: Prony, piece: Piece, counter: Counter) -> Forces:
    """Integrate the states over the linear pieces of a history; return the relaxed force at the end of each piece."""
    (time_s, elastic), state = history, np.zeros_like(prony.tau_s)
    forces = np.empty(len(time_s) - 1)
    for i, (length_s, change) in enumerate(zip(np.diff(time_s), np.diff(elastic), strict=True)):
        state = piece(counter.rates(prony, float(change / length_s)), float(length_s), state)
        forces[i] = (1 - prony.share.sum()) * elastic[i + 1] + state.sum()
    return forces


def euler(rates: Rates, length_s: float, state: State, *, step_s: float) -> State:
    """Integrate one linear piece by explicit Euler, with equal steps of at most `step_s`.

    The method is stable if the steps are shorter than twice the fastest relaxation time.
    """
    steps_n = ceil(length_s / step_s - 1e-9)
    with np.errstate(over="ignore", invalid="ignore"):  # divergence is detected at the end
        for _ in range(steps_n):
            state = state + length_s / steps_n * rates(0.0, state)
    return state


def solve(rates: Rates, length_s: float, state: State, *, method: str, tolerance: float, prony: Prony) -> State:
    """Integrate one linear piece with an adaptive solver of SciPy; raise `Failed` if the solver fails."""
    jacobian = np.diag(-1 / prony.tau_s)
    options = {"jac": lambda _, __: jacobian} if method in IMPLICIT else {}
    span_s = (0.0, length_s)
    solution = solve_ivp(rates, span_s, state, method=method, rtol=tolerance, atol=ATOL * tolerance, **options)
    if not solution.success:
        raise Failed(solution.message)
    return solution.y[:, -1]


def _entries(history: History, prony: Prony, tried: Integrators) -> list[tuple[str, str, Run]]:
    pieces: list[tuple[str, str, Piece]] = [
        (method, f"{tolerance:.0e}", partial(solve, method=method, tolerance=tolerance, prony=prony))
        for method in SOLVERS
        for tolerance in tried.tolerances
    ]
    pieces += [(EULER, f"{step_s:.0e} s", partial(euler, step_s=step_s)) for step_s in tried.euler_steps_s]
    entries: list[tuple[str, str, Run]] = [(EXACT, "", lambda _: relax(*history, prony)[1:])]
    return entries + [(method, setting, partial(integrate, history, prony, piece)) for method, setting, piece in pieces]


def _run_with_new_counter(run: Run, calls_max_n: int) -> Forces:
    return run(Counter(calls_max_n))


def _judge(run: Run, counter: Counter, truth: Forces) -> tuple[float | None, str | None]:
    """Return the relative rms error and None, or None and the reason why the integrator failed."""
    try:
        relaxed = run(counter)
    except Failed as failure:
        return None, str(failure)
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(relaxed - truth) / np.linalg.norm(truth))
    return (error, None) if error < DIVERGED else (None, f"diverged: the error is {error:.0e} times the force")


RADII_N, HEIGHTS_N = 56, 16  # knots of the displacement splines; twice as many knots change dB by 0.1 %


@dataclass(frozen=True)
class NodePath:
    """Position and rotation vector of every node (second axis) under every indentation (first axis)."""

    nodes_m: Float[np.ndarray, "n s 3"]
    turns_rad: Float[np.ndarray, "n s 3"]


def prepare(trial: Trial, rest: Nodes) -> Prepared:
    """Prepare the simulator's computation of dB, with the given nodes."""
    skin = with_nodes(trial, rest)
    return Prepared(len(skin.nodes_m), lambda: changes_of_field(trial.board, skin, trial.pokes_m)[1])


def gauss_in_z(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the simulator's computation of dB with the nodes that the simulator itself uses.

    No cell extends across a seam of the array of magnets that magnetised the skin. Each cell has Gauss nodes over the
    thickness.
    """
    return prepare(trial, place_nodes(trial.skin.thickness_m, rule))


def midpoint(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the simulator's computation of dB, with nodes at the centres of equal boxes."""
    return prepare(trial, midpoints(trial.skin.thickness_m, rule))


def gauss_in_xyz(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the simulator's computation of dB, with 2 x 2 Gauss nodes per cell in each layer of Gauss nodes."""
    return prepare(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=2))


def kernel_alone(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare only the sum over nodes, with the compiled kernel; the displacements of the nodes are computed before.

    The run time can be compared with the run times of the magpylib methods, which also sum over displaced nodes. One
    difference remains. For every indentation, the kernel computes the field of each node both at rest and displaced, so
    that it need not subtract two large sums. With magpylib, the field at rest is computed only once.
    """
    skin = with_nodes(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _rotated_moments(path, skin.moments_A_m2)

    def call() -> Changes:
        rest, poked = (skin.nodes_m, skin.moments_A_m2), zip(path.nodes_m, moments, strict=True)
        return np.stack([change_of_field(rest, moved, trial.board.chips_m) for moved in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_core(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the sum over nodes with magpylib.core: one call per indentation for all pairs of node and chip."""
    skin = with_nodes(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _rotated_moments(path, skin.moments_A_m2)
    rest_T = field_of((skin.nodes_m, skin.moments_A_m2), trial.board.chips_m)

    def call() -> Changes:
        poked = zip(path.nodes_m, moments, strict=True)
        return np.stack([field_of(moved, trial.board.chips_m) - rest_T for moved in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_dipoles(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the sum over nodes with magpylib objects: one Dipole per node, whose path contains all indentations."""
    skin = with_nodes(trial, place_nodes(trial.skin.thickness_m, rule))
    return _by_objects(trial, skin, lambda i: Dipole(moment=skin.moments_A_m2[i]))


def magpylib_cuboids(trial: Trial, rule: Quadrature) -> Prepared:
    """Prepare the sum over equal boxes with magpylib objects: Cuboids that move and rotate with the material."""
    rest = midpoints(trial.skin.thickness_m, rule)
    skin = with_nodes(trial, rest)
    j_T = mu_0 * skin.moments_A_m2 / rest.volumes_m3[:, None]
    sides_m = box_m(trial.skin.thickness_m, rule)
    return _by_objects(trial, skin, lambda i: Cuboid(polarization=j_T[i], dimension=sides_m))


METHODS: dict[str, Callable[[Trial, Quadrature], Prepared]] = {
    "Gauss in z": gauss_in_z,
    "midpoint": midpoint,
    "Gauss in x, y and z": gauss_in_xyz,
    "kernel alone": kernel_alone,
    "magpylib.core dipoles": magpylib_core,
    "magpylib dipoles": magpylib_dipoles,
    "magpylib cuboids": magpylib_cuboids,
}


def _rotated_moments(path: NodePath, moments_A_m2: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "n s 3"]:
    return np.stack([Rotation.from_rotvec(turns_rad).apply(moments_A_m2) for turns_rad in path.turns_rad])


def _by_objects(trial: Trial, skin: Skin, at_origin: Callable[[int], Any]) -> Prepared:
    chips_m, path = trial.board.chips_m, paths(trial, skin)
    objects = []
    for i, place_m in enumerate(skin.nodes_m):
        # Each path begins at rest, so that one call returns the fields at rest and under every indentation.
        source = at_origin(i)
        source.position = np.vstack([place_m, path.nodes_m[:, i]])
        source.orientation = Rotation.from_rotvec(np.vstack([np.zeros(3), path.turns_rad[:, i]]))
        objects.append(source)

    def call() -> Changes:
        b_T = getB(objects, chips_m, sumup=True).reshape(-1, len(chips_m), 3)
        return b_T[1:] - b_T[0]

    return Prepared(len(objects), call)


def paths(trial: Trial, skin: Skin) -> NodePath:
    """Return the displaced nodes of the skin under every indentation of the trial, from displacement splines."""
    nodes_m = np.tile(skin.nodes_m, (len(trial.pokes_m), 1, 1))
    turns_rad = np.zeros_like(nodes_m)
    true_m = trial.pokes_m[:, 2] + skin.depth_zero_m
    press = layer.IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    splines, reach_m = _deformation_splines(press, tuple(np.unique(true_m).tolist()))
    for poke_i, (poke_m, depth_m) in enumerate(zip(trial.pokes_m, true_m, strict=True)):
        deformed = splines[float(depth_m)]
        away_m = skin.nodes_m[:, :2] - poke_m[:2]
        r_m = np.hypot(*away_m.T)
        outward_m, up_m, angle_rad = np.sqrt(r_m**2 + deformed.grown_m2) - r_m, np.zeros_like(r_m), np.zeros_like(r_m)
        within = r_m < reach_m
        for changes, spline in zip((outward_m, up_m, angle_rad), deformed.splines, strict=True):
            changes[within] = spline.ev(r_m[within], skin.nodes_m[within, 2])
        cos, sin = (away_m / np.where(r_m > 0, r_m, 1.0)[:, None]).T
        nodes_m[poke_i] += np.stack([outward_m * cos, outward_m * sin, up_m], axis=1)
        turns_rad[poke_i] += angle_rad[:, None] * np.stack([-sin, cos, np.zeros_like(cos)], axis=1)
    if skin.hold is not None:
        true_poke_m = np.column_stack([trial.pokes_m[:, :2], true_m])
        _slide(nodes_m, turns_rad, press_motion(skin, skin.hold, true_poke_m), skin.seat_m)
    return NodePath(nodes_m, turns_rad)


def _slide(
    nodes_m: Float[np.ndarray, "n s 3"], turns_rad: Float[np.ndarray, "n s 3"], motion: slide.RigidMotion,
    middle_m: Float[np.ndarray, "2"],
) -> None:  # fmt: skip
    """Apply the rigid motion of the skin to its nodes, in place; the skin rotates about `middle_m`."""
    for poke_i, spin_rad in enumerate(motion.spin_rad):
        spin = Rotation.from_rotvec((0.0, 0.0, spin_rad))
        nodes_m[poke_i], _ = slide.apply(motion, poke_i, (nodes_m[poke_i], turns_rad[poke_i]), middle_m)
        turns_rad[poke_i] = (spin * Rotation.from_rotvec(turns_rad[poke_i])).as_rotvec()


@dataclass(frozen=True)
class _DeformationSplines:
    """Displacement of the material under an axially symmetric indentation, as splines.

    At a distance r from the axis and a height z, three splines give the changes of r, of z and of the rotation angle.
    Beyond the range of the splines, r^2 grows by `grown_m2`, while z and the angle do not change.
    """

    splines: tuple[RectBivariateSpline, ...]
    grown_m2: float


@lru_cache(maxsize=8)
def _deformation_splines(
    press: layer.IndentedLayer, depths_m: tuple[float, ...]
) -> tuple[dict[float, _DeformationSplines], float]:
    reach_m = press.thickness_m * deformation.reach(press.tip_radius_m / press.thickness_m, press.base)
    r_m = reach_m * np.linspace(0, 1, RADII_N) ** 1.5
    z_m = press.thickness_m * np.linspace(0, 1, HEIGHTS_N)
    r0_m, z0_m = (grid_m.ravel() for grid_m in np.meshgrid(r_m, z_m, indexing="ij"))
    steps_m = deformation.depth_steps(depths_m, press)
    by_depth = {}
    for step_m, end in zip(steps_m, deformation.follow(r0_m, z0_m, steps_m, press=press), strict=True):
        changes = [
            change.reshape(RADII_N, HEIGHTS_N)
            for change in (end.r_m - r0_m, end.z_m - z0_m, deformation.rotation_angle(end.f))
        ]
        edge_m = reach_m + float(changes[0][-1].mean())
        grown_m2 = edge_m**2 - reach_m**2 if press.base == "slipping" else 0.0
        by_depth[float(step_m)] = _DeformationSplines(
            tuple(RectBivariateSpline(r_m, z_m, change) for change in changes), grown_m2
        )
    return by_depth, reach_m


COARSEST = Quadrature(cell_m=20e-3, layers_n=1)  # only for drawing a random skin; its nodes are replaced afterwards


def draw_trial(
    board: Board, design: SkinDesign, *, spreads: Spreads, seed: int, name: str, pokes: Indentations
) -> Trial:
    """Draw the trial of a random skin that is not rotated and whose properties do not vary over its area.

    The places of `pokes` are relative to the skin's centre. Raises `ParamsError` if a poke does not reach the skin.
    """
    even = spreads.model_copy(update=dict.fromkeys(("skin_amplitude", "skin_filler", "skin_rotation_deg"), 0.0))
    skin = draw_skin(design, even, seed=seed, name=name, rule=COARSEST)
    pokes_m = milli * np.array([(*place, depth) for depth, place in product(pokes.depths_mm, pokes.places_mm)])
    pokes_m[:, :2] += skin.seat_m
    if not (pokes_m[:, 2] + skin.depth_zero_m > 0).all():
        got = f"{pokes_m[:, 2].min() + skin.depth_zero_m:.3g} m"
        raise ParamsError(f"skin {name}", "true depth of every poke", "above 0 m", got, "Increase depths_mm.")
    return Trial(board, design, skin, pokes.depths_mm, pokes_m)


def with_nodes(trial: Trial, rest: Nodes) -> Skin:
    """Return the trial's skin with its nodes replaced by the nodes `rest`.

    The new nodes are magnetised by the array of magnets in the design. The positions in `rest` are relative to the
    skin's centre and base.
    """
    b_T = magnet.array_field(rest.nodes_m, trial.skin.thickness_m, trial.design.polarity)
    j_T = magnet.magnetise(b_T, saturation_T=trial.design.saturation_T, half_field_T=trial.design.half_field_T)
    nodes_m = rest.nodes_m + np.append(trial.skin.seat_m, 0.0)
    return replace(trial.skin, nodes_m=nodes_m, moments_A_m2=magnet.moments(j_T, rest.volumes_m3))


def midpoints(thickness_m: float, rule: Quadrature) -> Nodes:
    """Return nodes at the centres of equal boxes; the boxes are not aligned with the seams of the magnetising array."""
    side_m, _, high_m = box_m(thickness_m, rule)
    side_n = round(SKIN_SIDE_M / side_m)
    x_m = side_m * (np.arange(side_n) + 0.5) - SKIN_SIDE_M / 2
    z_m = high_m * (np.arange(rule.layers_n) + 0.5)
    return _product(x_m, np.full(side_n, side_m), z_m, np.full(rule.layers_n, high_m))


def box_m(thickness_m: float, rule: Quadrature) -> tuple[float, float, float]:
    """Return the side lengths in m, along x, y and z, of the boxes of `midpoints`."""
    side_m = SKIN_SIDE_M / ceil(SKIN_SIDE_M / rule.cell_m - 1e-9)
    return side_m, side_m, thickness_m / rule.layers_n


def gauss_everywhere(thickness_m: float, rule: Quadrature, *, per_cell_n: int) -> Nodes:
    """Return Gauss nodes along x, y and z, in cells that end at the seams of the magnetising array."""
    spans_m = pairwise((-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2))
    edges_m = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in spans_m]
    starts_m, widths_m = np.concatenate([e[:-1] for e in edges_m]), np.concatenate([np.diff(e) for e in edges_m])
    share, weight = _gauss(per_cell_n)
    z_share, z_weight = _gauss(rule.layers_n)
    x_m, x_weight_m = starts_m[:, None] + widths_m[:, None] * share, widths_m[:, None] * weight
    return _product(x_m.ravel(), x_weight_m.ravel(), thickness_m * z_share, thickness_m * z_weight)


def _gauss(points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """Return the nodes and weights of Gauss-Legendre quadrature on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(points_n)
    return (1 + x) / 2, w / 2


def _product(
    x_m: Float[np.ndarray, " i"],
    x_weight_m: Float[np.ndarray, " i"],
    z_m: Float[np.ndarray, " j"],
    z_weight_m: Float[np.ndarray, " j"],
) -> Nodes:
    """Return the tensor product of nodes along x, y and z; x and y have the same nodes, because the skin is square."""
    nodes_m = np.stack(np.meshgrid(x_m, x_m, z_m, indexing="ij"), axis=-1).reshape(-1, 3)
    return Nodes(nodes_m, np.einsum("i,j,k->ijk", x_weight_m, x_weight_m, z_weight_m).ravel())


class RunTime(Strict):
    """Settings section `runtime`: the studies of quadratures and integrators, and how often each call is timed."""

    quadratures: Quadratures
    integrators: Integrators
    repeats_n: Annotated[int, Field(ge=1, le=1000)]


def runtime(settings: Settings, section: RunTime, results: Path) -> None:
    """Compare quadratures and integrators by error and run time.

    Run times are not an output of the DVC stage, because they differ each time the stage is run.
    """
    simulation = simulation_settings(settings)
    rows, calls = study_quadratures(
        _trials(simulation, section.quadratures, settings.seed), section.quadratures.rules_of()
    )
    integrator_rows, integrator_calls = study_integrators(section.integrators)
    choice = choose(rows, used=simulation.main_boards.quadrature.in_si())
    seconds = time_calls([*calls, *integrator_calls], section.repeats_n)
    io.write_json(SECONDS / settings.scene / "runtime.json", [asdict(row) for row in seconds])
    content: dict[str, Any] = {"choice": asdict(choice)}
    content |= {"quadratures": [asdict(row) for row in rows], "integrators": [asdict(row) for row in integrator_rows]}
    io.write_json(results, content)
    failed_n = sum(row.failure is not None for row in [*rows, *integrator_rows])
    say(
        f"{settings.scene}: tried {len(rows) + len(integrator_rows)} settings, of which {failed_n} failed; "
        f"cheapest acceptable quadrature rule: {choice.setting}"
    )


def _trials(simulation: SimulationSettings, tried: Quadratures, seed: int) -> list[Trial]:
    """Draw trials for the `skins_n` skins that are closest to their chips, which need the finest quadrature."""
    boards_and_skins = [
        (draw_board(simulation.main_boards.design, simulation.spreads, seed=seed, name=board), skin)
        for board, skin in list_captures(simulation, MAIN)
    ]
    nearest = sorted(boards_and_skins, key=lambda pair: -pair[0].chips_m[0, 2])[: tried.skins_n]
    return [
        draw_trial(board, simulation.skin, spreads=simulation.spreads, seed=seed, name=skin, pokes=tried)
        for board, skin in nearest
    ]
