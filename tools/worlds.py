"""Show which properties of simulated skins determine the scores of the paper's table 2 (not in the paper).

The networks of table 2 are trained and tested in several worlds. A world is a simulation that differs from the default
simulation in one respect, such as how differently skins slide. The worlds are in tools/worlds.yaml. All worlds have the
same presses, noise, folds and random draws of skins. Run in the checkout:

    python -m tools.worlds --figure docs/images/worlds.svg
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field
from scipy.constants import micro, milli

from pipeline.executors import make_executor
from pipeline.paper import TABLE_2
from pipeline.plot import drawing, svg
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
from reskin.config import Strict, parse, read_yaml
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
FORCE_TICKS_N2 = (0.2, 0.5, 1, 2)
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")
# For each row of table 2, the experiment whose networks the row scores.
ROWS = {"transfer": "single", "lobo": "multi", "triplet": "triplet", "adapt": "adapted"}
ROW_NAMES = {"single": "one skin", "multi": "many skins", "triplet": "triplet loss", "adapted": "adapted"}


class Residual(Strict):
    """A smooth random error that is added to the simulated changes of field."""

    length_mm: float  # correlation length along x and y
    length_log_N: float  # correlation length along the logarithm of the force
    own_share: float  # fraction of the error's variance that is drawn for each skin; the rest is the same on all skins


class Changes(Strict):
    """What a world changes: settings of sections `skin` and `spreads`, and the rms size of the error / |dB|."""

    skin: dict[str, float] = Field(default_factory=dict)
    spreads: dict[str, float] = Field(default_factory=dict)
    residual: float = 0.0


@dataclass(frozen=True)
class World:
    """A simulation, and the rms size, relative to |dB|, of the error that is added to its changes of field."""

    name: str
    simulation: SimulationSettings
    residual: float = 0.0


def world_of(simulation: SimulationSettings, name: str, changes: Changes) -> World:
    """Return a simulation with the changes of a world; unknown settings raise ParamsError."""
    changed = {
        key: parse(type(section), section.model_dump(mode="json") | update, f"{FILE.name}: {name}: {key}")
        for key, section, update in (
            ("skin", simulation.skin, changes.skin),
            ("spreads", simulation.spreads, changes.spreads),
        )
    }
    return World(name, simulation.model_copy(update=changed), changes.residual)


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


def draw(table: pd.DataFrame) -> str:
    """Draw accuracy and MSE_F of each row of table 2 in each world, and of the paper; return the figure as SVG."""
    labels = {"accuracy_pct": "within 1 mm / %", "mse_f_N2": "MSE_F / N²"}
    names = list(table["world"].unique())
    with drawing(1.2 + 0.45 * len(names), "Rows of table 2 in simulated worlds and in the paper") as figure:
        panels = figure.subplots(1, len(labels), sharey=True)
        for axes, (metric, label) in zip(panels, labels.items(), strict=True):
            for shift, (row, of_row) in enumerate(table.groupby("row", sort=False)):
                y = [names.index(name) + 0.15 * (shift - 1.5) for name in of_row["world"]]
                axes.plot(of_row[metric], y, "o", label=ROW_NAMES[str(row)])
            axes.set(xlabel=label, yticks=range(len(names)), yticklabels=[fill(name, 20) for name in names])
        panels[1].set(xscale="log", xticks=FORCE_TICKS_N2, xticklabels=map(str, FORCE_TICKS_N2))
        panels[1].minorticks_off()
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        return svg(figure)


def main() -> None:
    """Print and draw the mean scores of table 2 in each world: over pairs of skins, or over held-out skins."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", help="names of worlds; default: all worlds")
    parser.add_argument("--steps-n", type=int, help="number of training steps, for a quick trial")
    parser.add_argument("--figure", type=Path, help="file for the figure, such as docs/images/worlds.svg")
    arguments = parser.parse_args()
    preload_training()
    content = read_yaml(FILE)
    if arguments.steps_n is not None:
        for name in ("train_single", "train_multi", "train_triplet", "adapt"):
            content[name]["steps_n"] = arguments.steps_n
    known = {name: parse(Changes, changes, f"{FILE.name}: {name}") for name, changes in content.pop("worlds").items()}
    residual = parse(Residual, content.pop("residual"), f"{FILE.name}: residual")
    if unknown := set(arguments.worlds or ()) - set(known):
        parser.error(f"unknown worlds {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    settings = Settings("worlds", str(FILE), content, read_shared_files())
    nominal, scores = simulation_settings(settings), []
    for name in arguments.worlds or known:
        world = world_of(nominal, name, known[name])
        by_skin = (skin_rows(world, residual, settings.seed, *names) for names in list_captures(world.simulation, MAIN))
        rows = reduce(stack, by_skin)
        folds = draw_folds(rows, ("transfer", "lobo"), settings.section(Split, "split"), settings.seed)
        data = SceneData("worlds", settings, rows, folds)
        scores += [{"world": name} | row for row in scores_of(data)]
    means = pd.DataFrame(scores).groupby(["world", "row"], sort=False)[list(METRICS)].mean().reset_index()
    paper = [{"world": "paper", "row": row, **{name: TABLE_2[row][name][0] for name in METRICS}} for row in TABLE_2]
    table = pd.concat([means, pd.DataFrame(paper)], ignore_index=True)
    print(table.to_string(index=False, float_format="{:.3g}".format))
    if arguments.figure is not None:
        arguments.figure.write_text(draw(table), encoding="utf-8")


if __name__ == "__main__":  # worker processes import this module
    main()
