"""Faults of processes that are killed while they run: a stage of each kind, DVC, a worker process."""

import signal
import time

import psutil

from reskin import io
from tools.faults.harness import SCENE, Checkout, Result, Row, alive, fault, judge

TRAINING_STAGES = ("train_single", "train_multi", "train_triplet", "adapt")
STAGES = (
    "code", "simulate", "ingest_simulated", "describe", "split", *TRAINING_STAGES,
    "sensitivity", "audit", "report",
)  # fmt: skip
PARTS = 0.5, 0.1, 0.0  # of a stage's previous duration, tried in turn until the stage is killed before it ends
ADDRESS_SPACE_MAX = 100 * 2**20  # in bytes; less than a worker uses


def address(stage: str) -> str:
    """Return DVC's name of a stage: `stage@scene`."""
    return stage if stage == "code" else f"{stage}@{SCENE}"


def run_and_kill(checkout: Checkout, stage: str, part: float) -> Result | None:
    """Run a stage by DVC and kill it after the fraction `part` of its previous duration.

    A training stage is instead killed as soon as a training run is finished. Returns None if the stage ends before.
    """
    cost = checkout.folder / ".reskin/costs" / SCENE / f"{stage}.json"
    wait_s = part * (io.read_json(cost)["seconds"] if cost.exists() else 2.0)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", address(stage))
    process = checkout.stage(stage)
    if stage in TRAINING_STAGES:
        checkout.until(lambda: bool(checkout.trainings()), process)
    else:
        kill_s = time.monotonic() + wait_s
        checkout.until(lambda: time.monotonic() > kill_s, process)
    if alive(process):
        process.kill()
    result = checkout.end(repro, start_s)
    return result if result.status else None


def add_kill(stage: str) -> None:
    """Add a fault: the process of this stage is killed."""

    @fault(
        f"kill -9 in `{stage}`",
        "SIGKILL to the stage's process while it runs"
        + ("" if stage not in TRAINING_STAGES else ", as soon as a training run is finished"),
    )
    def case(checkout: Checkout) -> Row:
        for part in PARTS:
            checkout.reset(address(stage))
            if result := run_and_kill(checkout, stage, part):
                break
        else:
            raise AssertionError(f"{stage} ended before it could be killed")
        finished = checkout.trainings() if stage in TRAINING_STAGES else None
        return judge(checkout, result, checkout.run("dvc", "repro"), may_run=[address(stage)], finished=finished)


for name in STAGES:
    add_kill(name)


@fault(
    "kill -9 of `dvc repro` itself",
    "SIGKILL to DVC while `train_triplet` runs; the stage continues alone, and the next run starts at once",
)
def kill_dvc(checkout: Checkout) -> Row:
    stage = address("train_triplet")
    checkout.reset(stage)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", stage)
    process = checkout.stage("train_triplet")
    checkout.until(lambda: bool(checkout.trainings()), process)
    repro.send_signal(signal.SIGKILL)
    result, finished = checkout.end(repro, start_s), checkout.trainings()
    again = checkout.run("dvc", "repro")
    checkout.until(lambda: False, process, 60.0)  # give orphaned processes time to end
    return judge(checkout, result, again, may_run=[stage], finished=finished)


def _worker(checkout: Checkout, stage: str) -> tuple[psutil.Process, psutil.Process]:
    """Wait for a stage's first finished training run; return the stage's process and its largest worker process."""
    process = checkout.stage(stage)
    checkout.until(lambda: bool(checkout.trainings()), process)
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
def kill_worker(checkout: Checkout) -> Row:
    stage = address("train_triplet")
    checkout.reset(stage)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:1")
    _worker(checkout, "train_triplet")[1].kill()
    result, finished = checkout.end(repro, start_s), checkout.trainings()
    return judge(checkout, result, checkout.run("dvc", "repro"), may_run=[stage], finished=finished)


@fault(
    "worker out of memory, reported by the allocator",
    "after a finished training run, RLIMIT_AS of a worker of `train_triplet` is set to 100 MB, less than it uses",
)
def starve_worker(checkout: Checkout) -> Row:
    stage = address("train_triplet")
    checkout.reset(stage)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:1")
    worker = _worker(checkout, "train_triplet")[1]
    worker.rlimit(psutil.RLIMIT_AS, (ADDRESS_SPACE_MAX, ADDRESS_SPACE_MAX))
    result, finished = checkout.end(repro, start_s), checkout.trainings()
    return judge(checkout, result, checkout.run("dvc", "repro"), may_run=[stage], finished=finished)


@fault(
    "kill -9 of a stage with workers",
    "SIGKILL to the process of `train_triplet`; its workers must end too",
)
def kill_parent(checkout: Checkout) -> Row:
    stage = address("train_triplet")
    checkout.reset(stage)
    start_s = time.monotonic()
    repro = checkout.start("dvc", "repro", stage, RESKIN_EXECUTOR="processes:2")
    process, _ = _worker(checkout, "train_triplet")
    workers = process.children(recursive=True)
    process.kill()
    result = checkout.end(repro, start_s)
    _, left = psutil.wait_procs(workers, 10)
    finished = checkout.trainings()
    row = judge(checkout, result, checkout.run("dvc", "repro"), may_run=[stage], finished=finished)
    row.faults += [f"{len(left)} workers outlive their stage"] if any(alive(one) for one in left) else []
    return row
