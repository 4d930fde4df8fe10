"""Estimate the speed-up of training by 1 to 256 workers, and what limits it, by simulating the cluster.

The module uses the times and sizes measured by cluster.py, and the training times of each stage in
reports/<scene>/provenance.json. It writes a table and a figure. The discrete-event simulation makes three assumptions.
One client sends tasks one after another over a shared network. Each worker loads the training rows once. The time of a
task is the mean for its stage, multiplied by a ratio drawn from the measured task times.
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
WIDE_N = 10_000  # tasks in a hypothetical sweep that is large enough to occupy 256 workers


@dataclass(frozen=True)
class Measurements:
    """Times and sizes that the cluster test measured."""

    task_s: tuple[float, ...]  # CPU time of each task
    processes_s: tuple[float, float]  # time of the whole sweep in one process, and in two processes
    call_s: float  # overhead of a task: time per empty task, when empty tasks are sent one after another
    connect_s: float  # time to connect a stage to a cluster whose workers have already loaded the libraries
    rows_bytes: float  # size of the training rows, which each worker loads once
    task_bytes: float  # all bytes that a worker receives for a task, except the training rows


@dataclass(frozen=True)
class Sweep:
    """The training runs of a stage: number of tasks and mean seconds per task."""

    tasks_n: int
    task_s: float


def simulate(sweep: Sweep, workers_n: int, measured: Measurements, spread: Sequence[float]) -> float:
    """Simulate a sweep on this number of workers; return its duration in seconds."""
    rng = rng_for(0, "scaling", str(sweep.tasks_n))
    tasks_s = sweep.task_s * rng.choice(np.asarray(spread), sweep.tasks_n)
    free_s, has_rows = [(measured.connect_s, i) for i in range(workers_n)], set[int]()
    sent_s = arrived_s = measured.connect_s
    end_s = 0.0
    for task_s in tasks_s:
        at_s, worker = heapq.heappop(free_s)
        sent_s = max(sent_s, at_s) + measured.call_s
        load_bytes = measured.task_bytes + (0.0 if worker in has_rows else measured.rows_bytes)
        has_rows.add(worker)
        arrived_s = max(arrived_s, sent_s) + load_bytes / NETWORK_bytes_s
        done_s = arrived_s + task_s
        end_s = max(end_s, done_s)
        heapq.heappush(free_s, (done_s, worker))
    return end_s


def read_sweeps(scene: str) -> tuple[list[Sweep], float]:
    """Return a scene's sweeps, one per training stage, and the total seconds of all other stages."""
    stages = json.loads((ROOT / f"reports/{scene}/provenance.json").read_text())["runtime"]["stages"].values()
    sweeps, rest_s = [], 0.0
    for stage in stages:
        if trainings_n := stage["trainings_n"]:
            tasks_n = math.ceil(trainings_n / STACK_N["cpu"])
            sweeps.append(Sweep(tasks_n, stage["computed_s"] / tasks_n))
        else:
            rest_s += stage["computed_s"]
    return sweeps, rest_s


def write_scaling(measured: Measurements, folder: Path) -> None:
    """Write scaling.md (the table of speed-ups and the measurements behind it) and the figure scaling.svg."""
    spread = np.asarray(measured.task_s) / np.mean(measured.task_s)
    paper, rest_s = read_sweeps("paper")
    largest = max(paper, key=lambda sweep: sweep.tasks_n)
    wide = Sweep(WIDE_N, largest.task_s)
    quick, quick_rest_s = read_sweeps("quick")
    cases = {
        f"a sweep of {WIDE_N:,} tasks": ([wide], 0.0),
        f"largest sweep of `paper`, {largest.tasks_n} tasks": ([largest], 0.0),
        "all training runs of `paper`": (paper, 0.0),
        "`paper` in full": (paper, rest_s),
        "`quick` in full": (quick, quick_rest_s),
    }

    def total_s(sweeps: Sequence[Sweep], rest_s: float, workers_n: int, assumed: Measurements) -> float:
        return rest_s + sum(simulate(sweep, workers_n, assumed, spread) for sweep in sweeps)

    alone = {name: total_s(*case, 1, replace(measured, connect_s=0.0)) for name, case in cases.items()}
    faster = {
        name: [alone[name] / total_s(*case, workers_n, measured) for workers_n in WORKERS_N]
        for name, case in cases.items()
    }
    free = replace(measured, call_s=0.0, connect_s=0.0, task_bytes=0.0, rows_bytes=0.0)
    cost = {
        name: 100 * (1 - total_s(*case, WORKERS_N[-1], free) / total_s(*case, WORKERS_N[-1], measured))
        for name, case in cases.items()
    }
    rows = [
        f"| {n} | " + " | ".join(f"{faster[name][i]:.1f}" for name in cases) + " |" for i, n in enumerate(WORKERS_N)
    ]
    text = [
        "Speed-up over one worker, simulated from times and sizes of `python -m tests.benchmarks.cluster`.", "",
        "| workers | " + " | ".join(cases) + " |", "|---" * (len(cases) + 1) + "|", *rows, "",
        *explain(measured, paper, rest_s, largest, cost), "", "![Speed-up against workers](scaling.svg)", "",
    ]  # fmt: skip
    (folder / "scaling.md").write_text("\n".join(text))
    draw(faster, folder / "scaling.svg")


def explain(
    measured: Measurements, paper: Sequence[Sweep], rest_s: float, largest: Sweep, cost: dict[str, float]
) -> list[str]:
    """Return Markdown list items: the measurements, and what limits the speed-up."""
    one_s, two_s = measured.processes_s
    work_s = sum(sweep.tasks_n * sweep.task_s for sweep in paper)
    counts = ", ".join(str(sweep.tasks_n) for sweep in sorted(paper, key=lambda sweep: -sweep.tasks_n))
    mean_s, sd_s = np.mean(measured.task_s), np.std(measured.task_s)
    lines = [
        f"Measured: a sweep of {len(measured.task_s) + 1} tasks takes {one_s:.1f} s in one process and "
        f"{two_s:.1f} s in two ({one_s / two_s:.2f} times as fast), at a load of "
        f"{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores; "
        f"a task takes {mean_s:.2f} s of CPU (sd {100 * sd_s / mean_s:.0f} %).",
        f"Measured for Dask: {1e3 * measured.call_s:.1f} ms per task, {measured.connect_s:.1f} s to connect a stage, "
        f"{measured.task_bytes / 1e3:.1f} kB per task and {measured.rows_bytes / 1e6:.1f} MB of rows per worker. "
        "Assumed: a network of 1 Gbit/s, shared by all workers.",
        f"The number of tasks limits the speed-up: stages of `paper` have {counts} tasks and run one after another.",
        f"The remaining work is counted as one process: {rest_s:.0f} s of {rest_s + work_s:.0f} s, which limits the "
        f"speed-up of `paper` to {(rest_s + work_s) / rest_s:.0f}.",
        f"Dask does not limit the speed-up: with 256 workers, it costs {cost['`paper` in full']:.1f} % of the time of "
        f"`paper`. One scheduler can serve about {largest.task_s / measured.call_s:,.0f} workers with tasks of "
        f"{largest.task_s:.0f} s.",
    ]
    return [f"- {line}" for line in lines]


def draw(faster: dict[str, list[float]], file: Path) -> None:
    with rc_context({"svg.hashsalt": "reskin", "svg.fonttype": "none"}):
        figure = Figure(figsize=(6.5, 4.2), layout="constrained")
        axes = figure.subplots()
        axes.plot(WORKERS_N, WORKERS_N, color="0.7", linestyle=":", label="ideal")
        for (name, values), marker in zip(faster.items(), "osd^v", strict=True):
            axes.plot(WORKERS_N, values, marker=marker, markersize=4, label=name.replace("`", ""))
        axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="speed-up", xticks=WORKERS_N)
        axes.set_xticklabels([str(n) for n in WORKERS_N])
        axes.minorticks_off()
        axes.legend(frameon=False, fontsize=8)
        figure.savefig(file, metadata={"Date": None})
