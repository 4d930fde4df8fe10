"""Run many training jobs in parallel, with a cache of completed training runs.

Jobs with equal settings and seed are trained together as a stack (several networks in one computation, see
`reskin.models.network`). The last bits of a network's weights depend on the other networks in its stack. To give the
same results in every run, stacks are formed from all requested jobs, including those with cached results. The cache key
of a result depends on the keys of all jobs in the stack. If a stage is killed and run again, only the stacks that were
not completed are trained.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from tqdm import tqdm

from reskin import io
from reskin.errors import SchemaError, TrainingError
from reskin.models.inputs import Scaler
from reskin.models.job import JobKeys, TrainingData, TrainingJob, TrainingResult
from reskin.numerics import device

# Largest number of training runs for a job. A training run has collapsed if its network predicts nearly the same value
# for all inputs; the job is then run again. If all runs collapse, the network of the last run is kept and marked as
# collapsed, and `reskin predict` refuses to use it.
MAX_ATTEMPTS_N = 3
# Largest number of networks in a stack, by device. On a CPU, larger stacks are not faster.
STACK_N = {"cpu": 3, "cuda": 64}

NO_ROWS = np.zeros(0, np.int64)  # placeholder for the row numbers in a `RemoteJob`

# A job as it is sent to a worker process. It consists of the job without its row numbers, and of the names under which
# the row numbers `train` and `test` are stored in a file that all workers can read (the shared file).
RemoteJob = tuple[TrainingJob, str, str]
# The arrays of row numbers, with their names in the shared file. The keys are the ids of the arrays.
FoldRows = Mapping[int, tuple[str, np.ndarray]]


def run_jobs(
    jobs: Sequence[TrainingJob], data: TrainingData, *, executor: Executor, cache: Path, log: Callable[[str], None]
) -> list[TrainingResult]:
    """Train the jobs whose results are not in the cache, and return all results in the order of `jobs`.

    A job whose network collapses is run again with other random draws, until it has been run `MAX_ATTEMPTS_N` times.

    Parameters
    ----------
    data
        The rows to which the row numbers of the jobs refer.
    executor
        Executor with worker processes. Jobs that are trained together are called a stack; each stack is trained in one
        worker process.
    cache
        Folder with the results of completed training runs.
    log
        Function that is called with messages and warnings.
    """
    results = _run_once(jobs, data, executor, cache, log)
    for attempt_i in range(1, MAX_ATTEMPTS_N):
        collapsed = [i for i, result in enumerate(results) if result.collapsed]
        if not collapsed:
            break
        log(f"{len(collapsed)} of {len(jobs)} training runs collapsed and are repeated with other random numbers")
        retries = [replace(jobs[i], attempt_i=attempt_i) for i in collapsed]
        for i, result in zip(collapsed, _run_once(retries, data, executor, cache, log), strict=True):
            seconds = results[i].seconds + result.seconds
            started_s = results[i].started_s
            results[i] = replace(result, collapsed_before_n=attempt_i, seconds=seconds, started_s=started_s)
    return results


def _run_once(
    jobs: Sequence[TrainingJob], data: TrainingData, executor: Executor, cache: Path, log: Callable[[str], None]
) -> list[TrainingResult]:
    job_keys = JobKeys(data)
    keys = [job_keys.key(job) for job in jobs]
    unique = dict(zip(keys, jobs, strict=True))  # equal jobs are trained only once
    planned = [(stack, _result_files(stack, cache)) for stack in make_stacks(unique, STACK_N[device()])]
    missing = [(stack, files) for stack, files in planned if not all([_is_intact(file, log) for file in files])]
    fresh = {key for stack, _ in missing for key in stack}
    if len(fresh) < len(unique):
        log(f"{len(unique) - len(fresh)} of {len(unique)} training runs were finished before and are not repeated")
    if missing:
        # The name of the file contains the number of this process, because several processes may run jobs on the same
        # data at the same time.
        shared_file = cache / "rows" / f"{job_keys.data_digest()}-{os.getpid()}.safetensors"
        work = [([unique[key] for key in stack], files) for stack, files in missing]
        # The arrays of row numbers are not sent to the workers. Workers receive only the names of the arrays, which are
        # digests of their content, and read the arrays from the shared file. Therefore, little data is sent, and a
        # worker reads an array only once for all jobs that use it.
        sets = {id(rows): rows for stack, _ in work for job in stack for rows in (job.train, job.test)}
        folds = {i: (hashlib.sha256(rows.tobytes()).hexdigest()[:32], rows) for i, rows in sets.items()}
        skin = np.unique(data.skin, return_inverse=True)[1].astype(np.int64)
        tensors = {"db_uT": data.db_uT, "target": data.target, "skin": skin} | dict(folds.values())
        io.write_tensors(shared_file, tensors, {})
        try:
            _run_stacks(work, shared_file, folds, executor)
        finally:
            io.remove(shared_file)
    file_of = {key: file for stack, files in planned for key, file in zip(stack, files, strict=True)}
    return [replace(_read_result(file_of[key]), reused=key not in fresh) for key in keys]


def make_stacks(jobs: Mapping[str, TrainingJob], size_n: int) -> list[list[str]]:
    """Group jobs with equal settings and seed into stacks of at most `size_n` jobs, in the order of `jobs`.

    `jobs` is a mapping from cache keys to jobs. Each stack is returned as a list of keys.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for key, job in jobs.items():
        groups.setdefault((job.recipe, job.schedule, job.loss_weights, job.seed, job.seed_i), []).append(key)
    return [group[i : i + size_n] for group in groups.values() for i in range(0, len(group), size_n)]


def _result_files(stack: Sequence[str], cache: Path) -> list[Path]:
    digest = hashlib.sha256("".join(stack).encode()).hexdigest()[:32]
    return [cache / f"{digest}-{i}.safetensors" for i in range(len(stack))]


def _run_stacks(
    stacks: Sequence[tuple[Sequence[TrainingJob], Sequence[Path]]], shared_file: Path, folds: FoldRows,
    executor: Executor,
) -> None:  # fmt: skip
    running = {}
    for stack, files in stacks:
        remote = [
            (replace(job, train=NO_ROWS, test=NO_ROWS), folds[id(job.train)][0], folds[id(job.test)][0])
            for job in stack
        ]
        running[executor.submit(_train_to_files, shared_file, remote, files)] = stack
    with tqdm(total=sum(map(len, running.values())), unit="training") as bar:
        for future in as_completed(running):
            try:
                future.result()
            except Exception as error:
                for other in running:
                    other.cancel()
                if isinstance(error, TrainingError):
                    raise TrainingError(f"{running[future][0].name}, {error}") from None
                raise
            bar.update(len(running[future]))


def _train_to_files(shared_file: Path, remote: Sequence[RemoteJob], files: Sequence[Path]) -> None:
    """Train a stack, and write the result of each job to the job's file. This function runs in a worker process."""
    from reskin.models.train import train_stack  # imported here, because it imports torch, which only workers need

    jobs = [
        replace(job, train=_read_rows(shared_file, train), test=_read_rows(shared_file, test))
        for job, train, test in remote
    ]
    try:
        results = train_stack(jobs, _read_data(shared_file))
    except RuntimeError as error:
        # If there is not enough memory, torch raises a RuntimeError. It is converted to a MemoryError.
        if "out of memory" in str(error) or "allocate memory" in str(error):
            raise MemoryError(str(error)) from None
        raise
    for job, file, result in zip(jobs, files, results, strict=True):
        tensors = {f"weights.{name}": value for name, value in result.weights.items()} | result.scaler.arrays()
        tensors |= {"curve": np.array(result.curve), "predicted": result.predicted}
        metadata = {"seconds": f"{result.seconds:.3f}", "started_s": f"{result.started_s:.3f}"}
        metadata |= {"one_reading_s": f"{result.one_reading_s:.3g}", "job": job.name}
        optional = {"stopped_step": result.stopped_step, "explained_min": result.explained_min}
        metadata |= {name: repr(value) for name, value in optional.items() if value is not None}
        io.write_tensors(file, tensors, metadata)


def _is_intact(file: Path, log: Callable[[str], None]) -> bool:
    """Return whether a cached result exists and is intact. A damaged file is deleted, with a warning to `log`."""
    if not file.exists():
        return False
    try:
        io.read_tensors(file)
    except SchemaError as error:
        log(f"warning: a cached result is damaged, so its training run is repeated ({str(error).partition('. ')[0]})")
        io.remove(file)
        return False
    return True


@lru_cache(maxsize=1)
def _read_data(shared_file: Path) -> TrainingData:
    return TrainingData(**io.read_tensors(shared_file, ("db_uT", "target", "skin"))[0])


@lru_cache(maxsize=16)  # a worker needs the row numbers of only a few folds at a time
def _read_rows(shared_file: Path, name: str) -> np.ndarray:
    return io.read_tensors(shared_file, (name,))[0][name]


def _read_result(file: Path) -> TrainingResult:
    tensors, metadata = io.read_tensors(file)
    weights = {name.removeprefix("weights."): v for name, v in tensors.items() if name.startswith("weights.")}
    return TrainingResult(
        key=file.stem,
        weights=weights,
        scaler=Scaler.of_arrays(tensors),
        curve=[float(value) for value in tensors["curve"]],
        predicted=tensors["predicted"],
        stopped_step=int(metadata["stopped_step"]) if "stopped_step" in metadata else None,
        explained_min=float(metadata["explained_min"]) if "explained_min" in metadata else None,
        seconds=float(metadata["seconds"]),
        started_s=float(metadata["started_s"]),
        one_reading_s=float(metadata["one_reading_s"]),
    )
