"""Show which properties of simulated skins determine the scores of the paper's table 2 (not in the paper).

The networks of table 2 are trained and tested in several worlds. A world is a simulation that differs from the default
simulation in one factor, such as the spread of stiffness. The worlds are in tools/worlds.yaml. All worlds have the same
presses, noise, folds and random draws of skins. Run in the checkout:

    python -m tools.worlds --steps-n 20 --worlds default residual-0.42
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.constants import micro, milli

from pipeline.executors import make_executor
from pipeline.paper import TABLE_2
from pipeline.settings import Adaptations, Settings, Training, read_shared_files
from pipeline.simulation import simulation_settings
from pipeline.training.jobs import (
    CACHE,
    TRAINING_MODULE,
    SceneData,
    adaptation_jobs,
    make_jobs,
    preload_training,
    training_data,
)
from reskin.config import Strict, read_yaml
from reskin.data.rows import Rows, stack
from reskin.data.splits import Split, draw_folds
from reskin.metrics import score
from reskin.models.job import Pretrained, TrainingJob, TrainingResult
from reskin.models.recipe import HEADLINE
from reskin.models.runner import run_jobs
from reskin.physics.board import draw_board
from reskin.physics.skin import changes_of_field, draw_skin, forces
from reskin.seeds import rng_for
from reskin.simulation.capture import list_captures
from reskin.simulation.rig import actual_positions, read_force
from reskin.simulation.settings import MAIN, SimulationSettings

FILE = Path(__file__).with_suffix(".yaml")
WAVES_N = 48  # the smooth random error is a sum of this number of random cosines
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
# For each row of table 2, the experiment whose networks the row scores.
ROWS = {"transfer": "single", "lobo": "multi", "triplet": "triplet", "adapt": "adapted"}


class Residual(Strict):
    """Sizes and correlation lengths of a smooth random error that is added to the simulated changes of field."""

    sizes: tuple[float, ...]  # rms sizes relative to |dB|, one world per size
    length_mm: float  # correlation length along x and y
    length_log_N: float  # correlation length along the logarithm of the force
    own_share: float  # fraction of the error's variance that is drawn for each skin; the rest is the same on all skins


class Worlds(Strict):
    """Values of each factor, one world per value; in each world, all other factors have their default values."""

    residual: Residual
    skin_modulus: tuple[float, ...]  # values of spreads.skin_modulus
    amplitude_and_gap: tuple[float, ...]  # factors of spreads.skin_amplitude and spreads.board_gap
    friction: tuple[float, ...]  # values of skin.hold.friction, the friction between skin and tip


@dataclass(frozen=True)
class World:
    """A simulation, and the rms size, relative to |dB|, of the error that is added to its changes of field."""

    name: str
    simulation: SimulationSettings
    residual: float = 0.0


def worlds_of(simulation: SimulationSettings, section: Worlds) -> list[World]:
    """Return all worlds; the first is the default world."""
    spreads, hold = simulation.spreads, simulation.skin.hold
    worlds = [World("default", simulation)]
    worlds += [World(f"residual-{size:g}", simulation, size) for size in section.residual.sizes if size > 0]
    changed: dict[str, dict[str, float]] = {}
    for sd in section.skin_modulus:
        if sd != spreads.skin_modulus:
            changed[f"skin_modulus-{sd:g}"] = {"skin_modulus": sd}
    for times in section.amplitude_and_gap:
        if times != 1:
            scaled = {name: times * getattr(spreads, name) for name in ("skin_amplitude", "board_gap")}
            changed[f"amplitude_and_gap-{times:g}"] = scaled
    for name, values in changed.items():
        update = {"spreads": spreads.model_copy(update=values)}
        worlds.append(World(name, simulation.model_copy(update=update)))
    for friction in section.friction:
        if hold is not None and friction != hold.friction:
            skin = simulation.skin.model_copy(update={"hold": hold.model_copy(update={"friction": friction})})
            worlds.append(World(f"friction-{friction:g}", simulation.model_copy(update={"skin": skin})))
    return worlds


def draw_smooth_error(
    points: Float[np.ndarray, "n 3"], channels_n: int, residual: Residual, rng: np.random.Generator
) -> Float[np.ndarray, "n ch"]:
    """Draw a smooth random function of variance 1 per channel, and evaluate it at `points` (x mm, y mm, log of N)."""
    lengths = np.array([residual.length_mm, residual.length_mm, residual.length_log_N])
    waves = rng.standard_normal((3, WAVES_N)) / lengths[:, None]
    phase = rng.uniform(0, 2 * np.pi, WAVES_N)
    amplitude = rng.standard_normal((WAVES_N, channels_n)) * np.sqrt(2 / WAVES_N)
    return np.cos(points @ waves + phase) @ amplitude


def with_residual(
    change_uT: Float[np.ndarray, "n ch"], points: Float[np.ndarray, "n 3"], size: float, residual: Residual, seed: int,
    skin: str,
) -> Float[np.ndarray, "n ch"]:  # fmt: skip
    """Add to a skin's changes of field a smooth random error whose rms is `size` times |dB|."""
    channels_n = change_uT.shape[1]
    shared = draw_smooth_error(points, channels_n, residual, rng_for(seed, "worlds", "residual"))
    specific = draw_smooth_error(points, channels_n, residual, rng_for(seed, "worlds", "residual", skin))
    unit = np.sqrt(1 - residual.own_share) * shared + np.sqrt(residual.own_share) * specific
    return change_uT + size * np.linalg.norm(change_uT, axis=1, keepdims=True) / np.sqrt(channels_n) * unit


def skin_rows(world: World, residual: Residual, seed: int, board_name: str, skin_name: str) -> Rows:
    """Simulate the main protocol on a skin: each press alone, without effects of earlier presses; return the rows."""
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
    change_uT = with_residual(read_T.reshape(len(tip_m), -1) / micro, points, world.residual, residual, seed, skin_name)
    n, channels_n = change_uT.shape
    noise_uT = np.tile([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT], channels_n // 3)
    noload_uT = noise_uT / np.sqrt(rig.noload_frames_n) * rng.standard_normal((n, 1, channels_n))
    reading_uT = noise_uT * rng.standard_normal((n, rig.readings_n, channels_n))
    db_uT = (change_uT[:, None] + reading_uT - noload_uT).reshape(-1, channels_n)
    read_N, _ = read_force(np.column_stack([np.zeros((n, 2)), force_N]), noise_N=rig.force_noise_N, rng=rng)
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


def train(data: SceneData, jobs: list[TrainingJob]) -> list[TrainingResult]:
    """Run training jobs in two processes; results of earlier runs are taken from the cache."""
    with make_executor(imports=TRAINING_MODULE) as executor:
        return run_jobs(jobs, training_data(data), executor=executor, cache=Path(CACHE), log=print)


def scores_of(data: SceneData) -> Iterator[dict[str, Any]]:
    """Train the networks of all rows of table 2; yield the scores of each network on each tested skin."""
    sections = {name: data.settings.section(Training, f"train_{name}") for name in ("single", "multi", "triplet")}
    adapt, lobo = data.settings.section(Adaptations, "adapt"), data.folds_of("lobo")
    jobs = make_jobs(data, sections["single"], data.folds_of("transfer")) + make_jobs(data, sections["multi"], lobo)
    jobs += make_jobs(data, sections["triplet"], lobo, experiment="triplet")
    results = train(data, jobs)
    starts = {
        (job.recipe_name, job.fold, job.seed_i): Pretrained(result.key, result.weights, result.scaler)
        for job, result in zip(jobs, results, strict=True)
        if job.experiment == "triplet"
    }
    adapted = [
        job
        for fold in lobo
        for job in adaptation_jobs(
            data, fold, (HEADLINE, adapt.recipes[HEADLINE]), starts, experiment="adapt", pokes_n=adapt.pokes_n
        )
    ]
    for job, result in zip([*jobs, *adapted], [*results, *train(data, adapted)], strict=True):
        tested = data.rows.skin[job.test]
        for skin in np.unique(tested):
            own = tested == skin
            yield {"row": ROWS[job.experiment], **score(data.rows.target[job.test][own], result.predicted[own])}


def main() -> None:
    """Print the mean scores of table 2 in each world: over pairs of skins (row single), or over held-out skins."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", help="names of worlds, such as friction-0.35; default: all worlds")
    parser.add_argument("--steps-n", type=int, help="number of training steps, for a quick trial")
    arguments = parser.parse_args()
    preload_training()
    content = read_yaml(FILE)
    if arguments.steps_n is not None:
        for name in ("train_single", "train_multi", "train_triplet", "adapt"):
            content[name]["steps_n"] = arguments.steps_n
    settings = Settings("worlds", str(FILE), content, read_shared_files())
    section = settings.section(Worlds, "worlds")
    worlds = {world.name: world for world in worlds_of(simulation_settings(settings), section)}
    if unknown := set(arguments.worlds or ()) - set(worlds):
        parser.error(f"unknown worlds {', '.join(sorted(unknown))}; known: {', '.join(worlds)}")
    scores = []
    for name in arguments.worlds or worlds:
        world = worlds[name]
        by_skin = (
            skin_rows(world, section.residual, settings.seed, *names) for names in list_captures(world.simulation, MAIN)
        )
        rows = reduce(stack, by_skin)
        folds = draw_folds(rows, ("transfer", "lobo"), settings.section(Split, "split"), settings.seed)
        data = SceneData("worlds", settings, rows, folds)
        scores += [{"world": name} | row for row in scores_of(data)]
    table = pd.DataFrame(scores).groupby(["world", "row"], sort=False)[list(METRICS)].mean().reset_index()
    paper = [{"world": "paper", "row": row, **{name: TABLE_2[row][name][0] for name in METRICS}} for row in TABLE_2]
    print(pd.concat([table, pd.DataFrame(paper)]).to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":  # worker processes import this module
    main()
