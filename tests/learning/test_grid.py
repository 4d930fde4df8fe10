from concurrent.futures import Executor, Future

import numpy as np
import pytest

from pipeline import io
from pipeline.errors import TrainingError
from pipeline.learning.grid import Cell, cell_key, run_cells, train_cell
from pipeline.seeds import rng_for
from tests.learning.recipes import recipe


class Here(Executor):
    """Runs at once, in this process, and counts; fails from the `die_after`-th call on."""

    def __init__(self, die_after: int = 10**9) -> None:
        self.calls_n = 0
        self.die_after = die_after

    def submit(self, fn, /, *args, **kwargs):
        self.calls_n += 1
        future: Future = Future()
        if self.calls_n > self.die_after:
            future.set_exception(TrainingError("killed"))
            return future
        try:
            future.set_result(fn(*args, **kwargs))
        except TrainingError as error:
            future.set_exception(error)
        return future


def rows() -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(0, "rows")
    return rng.normal(0, 50, (40, 15)).astype(np.float32), rng.uniform(0, 16, (40, 3)).astype(np.float32)


def cells(folds_n: int = 3, **changes) -> list[Cell]:
    everyone = np.arange(40)
    held = [np.arange(i * 10, (i + 1) * 10) for i in range(folds_n)]
    return [
        Cell("lobo", "paper", recipe(epochs_n=1, **changes), f"b{i}", 7, 0, np.setdiff1d(everyone, test), test)
        for i, test in enumerate(held)
    ]


def run(some: list[Cell], cache, executor: Executor):
    return run_cells(some, *rows(), executor=executor, cache=cache, tell=lambda line: None)


def test_results_come_in_the_order_of_cells_with_a_prediction_a_test_row(tmp_path):
    done = run(cells(), tmp_path, Here())
    assert [one.predicted.shape for one in done] == [(10, 3)] * 3
    assert [one.key for one in done] == [cell_key(cell, *rows()) for cell in cells()]


def test_a_killed_grid_loses_no_finished_cell(tmp_path):
    with pytest.raises(TrainingError, match="killed"):
        run(cells(), tmp_path, Here(die_after=2))
    again = Here()
    done = run(cells(), tmp_path, again)
    assert again.calls_n == 1
    fresh = run(cells(), tmp_path / "other", Here())
    assert all((a.predicted == b.predicted).all() for a, b in zip(done, fresh, strict=True))


def test_one_more_fold_costs_one_fold(tmp_path):
    run(cells(2), tmp_path, Here())
    more = Here()
    run(cells(3), tmp_path, more)
    assert more.calls_n == 1


def test_a_cell_is_known_by_all_that_decides_it():
    cell = cells(1)[0]
    db_uT, target = rows()
    keys = {cell_key(cell, db_uT, target), cell_key(cells(1, batch_n=8)[0], db_uT, target)}
    for changed in ("train", "test"):
        other = db_uT.copy()
        other[getattr(cell, changed)[0], 0] += 1
        keys.add(cell_key(cell, other, target))
    assert len(keys) == 4


def test_what_is_left_in_the_cache_opens_without_pickle(tmp_path):
    run(cells(1), tmp_path, Here())
    (file,) = tmp_path.glob("*.safetensors")
    tensors, metadata = io.read_tensors(file)
    assert tensors["weights.feat.0.weight"].shape == (200, 15)
    assert float(metadata["seconds"]) > 0


def test_a_planted_leak_would_show_nothing_of_a_test_row_reaches_the_model():
    (cell,) = cells(1)
    db_uT, target = rows()
    weights, scaler, curve, predicted = train_cell(cell, db_uT, target)
    db_uT[cell.test] += 1e4
    target[cell.test] -= 1e4
    again, again_scaler, again_curve, again_predicted = train_cell(cell, db_uT, target)
    assert all((weights[name] == again[name]).all() for name in weights)
    assert all((a == b).all() for a, b in zip(scaler.arrays().values(), again_scaler.arrays().values(), strict=True))
    assert curve == again_curve
    assert (predicted != again_predicted).any()


def test_a_cell_that_diverges_is_named_and_ends_the_grid(tmp_path):
    with pytest.raises(
        TrainingError, match=r"lobo.paper.b[012].seed0, epoch 1: the loss must be finite.*rate_max \(1e\+30\)"
    ):
        run(cells(rate_max=1e30, batch_n=4), tmp_path, Here())
