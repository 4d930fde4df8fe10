"""Run one sweep of training runs on this machine and on a Dask cluster, also while parts of the cluster fail.

Run `python -m tests.benchmarks.cluster` as root, because each machine of the cluster is a
network namespace, which only root can create. deploy/dask.sh starts the programs, as on SLURM and Kubernetes. The
program writes docs/measured/cluster.md, scaling.md and scaling.svg.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tests.benchmarks.cluster_sweep import STEPS_N, TASKS_N
from tests.benchmarks.namespaces import Node, kill, network, unsupported_reason
from tests.benchmarks.scaling import Measurements, write_scaling
from tests.benchmarks.steps import ROOT, Steps, end_on_signals, require

WORKERS = ("w1", "w2", "w3")
PORT = 8786
STARTED_MAX_s, SWEEP_MAX_s = 240.0, 900.0
DUTY_s = (1.5, 0.5)  # seconds for which a slow worker is stopped and then runs, repeatedly
SWEEP = [sys.executable, "-W", "ignore", "-m", "tests.benchmarks.cluster_sweep"]


class Sweep:
    """A running or finished sweep; its methods read the task log and the results in the sweep's folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.found: dict[str, Any] = {}

    def lines(self, word: str) -> list[list[str]]:
        file = self.folder / "ran.txt"
        return (
            [line.split() for line in file.read_text().splitlines() if line.startswith(word)] if file.exists() else []
        )

    def read(self) -> "Sweep":
        self.found = json.loads((self.folder / "found.json").read_text())
        return self

    def tasks_per_worker(self) -> Counter[str]:
        return Counter(line[2] for line in self.lines("ended"))

    def task_s(self) -> list[float]:
        """Return the CPU seconds of each task. The first task is omitted because it loads the libraries."""
        begun = {(name, by): float(cpu_s) for _, name, by, cpu_s in self.lines("begun")}
        return [float(cpu_s) - begun[name, by] for _, name, by, cpu_s in self.lines("ended")][1:]


class Cluster:
    """A Dask cluster: a scheduler, three workers and a client machine, each with a network address of its own."""

    def __init__(self, nodes: Mapping[str, Node], folder: Path) -> None:
        self._nodes, self._folder = nodes, folder
        self.up: dict[str, subprocess.Popen[bytes]] = {}
        self.address = f"tcp://{nodes['scheduler'].address}:{PORT}"

    def start(self, name: str) -> None:
        words = ["scheduler", str(PORT)] if name == "scheduler" else ["worker", self.address]
        command = ["sh", str(ROOT / "deploy/dask.sh"), *words]
        self.up[name] = self._nodes[name].popen(command, self._folder / f"{name}.log", ROOT)

    def start_all(self) -> None:
        for name in ("scheduler", *WORKERS):
            self.start(name)
        self.wait_for(len(WORKERS))

    def wait_for(self, workers_n: int) -> None:
        """Wait until a client on the node `user` can reach this many workers."""
        words = (
            f"from distributed import Client as C; C({self.address!r}, timeout=60).wait_for_workers({workers_n}, 120)"
        )
        process = self._nodes["user"].popen(
            [sys.executable, "-W", "ignore", "-c", words], self._folder / "wait.log", ROOT
        )
        require(process.wait(STARTED_MAX_s) == 0, f"{workers_n} workers did not start: see {self._folder}/wait.log")

    def end(self, name: str) -> None:
        kill(self.up.pop(name))

    def end_all(self) -> None:
        for name in list(self.up):
            self.end(name)

    def sweep(self, folder: Path, *more: str) -> subprocess.Popen[bytes]:
        command = ["sh", str(ROOT / "deploy/dask.sh"), "run", self.address, *SWEEP, str(folder), *more]
        folder.mkdir(parents=True, exist_ok=True)
        return self._nodes["user"].popen(command, folder / "said.txt", ROOT)


def sweep_here(folder: Path, executor: str) -> Sweep:
    """Run the sweep on this machine; `executor` is `here` or `processes:N`."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "RESKIN_EXECUTOR": executor}
    subprocess.run([*SWEEP, str(folder)], cwd=ROOT, env=environment, check=True, timeout=SWEEP_MAX_s)
    return Sweep(folder).read()


def wait_for_sweep(process: subprocess.Popen[bytes], folder: Path) -> Sweep:
    """Wait for a sweep on the cluster; fail unless it succeeds."""
    process.wait(SWEEP_MAX_s)
    require(process.returncode == 0, (folder / "said.txt").read_text()[-600:])
    return Sweep(folder).read()


def wait_until(ready: Any, seconds: float, what: str) -> None:
    end_s = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > end_s:
            raise TimeoutError(f"{what} took more than {seconds:g} s")
        time.sleep(0.05)


def sweep_locally(steps: Steps, folder: Path) -> dict[str, Sweep]:
    found = {}
    for place in ("here", "processes:1", "processes:2"):
        with steps.step(f"`{place}`, on this machine") as note:
            sweep = found[place] = sweep_here(folder / place, place)
            note(f"{len(sweep.lines('ended'))} tasks, sweep {sweep.found['sweep_s']:.1f} s")
            require(sweep.found["sha256"] == found["here"].found["sha256"], "bytes differ")
    return found


def sweep_on_three_workers(
    steps: Steps, cluster: Cluster, nodes: Mapping[str, Node], folder: Path, expected: str
) -> Sweep:
    """Run the sweep on three workers. Require the local results, and note the bytes that each worker received."""
    with steps.step("three workers") as note:
        before = {name: nodes[name].received_bytes() for name in WORKERS}
        sweep = wait_for_sweep(cluster.sweep(folder / "whole", "--empty"), folder / "whole")
        require(sweep.found["sha256"] == expected, "bytes differ")
        received = {name: nodes[name].received_bytes() - before[name] for name in WORKERS}
        ran = sweep.tasks_per_worker()
        sweep.found["received_bytes"] = sum(received.values())
        require(len(sweep.lines("begun")) == TASKS_N, f"begun {len(sweep.lines('begun'))}")
        note(f"{TASKS_N} tasks, by worker {sorted(ran.values())}; received kB by worker "
            f"{sorted(round(n / 1e3) for n in received.values())}; equal bytes")  # fmt: skip
        reads = Counter(line[1] for line in sweep.lines("read"))
        require(set(reads.values()) <= {1}, f"rows read {reads}")
        note(f"rows ({sweep.found['rows_bytes'] / 1e6:.1f} MB) read once by each of {len(reads)} workers")
    return sweep


def kill_worker(steps: Steps, cluster: Cluster, folder: Path, expected: str) -> Sweep:
    with steps.step("a worker is killed during the sweep (SIGKILL)") as note:
        process, running = cluster.sweep(folder / "killed"), Sweep(folder / "killed")
        wait_until(lambda: len(running.lines("ended")) >= 3, SWEEP_MAX_s, "three tasks")
        cluster.end("w1")
        ended_n = len(running.lines("ended"))
        sweep = wait_for_sweep(process, folder / "killed")
        begun_n = len(sweep.lines("begun"))
        require(sweep.found["sha256"] == expected, "bytes differ")
        require(begun_n <= TASKS_N + 1, f"{begun_n} tasks begun")
        note(f"after {ended_n} of {TASKS_N} tasks; {begun_n - TASKS_N} tasks ran twice; equal bytes")
    cluster.start("w1")
    cluster.wait_for(len(WORKERS))
    return sweep


def restart_scheduler(steps: Steps, cluster: Cluster, folder: Path, expected: str) -> None:
    place = folder / "restarted"
    with steps.step("the scheduler is killed during the sweep") as note:
        process, running = cluster.sweep(place), Sweep(place)
        wait_until(lambda: len(running.lines("ended")) >= 4, SWEEP_MAX_s, "four tasks")
        cluster.end("scheduler")
        start_s = time.monotonic()
        process.wait(120)
        last_line = (place / "said.txt").read_text().splitlines()[-1]
        require(process.returncode == 1 and "Finished training runs are cached" in last_line, last_line)
        note(f"after {time.monotonic() - start_s:.1f} s: `{last_line}`")
        cluster.end_all()
    with steps.step("the scheduler and the workers are restarted, and the command is repeated") as note:
        finished = {line[1] for line in running.lines("ended")}
        before_n = len(running.lines("begun"))
        cluster.start_all()
        sweep = wait_for_sweep(cluster.sweep(place), place)
        again = [line[1] for line in sweep.lines("begun")[before_n:]]
        require(not finished & {*again}, "a finished training run was repeated")
        require(sweep.found["sha256"] == expected, "bytes differ")
        note(f"{len(finished)} tasks were finished, {len(again)} of {TASKS_N} ran; equal bytes")


@contextmanager
def slow_down(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Suspend and resume a worker repeatedly within the block, so that it runs for a quarter of the time."""
    done = threading.Event()

    def stop_and_go() -> None:
        while not done.is_set():
            for word, wait_s in zip((signal.SIGSTOP, signal.SIGCONT), DUTY_s, strict=True):
                os.killpg(process.pid, word)
                time.sleep(wait_s)

    thread = threading.Thread(target=stop_and_go, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def sweep_with_slow_worker(steps: Steps, cluster: Cluster, folder: Path, expected: str) -> None:
    with (
        steps.step("one worker is four times as slow (it is stopped for 1.5 s of every 2 s)") as note,
        slow_down(cluster.up["w2"]),
    ):
        sweep = wait_for_sweep(cluster.sweep(folder / "slow"), folder / "slow")
        require(sweep.found["sha256"] == expected, "bytes differ")
        by_worker = sorted(sweep.tasks_per_worker().values())
        note(f"sweep {sweep.found['sweep_s']:.1f} s, tasks by worker {by_worker}; equal bytes")


SRUN = """#!/bin/sh
n=${1#--ntasks=}
shift 2
while [ "$n" -gt 0 ]; do n=$((n - 1)); "$@" & done
wait
"""


def run_slurm_script(steps: Steps, folder: Path, expected: str) -> None:
    """Run the SLURM script as a job of three tasks on this machine, with a substitute for `srun`."""
    place, srun = folder / "slurm", folder / "bin/srun"
    srun.parent.mkdir()
    srun.write_text(SRUN)
    srun.chmod(0o755)
    job = {"SLURM_SUBMIT_DIR": str(ROOT), "SLURM_JOB_ID": str(os.getpid()), "SLURM_NTASKS": "3"}
    environment = {**os.environ, **job, "PATH": f"{srun.parent}:{os.environ['PATH']}"}
    with steps.step("`deploy/slurm/reskin.sbatch` with a substitute for `srun`, two workers") as note:
        words = ["bash", str(ROOT / "deploy/slurm/reskin.sbatch"), *SWEEP, str(place)]
        with (folder / "slurm.log").open("wb") as log:
            process = subprocess.Popen(words, env=environment, stdout=log, stderr=log, start_new_session=True)
            try:
                code = process.wait(SWEEP_MAX_s)
            finally:
                kill(process)
        require(code == 0, (folder / "slurm.log").read_text()[-600:])
        sweep = Sweep(place).read()
        require(sweep.found["sha256"] == expected, "bytes differ")
        note(f"tasks by worker {sorted(sweep.tasks_per_worker().values())}; equal bytes")


def run_steps(steps: Steps, folder: Path) -> Measurements:
    local = sweep_locally(steps, folder)
    expected = local["here"].found["sha256"]
    with ExitStack() as down:
        nodes = down.enter_context(network(["scheduler", "user", *WORKERS]))
        cluster = Cluster(nodes, folder)
        down.callback(cluster.end_all)
        with steps.step("scheduler, user and three workers, each in a network namespace") as note:
            cluster.start_all()
            note(", ".join(f"{name} {node.address}" for name, node in nodes.items()))
        sweep = sweep_on_three_workers(steps, cluster, nodes, folder, expected)
        warm = kill_worker(steps, cluster, folder, expected)
        restart_scheduler(steps, cluster, folder, expected)
        sweep_with_slow_worker(steps, cluster, folder, expected)
    run_slurm_script(steps, folder, expected)
    seconds = {place: found.found["sweep_s"] for place, found in local.items()}
    begun = sweep.lines("begun")
    return Measurements(
        task_s=tuple(local["here"].task_s()), processes_s=(seconds["processes:1"], seconds["processes:2"]),
        call_s=sweep.found["empty_s"], connect_s=warm.found["connect_s"], rows_bytes=sweep.found["rows_bytes"],
        task_bytes=sweep.found["received_bytes"] / len(begun),
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "docs/measured")
    parser.add_argument("--keep", type=Path, help="folder for all files of the test; it is kept")
    arguments = parser.parse_args()
    if reason := unsupported_reason():
        print(f"not tested: network namespaces need root on Linux and the command `ip`; on this machine: {reason}.")
        return
    end_on_signals()
    steps = Steps()
    with ExitStack() as kept:
        folder = arguments.keep or Path(kept.enter_context(tempfile.TemporaryDirectory()))
        measurements = run_steps(steps, folder.resolve())
    steps.write(
        arguments.out / "cluster.md",
        f"`python -m tests.benchmarks.cluster`: {TASKS_N} tasks of three training runs, {STEPS_N} steps each.",
    )
    write_scaling(measurements, arguments.out)


if __name__ == "__main__":
    main()
