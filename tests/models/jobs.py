"""What small networks learn from in tests: rows whose targets are a smooth function of their inputs."""

import numpy as np

from reskin.models.batches import LabelledRows, PreparedJob, UnlabelledRows
from reskin.models.losses import triplet_points
from reskin.models.network import draw_weights, paper_layers
from reskin.seeds import rng_for


def some_weights(*names: str | int) -> dict[str, np.ndarray]:
    return draw_weights(paper_layers(15), rng_for(0, "weights", *names))


def some_rows(n: int, *names: str | int) -> tuple[np.ndarray, np.ndarray]:
    inputs = rng_for(0, "inputs", *names).normal(size=(n, 15)).astype(np.float32)
    return inputs, np.tanh(inputs[:, :3] - inputs[:, 3:6])


def some_job(name: str | int = 0, *, n: int = 32, terms: bool = False, draws: str | int = "draws") -> PreparedJob:
    """A fresh job, the same for the same name; with `terms`, it holds all that a loss can stand on."""
    inputs, targets = some_rows(n, name)
    start, rng = some_weights(name), rng_for(0, draws, name)
    if not terms:
        return PreparedJob(start, rng, LabelledRows(inputs, targets, None))
    places = rng_for(0, "places", name).integers(0, 5, (n, 2)).astype(np.float64)
    labelled = LabelledRows(inputs, targets, triplet_points(places, np.arange(n) % 2))
    poked, _ = some_rows(20, name, "poked")
    row = np.concatenate([np.arange(20), np.arange(10)])  # the first ten rows lie on two lines
    line_i = np.repeat([0, 1, 2], 10)
    order = triplet_points(np.tile(np.arange(10) // 2, 3)[:, None].astype(np.float64), line_i)
    own = LabelledRows(*some_rows(6, name, "own"), None)
    return PreparedJob(start, rng, labelled, UnlabelledRows(poked, order, row), own)
