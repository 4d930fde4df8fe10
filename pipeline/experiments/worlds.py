"""Find which properties of simulated skins determine the scores of the paper's table 2 (not in the paper).

The networks of table 2 are trained and tested in several worlds. A world is a simulation whose settings differ from the
settings of the scene in one factor. Two of the factors are the variation of skins and the error of the simulation.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field
from scipy.constants import micro, milli

from pipeline.experiments.results import write_results
from pipeline.formatting import COLUMNS, TITLES, show, tabulate
from pipeline.paper import TABLE_2
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.scores import by_skin, rows_of_cards, select, whole
from pipeline.settings import Adaptations, Settings, Training
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from pipeline.statistics import over_boards, over_pairs, records
from pipeline.training.jobs import (
    PretrainedNetworks,
    SceneData,
    adaptation_jobs,
    make_jobs,
    preload_training,
    scored_card,
    train_jobs,
    write_timings,
)
from reskin.config import Strict
from reskin.data.rows import Rows, stack
from reskin.data.splits import Fold, Split, draw_folds
from reskin.metrics import METRICS
from reskin.models.job import Pretrained, TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.physics.board import draw_board
from reskin.physics.skin import changes_of_field, draw_skin, forces
from reskin.seeds import rng_for
from reskin.simulation.capture import list_captures
from reskin.simulation.rig import actual_positions, read_force
from reskin.simulation.settings import MAIN, SimulationSettings

WAVES_N = 48  # the smooth random error is a sum of this number of random cosines
DEFAULT = "default"
Size = Annotated[float, Field(ge=0, le=2)]
Sizes = Annotated[tuple[Size, ...], Field(min_length=1)]
# For each row of table 2, the experiment whose networks the row scores.
EXPERIMENTS = {"single": "transfer", "multi": "lobo", "triplet": "triplet", "adapted": "adapt"}


class Residual(Strict):
    """Sizes and correlation lengths of a smooth random error that is added to the simulated changes of field."""

    sizes: Sizes  # rms sizes relative to |dB|, one world per size
    length_mm: Annotated[float, Field(gt=0, le=50)]  # correlation length along x and y
    length_log_N: Annotated[float, Field(gt=0, le=10)]  # correlation length along the logarithm of the force
    # Fraction of the error's variance that is drawn for each skin; the rest of the error is the same on all skins.
    own_share: Annotated[float, Field(ge=0, le=1)]


class Worlds(Strict):
    """Settings section `worlds`: the values of each factor, one world per value.

    In each world, all other factors have the values of the scene.
    """

    residual: Residual
    skin_modulus: Sizes  # values of spreads.skin_modulus
    amplitude_and_gap: Sizes  # factors by which spreads.skin_amplitude and spreads.board_gap are multiplied
    friction: Sizes  # values of skin.hold.friction, the friction between skin and tip


@dataclass(frozen=True)
class World:
    """One world.

    - factor, value: the factor that differs from the scene, and the value that it has in this world.
    - simulation: settings of the simulation.
    - residual: rms size, relative to |dB|, of the error that is added to the simulated changes of field.
    """

    factor: str
    value: float
    simulation: SimulationSettings
    residual: float = 0.0

    @property
    def name(self) -> str:
        """Name of the world in the names of folds and files."""
        return f"{self.factor}-{self.value:g}"


def worlds_of(simulation: SimulationSettings, section: Worlds) -> list[World]:
    """Return all worlds. The first is the default world, which has the scene's settings."""
    spreads, hold = simulation.spreads, simulation.skin.hold
    listed = [World(DEFAULT, 1.0, simulation)]
    listed += [World("residual", size, simulation, size) for size in section.residual.sizes if size > 0]
    for sd in section.skin_modulus:
        if sd != spreads.skin_modulus:
            changed = spreads.model_copy(update={"skin_modulus": sd})
            listed.append(World("skin_modulus", sd, simulation.model_copy(update={"spreads": changed})))
    for times in section.amplitude_and_gap:
        if times != 1:
            scaled = {name: times * getattr(spreads, name) for name in ("skin_amplitude", "board_gap")}
            changed = spreads.model_copy(update=scaled)
            listed.append(World("amplitude_and_gap", times, simulation.model_copy(update={"spreads": changed})))
    for friction in section.friction:
        if hold is not None and friction != hold.friction:
            skin = simulation.skin.model_copy(update={"hold": hold.model_copy(update={"friction": friction})})
            listed.append(World("friction", friction, simulation.model_copy(update={"skin": skin})))
    return listed


def draw_smooth_error(
    points: Float[np.ndarray, "n 3"], channels_n: int, residual: Residual, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw a smooth random function of variance 1 for each channel, and evaluate it at `points`.

    The columns of `points` are x and y in mm, and the logarithm of the force in N.
    """
    lengths = np.array([residual.length_mm, residual.length_mm, residual.length_log_N])
    waves = rng.standard_normal((3, WAVES_N)) / lengths[:, None]
    phase = rng.uniform(0, 2 * np.pi, WAVES_N)
    amplitude = rng.standard_normal((WAVES_N, channels_n)) * np.sqrt(2 / WAVES_N)
    return np.cos(points @ waves + phase) @ amplitude


def with_residual(
    change_uT: Float[np.ndarray, "n ch"],
    points: Float[np.ndarray, "n 3"],
    size: float,
    residual: Residual,
    seed: int,
    skin: str,
) -> Float[np.ndarray, "n ch"]:
    """Return a skin's changes of field plus a smooth random error whose rms is `size` times |dB|.

    The error is a sum of two components: one is the same for all skins, and the other is drawn for this skin.
    `residual.own_share` is the fraction of the variance that belongs to the second component.
    """
    if size == 0:
        return change_uT
    channels_n = change_uT.shape[1]
    shared = draw_smooth_error(points, channels_n, residual, rng_for(seed, "worlds", "residual"))
    specific = draw_smooth_error(points, channels_n, residual, rng_for(seed, "worlds", "residual", skin))
    unit = np.sqrt(1 - residual.own_share) * shared + np.sqrt(residual.own_share) * specific
    length_uT = np.linalg.norm(change_uT, axis=1, keepdims=True)
    return change_uT + size * length_uT / np.sqrt(channels_n) * unit


def rows_of(world: World, section: Worlds, seed: int) -> Rows:
    """Simulate the main protocol on every skin of a world; return the input rows and labels of all skins."""
    by_skin = [_skin_rows(world, section, seed, board, skin) for board, skin in list_captures(world.simulation, MAIN)]
    rows = by_skin[0]
    for skin_rows in by_skin[1:]:
        rows = stack(rows, skin_rows)
    return rows


def _skin_rows(world: World, section: Worlds, seed: int, board_name: str, skin_name: str) -> Rows:
    simulation, rig, chip = world.simulation, world.simulation.rig, world.simulation.chip
    kind = simulation.main_boards
    rng = rng_for(seed, "worlds", board_name, skin_name)  # every world has the same presses and noise
    board = draw_board(kind.design, simulation.spreads, seed=seed, name=board_name)
    rule = kind.quadrature.in_si()
    skin = draw_skin(simulation.skin, simulation.spreads, seed=seed, name=skin_name, rule=rule, sides_m=kind.skin_m)
    plan = simulation.main.plan(rng, kind.skin_mm)
    tip_m = ((actual_positions(plan, rig, rng) - (*plan.centre_mm, 0)) * milli)[:, 0]
    tip_m[:, :2] += rig.place_offset_sd_mm * milli * rng_for(seed, "rig", board_name).standard_normal(2)
    _, change_T = changes_of_field(board, skin, tip_m)
    read_T = np.einsum("kij,nkj->nki", board.sensitivity @ board.turn.transpose(0, 2, 1), change_T)
    force_N = forces(skin, tip_m[:, 2])
    points = np.column_stack([tip_m[:, :2] / milli, np.log(np.maximum(force_N, rig.force_noise_N))])
    change_uT = with_residual(
        read_T.reshape(len(tip_m), -1) / micro, points, world.residual, section.residual, seed, skin_name
    )
    n, channels_n = change_uT.shape
    noise_uT = np.tile([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT], channels_n // 3)
    noload_uT = noise_uT / np.sqrt(rig.noload_frames_n) * rng.standard_normal((n, 1, channels_n))
    reading_uT = noise_uT * rng.standard_normal((n, rig.readings_n, channels_n))
    db_uT = (change_uT[:, None] + reading_uT - noload_uT).reshape(-1, channels_n)
    tip_N = np.column_stack([np.zeros((n, 2)), force_N])
    read_N, _ = read_force(tip_N, noise_N=rig.force_noise_N, rng=rng)
    target = np.column_stack([plan.x_mm[:, 0], plan.y_mm[:, 0], read_N[:, 2]]).astype(np.float32)
    kept = np.repeat(read_N[:, 2] >= 0, rig.readings_n)  # excludes negative forces, as `Selection` does
    rows_n = n * rig.readings_n
    return Rows(
        capture=np.full(rows_n, skin_name)[kept], board=np.full(rows_n, board_name)[kept],
        skin=np.full(rows_n, skin_name)[kept], db_uT=db_uT.astype(np.float32)[kept],
        target=np.repeat(target, rig.readings_n, axis=0)[kept],
        pass_i=np.repeat(plan.pass_i.astype(np.int32), rig.readings_n)[kept],
        indentation=np.repeat(np.arange(n), rig.readings_n)[kept], dropped={},
    )  # fmt: skip


def folds_of(rows: Rows, split: Split, seed: int, world: str, before_n: int) -> Iterator[Fold]:
    """Draw the folds of one world, whose names begin with the name of the world.

    `rows` are the rows of this world. The row numbers in folds refer to the concatenated rows of all worlds, in which
    `before_n` rows of earlier worlds precede `rows`.
    """
    for fold in draw_folds(rows, ("transfer", "lobo"), split, seed):
        sides = [side + before_n for side in (fold.train, fold.test, fold.pool)]
        yield Fold(fold.experiment, f"{world}.{fold.name}", *sides)


def worlds(settings: Settings, section: Worlds, results: Path) -> None:
    """Train the networks of table 2 in every world; score each network in the world in which it was trained."""
    preload_training()
    split = settings.section(Split, "split")
    listed = worlds_of(simulation_settings(settings), section)
    rows, folds = None, []
    for i, world in enumerate(listed):
        world_rows = rows_of(world, section, settings.seed)
        folds += list(folds_of(world_rows, split, settings.seed, world.name, 0 if rows is None else len(rows)))
        rows = world_rows if rows is None else stack(rows, world_rows)
        say(f"{settings.scene} worlds: {i + 1} of {len(listed)} worlds simulated ({world.name})")
    assert rows is not None, "the default world always exists"
    data = SceneData(settings.scene, settings, rows, folds)
    cards = _train(data, listed)
    numbers = {"by_world": [_scored(cards, world) for world in listed], **_constants(section, data, listed)}
    write_results(results, numbers, {})


def _train(data: SceneData, listed: Sequence[World]) -> list[dict[str, Any]]:
    """Train the networks of all rows of table 2, and return their model cards.

    Single, multi and triplet networks are trained; the triplet networks are then adapted.
    """
    lobo = data.folds_of("lobo")
    jobs = make_jobs(data, data.settings.section(Training, "train_single"), data.folds_of("transfer"))
    jobs += make_jobs(data, data.settings.section(Training, "train_multi"), lobo)
    jobs += make_jobs(data, data.settings.section(Training, "train_triplet"), lobo, experiment="triplet")
    trained = train_jobs(data, jobs, "worlds")
    starts: PretrainedNetworks = {
        (job.recipe_name, job.fold, job.seed_i): Pretrained(result.key, result.weights, result.scaler)
        for job, result in zip(jobs, trained, strict=True)
        if job.experiment == "triplet"
    }
    adapt = data.settings.section(Adaptations, "adapt")
    adapted: list[TrainingJob] = [
        job
        for fold in lobo
        for job in adaptation_jobs(
            data, fold, (HEADLINE, adapt.recipes[HEADLINE]), starts, experiment="adapt", pokes_n=adapt.pokes_n
        )
    ]
    trained = [*trained, *train_jobs(data, adapted, "worlds")]
    write_timings(data.scene, "worlds", [*jobs, *adapted], trained)
    return [{**scored_card(data, job, result)} for job, result in zip([*jobs, *adapted], trained, strict=True)]


def _scored(cards: Sequence[dict[str, Any]], world: World) -> dict[str, Any]:
    """Return the scores of the rows of table 2 in one world."""
    world_cards = [
        card | {"fold": card["fold"].removeprefix(f"{world.name}.")}
        for card in cards
        if card["fold"].startswith(f"{world.name}.") and card["recipe_name"] == HEADLINE
    ]
    table, scores = rows_of_cards(world_cards), {}
    for row, experiment in EXPERIMENTS.items():
        rows = select(table, question=experiment)
        boards = by_skin(rows).groupby("board")[list(METRICS)].mean() if row == "single" else None
        boards = whole(rows).groupby("board")[list(METRICS)].mean() if boards is None else boards
        scored = over_pairs(rows) if row == "single" else over_boards(rows)
        scores[row] = {name: scored[name] for name in METRICS if name in scored} | {"by_board": records(boards)}
    return {"factor": world.factor, "value": world.value, **scores}


def _constants(section: Worlds, data: SceneData, listed: Sequence[World]) -> dict[str, Any]:
    """Return the settings of the default world, and the numbers of rows, folds and training steps."""
    first = listed[0].simulation
    return {
        "residual_length_mm": section.residual.length_mm, "residual_own_share": section.residual.own_share,
        "skin_modulus": first.spreads.skin_modulus,
        "friction": first.skin.hold.friction if first.skin.hold is not None else 0.0,
        "rows_n": len(data.rows), "folds_n": len(data.folds_of("lobo")) // len(listed),
        "steps_n": data.settings.section(Training, "train_multi").recipes[HEADLINE].steps_n,
    }  # fmt: skip


DEFAULT_WORLD = "default"
FACTORS = {
    "residual": "error of the simulation, relative to |dB|",
    "skin_modulus": "spread of stiffness (sd of the logarithm)",
    "amplitude_and_gap": "spreads of amplitude and gap / default", "friction": "friction between skin and tip",
}  # fmt: skip
DRAWN = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
MEANING = (
    "A world is a simulation that differs from the default simulation in one factor. All worlds have the same "
    "indentations, noise and folds, and the same random draws of skins. Error of the simulation: a smooth random error "
    "that is added to the changes of field. Its rms size is given relative to |dB|. The largest size is the error of "
    "the simulation on recorded boards: the square root of (1 - explained), where `explained` is the fraction of "
    "|dB|² that the simulation explains (scene lab). The error is correlated over {residual_length_mm:g} mm, and "
    "{residual_own_share:.0%} of its variance is specific to a skin. The simulated skins of all other scenes have no "
    "such error. {folds_n} boards are held out in turn. One network is trained for each row of table 2, fold and "
    "world, for {steps_n} steps. The default world has the skins of table 2, but its own presses, without the effect "
    "of earlier presses on later ones. So its scores differ slightly from those of table 2."
)
# Values of two factors in the default world. The values of the other factors are in the experiment's numbers.
DEFAULTS = {"residual": 0.0, "amplitude_and_gap": 1.0}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the rows of table 2 for each world."""
    lines = [
        {"world": _describe(world), "row": TITLES[row], "source": source}
        | {title: show(world[row].get(metric)) for metric, title in COLUMNS.items()}
        for world in numbers["by_world"]
        for row in TABLE_2
    ]
    return {"worlds": tabulate(lines, meaning=MEANING.format(**numbers))}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the scores of the rows of table 2 against each factor, with the paper's values as dashed lines."""
    with drawing(11.0, 7.6) as figure:
        panels = figure.subplots(len(DRAWN), len(FACTORS), sharey="row", squeeze=False)
        for column, (factor, label) in enumerate(FACTORS.items()):
            results = _along(numbers, factor)
            for row, metric in enumerate(DRAWN):
                _draw(panels[row][column], results, metric, default=_default(numbers, factor))
            panels[-1][column].set_xlabel(label, fontsize=8)
        for row, metric in enumerate(DRAWN):
            panels[row][0].set_ylabel(COLUMNS[metric].replace(", ", " / "))
        handles = panels[0][0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
        title = f"Scores of table 2 in each world ({source}; dotted: default world, dashed: the paper's scores)"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        return {"worlds.svg": svg(figure)}


def _draw(axes: Any, results: Sequence[tuple[float, Mapping[str, Any]]], metric: str, *, default: float) -> None:
    values = [value for value, _ in results]
    for (row, paper), colour, marker in zip(TABLE_2.items(), COLOURS, MARKERS, strict=False):
        means = [world[row][metric]["mean"] for _, world in results]
        axes.plot(values, means, color=colour, marker=marker, markersize=5, linewidth=1.2, label=TITLES[row])
        axes.axhline(paper[metric][0], color=colour, linestyle="--", linewidth=0.8)
    axes.axvline(default, color="0.5", linestyle=":", linewidth=1, label="default")
    if metric != "accuracy_pct":
        axes.set_yscale("log")
    axes.grid(alpha=0.25)


def _along(numbers: Mapping[str, Any], factor: str) -> list[tuple[float, Mapping[str, Any]]]:
    """Return the values of a factor in ascending order, including the default, each with the results of its world."""
    worlds = [(world["value"], world) for world in numbers["by_world"] if world["factor"] == factor]
    default_world = next(world for world in numbers["by_world"] if world["factor"] == DEFAULT_WORLD)
    return sorted([*worlds, (_default(numbers, factor), default_world)], key=lambda pair: pair[0])


def _default(numbers: Mapping[str, Any], factor: str) -> float:
    return DEFAULTS[factor] if factor in DEFAULTS else float(numbers[factor])


def _describe(world: Mapping[str, Any]) -> str:
    return "default" if world["factor"] == DEFAULT_WORLD else f"{FACTORS[world['factor']]}: {world['value']:g}"
