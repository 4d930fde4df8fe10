"""Time to train the networks of many folds in stacks, compared with a loop over a DataLoader, one network at a time.

Ratios are computed within a repeat, during which the load of the machine is about constant. If other programs keep the
machine busy, use the ratios of CPU seconds: wall times of two processes then include waiting.
"""

import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain, islice, repeat
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

from pipeline.executors import make_executor
from reskin.models.job import TrainingData, TrainingJob
from reskin.models.network import paper_layers
from reskin.models.recipe import Recipe
from reskin.models.runner import STACK_N, run_jobs
from reskin.models.train import train_stack
from reskin.seeds import rng_for
from tools.benchmarks.common import table

BOARDS_N, SKINS_PER_BOARD_N, SEEDS_N, CHANNELS_N, BATCH_N = 6, 3, 3, 15, 128
PLAIN_N = 2  # the plain loops train this number of networks; their time is scaled up to the whole grid
Seconds = tuple[float, float]  # wall and CPU seconds


def recipe(triplet_weight: float, steps_n: int) -> Recipe:
    return Recipe(
        architecture="paper", inputs="raw", scaling="standard", triplet_weight=triplet_weight, steps_n=steps_n,
        batch_n=BATCH_N, rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.0,
    )  # fmt: skip


def make_rows(rows_n: int) -> TrainingData:
    rng = rng_for(0, "training benchmark")
    place_mm = 2.0 * rng.integers(0, 9, (rows_n, 2))
    target = np.column_stack([place_mm, rng.uniform(0, 3, rows_n)])
    db_uT = 50 * np.tanh(target @ rng.normal(0, 0.1, (3, CHANNELS_N))) + rng.normal(0, 3, (rows_n, CHANNELS_N))
    skin = np.arange(rows_n) * BOARDS_N * SKINS_PER_BOARD_N // rows_n
    return TrainingData(db_uT.astype(np.float32), target.astype(np.float32), skin)


def fold_grid(rows: TrainingData, one: Recipe) -> list[TrainingJob]:
    board = rows.skin // SKINS_PER_BOARD_N
    return [
        TrainingJob("lobo", "paper", one, f"b{held}", 0, seed_i,
             np.flatnonzero(board != held), np.flatnonzero(board == held))
        for held in range(BOARDS_N)
        for seed_i in range(SEEDS_N)
    ]  # fmt: skip


def by_loader(data: TensorDataset) -> Iterable[Sequence[torch.Tensor]]:
    loader = DataLoader(data, batch_size=BATCH_N, shuffle=True, drop_last=True)
    return chain.from_iterable(repeat(loader))


def by_index(data: TensorDataset) -> Iterable[Sequence[torch.Tensor]]:
    while True:
        yield from (data[chosen] for chosen in torch.randperm(len(data)).split(BATCH_N) if len(chosen) == BATCH_N)


def plain_loop(batches: Iterable[Sequence[torch.Tensor]]) -> None:
    layers = [(nn.Linear(one.in_n, one.out_n), *([nn.ReLU()] if one.relu else [])) for one in paper_layers(CHANNELS_N)]
    network = nn.Sequential(*chain.from_iterable(layers))
    optimizer, criterion = torch.optim.AdamW(network.parameters(), lr=3e-3, weight_decay=0.0), nn.MSELoss()
    for inputs, targets in batches:
        optimizer.zero_grad()
        criterion(network(inputs), targets).backward()
        optimizer.step()


def plain_grid(
    rows: TrainingData, jobs: list[TrainingJob], batches_of: Callable[[TensorDataset], Iterable[Sequence[torch.Tensor]]]
) -> Seconds:
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    for job in jobs[:: len(jobs) // PLAIN_N]:
        view, target = (torch.from_numpy(one[job.train]) for one in (rows.db_uT, rows.target))
        data = TensorDataset((view - view.mean(0)) / view.std(0), (target - target.mean(0)) / target.std(0))
        plain_loop(islice(batches_of(data), job.recipe.steps_n))
    scale = len(jobs) / PLAIN_N
    return scale * (time.perf_counter() - start_s), scale * (time.process_time() - start_cpu_s)


def stack_cpu_s(rows: TrainingData, jobs: list[TrainingJob]) -> float:
    """Train one stack in this process; return its CPU seconds, scaled up to the whole grid."""
    start_s = time.process_time()
    train_stack([replace(one, test=one.test[:1]) for one in jobs[: STACK_N["cpu"]]], rows)
    return (time.process_time() - start_s) * len(jobs) / STACK_N["cpu"]


def main(rows_n: int = 100_000, steps_n: int = 400, repeats_n: int = 3) -> None:
    torch.set_num_threads(1)
    rows, columns = make_rows(rows_n), defaultdict(list)
    jobs = fold_grid(rows, recipe(0.0, steps_n))
    plain_loop(islice(by_index(TensorDataset(torch.rand(BATCH_N, CHANNELS_N), torch.rand(BATCH_N, 3))), 3))
    few = [replace(one, recipe=recipe(0.0, 1), test=one.test[:1]) for one in jobs[:2]]
    train_stack(few, rows)  # the first call imports PyTorch
    for _ in range(repeats_n):
        grids = {"grid": jobs, "grid with triplets": fold_grid(rows, recipe(0.1, steps_n))}
        with make_executor(imports="reskin.models.train") as executor, tempfile.TemporaryDirectory() as folder:
            for i, (what, grid) in enumerate({"start of workers": few, **grids}.items()):
                start_s = time.perf_counter()
                run_jobs(grid, rows, executor=executor, cache=Path(folder) / str(i), log=lambda _: None)
                columns[f"{what}, s"].append(time.perf_counter() - start_s)
        columns["grid, CPU s"].append(stack_cpu_s(rows, jobs))
        for what, batches_of in (("DataLoader loop", by_loader), ("loop over index tensors", by_index)):
            plain_s, plain_cpu_s = plain_grid(rows, jobs, batches_of)
            columns[f"{what}, s"].append(plain_s)
            columns[f"{what} / grid"].append(plain_s / columns["grid, s"][-1])
            columns[f"{what} / grid, CPU s"].append(plain_cpu_s / columns["grid, CPU s"][-1])
    print(f"{len(jobs)} networks, {steps_n} steps with {BATCH_N} of {rows_n:,} rows x {CHANNELS_N}")
    statistics: dict[str, Callable[[list[float]], float]] = {"lowest": min, "median": median, "highest": max}
    print(table([
        {"": what} | {name: f"{function(values):.2f}" for name, function in statistics.items()}
        for what, values in columns.items()
    ]))  # fmt: skip


if __name__ == "__main__":
    main()
