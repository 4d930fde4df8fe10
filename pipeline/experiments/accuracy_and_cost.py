"""Accuracy and cost: error against run time of numerical methods and of training, and the error of neglected terms.

The studies are:

- *field change*: the field of a magnetised skin is an integral over its volume. A quadrature rule replaces the integral
  by a sum over nodes, which are points with weights in the skin.
- *relaxation*: the force relaxes while a press is held. Its differential equation is integrated over time.
- *training*, *adaptation*: the error of networks on held-out skins, by the number of training steps.
- *neglected term*: the error that is made if a term of the simulation is left out.

The errors are in numbers.json. Run times differ from run to run, and are written to a file of their own.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise, product
from math import ceil
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import mpmath
import numpy as np
from jaxtyping import Float
from magpylib.core import dipole_Hfield, magnet_cuboid_Bfield
from pydantic import Field
from scipy.constants import micro, milli, mu_0
from scipy.integrate import solve_ivp

from pipeline.description import norm_error
from pipeline.experiments.results import write_results
from pipeline.plot import drawing, svg
from pipeline.provenance import SECONDS
from pipeline.settings import Adaptations, Settings, Training
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from pipeline.training.jobs import adaptation_jobs, make_jobs, read_data, read_pretrained, train_jobs
from reskin import io
from reskin.config import Strict
from reskin.data.grid import CENTRE_MM
from reskin.metrics import score
from reskin.models.job import TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.physics import aging, magnet
from reskin.physics.aging import SKIN_RELAXATION, Ageing, Memory, Prony, Relaxation, relax
from reskin.physics.board import Board, draw_board
from reskin.physics.magnet import SEAMS_M, SKIN_SIDE_M, Dipoles, Nodes, Quadrature, change_of_field, place_nodes
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, moved_dipoles
from reskin.seeds import rng_for
from reskin.simulation.capture import list_captures
from reskin.simulation.contact import Response, Terms, simulate_response
from reskin.simulation.settings import MAIN, SimulationSettings

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Changes = Float[np.ndarray, "n k 3"]  # dB in T at the chips, for each press


class Quadratures(Strict):
    """Quadrature rules to compare on one skin of the scene.

    Each place, relative to the skin's centre, is pressed to each depth. A rule is a pair of the cell size in mm and the
    number of layers of nodes; `rules` lists the rules of each method.
    """

    places_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]
    rules: dict[str, tuple[tuple[Positive, Count], ...]]


class Integrators(Strict):
    """Integrators to compare for every ratio of the slowest to the fastest relaxation time.

    `tolerances` are relative tolerances of SciPy's solvers, `euler_steps_s` the steps of the explicit Euler method. An
    integrator that needs more than `calls_max_n` evaluations of the right-hand side has failed.
    """

    ratios: tuple[Annotated[float, Field(gt=1, le=1e12)], ...]
    tolerances: tuple[Positive, ...]
    euler_steps_s: tuple[Positive, ...]
    calls_max_n: Count


class AccuracyAndCost(Strict):
    """Settings section `accuracy_and_cost`.

    - training_steps_n, adaptation_steps_n: numbers of steps with which networks are trained and adapted.
    - neglected_terms: whether the errors of neglected terms are computed.
    - repeats_n: number of times that each numerical method is timed.
    """

    quadratures: Quadratures
    integrators: Integrators
    training_steps_n: tuple[Count, ...]
    adaptation_steps_n: tuple[Count, ...]
    neglected_terms: bool
    repeats_n: Count


@dataclass(frozen=True)
class Row:
    """The error of one method with one setting; `error` is None if the method failed."""

    study: str
    method: str
    setting: str
    error: float | None
    unit: str = "1"
    seconds: float | None = None  # median run time per press, or time of a training run


def accuracy_and_cost(
    settings: Settings, section: AccuracyAndCost, indentations: Path, folds: Path, pretrained: Path, results: Path
) -> None:
    """Measure the errors and run times of all methods, and the errors of neglected terms."""
    simulation, seed = simulation_settings(settings), settings.seed
    rows = [
        *study_field(simulation, section.quadratures, seed, section.repeats_n),
        *study_relaxation(section.integrators, section.repeats_n),
        *study_training(settings, section, indentations, folds, pretrained),
        *(neglected_terms(simulation, seed) if section.neglected_terms else ()),
    ]
    numbers, seconds = [], []
    for row in map(asdict, rows):
        time_s = row.pop("seconds")
        numbers.append(row)
        if time_s is not None:
            seconds.append({name: row[name] for name in ("study", "method", "setting")} | {"seconds": time_s})
    io.write_json(SECONDS / settings.scene / "accuracy_and_cost.json", seconds)
    write_results(results, {"rows": numbers}, {})
    say(f"{settings.scene}: {len(rows)} errors, of which {sum(row.error is None for row in rows)} methods failed")


def median_s(call: Callable[[], object], repeats_n: int) -> float:
    """Return the median time of a call, which has run before, so that nothing is compiled or cached."""
    times_s = []
    for _ in range(repeats_n):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return float(np.median(times_s))


# Quadrature of the field ------------------------------------------------------------------------------------------

FIELD, REFERENCE = "field change dB of a press", "reference"
ERROR_MAX = 0.02  # largest acceptable error of dB
# The reference is a Gauss rule along x, y and z with 3 x 3 nodes per cell. Its difference from a coarser rule is an
# upper bound of its own error. Magnetised boxes that move with the material would be no better reference, because rigid
# boxes overlap where the skin is compressed.
FINE, COARSER, PER_CELL_N = Quadrature(0.5e-3, 10), Quadrature(0.7e-3, 8), 3


@dataclass(frozen=True)
class Trial:
    """A board with a skin, and presses (x, y, depth) sorted by depth."""

    simulation: SimulationSettings
    board: Board
    skin: Skin
    presses_m: Float[np.ndarray, "n 3"]

    def with_nodes(self, rest: Nodes) -> Skin:
        """Return the skin with the given nodes, which are relative to its centre and base."""
        design = self.simulation.skin
        b_T = magnet.array_field(rest.nodes_m, self.skin.thickness_m, design.polarity)
        j_T = magnet.magnetise(b_T, saturation_T=design.saturation_T, half_field_T=design.half_field_T)
        nodes_m = rest.nodes_m + np.append(self.skin.seat_m, 0.0)
        return replace(self.skin, nodes_m=nodes_m, moments_A_m2=magnet.moments(j_T, rest.volumes_m3))

    def change(self, skin: Skin) -> Changes:
        return changes_of_field(self.board, skin, self.presses_m)[1]


def draw_trial(simulation: SimulationSettings, tried: Quadratures, seed: int) -> Trial:
    """Draw the skin that is closest to its chips, which needs the finest quadrature, with an even magnetisation."""
    design, spreads = simulation.main_boards.design, simulation.spreads
    drawn = [
        (draw_board(design, spreads, seed=seed, name=board), skin) for board, skin in list_captures(simulation, MAIN)
    ]
    board, name = max(drawn, key=lambda pair: float(pair[0].chips_m[0, 2]))
    even = spreads.model_copy(update=dict.fromkeys(("skin_amplitude", "skin_filler", "skin_rotation_deg"), 0.0))
    skin = draw_skin(simulation.skin, even, seed=seed, name=name, rule=Quadrature(20e-3, 1))
    presses_m = milli * np.array([(*place, depth) for depth, place in product(tried.depths_mm, tried.places_mm)])
    presses_m[:, :2] += skin.seat_m
    return Trial(simulation, board, skin, presses_m)


def study_field(simulation: SimulationSettings, tried: Quadratures, seed: int, repeats_n: int) -> Iterator[Row]:
    """Compare quadrature rules; the error of a rule is its rms error / rms dB at the worst depth."""
    trial = draw_trial(simulation, tried, seed)
    h_m, depths_n = trial.skin.thickness_m, len(tried.depths_mm)
    truth_T, coarser_T = (
        trial.change(trial.with_nodes(gauss_nodes(h_m, rule, PER_CELL_N))) for rule in (FINE, COARSER)
    )

    def worst(found_T: Changes) -> float:
        parts = (np.split(values_T, depths_n) for values_T in (found_T, truth_T))
        return max(norm_error(*of_depth) for of_depth in zip(*parts, strict=True))

    yield Row(FIELD, REFERENCE, "upper bound of its own error", worst(coarser_T))
    for method, rules in tried.rules.items():
        for cell_mm, layers_n in rules:
            call = METHODS[method](trial, Quadrature(cell_mm * milli, layers_n))
            error, seconds = worst(call()), median_s(call, repeats_n) / len(trial.presses_m)
            yield Row(FIELD, method, f"{cell_mm:g} mm x {layers_n}", error, seconds=seconds)


def gauss_nodes(thickness_m: float, rule: Quadrature, per_cell_n: int) -> Nodes:
    """Return Gauss nodes along x, y and z, in cells that end at the seams of the magnetising array."""
    spans_m = pairwise((-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2))
    edges_m = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in spans_m]
    starts_m, widths_m = np.concatenate([e[:-1] for e in edges_m]), np.concatenate([np.diff(e) for e in edges_m])
    (x, x_weight), (z, z_weight) = map(np.polynomial.legendre.leggauss, (per_cell_n, rule.layers_n))
    x_m = (starts_m[:, None] + widths_m[:, None] * (1 + x) / 2).ravel()
    return _grid(x_m, (widths_m[:, None] * x_weight / 2).ravel(), thickness_m * (1 + z) / 2, thickness_m * z_weight / 2)


def midpoints(thickness_m: float, rule: Quadrature) -> Nodes:
    """Return nodes at the centres of equal boxes, which are not aligned with the seams of the magnetising array."""
    side_m, _, high_m = box_m(thickness_m, rule)
    x_m = side_m * (np.arange(round(SKIN_SIDE_M / side_m)) + 0.5) - SKIN_SIDE_M / 2
    z_m = high_m * (np.arange(rule.layers_n) + 0.5)
    return _grid(x_m, np.full_like(x_m, side_m), z_m, np.full_like(z_m, high_m))


def box_m(thickness_m: float, rule: Quadrature) -> tuple[float, float, float]:
    """Return the side lengths of the boxes of `midpoints` along x, y and z."""
    side_m = SKIN_SIDE_M / ceil(SKIN_SIDE_M / rule.cell_m - 1e-9)
    return side_m, side_m, thickness_m / rule.layers_n


def _grid(x_m: Any, x_weight_m: Any, z_m: Any, z_weight_m: Any) -> Nodes:
    """Return the tensor product of nodes along x, y and z; x and y have the same nodes, because the skin is square."""
    nodes_m = np.stack(np.meshgrid(x_m, x_m, z_m, indexing="ij"), axis=-1).reshape(-1, 3)
    return Nodes(nodes_m, np.einsum("i,j,k->ijk", x_weight_m, x_weight_m, z_weight_m).ravel())


def _simulator(trial: Trial, rule: Quadrature, place: Callable[[float, Quadrature], Nodes]) -> Callable[[], Changes]:
    return partial(trial.change, trial.with_nodes(place(trial.skin.thickness_m, rule)))


def _sum_alone(
    trial: Trial, rule: Quadrature, change: Callable[[Dipoles, Dipoles, Any], Float[np.ndarray, "k 3"]]
) -> Callable[[], Changes]:
    """Return a call that only sums the fields of dipoles, which were moved before."""
    skin = trial.with_nodes(place_nodes(trial.skin.thickness_m, rule))
    moved = [(before, after) for _, before, after in moved_dipoles(skin, trial.presses_m)]
    return lambda: np.stack([change(before, after, trial.board.chips_m) for before, after in moved])


def magpylib_change(before: Dipoles, after: Dipoles, chips_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Return the change of the field in T, with one call of magpylib.core for all pairs of a dipole and a chip."""

    def field_T(sources: Dipoles) -> Float[np.ndarray, "k 3"]:
        places_m, moments = sources
        separation_m = (chips_m[:, None] - places_m).reshape(-1, 3)
        h_A_m = dipole_Hfield(observers=separation_m, moments=np.tile(moments, (len(chips_m), 1)))
        return mu_0 * h_A_m.reshape(len(chips_m), -1, 3).sum(axis=1)

    return field_T(after) - field_T(before)


USED = "Gauss in z"  # the method of the simulator
METHODS: dict[str, Callable[[Trial, Quadrature], Callable[[], Changes]]] = {
    USED: partial(_simulator, place=place_nodes),
    "midpoint": partial(_simulator, place=midpoints),
    "Gauss in x, y and z": partial(_simulator, place=partial(gauss_nodes, per_cell_n=2)),
    "kernel alone": partial(_sum_alone, change=change_of_field),
    "magpylib.core alone": partial(_sum_alone, change=magpylib_change),
}


# Integration of the relaxation ------------------------------------------------------------------------------------

EXACT, EULER = "exact update", "explicit Euler"
SOLVERS = ("Radau", "BDF", "LSODA", "RK45")  # methods of scipy.integrate.solve_ivp
IMPLICIT = ("Radau", "BDF", "LSODA")  # these accept a Jacobian, which is constant here
ATOL = 1e-3  # absolute / relative tolerance; the states are a few percent of the peak force, which is 1
# A press raises the elastic force to 1 within 0.3 s, holds it for 0.7 s, and releases it within 0.5 s.
TIME_S, ELASTIC = np.array([0.0, 0.3, 1.0, 1.5]), np.array([0.0, 1.0, 1.0, 0.0])


class Failed(Exception):
    """An integrator failed, or needed too many evaluations of the right-hand side."""


def study_relaxation(tried: Integrators, repeats_n: int) -> Iterator[Row]:
    """Compare integrators of q' = -q / tau + share e' with a 50-digit solution, at every stiffness ratio."""
    for ratio in tried.ratios:
        prony = stiff(ratio)
        truth = hereditary(TIME_S, ELASTIC, prony)
        settings = [(method, tolerance, "{:.0e}") for method, tolerance in product(SOLVERS, tried.tolerances)]
        settings += [(EULER, step_s, "{:.0e} s") for step_s in tried.euler_steps_s]
        runs: list[tuple[str, str, Callable[[], Any]]] = [(EXACT, "", partial(relax, TIME_S, ELASTIC, prony))]
        runs += [
            (method, shown.format(of), partial(integrate, prony, method, of, tried.calls_max_n))
            for method, of, shown in settings
        ]
        for method, setting, run in runs:
            error = error_of(run, truth)
            seconds = None if error is None else median_s(run, repeats_n)
            yield Row(f"relaxation, stiffness {ratio:.0e}", method, setting, error, seconds=seconds)


def error_of(run: Callable[[], Float[np.ndarray, " u"]], truth: Float[np.ndarray, " u"]) -> float | None:
    """Return the relative rms error of an integrator, or None if it failed or diverged."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            error = norm_error(run(), truth)
    except Failed:
        return None
    return error if error < 1 else None  # an error of 1 is as large as the force


def stiff(ratio: float) -> Prony:
    """Return the skin's relaxation with another ratio of the slowest to the fastest relaxation time; really 1e7."""
    slowest_s, fastest_s = SKIN_RELAXATION.tau_s.max(), SKIN_RELAXATION.tau_s.min()
    power = np.log(ratio) / np.log(slowest_s / fastest_s)
    return Prony(slowest_s * (SKIN_RELAXATION.tau_s / slowest_s) ** power, SKIN_RELAXATION.share)


def integrate(prony: Prony, method: str, setting: float, calls_max_n: int) -> Float[np.ndarray, " u"]:
    """Integrate the states of the relaxation piece by piece; return the relaxed force at `TIME_S`."""
    state, found, calls_n = np.zeros_like(prony.tau_s), [0.0], 0
    jacobian = np.diag(-1 / prony.tau_s)
    for length_s, change, elastic in zip(np.diff(TIME_S), np.diff(ELASTIC), ELASTIC[1:], strict=True):
        driven = prony.share * change / length_s

        def rates(_: float, state: Any, driven: Any = driven) -> Any:
            nonlocal calls_n
            calls_n += 1
            if calls_n > calls_max_n:
                raise Failed
            return driven - state / prony.tau_s

        if method == EULER:
            steps_n = ceil(length_s / setting - 1e-9)
            for _ in range(steps_n):
                state = state + length_s / steps_n * rates(0.0, state)
        else:
            options = {"jac": lambda _, __: jacobian} if method in IMPLICIT else {}
            tolerances = {"rtol": setting, "atol": ATOL * setting}
            solution = solve_ivp(rates, (0.0, length_s), state, method=method, **tolerances, **options)
            if not solution.success:
                raise Failed
            state = solution.y[:, -1]
        found.append((1 - prony.share.sum()) * elastic + state.sum())
    return np.array(found)


def hereditary(
    time_s: Float[np.ndarray, " t"], elastic: Float[np.ndarray, " t"], prony: Prony
) -> Float[np.ndarray, " t"]:
    """Return the relaxed force at each time, from the hereditary integral of Lee & Radok with 50 digits.

    The integrand is relaxation(t - s) d elastic(s), over all earlier times s. Between two successive times, the elastic
    force is linear, so that the integral has a closed form.
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


# Training and adaptation ------------------------------------------------------------------------------------------


def study_training(
    settings: Settings, section: AccuracyAndCost, indentations: Path, folds: Path, pretrained: Path
) -> Iterator[Row]:
    """Train and adapt networks with several numbers of steps, and score them on the first held-out board."""
    data, adapt = read_data(settings, indentations, folds), settings.section(Adaptations, "adapt")
    fold, networks = data.folds_of("lobo")[0], read_pretrained(pretrained)
    recipe, adaptation = settings.section(Training, "train_multi").recipes[HEADLINE], adapt.recipes[HEADLINE]
    jobs: dict[tuple[str, int], list[TrainingJob]] = {}
    for steps_n in section.training_steps_n:
        shorter = Training(recipes={HEADLINE: recipe.model_copy(update={"steps_n": steps_n})}, seeds_n=1)
        jobs["training", steps_n] = make_jobs(data, shorter, [fold])
    for steps_n in section.adaptation_steps_n:
        named = HEADLINE, adaptation.model_copy(update={"steps_n": steps_n})
        adapting = adaptation_jobs(data, fold, named, networks, experiment="adapt", pokes_n=adapt.pokes_n)
        jobs["adaptation", steps_n] = [job for job in adapting if job.seed_i == 0]
    results = iter(train_jobs(data, [job for of_steps in jobs.values() for job in of_steps], "accuracy_and_cost"))
    for (study, steps_n), of_steps in jobs.items():
        trained = [next(results) for _ in of_steps]
        true = data.rows.target[np.concatenate([job.test for job in of_steps])]
        error = score(true, np.concatenate([result.predicted for result in trained]))["mse_xy_mm2"]
        seconds = float(np.median([result.seconds for result in trained]))
        yield Row(study, "network", f"{steps_n} steps", error, "mm²", seconds)


# Neglected terms --------------------------------------------------------------------------------------------------

# Terms that a protocol may leave out, with assumed sizes. Friction is not listed, because it acts only in drags.
TERMS = {
    "ageing": Terms(ageing=Ageing(settling=0.10, ageing=0.01, fading_per_decade=0.005, wandering_uT=0.2)),
    "relaxation": Terms(relaxation=Relaxation(approach_s=0.5, hold_s=0.5)),
    "memory": Terms(memory=Memory(share=(0.11, 0.1), tau_s=(5.0, 60.0), contact_s=5.0, rest_s=1.0)),
}
WARMER_K = 1.0  # rise of the skin's temperature
PLACES_M = ((4e-3, 2e-3), (-6e-3, 4e-3))  # presses between middle and edge, and near the edge
BOXES = Quadrature(1.5e-3, 3)  # boxes of magnetic powder


def neglected_terms(simulation: SimulationSettings, seed: int) -> Iterator[Row]:
    """Compute the errors of leaving out each term, on the first skin and with the presses of the main protocol."""
    kind, (board_name, skin_name) = simulation.main_boards, list_captures(simulation, MAIN)[0]
    board = draw_board(kind.design, simulation.spreads, seed=seed, name=board_name)
    rule = kind.quadrature.in_si()
    skin = draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin_name, rule=rule)
    plan = simulation.main.plan(rng_for(seed, "neglected terms"), kind.skin_mm)
    tip_m = milli * np.stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM, plan.depth_mm], axis=2)

    def respond(terms: Terms) -> Response:
        rng = rng_for(seed, "neglected terms", "walk")
        return simulate_response(board, skin, tip_m, tilt=plan.tilt, terms=terms, rng=rng)

    plain, found = respond(Terms()), {}
    for term, true in ((term, respond(terms)) for term, terms in TERMS.items()):
        found[term] = {
            "% of dB": 100 * norm_error(plain.change_T, true.change_T),
            "µT at rest": float(np.abs(true.rest_T[-1] - plain.rest_T[-1]).max() / micro),
            "% of the force": 100 * norm_error(plain.force_N[-1], true.force_N[-1]),
        }
    factor = float(aging.relative_remanence(np.array([WARMER_K]))[0])
    found["temperature"] = {
        f"% of dB at {WARMER_K:g} K": 100 * abs(1 / factor - 1),
        f"µT at rest at {WARMER_K:g} K": float(np.abs((factor - 1) * plain.rest_T).max() / micro),
    }
    deepest_m = float(tip_m[..., 2].max())
    if skin.base == "slipping":
        found["free edge"] = {"% of dB": free_edge_pct(board, skin, deepest_m)}
    pokes_m = np.array([(*place_m, deepest_m) for place_m in PLACES_M])
    found["own field of the powder"] = {"% of dB": own_field_pct(simulation.skin, board, skin, pokes_m)}
    for term, unit, error in ((term, *item) for term, errors in found.items() for item in errors.items()):
        simulated = term in simulation.main.terms
        yield Row("neglected term", term, "simulated" if simulated else "neglected", error, unit)


def free_edge_pct(board: Board, skin: Skin, depth_m: float) -> float:
    """Return the error of the infinite layer, from a disc of radius R with a free edge in plane stress.

    Material at radius r moves outwards by c / r in the infinite layer, and by c / r + c r / (3 R^2) in the disc.
    """
    [(_, before, after)] = moved_dipoles(skin, np.array([[*skin.seat_m, depth_m]]))
    offset_m, moved_m = (of[0][:, :2] - skin.seat_m for of in (before, after))
    far = np.argmax(np.hypot(*offset_m.T))
    growth_m2 = float((moved_m[far] ** 2).sum() - (offset_m[far] ** 2).sum())
    stretched_m = moved_m * (1 + growth_m2 / 6 / (min(skin.sides_m) / 2) ** 2) + skin.seat_m
    ended = np.column_stack([stretched_m, after[0][:, 2]]), after[1]
    found_T, truth_T = (change_of_field(before, of, board.chips_m) for of in (after, ended))
    return 100 * norm_error(found_T, truth_T)


def own_field_pct(design: SkinDesign, board: Board, skin: Skin, pokes_m: Float[np.ndarray, "n 3"]) -> float:
    """Return the error of magnetising powder without the field of the other powder, to first order."""
    rest = midpoints(skin.thickness_m, BOXES)
    b_T = magnet.array_field(rest.nodes_m, skin.thickness_m, design.polarity)
    sizes = {"saturation_T": design.saturation_T, "half_field_T": design.half_field_T}
    j_T, boxes_n = magnet.magnetise(b_T, **sizes), len(b_T)
    away_m = (rest.nodes_m[:, None] - rest.nodes_m).reshape(-1, 3)
    boxes_m = np.tile(box_m(skin.thickness_m, BOXES), (boxes_n**2, 1))
    own_T = magnet_cuboid_Bfield(away_m, boxes_m, np.tile(j_T, (boxes_n, 1))).reshape(boxes_n, boxes_n, 3).sum(axis=1)
    with_own_T = magnet.magnetise(b_T + own_T - j_T, **sizes)  # the field that magnetises the powder is mu0 H = B - J
    nodes_m = rest.nodes_m + np.append(skin.seat_m, 0.0)
    moments = (magnet.moments(j, rest.volumes_m3) for j in (j_T, with_own_T))
    skins = (replace(skin, nodes_m=nodes_m, moments_A_m2=moments_A_m2) for moments_A_m2 in moments)
    return 100 * norm_error(*(changes_of_field(board, of, pokes_m)[1] for of in skins))


# Figure -----------------------------------------------------------------------------------------------------------

SHOWN_MIN = 1e-16  # smaller errors are drawn at this value, because a logarithmic axis cannot show 0


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw error against run time, one panel per study; empty if `numbers`, which is from a run, has no times."""
    rows = [row for row in numbers["rows"] if row.get("seconds") is not None]
    studies = list(dict.fromkeys(row["study"] for row in rows))
    if not studies:
        return {}
    with drawing(0.4 + 2.5 * len(studies), f"Error against run time ({source})") as figure:
        panels = figure.subplots(len(studies), 1, squeeze=False)[:, 0]
        for axes, study in zip(panels, studies, strict=True):
            _panel(axes, [row for row in rows if row["study"] == study])
            for row in numbers["rows"]:
                if (row["study"], row["method"]) == (study, REFERENCE):
                    axes.axhline(row["error"], color="0.5", linestyle=":", label=row["setting"])
                    axes.axhline(ERROR_MAX, color="0.3", linestyle="--", label=f"limit {ERROR_MAX:.0%}")
            axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.28), ncols=2)
        return {"accuracy_and_cost.svg": svg(figure)}


def _panel(axes: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    unit = "relative error" if rows[0]["unit"] == "1" else f"MSE_xy / {rows[0]['unit']}"
    axes.set(xscale="log", yscale="log", xlabel="run time / ms", ylabel=unit, title=rows[0]["study"])
    for method in dict.fromkeys(row["method"] for row in rows):
        points = sorted((1e3 * row["seconds"], max(row["error"], SHOWN_MIN)) for row in rows if row["method"] == method)
        axes.plot(*zip(*points, strict=True), label=method)
