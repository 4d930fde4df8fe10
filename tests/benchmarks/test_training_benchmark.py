"""Time to train networks for many folds, which this project trains in stacks (several networks at once).

The time is compared with that of a plain loop over a DataLoader, and of a loop over index tensors.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_training_benchmark.py`. The test asserts only that the
training converges. Time ratios are computed within a repeat, during which the load of the machine is about constant. If
other programs keep the machine busy, use the ratios of CPU seconds: wall times of two threads then include waiting.
"""

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, islice, repeat
from pathlib import Path
from statistics import harmonic_mean, median

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from pipeline.executors import make_executor
from reskin.models import train as train_module
from reskin.models.batches import BatchSampler
from reskin.models.job import TrainingData, TrainingJob
from reskin.models.network import FEATURE_LAYERS_N, Stack, paper_layers
from reskin.models.optimiser import AdamW
from reskin.models.recipe import Recipe
from reskin.models.runner import STACK_N, run_jobs
from reskin.models.train import Monitor, train_stack
from reskin.seeds import rng_for
from tests.benchmarks import FULL, size

BOARDS_N, SKINS_PER_BOARD_N, SEEDS_N = 6, 3, 3
ROWS_N, CHANNELS_N = size(100_000, 3_600), 15
STEPS_N, BATCH_N = size(400, 2), 128
# The plain loops train only this number of networks, one after another; their time is scaled up to the whole grid.
PLAIN_N = 2
REPEATS_N = size(3, 1)
LAYERS = paper_layers(CHANNELS_N)


def recipe(triplet_weight: float, steps_n: int = STEPS_N) -> Recipe:
    return Recipe(
        architecture="paper", inputs="raw", scaling="standard", triplet_weight=triplet_weight, steps_n=steps_n,
        batch_n=BATCH_N, rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.0,
    )  # fmt: skip


def make_rows() -> TrainingData:
    rng = rng_for(0, "training benchmark")
    place_mm = 2.0 * rng.integers(0, 9, (ROWS_N, 2))
    target = np.column_stack([place_mm, rng.uniform(0, 3, ROWS_N)])
    db_uT = 50 * np.tanh(target @ rng.normal(0, 0.1, (3, CHANNELS_N))) + rng.normal(0, 3, (ROWS_N, CHANNELS_N))
    skin = np.arange(ROWS_N) * BOARDS_N * SKINS_PER_BOARD_N // ROWS_N
    return TrainingData(db_uT.astype(np.float32), target.astype(np.float32), skin)


def fold_grid(rows: TrainingData, triplet_weight: float) -> list[TrainingJob]:
    board = rows.skin // SKINS_PER_BOARD_N
    return [
        TrainingJob("lobo", "paper", recipe(triplet_weight), f"b{held}", 0, seed_i,
             np.flatnonzero(board != held), np.flatnonzero(board == held))
        for held in range(BOARDS_N)
        for seed_i in range(SEEDS_N)
    ]  # fmt: skip


def flop(triplet_weight: float) -> float:
    """Count the floating-point operations of the matrix products in one training step of one network.

    A multiply-add counts as two operations. The forward pass, the weight gradients and the input gradients (not
    computed for the first layer) take 2 b (3 sum(in out) - in1 out1) operations. Here, b is the number of rows in the
    batch, in and out are the widths of a layer, and in1 and out1 are those of the first layer. Triplets add two passes
    through the first three layers. Bias, ReLU, loss and optimiser are not counted.
    """

    def passes(layers: Sequence) -> float:
        return 2.0 * BATCH_N * (3 * sum(one.in_n * one.out_n for one in layers) - layers[0].in_n * layers[0].out_n)

    return passes(LAYERS) + (2 * passes(LAYERS[:FEATURE_LAYERS_N]) if triplet_weight else 0.0)


def sgemm_flop_per_s(repeats_n: int = 8, n: int = size(1024, 64)) -> list[float]:
    torch.set_num_threads(1)
    one, other = torch.rand(2, n, n)
    return [2 * n**3 / seconds(lambda: one @ other, time.process_time) for _ in range(repeats_n)]


def seconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    start_s = clock()
    call()
    return clock() - start_s


def train_one(job: TrainingJob, rows: TrainingData) -> int:
    train_stack([job], rows)
    return os.getpid()


def start_workers(executor: Executor, workers_n: int = 2) -> None:
    """Let each worker train for one step, because the first step in a process loads most of PyTorch."""
    few = TrainingData(*(values[:BATCH_N] for values in (make_rows().db_uT, make_rows().target, make_rows().skin)))
    job = replace(fold_grid(few, 0.0)[0], recipe=recipe(0.0, 1), train=np.arange(64), test=np.arange(64, BATCH_N))
    running = [executor.submit(train_one, job, few) for _ in range(workers_n)]
    assert len({one.result() for one in running}) == workers_n


def run_grid(jobs: list[TrainingJob], rows: TrainingData, executor: Executor, cache: Path) -> tuple[float, float]:
    """Train all jobs; return the wall seconds, and the seconds per network summed over all networks."""
    start_s = time.perf_counter()
    trained = run_jobs(jobs, rows, executor=executor, cache=cache, log=lambda line: None)
    took_s = time.perf_counter() - start_s
    assert all(one.stopped_step is None and (not FULL or one.curve[-1] < one.curve[0]) for one in trained)
    return took_s, sum(one.seconds for one in trained)


def plain_network() -> nn.Sequential:
    layers = [(nn.Linear(one.in_n, one.out_n), *([nn.ReLU()] if one.relu else [])) for one in LAYERS]
    return nn.Sequential(*chain.from_iterable(layers))


def plain_loop(batches: Iterable[Sequence[torch.Tensor]]) -> None:
    network = plain_network()
    optimizer, criterion = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.0), nn.MSELoss()
    for inputs, targets in batches:
        optimizer.zero_grad()
        loss = criterion(network(inputs), targets)
        loss.backward()
        optimizer.step()
    assert torch.isfinite(loss)


def plain_grid(
    rows: TrainingData, threads_n: int, batches_of: Callable[[TensorDataset], Iterable]
) -> tuple[float, float]:
    """Train PLAIN_N networks one after another; return wall and CPU seconds scaled up to the whole grid."""
    torch.set_num_threads(threads_n)
    jobs = fold_grid(rows, 0.0)
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    for job in jobs[:: len(jobs) // PLAIN_N]:
        view, target = (torch.from_numpy(one[job.train]) for one in (rows.db_uT, rows.target))
        data = TensorDataset((view - view.mean(0)) / view.std(0), (target - target.mean(0)) / target.std(0))
        plain_loop(islice(batches_of(data), STEPS_N))
    took_s, took_cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    torch.set_num_threads(1)
    return took_s * len(jobs) / PLAIN_N, took_cpu_s * len(jobs) / PLAIN_N


def engine_cpu_s(rows: TrainingData) -> float:
    """Train one stack of networks in this process; return its CPU seconds, scaled up to the whole grid.

    CPU time hardly depends on the machine's load.
    """
    jobs = [replace(one, test=one.test[:1]) for one in fold_grid(rows, 0.0)]
    start_s = time.process_time()
    train_stack(jobs[: STACK_N["cpu"]], rows)
    return (time.process_time() - start_s) * len(jobs) / STACK_N["cpu"]


def by_loader(data: TensorDataset) -> Iterable:
    loader = DataLoader(data, batch_size=BATCH_N, shuffle=True, drop_last=True)
    return chain.from_iterable(repeat(loader))


def by_index(data: TensorDataset) -> Iterable:
    while True:
        yield from (data[chosen] for chosen in torch.randperm(len(data)).split(BATCH_N) if len(chosen) == BATCH_N)


@contextmanager
def record_cpu_s(parts: dict[str, list[tuple[object, str]]]):
    """Yield the CPU seconds spent in each of the named functions during the block; none of them calls another."""
    spent_s: dict[str, float] = defaultdict(float)

    def timed(call: Callable, part: str) -> Callable:
        def run(*args, **kwargs):
            start_s = time.process_time()
            try:
                return call(*args, **kwargs)
            finally:
                spent_s[part] += time.process_time() - start_s

        return run

    with pytest.MonkeyPatch.context() as patch:
        for part, functions in parts.items():
            for owner, name in functions:
                patch.setattr(owner, name, timed(getattr(owner, name), part))
        yield spent_s


STEP = {
    "draw and gather batches": [(BatchSampler, "sample")],
    "forward": [(Stack, "features"), (Stack, "head")],
    "losses": [(train_module, "squared_error"), (train_module, "triplet_loss")],
    "backward": [(torch.Tensor, "backward")],
    "clipping of gradients": [(train_module, "clip_gradients")],
    "AdamW": [(AdamW, "step")],
    "one-cycle rate": [(train_module, "one_cycle")],
    "check that weights are finite and keep them": [(Monitor, "check")],
}


@pytest.fixture(autouse=True)
def _unset_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("RESKIN_EXECUTOR", "RESKIN_DEVICE"):
        monkeypatch.delenv(variable, raising=False)


@pytest.mark.timeout(1800)
def test_time_to_train_all_folds_compared_with_plain_loops_and_sgemm(tmp_path: Path) -> None:
    rows = make_rows()
    # the first call imports PyTorch
    plain_loop(islice(by_index(TensorDataset(torch.rand(BATCH_N, CHANNELS_N), torch.rand(BATCH_N, 3))), 3))
    train_stack([replace(fold_grid(rows, 0.0)[0], recipe=recipe(0.0, 1))], rows)
    columns: dict[str, list[float]] = defaultdict(list)
    for i in range(REPEATS_N):
        sgemm = max(sgemm_flop_per_s())
        columns["sgemm, one thread, GFLOP/s"].append(1e-9 * sgemm)
        with make_executor(imports="reskin.models.train") as executor:
            start_s = seconds(lambda: start_workers(executor))
            # Each product takes a quarter of a second.
            beside = [executor.submit(sgemm_flop_per_s, size(100, 2)) for _ in range(2)]
            both = harmonic_mean(list(chain.from_iterable(one.result() for one in beside)))
            columns["sgemm, in both processes at once, GFLOP/s"].append(1e-9 * both)
            for what, weight in (("grid", 0.0), ("grid with triplets", 0.1)):
                jobs = fold_grid(rows, weight)
                took_s, within_s = run_grid(jobs, rows, executor, tmp_path / f"{i}{weight}")
                columns[f"{what}, s"].append(took_s)
                rate = len(jobs) * STEPS_N * flop(weight) / within_s
                columns[f"{what}, % of one thread's sgemm"].append(100 * rate / sgemm)
                columns[f"{what}, % of sgemm in both processes"].append(100 * rate / both)
        plain = {
            "DataLoader loop, 2 threads": plain_grid(rows, 2, by_loader),
            "DataLoader loop, 1 thread": plain_grid(rows, 1, by_loader),
            "loop over index tensors, 1 thread": plain_grid(rows, 1, by_index),
        }
        grid_s, grid_cpu_s = columns["grid, s"][-1], engine_cpu_s(rows)
        columns["start of both workers, s"].append(start_s)
        columns["grid, CPU s"].append(grid_cpu_s)
        for what, (plain_s, plain_cpu_s) in plain.items():
            columns[f"{what}, s"].append(plain_s)
            columns[f"{what}, CPU s"].append(plain_cpu_s)
            columns[f"{what} / grid"].append(plain_s / grid_s)
            columns[f"{what} / grid with start of workers"].append(plain_s / (grid_s + start_s))
            columns[f"{what} / grid, CPU s"].append(plain_cpu_s / grid_cpu_s)
    print(
        f"\n{len(jobs)} networks, {STEPS_N} steps with {BATCH_N} of {ROWS_N:,} rows x {CHANNELS_N}; two processes;",
        end=" ",
    )
    print(f"plain loops: {PLAIN_N} networks are timed, and the time is scaled to {len(jobs)}; {REPEATS_N} repeats")
    print(f"{'':67}{'lowest':>8} {'median':>8} {'highest':>8}")
    for name, values in columns.items():
        print(f"  {name:65}{min(values):8.2f} {median(values):8.2f} {max(values):8.2f}")


@pytest.mark.timeout(600)
@pytest.mark.parametrize("triplet_weight", [0.0, 0.1])
def test_cpu_time_of_all_parts_of_a_training_step(triplet_weight: float) -> None:
    rows = make_rows()
    jobs = [replace(one, test=one.test[:1]) for one in fold_grid(rows, triplet_weight)[: STACK_N["cpu"]]]
    train_stack([replace(jobs[0], recipe=recipe(triplet_weight, 1))], rows)  # the first call imports PyTorch
    sgemm, best_s, best = max(sgemm_flop_per_s()), np.inf, {}
    for _ in range(REPEATS_N):
        with record_cpu_s({"all": [(train_module, "train")]}) as whole, record_cpu_s(STEP) as spent_s:
            assert all(one.stopped_step is None for one in train_stack(jobs, rows))
        if whole["all"] < best_s:
            best_s, best = whole["all"], dict(spent_s)
    best["rest (slicing batches, sums, the loop, copying rows at first)"] = best_s - sum(best.values())
    rate = len(jobs) * STEPS_N * flop(triplet_weight) / best_s
    print(f"\na step of {len(jobs)} networks{' with triplets' if triplet_weight else ''}: ", end="")
    print(f"{1e3 * best_s / STEPS_N:.2f} ms, {100 * rate / sgemm:.0f} % of sgemm; best of {REPEATS_N}")
    for part, part_s in best.items():
        print(f"  {part:66}{1e3 * part_s / STEPS_N:7.3f} ms {100 * part_s / best_s:5.1f} %")
