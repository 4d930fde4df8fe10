"""Many trainings at once: recipes x folds x seeds. In: rows and cells. Out: one finished file a cell.

A cell is known by its content (rows, recipe, seed, code), and a finished one is never trained again: a killed stage
goes on where it was, and one more seed costs one seed. Refuses to know stages, scores and pages.
"""

import hashlib
import importlib.metadata
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from pipeline import io, seeds
from pipeline.errors import TrainingError, complain
from pipeline.learning.recipe import Recipe
from pipeline.learning.standardise import FIT, Scaler

SOURCES = Path(__file__).parent


@dataclass(frozen=True)
class Cell:
    """One training: a recipe on one fold with one seed. `train` and `test` are row numbers."""

    question: str
    recipe_name: str
    recipe: Recipe
    fold: str
    seed: int
    seed_i: int
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]

    @property
    def name(self) -> str:
        """A name for files and for people, unique within a stage."""
        return f"{self.question}.{self.recipe_name}.{self.fold}.seed{self.seed_i}"


@dataclass(frozen=True)
class Trained:
    """A finished cell: weights by name, scaler, loss a epoch, predictions (mm, mm, N) for the test rows."""

    key: str
    weights: dict[str, np.ndarray]
    scaler: Scaler
    curve: list[float]
    predicted: Float32[np.ndarray, "b 3"]
    seconds: float


def train_cell(
    cell: Cell, db_uT: Float32[np.ndarray, "f ch"], target: Float32[np.ndarray, "f 3"]
) -> tuple[dict[str, np.ndarray], Scaler, list[float], Float32[np.ndarray, "b 3"]]:
    """Fit the scaler on training rows, train, predict the test rows."""
    import torch  # late: only a process that trains pays for it

    from pipeline.learning.train import predict, train
    from pipeline.seeds import torch_generator_for

    torch.set_num_threads(1)  # the same sums in the same order, however many cells run beside this one
    scaler = FIT[cell.recipe.scaling](db_uT[cell.train], target[cell.train])
    generator = torch_generator_for(cell.seed, "train", cell.question, cell.fold, cell.seed_i)
    net, curve = train(
        torch.from_numpy(scaler.encode(db_uT[cell.train])),
        torch.from_numpy(scaler.encode_target(target[cell.train])),
        cell.recipe,
        generator,
    )
    answers = predict(net, torch.from_numpy(scaler.encode(db_uT[cell.test]))).numpy()
    weights = {name: value.numpy() for name, value in net.state_dict().items()}
    return weights, scaler, curve, scaler.decode(answers)


def run_cells(
    cells: Sequence[Cell],
    db_uT: Float32[np.ndarray, "f ch"],
    target: Float32[np.ndarray, "f 3"],
    *,
    executor: Executor,
    cache: Path,
    tell: Callable[[str], None],
) -> list[Trained]:
    """Train what `cache` does not hold yet, and return every cell's result in the order of `cells`."""
    rows_file = cache / "rows" / f"{_digest(db_uT, target)}.safetensors"
    if not rows_file.exists():
        io.write_tensors(rows_file, {"db_uT": db_uT, "target": target}, {})
    keys = [cell_key(cell, db_uT, target) for cell in cells]
    files = [cache / f"{key}.safetensors" for key in keys]
    missing = [i for i, file in enumerate(files) if not file.exists()]
    if len(missing) < len(cells):
        tell(f"{len(cells) - len(missing)} of {len(cells)} trainings were finished before")
    start_s = time.monotonic()
    running = {executor.submit(_train_to_file, rows_file, cells[i], files[i]): i for i in missing}
    for done_n, future in enumerate(as_completed(running), 1):
        try:
            future.result()
        except TrainingError as error:
            executor.shutdown(cancel_futures=True)
            raise TrainingError(f"{cells[running[future]].name}, {error}") from None
        except BrokenExecutor:
            raise TrainingError(
                complain(
                    "training",
                    "a worker process",
                    "alive to its end",
                    "one that died",
                    "Out of memory? Run again: what was finished is kept.",
                )
            ) from None
        left_s = (time.monotonic() - start_s) / done_n * (len(missing) - done_n)
        tell(f"{done_n}/{len(missing)} {cells[running[future]].name}, about {left_s:.0f} s left")
    io.remove(rows_file)
    return [_read_trained(file, key) for file, key in zip(files, keys, strict=True)]


def cell_key(cell: Cell, db_uT: Float32[np.ndarray, "f ch"], target: Float32[np.ndarray, "f 3"]) -> str:
    """Name a cell by all that decides its result: rows of both sides, recipe, seed, code, torch and platform."""
    words = [
        cell.question, cell.fold, cell.recipe.model_dump_json(), cell.seed, cell.seed_i,
        _code_digest(), importlib.metadata.version("torch"), importlib.metadata.version("numpy"), sys.platform,
    ]  # fmt: skip
    rows = _digest(db_uT[cell.train], target[cell.train], db_uT[cell.test])
    return hashlib.sha256(json.dumps([*words, rows]).encode()).hexdigest()[:32]


def _train_to_file(rows_file: Path, cell: Cell, file: Path) -> None:
    start_s = time.monotonic()
    rows = _read_rows(rows_file)
    weights, scaler, curve, predicted = train_cell(cell, rows["db_uT"], rows["target"])
    tensors = {f"weights.{name}": value for name, value in weights.items()} | scaler.arrays()
    tensors |= {"curve": np.array(curve), "predicted": predicted}
    io.write_tensors(file, tensors, {"seconds": f"{time.monotonic() - start_s:.3f}", "cell": cell.name})


@lru_cache(maxsize=1)
def _read_rows(rows_file: Path) -> dict[str, np.ndarray]:
    return io.read_tensors(rows_file)[0]


def _read_trained(file: Path, key: str) -> Trained:
    tensors, metadata = io.read_tensors(file)
    weights = {name.removeprefix("weights."): v for name, v in tensors.items() if name.startswith("weights.")}
    curve = [float(value) for value in tensors["curve"]]
    seconds = float(metadata["seconds"])
    return Trained(key, weights, Scaler.of_arrays(tensors), curve, tensors["predicted"], seconds)


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


@lru_cache(maxsize=1)
def _code_digest() -> str:
    digest = hashlib.sha256()
    for source in [*sorted(SOURCES.glob("*.py")), Path(seeds.__file__)]:
        digest.update(source.read_bytes())
    return digest.hexdigest()
