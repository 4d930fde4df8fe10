"""Error against run time: ways to sum a skin and to relax its force."""

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
    """A skin that only waits to be poked: all pokes of its trial in one call."""

    nodes_n: int
    call: Callable[[], Changes]


@dataclass(frozen=True)
class Trial:
    """One skin on its board, and pokes as commanded, depth after depth."""

    board: Board
    design: SkinDesign
    skin: Skin
    depths_mm: tuple[float, ...]
    pokes_m: Float[np.ndarray, "n 3"]


Positive = Annotated[float, Field(gt=0)]


class Pokes(Strict):
    """Every place, seen from the skin's middle, at every depth."""

    places_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]


REFERENCE = "reference"  # the method of a row that says how wrong the reference of its study is at most
CANDIDATES = "Gauss in z"  # the rules that `nodes.place_nodes` can lay
ERROR_MAX = 0.02  # DESIGN 6: an indentation at no more than 2 % error of dB
Key = tuple[str, str, str]  # study, method, setting


@dataclass(frozen=True)
class Row:
    """One method with one setting."""

    study: str
    method: str
    setting: str

    @property
    def key(self) -> Key:
        return (self.study, self.method, self.setting)


@dataclass(frozen=True)
class Precision(Row):
    """How wrong one method is with one setting, relative to the size of what it computes; or why it failed."""

    work_n: int  # nodes that are summed, or right-hand sides that were called
    error: float | None  # None: failed
    failure: str | None = None
    parts: dict[str, float] = field(default_factory=dict)  # the error of each depth, where a study has depths


@dataclass(frozen=True)
class Seconds(Row):
    """Median time of an indentation."""

    median_s: float
    repeats_n: int


@dataclass(frozen=True)
class Contestant:
    """A call to be timed, and how many indentations it computes."""

    key: Key
    call: Callable[[], Any]
    indentations_n: int


@dataclass(frozen=True)
class Choice:
    """The cheapest rule that is good enough (None: no rule is), and how the rule in use compares (None: not tried)."""

    setting: str | None
    nodes_n: int | None
    error: float | None
    used_setting: str
    used_nodes_n: int | None
    used_error: float | None
    differs: bool


def written(rule: Quadrature) -> str:
    """Write a rule as rows and figures do."""
    return f"{rule.cell_m / milli:.3g} mm x {rule.layers_n}"


def choose(rows: Sequence[Precision], *, used: Quadrature, error_max: float = ERROR_MAX) -> Choice:
    """Take the rule with the fewest nodes among those whose error, of the worst depth, is below `error_max`.

    Nodes stand for time, to which they are proportional, so that the choice is the same in every run.
    """
    tried = {row.setting: row for row in rows if row.method == CANDIDATES}
    passing = [row for row in tried.values() if row.error is not None and row.error < error_max]
    best = min(passing, key=lambda row: (row.work_n, row.error), default=None)
    now = tried.get(written(used))
    return Choice(
        setting=best.setting if best else None,
        nodes_n=best.work_n if best else None,
        error=best.error if best else None,
        used_setting=written(used),
        used_nodes_n=now.work_n if now else None,
        used_error=now.error if now else None,
        differs=best is None or best.setting != written(used),
    )


def race(contestants: Sequence[Contestant], repeats_n: int) -> list[Seconds]:
    """Time all contestants in turn, `repeats_n` rounds of them, so that a busy moment of the machine hits all alike.

    Each has run before, when its error was found: compilation and caches are not part of an indentation.
    """
    if repeats_n < 1:
        raise ParamsError("stopwatch", "repeats_n", "1 or more", repeats_n, "Repeat.")
    times_s = np.empty((repeats_n, len(contestants)))
    for round_i in range(repeats_n):
        # Every other round runs backwards, so that nobody always inherits the caches of the same neighbour.
        for i in range(len(contestants))[:: -1 if round_i % 2 else 1]:
            start_s = perf_counter()
            contestants[i].call()
            times_s[round_i, i] = perf_counter() - start_s
    return [
        Seconds(*contestant.key, median_s=float(np.median(laps_s)) / contestant.indentations_n, repeats_n=repeats_n)
        for contestant, laps_s in zip(contestants, times_s.T, strict=True)
    ]


STUDY = "dB of an indentation"
ALL = "all depths"
Cell_mm = Annotated[float, Field(gt=0, le=20)]
Layers = Annotated[int, Field(ge=1, le=100)]


class Quadratures(Pokes):
    """Pokes seen from the skin's middle, on so many skins, and (cell, layers) of every rule of every method."""

    skins_n: Annotated[int, Field(ge=1, le=100)]
    rules: Annotated[dict[str, tuple[tuple[Cell_mm, Layers], ...]], Field(min_length=1)]

    def rules_of(self) -> dict[str, list[Quadrature]]:
        """Give the rules of every method."""
        return {name: [Quadrature(milli * cell, n) for cell, n in rules] for name, rules in self.rules.items()}


@dataclass(frozen=True)
class Reference:
    """Gauss rules along x, y and z: the truth is the finer one, and the coarser one bounds its error.

    Moved boxes would be the obvious truth, but rigid boxes overlap where the skin is squeezed: they approach this one
    with the square of the cell, 5-9 % off at 0.4 mm x 20 layers, and extrapolated to no cell within 1 %.
    """

    coarser: Quadrature
    finer: Quadrature
    per_cell_n: int


FINE = Reference(coarser=Quadrature(0.7e-3, 8), finer=Quadrature(0.5e-3, 10), per_cell_n=3)


def study_quadratures(
    trials: Sequence[Trial], rules: Mapping[str, Sequence[Quadrature]], reference: Reference = FINE
) -> tuple[list[Precision], list[Contestant]]:
    """Compare every rule of every method with the reference, over all trials; the first trial is what is timed.

    `parts` of a row holds the error of each depth, of the skin that is worst there; `error` is the worst of these.
    """
    if not trials or (unknown := set(rules) - set(METHODS)):
        got = unknown if trials else "no trial"
        raise ParamsError(STUDY, "methods", f"among {list(METHODS)}", got, "Mend the rules.")
    truths_T = [_reference(trial, reference.finer, reference.per_cell_n).call() for trial in trials]
    coarser = [_reference(trial, reference.coarser, reference.per_cell_n) for trial in trials]
    found_T = [prepared.call() for prepared in coarser]
    rows = [_row(REFERENCE, reference.coarser, coarser[0].nodes_n, errors(trials, found_T, truths_T))]
    contestants = []
    for method, rule in ((method, rule) for method, of_method in rules.items() for rule in of_method):
        skins = [METHODS[method](trial, rule) for trial in trials]
        found_T = [prepared.call() for prepared in skins]
        rows.append(_row(method, rule, skins[0].nodes_n, errors(trials, found_T, truths_T)))
        contestants.append(Contestant(rows[-1].key, skins[0].call, len(trials[0].pokes_m)))
    return rows, contestants


def errors(
    trials: Sequence[Trial],
    found_T: Sequence[Float[np.ndarray, "n k 3"]],
    truth_T: Sequence[Float[np.ndarray, "n k 3"]],
) -> dict[str, float]:
    """Give rms error over rms of dB at each depth, of the skin that is worst there, and over all pokes of all skins."""
    depths_mm = trials[0].depths_mm
    shape = (len(trials), len(depths_mm), -1)
    true_T = np.stack(truth_T).reshape(shape)
    wrong_T = np.stack(found_T).reshape(shape) - true_T
    each = np.linalg.norm(wrong_T, axis=2) / np.linalg.norm(true_T, axis=2)
    named = {f"{depth:.3g} mm": float(worst) for depth, worst in zip(depths_mm, each.max(axis=0), strict=True)}
    return named | {ALL: float(np.linalg.norm(wrong_T) / np.linalg.norm(true_T))}


def _row(method: str, rule: Quadrature, nodes_n: int, parts: dict[str, float]) -> Precision:
    return Precision(STUDY, method, written(rule), work_n=nodes_n, error=max(parts.values()), parts=parts)


def _reference(trial: Trial, rule: Quadrature, per_cell_n: int) -> Prepared:
    return whole(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=per_cell_n))


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
    slowest_s, fastest_s = SKIN_RELAXATION.tau_s.max(), SKIN_RELAXATION.tau_s.min()
    power = np.log(ratio) / np.log(slowest_s / fastest_s)
    return Prony(slowest_s * (SKIN_RELAXATION.tau_s / slowest_s) ** power, SKIN_RELAXATION.share)


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


RADII_N, HEIGHTS_N = 56, 16  # of the splines that move nodes; twice as many change dB by 0.1 %


@dataclass(frozen=True)
class NodePath:
    """Place and rotation vector of every node under every poke."""

    nodes_m: Float[np.ndarray, "n s 3"]
    turns_rad: Float[np.ndarray, "n s 3"]


def whole(trial: Trial, rest: Nodes) -> Prepared:
    """Take the product's way over any nodes: flow and field of every poke."""
    skin = laid(trial, rest)
    return Prepared(len(skin.nodes_m), lambda: changes_of_field(trial.board, skin, trial.pokes_m)[1])


def gauss_in_z(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way: cells that end at the seams, Gauss nodes over the thickness, flow and field included."""
    return whole(trial, place_nodes(trial.skin.thickness_m, rule))


def midpoint(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way over the middles of equal boxes."""
    return whole(trial, midpoints(trial.skin.thickness_m, rule))


def gauss_in_xyz(trial: Trial, rule: Quadrature) -> Prepared:
    """Take the product's way over 2 x 2 Gauss nodes in each cell, times the Gauss nodes over the thickness."""
    return whole(trial, gauss_everywhere(trial.skin.thickness_m, rule, per_cell_n=2))


def kernel_alone(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by its compiled kernel, moved before: what magpylib's times are to be compared with.

    It computes each node at rest and moved, and so needs no difference of large sums; magpylib's rest is kept instead.
    """
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _turned(path, skin.moments_A_m2)

    def call() -> Changes:
        rest, poked = (skin.nodes_m, skin.moments_A_m2), zip(path.nodes_m, moments, strict=True)
        return np.stack([change_of_field(rest, now, trial.board.chips_m) for now in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_core(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by magpylib.core: every pair of node and chip in one vectorised call a poke."""
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    path = paths(trial, skin)
    moments = _turned(path, skin.moments_A_m2)
    rest_T = field_of((skin.nodes_m, skin.moments_A_m2), trial.board.chips_m)

    def call() -> Changes:
        poked = zip(path.nodes_m, moments, strict=True)
        return np.stack([field_of(now, trial.board.chips_m) - rest_T for now in poked])

    return Prepared(len(skin.nodes_m), call)


def magpylib_dipoles(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum the product's nodes by magpylib's objects: one Dipole a node, each with its path through all pokes."""
    skin = laid(trial, place_nodes(trial.skin.thickness_m, rule))
    return _by_objects(trial, skin, lambda i: Dipole(moment=skin.moments_A_m2[i]))


def magpylib_cuboids(trial: Trial, rule: Quadrature) -> Prepared:
    """Sum equal boxes by magpylib's objects: one Cuboid a box that moves and turns with its middle, undeformed."""
    rest = midpoints(trial.skin.thickness_m, rule)
    skin = laid(trial, rest)
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


def _turned(path: NodePath, moments_A_m2: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "n s 3"]:
    return np.stack([Rotation.from_rotvec(turns_rad).apply(moments_A_m2) for turns_rad in path.turns_rad])


def _by_objects(trial: Trial, skin: Skin, at_origin: Callable[[int], Any]) -> Prepared:
    chips_m, path = trial.board.chips_m, paths(trial, skin)
    objects = []
    for i, place_m in enumerate(skin.nodes_m):
        # The first place of each path is rest, so that one call gives the field before and under every poke.
        source = at_origin(i)
        source.position = np.vstack([place_m, path.nodes_m[:, i]])
        source.orientation = Rotation.from_rotvec(np.vstack([np.zeros(3), path.turns_rad[:, i]]))
        objects.append(source)

    def call() -> Changes:
        b_T = getB(objects, chips_m, sumup=True).reshape(-1, len(chips_m), 3)
        return b_T[1:] - b_T[0]

    return Prepared(len(objects), call)


def paths(trial: Trial, skin: Skin) -> NodePath:
    """Follow the skin's nodes through every poke of the trial."""
    nodes_m = np.tile(skin.nodes_m, (len(trial.pokes_m), 1, 1))
    turns_rad = np.zeros_like(nodes_m)
    true_m = trial.pokes_m[:, 2] + skin.depth_zero_m
    press = layer.IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    bends, reach_m = _bends(press, tuple(np.unique(true_m).tolist()))
    for poke_i, (poke_m, depth_m) in enumerate(zip(trial.pokes_m, true_m, strict=True)):
        bend = bends[float(depth_m)]
        away_m = skin.nodes_m[:, :2] - poke_m[:2]
        r_m = np.hypot(*away_m.T)
        outward_m, up_m, angle_rad = np.sqrt(r_m**2 + bend.grown_m2) - r_m, np.zeros_like(r_m), np.zeros_like(r_m)
        here = r_m < reach_m
        for part, spline in zip((outward_m, up_m, angle_rad), bend.splines, strict=True):
            part[here] = spline.ev(r_m[here], skin.nodes_m[here, 2])
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
    for poke_i, spin_rad in enumerate(motion.spin_rad):
        spin = Rotation.from_rotvec((0.0, 0.0, spin_rad))
        nodes_m[poke_i], _ = slide.apply(motion, poke_i, (nodes_m[poke_i], turns_rad[poke_i]), middle_m)
        turns_rad[poke_i] = (spin * Rotation.from_rotvec(turns_rad[poke_i])).as_rotvec()


@dataclass(frozen=True)
class _Bend:
    """Splines of the change of r, of z and of the angle over (r, z); past their reach r^2 grows."""

    splines: tuple[RectBivariateSpline, ...]
    grown_m2: float


@lru_cache(maxsize=8)
def _bends(press: layer.IndentedLayer, depths_m: tuple[float, ...]) -> tuple[dict[float, _Bend], float]:
    reach_m = press.thickness_m * deformation.reach(press.tip_radius_m / press.thickness_m, press.base)
    r_m = reach_m * np.linspace(0, 1, RADII_N) ** 1.5
    z_m = press.thickness_m * np.linspace(0, 1, HEIGHTS_N)
    r0_m, z0_m = (part.ravel() for part in np.meshgrid(r_m, z_m, indexing="ij"))
    steps_m = deformation.depth_steps(depths_m, press)
    found = {}
    for step_m, end in zip(steps_m, deformation.follow(r0_m, z0_m, steps_m, press=press), strict=True):
        changes = [
            part.reshape(RADII_N, HEIGHTS_N)
            for part in (end.r_m - r0_m, end.z_m - z0_m, deformation.rotation_angle(end.f))
        ]
        edge_m = reach_m + float(changes[0][-1].mean())
        grown_m2 = edge_m**2 - reach_m**2 if press.base == "slipping" else 0.0
        found[float(step_m)] = _Bend(tuple(RectBivariateSpline(r_m, z_m, change) for change in changes), grown_m2)
    return found, reach_m


COARSEST = Quadrature(cell_m=20e-3, layers_n=1)  # its nodes are replaced


def draw_trial(board: Board, design: SkinDesign, *, spreads: Spreads, seed: int, name: str, pokes: Pokes) -> Trial:
    """Draw the skin called `name`, even and straight, and lay the pokes on its pattern wherever that sits."""
    even = spreads.model_copy(update=dict.fromkeys(("skin_amplitude", "skin_filler", "skin_rotation_deg"), 0.0))
    skin = draw_skin(design, even, seed=seed, name=name, rule=COARSEST)
    pokes_m = milli * np.array([(*place, depth) for depth, place in product(pokes.depths_mm, pokes.places_mm)])
    pokes_m[:, :2] += skin.seat_m
    if not (pokes_m[:, 2] + skin.depth_zero_m > 0).all():
        got = f"{pokes_m[:, 2].min() + skin.depth_zero_m:.3g} m"
        raise ParamsError(f"skin {name}", "true depth of every poke", "above 0 m", got, "Poke deeper.")
    return Trial(board, design, skin, pokes.depths_mm, pokes_m)


def laid(trial: Trial, rest: Nodes) -> Skin:
    """Give the trial's skin on these nodes (from its middle and its base), magnetised as any skin is."""
    b_T = magnet.array_field(rest.nodes_m, trial.skin.thickness_m, trial.design.polarity)
    j_T = magnet.magnetise(b_T, saturation_T=trial.design.saturation_T, half_field_T=trial.design.half_field_T)
    nodes_m = rest.nodes_m + np.append(trial.skin.seat_m, 0.0)
    return replace(trial.skin, nodes_m=nodes_m, moments_A_m2=magnet.moments(j_T, rest.volumes_m3))


def midpoints(thickness_m: float, rule: Quadrature) -> Nodes:
    """Fill the skin with the middles of equal boxes that heed no seam: the lattice one would take first."""
    side_m, _, high_m = box_m(thickness_m, rule)
    side_n = round(SKIN_SIDE_M / side_m)
    x_m = side_m * (np.arange(side_n) + 0.5) - SKIN_SIDE_M / 2
    z_m = high_m * (np.arange(rule.layers_n) + 0.5)
    return _product(x_m, np.full(side_n, side_m), z_m, np.full(rule.layers_n, high_m))


def box_m(thickness_m: float, rule: Quadrature) -> tuple[float, float, float]:
    """Give the sides of the boxes whose middles `midpoints` are."""
    side_m = SKIN_SIDE_M / ceil(SKIN_SIDE_M / rule.cell_m - 1e-9)
    return side_m, side_m, thickness_m / rule.layers_n


def gauss_everywhere(thickness_m: float, rule: Quadrature, *, per_cell_n: int) -> Nodes:
    """Fill the skin with cells that end at the seams, each with Gauss nodes along x and y too: an order higher."""
    spans_m = pairwise((-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2))
    edges_m = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in spans_m]
    starts_m, widths_m = np.concatenate([e[:-1] for e in edges_m]), np.concatenate([np.diff(e) for e in edges_m])
    share, weight = _gauss(per_cell_n)
    z_share, z_weight = _gauss(rule.layers_n)
    x_m, x_weight_m = starts_m[:, None] + widths_m[:, None] * share, widths_m[:, None] * weight
    return _product(x_m.ravel(), x_weight_m.ravel(), thickness_m * z_share, thickness_m * z_weight)


def _gauss(points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    x, w = np.polynomial.legendre.leggauss(points_n)
    return (1 + x) / 2, w / 2


def _product(
    x_m: Float[np.ndarray, " i"],
    x_weight_m: Float[np.ndarray, " i"],
    z_m: Float[np.ndarray, " j"],
    z_weight_m: Float[np.ndarray, " j"],
) -> Nodes:
    # x and y alike, as the skin is.
    nodes_m = np.stack(np.meshgrid(x_m, x_m, z_m, indexing="ij"), axis=-1).reshape(-1, 3)
    return Nodes(nodes_m, np.einsum("i,j,k->ijk", x_weight_m, x_weight_m, z_weight_m).ravel())


class RunTime(Strict):
    """Section `runtime`: both studies, and how often each call is timed."""

    quadratures: Quadratures
    integrators: Integrators
    repeats_n: Annotated[int, Field(ge=1, le=1000)]


def read(settings: Settings) -> RunTime:
    """Read section runtime."""
    return settings.section(RunTime, "runtime")


def runtime(settings: Settings, results: Path) -> None:
    """Compare quadratures and integrators; seconds differ between identical runs, so they are no output."""
    of, tried = simulation_settings(settings), read(settings)
    rows, calls = study_quadratures(_trials(of, tried.quadratures, settings.seed), tried.quadratures.rules_of())
    more, more_calls = study_integrators(tried.integrators)
    choice = choose(rows, used=of.main_boards.quadrature.in_si())
    seconds = race([*calls, *more_calls], tried.repeats_n)
    io.write_json(SECONDS / settings.scene / "runtime.json", [asdict(row) for row in seconds])
    words: dict[str, Any] = {"choice": asdict(choice)}
    words |= {"quadratures": [asdict(row) for row in rows], "integrators": [asdict(row) for row in more]}
    io.write_json(results, words)
    failed_n = sum(row.failure is not None for row in [*rows, *more])
    say(
        f"{settings.scene}: {len(rows) + len(more)} ways tried, {failed_n} failed; "
        f"cheapest quadrature: {choice.setting}"
    )


def _trials(of: SimulationSettings, tried: Quadratures, seed: int) -> list[Trial]:
    """Take the skins on the boards whose chips are nearest: there a quadrature has to be finest."""
    drawn = [
        (draw_board(of.main_boards.design, of.spreads, seed=seed, name=board), skin)
        for board, skin in list_captures(of, MAIN)
    ]
    nearest = sorted(drawn, key=lambda pair: -pair[0].chips_m[0, 2])[: tried.skins_n]
    return [
        draw_trial(board, of.skin, spreads=of.spreads, seed=seed, name=skin, pokes=tried) for board, skin in nearest
    ]
