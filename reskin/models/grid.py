"""Many trainings at once: recipes x folds x seeds. In: rows and trials. Out: one finished file a trial.

Trials of equal settings and seed are trained as one stack. Where a network lies in a stack shows in the last bits of
its sums, so stacks are made of all trials that are asked for, done or not, and are known by all their members: a killed
stage goes on at the stacks that were not whole, and gives what it would have given; one more seed costs one seed.
Refuses to know stages, scores and pages.
"""

import hashlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from reskin import io
from reskin.errors import SchemaError, TrainingError
from reskin.models.inputs import Scaler
from reskin.models.trial import Keys, Measured, Trained, Trial
from reskin.numerics import device

ATTEMPTS_MAX_N = 3  # trainings of one trial; what collapses in all of them is kept, recorded, and refused by `predict`
STACK_N = {"cpu": 3, "cuda": 64}  # networks trained side by side; on a CPU more gain nothing, and two processes share


def run_trials(
    trials: Sequence[Trial], rows: Measured, *, executor: Executor, cache: Path, tell: Callable[[str], None]
) -> list[Trained]:
    """Train what `cache` does not hold yet, and return every trial's result in the order of `trials`.

    What collapsed is trained again with other random draws, at most `ATTEMPTS_MAX_N` times in all.
    """
    run = partial(_run_once, rows=rows, executor=executor, cache=cache, tell=tell)
    done = run(trials)
    for attempt_i in range(1, ATTEMPTS_MAX_N):
        again = [i for i, trained in enumerate(done) if trained.collapsed]
        if not again:
            break
        tell(f"{len(again)} of {len(trials)} trainings collapsed: once more with other draws")
        retrained = run([replace(trials[i], attempt_i=attempt_i) for i in again])
        for i, trained in zip(again, retrained, strict=True):
            done[i] = replace(trained, collapsed_before_n=attempt_i, seconds=done[i].seconds + trained.seconds)
    return done


def _run_once(
    trials: Sequence[Trial], *, rows: Measured, executor: Executor, cache: Path, tell: Callable[[str], None]
) -> list[Trained]:
    keys = Keys(rows)
    names = [keys.key(trial) for trial in trials]
    members = dict(zip(names, trials, strict=True))  # equal trainings are one
    planned = [(stack, _files_of(stack, cache)) for stack in stacks(members, STACK_N[device()])]
    missing = [(stack, files) for stack, files in planned if not all([_is_whole(file, tell) for file in files])]
    fresh = {key for stack, _ in missing for key in stack}
    if len(fresh) < len(members):
        tell(f"{len(members) - len(fresh)} of {len(members)} trainings were finished before")
    if missing:
        rows_file = cache / "rows" / f"{keys.rows_digest()}-{os.getpid()}.safetensors"  # an experiment may run beside
        skin = np.unique(rows.skin, return_inverse=True)[1].astype(np.int64)
        work = [([members[key] for key in stack], files) for stack, files in missing]
        folds = _folds_of([trial for stack, _ in work for trial in stack])
        shared = {"db_uT": rows.db_uT, "target": rows.target, "skin": skin}
        io.write_tensors(rows_file, shared | {name: numbers for name, numbers in folds.values()}, {})
        try:
            _run_stacks(work, rows_file, folds, executor, tell)
        finally:
            io.remove(rows_file)
    file_of = {key: file for stack, files in planned for key, file in zip(stack, files, strict=True)}
    return [replace(_read_trained(file_of[key]), reused=key not in fresh) for key in names]


def stacks(members: Mapping[str, Trial], size_n: int) -> list[list[str]]:
    """Group keys of trials of equal settings and seed, in order, at most `size_n` in a stack."""
    alike: dict[tuple[object, ...], list[str]] = {}
    for key, trial in members.items():
        alike.setdefault((trial.recipe, trial.schedule, trial.terms, trial.seed, trial.seed_i), []).append(key)
    return [group[i : i + size_n] for group in alike.values() for i in range(0, len(group), size_n)]


def _files_of(stack: Sequence[str], cache: Path) -> list[Path]:
    """Name the file of each member's result by all members and its place among them."""
    digest = hashlib.sha256("".join(stack).encode()).hexdigest()[:32]
    return [cache / f"{digest}-{i}.safetensors" for i in range(len(stack))]


Folds = Mapping[int, tuple[str, np.ndarray]]  # row numbers by identity: their name in the file of rows, and they


def _folds_of(trials: Sequence[Trial]) -> Folds:
    """Name each set of row numbers by its content, so that a worker reads it once and no call carries 8 bytes a row."""
    sets = {id(numbers): numbers for trial in trials for numbers in (trial.train, trial.test)}
    return {key: (hashlib.sha256(numbers.tobytes()).hexdigest()[:32], numbers) for key, numbers in sets.items()}


def _run_stacks(
    planned: Sequence[tuple[Sequence[Trial], Sequence[Path]]], rows_file: Path, folds: Folds, executor: Executor,
    tell: Callable[[str], None],
) -> None:  # fmt: skip
    start_s, done_n, all_n = time.monotonic(), 0, sum(len(stack) for stack, _ in planned)

    def send(trial: Trial) -> Sent:
        return replace(trial, train=IN_FILE, test=IN_FILE), folds[id(trial.train)][0], folds[id(trial.test)][0]

    running = {
        executor.submit(_stack_to_files, rows_file, [send(trial) for trial in stack], files): stack
        for stack, files in planned
    }
    for future in as_completed(running):
        try:
            future.result()
        except Exception as error:
            executor.shutdown(cancel_futures=True)
            if isinstance(error, TrainingError):
                raise TrainingError(f"{running[future][0].name}, {error}") from None
            raise
        done_n += len(running[future])
        left_s = (time.monotonic() - start_s) / done_n * (all_n - done_n)
        tell(f"{done_n}/{all_n} {running[future][-1].name}, about {left_s:.0f} s left")


IN_FILE = np.zeros(0, np.int64)  # stands for row numbers that lie in the file of rows
Sent = tuple[Trial, str, str]  # a trial without its row numbers, and the names of those of `train` and of `test`


def _stack_to_files(rows_file: Path, sent: Sequence[Sent], files: Sequence[Path]) -> None:
    from reskin.models.train import train_stack  # torch, late: only a process that trains pays for it

    def numbers(name: str) -> np.ndarray:
        return _read_numbers(rows_file, name)

    trials = [replace(trial, train=numbers(train), test=numbers(test)) for trial, train, test in sent]
    try:
        results = train_stack(trials, _read_rows(rows_file))
    except RuntimeError as error:
        if "out of memory" in str(error) or "allocate memory" in str(error):  # torch has no error of its own on a CPU
            raise MemoryError(str(error)) from None
        raise
    for trial, file, trained in zip(trials, files, results, strict=True):
        tensors = {f"weights.{name}": value for name, value in trained.weights.items()} | trained.scaler.arrays()
        tensors |= {"curve": np.array(trained.curve), "predicted": trained.predicted}
        metadata = {"seconds": f"{trained.seconds:.3f}", "one_reading_s": f"{trained.one_reading_s:.3g}"}
        metadata["trial"] = trial.name
        optional = {"stopped_step": trained.stopped_step, "explained_min": trained.explained_min}
        metadata |= {name: repr(value) for name, value in optional.items() if value is not None}
        io.write_tensors(file, tensors, metadata)


def _is_whole(file: Path, tell: Callable[[str], None]) -> bool:
    """Tell whether a result is there as it was written; one that was damaged is said, and trained again."""
    if not file.exists():
        return False
    try:
        io.read_tensors(file)
    except SchemaError as error:
        tell(f"warning: a finished training is damaged and is trained again ({str(error).partition('. ')[0]})")
        io.remove(file)
        return False
    return True


@lru_cache(maxsize=1)
def _read_rows(rows_file: Path) -> Measured:
    return Measured(**io.read_tensors(rows_file, ("db_uT", "target", "skin"))[0])


@lru_cache(maxsize=16)  # sets of a few folds
def _read_numbers(rows_file: Path, name: str) -> np.ndarray:
    return io.read_tensors(rows_file, (name,))[0][name]


def _read_trained(file: Path) -> Trained:
    tensors, metadata = io.read_tensors(file)
    weights = {name.removeprefix("weights."): v for name, v in tensors.items() if name.startswith("weights.")}
    return Trained(
        key=file.stem,
        weights=weights,
        scaler=Scaler.of_arrays(tensors),
        curve=[float(value) for value in tensors["curve"]],
        predicted=tensors["predicted"],
        stopped_step=int(metadata["stopped_step"]) if "stopped_step" in metadata else None,
        explained_min=float(metadata["explained_min"]) if "explained_min" in metadata else None,
        seconds=float(metadata["seconds"]),
        one_reading_s=float(metadata["one_reading_s"]),
    )
