"""Small recipes, training data and jobs for tests.

`some_job` prepares a network whose targets are a smooth function of the inputs. The other jobs use `example_data`, a
scene of four skins: the first two are training skins, and the last one is the new skin, to which networks are adapted.
"""

from dataclasses import replace

import numpy as np

from reskin.data.lines import Lines, hand_lines
from reskin.models.batches import LabelledRows, PreparedJob, UnlabelledRows
from reskin.models.inputs import fit_standard
from reskin.models.job import Adaptation, FineTuning, Pretrained, TrainingData, TrainingJob
from reskin.models.losses import triplet_points
from reskin.models.network import draw_weights, paper_layers
from reskin.models.recipe import AdaptationRecipe, FineTuningRecipe, Recipe
from reskin.seeds import rng_for

ROWS_N = 48  # There are twelve rows on each of four skins.
TRAIN, TEST, POKED, LABELLED = np.arange(24), np.arange(42, 48), np.arange(36, 42), np.arange(36, 39)
SETTINGS = {"steps_n": 4, "batch_n": 16, "rate_max": 3e-3, "gradient_norm_max": 1.0, "weight_decay": 0.0}


def recipe(**changes: object) -> Recipe:
    values = {
        "architecture": "paper",
        "inputs": "raw",
        "scaling": "standard",
        "triplet_weight": 0.0,
        "steps_n": 4,
        "batch_n": 16,
        "rate_max": 3e-3,
        "gradient_norm_max": 1.0,
        "weight_decay": 0.0,
    }
    return Recipe.model_validate(values | changes)


def some_weights(*names: str | int) -> dict[str, np.ndarray]:
    return draw_weights(paper_layers(15), rng_for(0, "weights", *names))


def some_rows(n: int, *names: str | int) -> tuple[np.ndarray, np.ndarray]:
    inputs = rng_for(0, "inputs", *names).normal(size=(n, 15)).astype(np.float32)
    return inputs, np.tanh(inputs[:, :3] - inputs[:, 3:6])


def some_job(name: str | int = 0, *, n: int = 32, terms: bool = False, draws: str | int = "draws") -> PreparedJob:
    """Return a new prepared job. Equal arguments give equal jobs.

    With `terms`, the job contains the data for all loss terms.
    """
    inputs, targets = some_rows(n, name)
    start, rng = some_weights(name), rng_for(0, draws, name)
    if not terms:
        return PreparedJob(start, rng, LabelledRows(inputs, targets, None))
    places = rng_for(0, "places", name).integers(0, 5, (n, 2)).astype(np.float64)
    labelled = LabelledRows(inputs, targets, triplet_points(places, np.arange(n) % 2))
    poked, _ = some_rows(20, name, "poked")
    row = np.concatenate([np.arange(20), np.arange(10)])  # Rows 0 to 9 are on two lines each.
    line_i = np.repeat([0, 1, 2], 10)
    order = triplet_points(np.tile(np.arange(10) // 2, 3)[:, None].astype(np.float64), line_i)
    few_labels = LabelledRows(*some_rows(6, name, "own"), None)
    return PreparedJob(start, rng, labelled, UnlabelledRows(poked, order, row), few_labels)


def example_data() -> TrainingData:
    rng = rng_for(0, "rows")
    db_uT = rng.normal(0, 50, (ROWS_N, 15)).astype(np.float32)
    target = np.hstack([2.0 * rng.integers(0, 5, (ROWS_N, 2)), rng.uniform(0, 3, (ROWS_N, 1))]).astype(np.float32)
    return TrainingData(db_uT, target, np.repeat(["b0_s0", "b0_s1", "b1_s0", "b1_s1"], 12))


def with_values(data: TrainingData, part: str, row: np.ndarray, value: object) -> TrainingData:
    """Return the training data, with `value` in the given rows of the array named `part`."""
    values = getattr(data, part).copy()
    values[row] = value
    return replace(data, **{part: values})


def pooled(**changes: object) -> TrainingJob:
    return TrainingJob("triplet", "paper", recipe(triplet_weight=0.5, **changes), "b1", 7, 0, TRAIN, TEST)


def without_triplets() -> TrainingJob:
    return replace(pooled(), recipe=recipe())


def lines(row: np.ndarray = POKED) -> Lines:
    """Return the pokes of a new skin as one line, which has two pokes at each place."""
    one = hand_lines(np.zeros(len(row), np.int32), np.repeat(np.arange(len(row) // 2), 2).astype(np.int32))
    return replace(one, row=row[one.row])


def start(key: str = "start") -> Pretrained:
    rows = example_data()
    weights = draw_weights(paper_layers(15), rng_for(0, "start"))
    return Pretrained(key, weights, fit_standard(rows.db_uT[TRAIN], rows.target[TRAIN]))


def adaptation(*, unlabelled_weight: float = 0.5, along: Lines | None = None) -> TrainingJob:
    settings = AdaptationRecipe(unlabelled_weight=unlabelled_weight, **SETTINGS)
    return replace(pooled(), experiment="adapt", skin="b1_s1", tuning=Adaptation(start(), settings, along or lines()))


def fine_tuning(*, own_weight: float = 0.5) -> TrainingJob:
    tuning = FineTuning(start(), FineTuningRecipe(own_weight=own_weight, **SETTINGS), LABELLED)
    return replace(pooled(), experiment="labels", skin="b1_s1", tuning=tuning)
