"""Simulate 1 to 256 workers from measured times and sizes: where more workers stop helping, and why.

Reads the measurements of cluster.py and the times of each stage's trainings (reports/<scene>/provenance.json); writes a
table and a figure. The simulation is event by event: one client sends tasks one after another over one network, each
worker reads the rows once, and tasks take as long as those of the stages, with the measured spread.
"""

import heapq
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from reskin.models.runner import STACK_N
from reskin.seeds import rng_for
from tests.benchmarks.steps import ROOT

WORKERS_N = (1, 2, 4, 8, 16, 32, 64, 128, 256)
NETWORK_bytes_s = 1.25e8  # assumed: 1 Gbit/s, shared by all workers
WIDE_N = 10_000  # tasks of a sweep that is wide enough for any of these


@dataclass(frozen=True)
class Measurements:
    """Of the cluster test: seconds of single tasks, of the sweep on one and two processes, of the engine's parts."""

    task_s: tuple[float, ...]  # of CPU
    processes_s: tuple[float, float]
    call_s: float  # a call that does nothing, one after another
    connect_s: float  # of a stage to a cluster whose workers have loaded their libraries
    rows_bytes: float  # what each worker reads once
    task_bytes: float  # what comes to a worker for each task, all included


@dataclass(frozen=True)
class Sweep:
    """Trainings of a stage: how many tasks, and the mean seconds of one."""

    tasks_n: int
    task_s: float


def simulate(sweep: Sweep, workers_n: int, of: Measurements, spread: Sequence[float]) -> float:
    """Give the seconds of a sweep on so many workers."""
    rng = rng_for(0, "scaling", str(sweep.tasks_n))
    tasks_s = sweep.task_s * rng.choice(np.asarray(spread), sweep.tasks_n)
    free_s, rows_there = [(of.connect_s, i) for i in range(workers_n)], set[int]()
    handed_s = carried_s = of.connect_s
    end_s = 0.0
    for task_s in tasks_s:
        at_s, worker = heapq.heappop(free_s)
        handed_s = max(handed_s, at_s) + of.call_s
        load_bytes = of.task_bytes + (0.0 if worker in rows_there else of.rows_bytes)
        rows_there.add(worker)
        carried_s = max(carried_s, handed_s) + load_bytes / NETWORK_bytes_s
        done_s = carried_s + task_s
        end_s = max(end_s, done_s)
        heapq.heappush(free_s, (done_s, worker))
    return end_s


def sweeps_of(scene: str) -> tuple[list[Sweep], float]:
    """Read what each stage's trainings took, and the seconds of all other stages."""
    stages = json.loads((ROOT / f"reports/{scene}/provenance.json").read_text())["runtime"]["stages"].values()
    sweeps, rest_s = [], 0.0
    for stage in stages:
        if trainings_n := stage["trainings_n"]:
            tasks_n = math.ceil(trainings_n / STACK_N["cpu"])
            sweeps.append(Sweep(tasks_n, stage["computed_s"] / tasks_n))
        else:
            rest_s += stage["computed_s"]
    return sweeps, rest_s


def write_scaling(of: Measurements, folder: Path) -> None:
    """Write the table and the figure, and the measurements that they rest on."""
    spread = np.asarray(of.task_s) / np.mean(of.task_s)
    paper, rest_s = sweeps_of("paper")
    largest = max(paper, key=lambda sweep: sweep.tasks_n)
    wide = Sweep(WIDE_N, largest.task_s)
    quick, quick_rest_s = sweeps_of("quick")
    cases = {
        f"a sweep of {WIDE_N:,} tasks": ([wide], 0.0),
        f"largest sweep of `paper`, {largest.tasks_n} tasks": ([largest], 0.0),
        "all trainings of `paper`": (paper, 0.0),
        "`paper` in full": (paper, rest_s),
        "`quick` in full": (quick, quick_rest_s),
    }

    def total_s(sweeps: Sequence[Sweep], rest_s: float, workers_n: int, at: Measurements) -> float:
        return rest_s + sum(simulate(sweep, workers_n, at, spread) for sweep in sweeps)

    alone = {name: total_s(*case, 1, replace(of, connect_s=0.0)) for name, case in cases.items()}
    faster = {
        name: [alone[name] / total_s(*case, workers_n, of) for workers_n in WORKERS_N] for name, case in cases.items()
    }
    free = replace(of, call_s=0.0, connect_s=0.0, task_bytes=0.0, rows_bytes=0.0)
    cost = {
        name: 100 * (1 - total_s(*case, WORKERS_N[-1], free) / total_s(*case, WORKERS_N[-1], of))
        for name, case in cases.items()
    }
    rows = [
        f"| {n} | " + " | ".join(f"{faster[name][i]:.1f}" for name in cases) + " |" for i, n in enumerate(WORKERS_N)
    ]
    text = [
        "`make cluster-test`: speed-up over one worker, simulated from measured times and sizes.", "",
        "| workers | " + " | ".join(cases) + " |", "|---" * (len(cases) + 1) + "|", *rows, "",
        *explain(of, paper, rest_s, largest, cost), "", "![Speed-up against workers](scaling.svg)", "",
    ]  # fmt: skip
    (folder / "scaling.md").write_text("\n".join(text))
    draw(faster, folder / "scaling.svg")


def explain(
    of: Measurements, paper: Sequence[Sweep], rest_s: float, largest: Sweep, cost: dict[str, float]
) -> list[str]:
    """Say what was measured, and what bounds the speed-up."""
    one_s, two_s = of.processes_s
    work_s = sum(sweep.tasks_n * sweep.task_s for sweep in paper)
    counts = ", ".join(str(sweep.tasks_n) for sweep in sorted(paper, key=lambda sweep: -sweep.tasks_n))
    mean_s, sd_s = np.mean(of.task_s), np.std(of.task_s)
    lines = [
        f"Measured, sweep of {len(of.task_s) + 1} tasks: one process {one_s:.1f} s, two {two_s:.1f} s, "
        f"{one_s / two_s:.2f} times as fast, at a load of {os.getloadavg()[0]:.0f} on "
        f"{os.cpu_count()} cores; a task {mean_s:.2f} s of CPU (sd {100 * sd_s / mean_s:.0f} %).",
        f"Measured, engine: {1e3 * of.call_s:.1f} ms a task, {of.connect_s:.1f} s for a stage to connect, "
        f"{of.task_bytes / 1e3:.1f} kB to a worker for a task, {of.rows_bytes / 1e6:.1f} MB of rows once a worker. "
        "Assumed: 1 Gbit/s for all.",
        f"The number of tasks bounds it: stages of `paper` have {counts} (three trainings each) and run one after "
        "another; workers beyond a stage's tasks have nothing to do, and its last round is seldom full.",
        f"Then what is no training: {rest_s:.0f} s of `paper`'s {rest_s + work_s:.0f} s, counted here as the work of "
        f"one process, allow at most {(rest_s + work_s) / rest_s:.0f} times.",
        f"The engine does not: with 256 workers it costs {cost['`paper` in full']:.1f} % of the time of `paper`. "
        f"Handing out a task in {1e3 * of.call_s:.1f} ms feeds about {largest.task_s / of.call_s:,.0f} workers with "
        f"tasks of {largest.task_s:.0f} s.",
    ]
    return [f"- {line}" for line in lines]


def draw(faster: dict[str, list[float]], file: Path) -> None:
    with rc_context({"svg.hashsalt": "reskin", "svg.fonttype": "none"}):
        figure = Figure(figsize=(6.5, 4.2), layout="constrained")
        axes = figure.subplots()
        axes.plot(WORKERS_N, WORKERS_N, color="0.7", linestyle=":", label="as many times as workers")
        for (name, values), marker in zip(faster.items(), "osd^v", strict=True):
            axes.plot(WORKERS_N, values, marker=marker, markersize=4, label=name.replace("`", ""))
        axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="speed-up", xticks=WORKERS_N)
        axes.set_xticklabels([str(n) for n in WORKERS_N])
        axes.minorticks_off()
        axes.legend(frameon=False, fontsize=8)
        figure.savefig(file, metadata={"Date": None})
