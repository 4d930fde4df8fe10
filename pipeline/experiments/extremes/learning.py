"""Extreme cases of learning: small training runs on random data in uT, mm and N."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from jaxtyping import Float32

from pipeline.experiments.extremes.cases import Case, World, largest
from reskin.metrics import METRICS, score
from reskin.models.job import FineTuning, Pretrained, TrainingData, TrainingJob, TrainingResult, curve_steps
from reskin.models.recipe import FineTuningRecipe, Recipe
from reskin.seeds import rng_for

ROWS_N, TRAIN_N, CHANNELS_N = 240, 160, 15
# Middle and half range of the targets (x in mm, y in mm, force in N); forces are 0.6 to 9.4 N, as in recordings.
MIDDLE, REACH = np.array([8.0, 8.0, 5.0]), np.array([8.0, 8.0, 4.4])
BLOCK_N, COLLAPSE_N = 50, 200  # steps after which the training loop checks for divergence and for a collapse
CONSTANT_uT = 12.3
RECIPE = Recipe(
    architecture="paper", inputs="raw", scaling="standard", triplet_weight=0.0, steps_n=BLOCK_N, batch_n=32,
    rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.0,
)  # fmt: skip


def make_job(seed: int, **settings: float) -> TrainingJob:
    recipe = RECIPE.model_copy(update=settings)
    return TrainingJob("extremes", "paper", recipe, "f", seed, 0, np.arange(TRAIN_N), np.arange(TRAIN_N, ROWS_N))


def make_rows(seed: int) -> TrainingData:
    signal = rng_for(seed, "extremes", "learning").normal(0, 1, (ROWS_N, CHANNELS_N))
    target = MIDDLE + REACH * np.tanh(signal[:, :3])
    return TrainingData((50 * signal).astype(np.float32), target.astype(np.float32), np.arange(ROWS_N) % 2)


def train(jobs: Sequence[TrainingJob], rows: TrainingData) -> list[TrainingResult]:
    """Train networks together."""
    from reskin.models.train import train_stack  # imports torch, which takes a second

    return train_stack(list(jobs), rows)


@cache
def trained_once(seed: int) -> TrainingResult:
    return train([make_job(seed)], make_rows(seed))[0]


def tuned(seed: int, scale: float, **settings: float) -> TrainingJob:
    """Return a job that fine-tunes a trained network whose bottleneck weights were multiplied by `scale`."""
    trained = trained_once(seed)
    bottleneck = {"layer3.weight": trained.weights["layer3.weight"] * np.float32(scale)}
    usual = {"steps_n": BLOCK_N, "batch_n": 32, "rate_max": 3e-3, "gradient_norm_max": 1.0, "weight_decay": 0.0}
    recipe = FineTuningRecipe.model_validate(usual | {"own_weight": 1.0} | settings)
    job = make_job(seed)
    start = Pretrained("", {**trained.weights, **bottleneck}, trained.scaler)
    return replace(job, tuning=FineTuning(start, recipe, job.test[:20]))


def constant_channels(world: World) -> float:
    rows = make_rows(world.seed)
    rows = replace(rows, db_uT=np.full_like(rows.db_uT, CONSTANT_uT))
    (trained,) = train([make_job(world.seed)], rows)
    return float(np.abs(trained.scaler.encode(rows.db_uT)).max()) if _is_sound(trained) else np.inf


def label_scale(world: World, power: int) -> float:
    """Return the change of the scores if labels are multiplied by 2^power and predictions are divided by it."""
    rows, job = make_rows(world.seed), make_job(world.seed)
    true = rows.target[job.test]
    (usual,), (scaled,) = (train([job], replace(rows, target=_times(rows.target, 2.0**p))) for p in (0, power))
    first, other = score(true, usual.predicted), score(true, _times(scaled.predicted, 2.0**-power))
    return largest(*(abs(other[name] / first[name] - 1) for name in METRICS))


def identical_readings(world: World) -> float:
    """Return the largest change of a weight due to the triplet loss."""
    rows = make_rows(world.seed)
    rows = replace(rows, db_uT=np.full_like(rows.db_uT, CONSTANT_uT))
    (plain,), (pulled,) = (train([make_job(world.seed, triplet_weight=weight)], rows) for weight in (0.0, 1e3))
    return _distance(plain.weights, pulled.weights) if _is_sound(pulled) else np.inf


def exploding(world: World) -> float:
    """Return the number of steps between the kept weights and the last check before the divergence."""
    job = tuned(world.seed, 1e3, steps_n=3 * BLOCK_N, rate_max=1e10)
    (trained,) = train([job], make_rows(world.seed))
    if trained.stopped_step is None or not all(np.isfinite(value).all() for value in trained.weights.values()):
        return np.inf
    kept_step = curve_steps(3 * BLOCK_N)[len(trained.curve) - 1] if trained.curve else 0
    return float(abs(trained.stopped_step - BLOCK_N - kept_step))


def overflowing_neighbour(world: World) -> float:
    """Return the largest change of a weight if a network is trained together with one that overflows."""
    rows = make_rows(world.seed)
    sound, broken = (tuned(world.seed, scale) for scale in (1.0, 1e30))
    (alone,), (beside, overflowing) = train([sound], rows), train([sound, broken], rows)
    expected = _is_sound(beside) and overflowing.stopped_step == BLOCK_N
    return _distance(alone.weights, beside.weights) if expected else np.inf


def collapsed(world: World) -> float:
    """Return the number of networks, one that predicts a constant and one that does not, that are judged wrongly."""
    jobs = [tuned(world.seed, scale, steps_n=COLLAPSE_N, rate_max=1e-12) for scale in (0.0, 1.0)]
    dead, alive = train(jobs, make_rows(world.seed))
    return float((not dead.collapsed) + alive.collapsed)


def one_row(world: World) -> float:
    """Return the largest error of a prediction after training on a single row."""
    rows, job = make_rows(world.seed), make_job(world.seed)
    (trained,) = train([replace(job, train=job.train[:1], test=job.train[:1])], rows)
    return float(np.abs(trained.predicted - rows.target[:1]).max())


def _times(target: Float32[np.ndarray, "f 3"], scale: float) -> Float32[np.ndarray, "f 3"]:
    return (target.astype(np.float64) * scale).astype(np.float32)


def _distance(weights: Mapping[str, np.ndarray], others: Mapping[str, np.ndarray]) -> float:
    return largest(*(float(np.abs(others[name] - weights[name]).max()) for name in others))


def _is_sound(trained: TrainingResult) -> bool:
    return trained.stopped_step is None and bool(np.isfinite(trained.predicted).all())


_AMPLIFIED = "Another order of summation changes a float32 sum by 6e-8, and 50 steps amplify the change."
_case = partial(Case, "learning")
CASES: tuple[Case, ...] = (
    _case("constant_channels", "scaled inputs if all channels are constant, as without a magnet",
          "0: the scale has a minimum", constant_channels, 0.0, "Exact."),
    *(_case(f"label_scale_{power}", f"scores with labels multiplied by 2^{power}",
            "the same scores after scaling back", partial(label_scale, power=power), 0.0,
            "Powers of two cause no rounding errors.", full=True)
      for power in (-20, 20)),
    _case("identical_readings", "weights after training with a triplet weight of 1000 on identical readings",
          "weights without triplet loss: its gradient is 0", identical_readings, 0.0, "Exact.", full=True),
    _case("exploding", "kept weights after a divergence (bottleneck times 1e3, learning rate 1e10)",
          "the finite weights of the last check", exploding, 0.0, "Exact.", unit="steps"),
    _case("overflowing_neighbour", "weights of a network trained together with one that overflows",
          "weights of the network trained alone", overflowing_neighbour, 1e-4, _AMPLIFIED, full=True),
    _case("collapsed", "a network that predicts a constant, and one that does not",
          "only the first counts as collapsed", collapsed, 0.0, "Exact.", unit="networks", full=True),
    _case("one_row", "prediction after training on one row", "its place and force", one_row, 1e-4, _AMPLIFIED,
          unit="mm or N", full=True),
)  # fmt: skip
