"""Tests of the runner, which runs training jobs in worker processes and stores their results in a cache.

Jobs with equal settings are trained together as a stack.
"""

from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.executors import make_executor
from reskin.errors import ReskinError
from reskin.models import train
from reskin.models.batches import prepare
from reskin.models.job import TrainingJob, TrainingResult
from reskin.models.runner import STACK_N, make_stacks, run_jobs
from reskin.models.train import CHECKED_STEPS_N, train_stack
from tests.models.example_jobs import TRAIN, adaptation, example_data, fine_tuning, pooled, recipe, without_triplets

SIZE_N = STACK_N["cpu"]
# Tolerance in mm and N: networks that are trained in different stacks have different rounding errors (see
# test_train.py).
STACKED_ATOL = 1e-3


class InlineExecutor(Executor):
    """An executor that runs calls in this process and counts them.

    After `die_after` calls, it behaves as if its worker processes had died.
    """

    def __init__(self, die_after: int = 10**9, error: type[Exception] = BrokenProcessPool) -> None:
        self.calls_n = 0
        self.die_after = die_after
        self.error = error

    def submit(self, fn, /, *args, **kwargs):
        self.calls_n += 1
        future: Future = Future()
        if self.calls_n > self.die_after:
            future.set_exception(self.error("killed"))
            return future
        try:
            future.set_result(fn(*args, **kwargs))
        except ReskinError as error:
            future.set_exception(error)
        return future


def jobs(folds_n: int = 3, **changes: object) -> list[TrainingJob]:
    """Return one job for each of `folds_n` folds. Each fold holds out one row of two skins."""
    everyone = np.arange(24)
    held = [np.array([i, i + 12]) for i in range(folds_n)]
    one = replace(pooled(**changes), experiment="lobo")
    return [replace(one, fold=f"b{i}", train=np.setdiff1d(everyone, test), test=test) for i, test in enumerate(held)]


def run(
    selected: list[TrainingJob], cache: Path, executor: Executor | None = None, log: list[str] | None = None
) -> list[TrainingResult]:
    print_line = (lambda line: None) if log is None else log.append
    return run_jobs(selected, example_data(), executor=executor or InlineExecutor(), cache=cache, log=print_line)


def trainings_n(selected: list[TrainingJob], cache: Path) -> int:
    """Run the jobs, and return the number of stacks that were trained because they were not in the cache."""
    executor = InlineExecutor()
    run(selected, cache, executor)
    return executor.calls_n


def equal_results(one: TrainingResult, other: TrainingResult) -> bool:
    weights = all((one.weights[name] == other.weights[name]).all() for name in one.weights)
    return weights and (one.predicted == other.predicted).all() and one.curve == other.curve


def test_results_are_in_the_order_of_jobs(tmp_path):
    selected = [*jobs(2), pooled(), *jobs(5, steps_n=3), without_triplets(), adaptation(), fine_tuning()]
    done = run(selected, tmp_path)
    assert len({one.key for one in done}) == len(selected)
    assert [one.predicted.shape for one in done] == [(len(job.test), 3) for job in selected]


def test_result_of_a_job_does_not_depend_on_other_jobs_of_the_stack(tmp_path):
    selected = [*jobs(2), pooled(), adaptation(), jobs(3)[2]]
    for job, one in zip(selected, run(selected, tmp_path), strict=True):
        (alone,) = train_stack([job], example_data())
        np.testing.assert_allclose(one.predicted, alone.predicted, rtol=0, atol=STACKED_ATOL)
        assert (one.scaler.input_shift == alone.scaler.input_shift).all()


def test_jobs_that_finished_before_a_run_was_killed_are_kept(tmp_path):
    selected = jobs(2 * SIZE_N + 1)
    with pytest.raises(BrokenProcessPool):
        run(selected, tmp_path / "killed", InlineExecutor(die_after=1))
    # The second run trains the two of the three stacks that were not finished.
    assert trainings_n(selected, tmp_path / "killed") == 2
    done, fresh = run(selected, tmp_path / "killed"), run(selected, tmp_path / "fresh")
    assert all(equal_results(a, b) for a, b in zip(done, fresh, strict=True))


def test_stack_killed_while_its_results_were_written_is_trained_again(tmp_path):
    # Networks at different positions of a stack have different rounding errors. Many training steps with batches of one
    # row amplify these differences.
    selected = jobs(SIZE_N, steps_n=60, batch_n=1)
    done = run(selected, tmp_path)
    (tmp_path / f"{done[1].key}.safetensors").unlink()
    assert all(equal_results(a, b) for a, b in zip(done, run(selected, tmp_path), strict=True))


@pytest.mark.parametrize("damage", ["cut", "empty", "bit"])
def test_damaged_result_in_the_cache_is_reported_and_trained_again(tmp_path, damage):
    first, log = run(jobs(), tmp_path), []
    file = tmp_path / f"{first[1].key}.safetensors"
    content = bytearray(file.read_bytes())
    content[-5] ^= 1  # One bit of a weight is changed. The file format does not detect such damage.
    file.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "bit": content}[damage])
    again = run(jobs(), tmp_path, log=log)
    assert [line.startswith("warning: a cached result is damaged") for line in log] == [True]
    assert all(equal_results(a, b) for a, b in zip(first, again, strict=True))


def test_finished_jobs_are_read_from_the_cache(tmp_path):
    log: list[str] = []
    first = run(jobs(), tmp_path)
    again = run(jobs(), tmp_path, InlineExecutor(die_after=0), log)
    assert all(equal_results(a, b) for a, b in zip(first, again, strict=True))
    assert log == ["3 of 3 training runs were finished before and are not repeated"]


def test_equal_jobs_are_trained_only_once(tmp_path):
    one = jobs(1)[0]
    selected = [one, replace(one, recipe_name="twin"), one]
    done = run(selected, tmp_path)
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
    assert all(equal_results(done[0], other) for other in done[1:])


# With these weights, all ReLUs are 0, so the output is constant and there is no gradient.
DEAD = {"layer1.weight": 0, "layer1.bias": 0}


def prepare_dead(attempts: set[int]) -> object:
    """Return a substitute for `prepare`.

    In the given attempts, the network of fold b0 starts with weights whose output is constant.
    """

    def make(job: TrainingJob, rows: object) -> object:
        prepared, scaler = prepare(job, rows)
        if job.fold == "b0" and job.attempt_i in attempts:
            weights = {name: value * DEAD.get(name, 1) for name, value in prepared.initial_weights.items()}
            weights["layer2.weight"] = 0 * weights["layer2.weight"]
            prepared = replace(prepared, initial_weights=weights)
        return prepared, scaler

    return make


@pytest.mark.parametrize(("dead", "before_n", "collapsed"), [(set(), 0, 0), ({0}, 1, 0), ({0, 1, 2}, 2, 1)])
def test_training_that_collapses_to_a_constant_output_is_repeated_at_most_twice(
    tmp_path, monkeypatch, dead, before_n, collapsed
):
    monkeypatch.setattr(train, "prepare", prepare_dead(dead))
    selected, log = jobs(2, steps_n=CHECKED_STEPS_N, rate_max=1e-2), []
    for _ in range(2):  # The second run reads the same results from the cache.
        first, second = run(selected, tmp_path, log=log)
        assert (first.collapsed_before_n, first.collapsed) == (before_n, bool(collapsed))
        assert (second.collapsed_before_n, second.collapsed) == (0, False)
        assert second.explained_min > 0.5
    assert any("collapsed" in line for line in log) == bool(dead)


def test_constant_or_unknown_target_does_not_count_as_a_collapse(tmp_path):
    rows = example_data()
    flat, unknown = rows.target.copy(), rows.target.copy()
    flat[:, 2], unknown[:, 2] = 1.5, np.nan
    one = replace(without_triplets(), recipe=recipe(steps_n=CHECKED_STEPS_N, rate_max=1e-2), test=TRAIN)
    for target in (flat, unknown):
        (trained,) = train_stack([one], replace(rows, target=target))
        off = (trained.predicted - target[TRAIN])[:, :2].astype(float)
        truth = 1 - (off**2).mean(axis=0) / target[TRAIN, :2].var(axis=0)
        assert trained.explained_min == pytest.approx(truth.min(), rel=1e-5)


def test_training_in_a_worker_process_gives_the_same_result(tmp_path, monkeypatch):
    monkeypatch.setenv("RESKIN_EXECUTOR", "processes:1")
    selected = [adaptation(), fine_tuning()]
    with make_executor(imports="reskin.models.train") as executor:
        in_worker = run(selected, tmp_path / "apart", executor)
    assert all(equal_results(a, b) for a, b in zip(in_worker, run(selected, tmp_path / "here"), strict=True))


def by_key(selected: list[TrainingJob]) -> dict[str, TrainingJob]:
    return {f"key{i}": job for i, job in enumerate(selected)}


@given(st.lists(st.integers(0, 4), max_size=20), st.integers(1, 5))
def test_each_job_is_in_exactly_one_stack(kinds, size_n):
    settings = [{"steps_n": 3}, {"steps_n": 4}, {"rate_max": 1e-3}, {"architecture": "released"}, {"batch_n": 8}]
    selected = by_key([pooled(**settings[kind]) for kind in kinds])
    found = make_stacks(selected, size_n)
    assert sorted(key for one in found for key in one) == sorted(selected)
    for one in found:
        assert 1 <= len(one) <= size_n
        assert len({kinds[int(key.removeprefix("key"))] for key in one}) == 1
    counts = [kinds.count(kind) for kind in set(kinds)]
    # There are as few stacks as the limit on their size allows.
    assert len(found) == sum(-(-count // size_n) for count in counts)
