"""Many trainings at once: recipes x folds x seeds. In: rows and cells. Out: one finished file a cell.

Cells of equal settings are trained as one stack. A finished cell is never trained again: a killed stage goes on where
it was, and one more seed costs one seed. Refuses to know stages, scores and pages.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from pipeline import io
from pipeline.errors import TrainingError, complain
from pipeline.learning.cell import Cell, Keys, Measured, Trained, make_job
from pipeline.learning.executors import device
from pipeline.learning.inputs import VIEW
from pipeline.learning.standardise import Scaler
from pipeline.learning.stopwatch import median_s

STACK_N = {"cpu": 3, "cuda": 64}  # networks trained side by side; on a CPU more gain nothing, and two processes share


def train_stack(cells: Sequence[Cell], rows: Measured) -> list[Trained]:
    """Train cells of equal settings side by side, and predict their test rows."""
    import torch  # late: only a process that trains pays for it

    from pipeline.learning.model import Predictor
    from pipeline.learning.train import train

    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    start_s, on, first = time.monotonic(), device(), cells[0]
    jobs, scalers = zip(*(make_job(cell, rows) for cell in cells), strict=True)
    architecture = first.recipe.architecture
    outcomes = train(jobs, architecture, first.schedule, first.terms, on)
    seconds = (time.monotonic() - start_s) / len(cells)
    trained = []
    for cell, scaler, outcome in zip(cells, scalers, outcomes, strict=True):
        inputs = scaler.encode(VIEW[cell.recipe.inputs](rows.db_uT[cell.test]))
        predict = Predictor(outcome.weights, architecture, on)
        trained.append(
            Trained(
                key="", weights=outcome.weights, scaler=scaler, curve=outcome.curve,
                predicted=scaler.decode(predict(inputs)), stopped_step=outcome.stopped_step, seconds=seconds,
                one_reading_s=median_s(partial(predict, inputs[:1])),
            )
        )  # fmt: skip
    return trained


def run_cells(
    cells: Sequence[Cell], rows: Measured, *, executor: Executor, cache: Path, tell: Callable[[str], None]
) -> list[Trained]:
    """Train what `cache` does not hold yet, and return every cell's result in the order of `cells`."""
    keys = Keys(rows)
    files = {id(cell): cache / f"{keys.key(cell)}.safetensors" for cell in cells}  # not by name: it decides no result
    unfinished = {files[id(cell)]: cell for cell in cells if not files[id(cell)].exists()}
    finished_n, missing = sum(files[id(cell)] not in unfinished for cell in cells), list(unfinished.values())
    if finished_n:
        tell(f"{finished_n} of {len(cells)} trainings were finished before")
    if missing:
        rows_file = cache / "rows" / f"{keys.rows_digest()}.safetensors"
        skin = np.unique(rows.skin, return_inverse=True)[1].astype(np.int64)
        io.write_tensors(rows_file, {"db_uT": rows.db_uT, "target": rows.target, "skin": skin}, {})
        _run_stacks(missing, rows_file, files, executor, tell)
        io.remove(rows_file)
    return [_read_trained(files[id(cell)]) for cell in cells]


def _run_stacks(
    cells: Sequence[Cell], rows_file: Path, files: Mapping[int, Path], executor: Executor, tell: Callable[[str], None]
) -> None:
    start_s, done_n, running = time.monotonic(), 0, {}
    for stack in stacks(cells, STACK_N[device()]):
        running[executor.submit(_stack_to_files, rows_file, stack, [files[id(cell)] for cell in stack])] = stack
    for future in as_completed(running):
        try:
            future.result()
        except TrainingError as error:
            executor.shutdown(cancel_futures=True)
            raise TrainingError(f"{running[future][0].name}, {error}") from None
        except BrokenExecutor:
            raise TrainingError(
                complain(
                    "training", "a worker process", "alive to its end", "one that died",
                    "Out of memory? Run again: what was finished is kept.",
                )
            ) from None  # fmt: skip
        done_n += len(running[future])
        left_s = (time.monotonic() - start_s) / done_n * (len(cells) - done_n)
        tell(f"{done_n}/{len(cells)} {running[future][-1].name}, about {left_s:.0f} s left")


def stacks(cells: Sequence[Cell], size_n: int) -> list[list[Cell]]:
    """Put cells of equal settings together, at most so many; what a cell becomes does not depend on it."""
    alike: dict[tuple[object, ...], list[Cell]] = {}
    for cell in cells:
        alike.setdefault((cell.recipe, cell.schedule, cell.terms), []).append(cell)
    return [group[i : i + size_n] for group in alike.values() for i in range(0, len(group), size_n)]


def _stack_to_files(rows_file: Path, cells: Sequence[Cell], files: Sequence[Path]) -> None:
    for cell, file, one in zip(cells, files, train_stack(cells, _read_rows(rows_file)), strict=True):
        tensors = {f"weights.{name}": value for name, value in one.weights.items()} | one.scaler.arrays()
        tensors |= {"curve": np.array(one.curve), "predicted": one.predicted}
        words = {"seconds": f"{one.seconds:.3f}", "one_reading_s": f"{one.one_reading_s:.3g}", "cell": cell.name}
        if one.stopped_step is not None:
            words["stopped_step"] = str(one.stopped_step)
        io.write_tensors(file, tensors, words)


@lru_cache(maxsize=1)
def _read_rows(rows_file: Path) -> Measured:
    return Measured(**io.read_tensors(rows_file)[0])


def _read_trained(file: Path) -> Trained:
    tensors, words = io.read_tensors(file)
    weights = {name.removeprefix("weights."): v for name, v in tensors.items() if name.startswith("weights.")}
    return Trained(
        key=file.stem,
        weights=weights,
        scaler=Scaler.of_arrays(tensors),
        curve=[float(value) for value in tensors["curve"]],
        predicted=tensors["predicted"],
        stopped_step=int(words["stopped_step"]) if "stopped_step" in words else None,
        seconds=float(words["seconds"]),
        one_reading_s=float(words["one_reading_s"]),
    )
