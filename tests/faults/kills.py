"""Faults of processes that are killed in mid-run: every kind of stage, DVC itself, a worker."""

import signal
import time

import psutil

from reskin import io
from tests.faults.harness import SCENE, Checkout, Result, Row, alive, fault, judge

TRAINS = ("train_single", "train_multi", "train_triplet", "adapt")
STAGES = (
    "code", "simulate", "ingest_simulated", "describe", "split", *TRAINS, "train_classical", "table2", "sensitivity",
    "audit", "report", "publish",
)  # fmt: skip
ATTEMPTS_N = 4
ADDRESS_SPACE_MAX = 100 * 2**20  # bytes


def address(stage: str) -> str:
    """Return the name of a stage in DVC."""
    return stage if stage == "code" else f"{stage}@{SCENE}"


def run_and_kill(at: Checkout, stage: str, part: float) -> Result | None:
    """Run a stage through DVC, and kill its process after a part of its earlier duration; None if it ended first."""
    cost = at.folder / ".reskin/costs" / SCENE / f"{stage}.json"
    wait_s = part * (io.read_json(cost)["seconds"] if cost.exists() else 2.0)
    if stage == "publish":
        (at.folder / "mlflow.db").unlink()  # otherwise there is nothing to write
    start_s = time.monotonic()
    repro = at.start("dvc", "repro", address(stage))
    process = at.stage(stage)
    if stage in TRAINS:
        at.until(lambda: bool(at.trainings()), process)
    else:
        at.until(lambda: f"{stage}: stage " in at.output() or stage == "code", process)
        kill_s = time.monotonic() + wait_s
        at.until(lambda: time.monotonic() > kill_s, process)
    if alive(process):
        process.kill()
    result = at.end(repro, start_s)
    return result if result.status else None


def add_kill(stage: str) -> None:
    """Add the fault of a killed stage."""

    @fault(
        f"kill -9 in `{stage}`",
        "SIGKILL to the stage's process in mid-run"
        + ("" if stage not in TRAINS else ", as soon as a training run is finished"),
    )
    def case(at: Checkout) -> Row:
        for i in range(ATTEMPTS_N):
            at.reset(address(stage))
            if result := run_and_kill(at, stage, 0.5 / 2**i):
                break
        else:
            raise AssertionError(f"{stage} ended before it could be killed")
        finished = at.trainings() if stage in TRAINS else None
        return judge(at, result, at.run("dvc", "repro"), may_run=[address(stage)], finished=finished)


for name in STAGES:
    add_kill(name)


@fault(
    "kill -9 of `dvc repro` itself",
    "SIGKILL to DVC while `train_triplet` runs; the stage continues alone, and the next run starts at once",
)
def kill_dvc(at: Checkout) -> Row:
    stage = address("train_triplet")
    at.reset(stage)
    start_s = time.monotonic()
    repro = at.start("dvc", "repro", stage)
    process = at.stage("train_triplet")
    at.until(lambda: bool(at.trainings()), process)
    repro.send_signal(signal.SIGKILL)
    result, finished = at.end(repro, start_s), at.trainings()
    again = at.run("dvc", "repro")
    at.until(lambda: False, process, 60.0)  # orphaned processes have time to end
    return judge(at, result, again, may_run=[stage], finished=finished)


def _worker(at: Checkout, stage: str) -> tuple[psutil.Process, psutil.Process]:
    """Return a stage's process and one of its workers, once a training run is finished."""
    process = at.stage(stage)
    at.until(lambda: bool(at.trainings()), process)
    workers = [child for child in process.children(recursive=True) if _is_worker(child)]
    return process, max(workers, key=lambda child: child.memory_info().rss)


def _is_worker(process: psutil.Process) -> bool:
    return (
        process.cpu_times().user > 0
        and not process.children()
        and "resource_tracker" not in " ".join(process.cmdline())
    )


@fault(
    "worker out of memory, killed by the kernel",
    "SIGKILL to a worker process of `train_triplet` after a finished training run",
)
def kill_worker(at: Checkout) -> Row:
    stage = address("train_triplet")
    at.reset(stage)
    start_s = time.monotonic()
    repro = at.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:1")
    _worker(at, "train_triplet")[1].kill()
    result, finished = at.end(repro, start_s), at.trainings()
    return judge(at, result, at.run("dvc", "repro"), may_run=[stage], finished=finished)


@fault(
    "worker out of memory, reported by the allocator",
    "after a finished training run, RLIMIT_AS of a worker of `train_triplet` is set to 100 MB, less than it uses",
)
def starve_worker(at: Checkout) -> Row:
    stage = address("train_triplet")
    at.reset(stage)
    start_s = time.monotonic()
    repro = at.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:1")
    worker = _worker(at, "train_triplet")[1]
    worker.rlimit(psutil.RLIMIT_AS, (ADDRESS_SPACE_MAX, ADDRESS_SPACE_MAX))
    result, finished = at.end(repro, start_s), at.trainings()
    return judge(at, result, at.run("dvc", "repro"), may_run=[stage], finished=finished)


@fault(
    "kill -9 of a stage with workers",
    "SIGKILL to the process of `train_triplet`; its workers must end too",
)
def kill_parent(at: Checkout) -> Row:
    stage = address("train_triplet")
    at.reset(stage)
    start_s = time.monotonic()
    repro = at.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:2")
    process, _ = _worker(at, "train_triplet")
    workers = process.children(recursive=True)
    process.kill()
    result = at.end(repro, start_s)
    _, left = psutil.wait_procs(workers, 10)
    finished = at.trainings()
    row = judge(at, result, at.run("dvc", "repro"), may_run=[stage], finished=finished)
    row.faults += [f"{len(left)} workers outlive their stage"] if any(alive(one) for one in left) else []
    return row
