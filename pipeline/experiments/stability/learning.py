"""Extreme cases of learning: small training runs on random data in uT, mm and N."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float32

from pipeline.experiments.stability.cases import Case, condition_case, error_case, rejection_case
from reskin.data.rows import Rows
from reskin.data.splits import Split, draw_folds
from reskin.metrics import METRICS, score
from reskin.models.job import FineTuning, Pretrained, TrainingData, TrainingJob, TrainingResult, curve_steps
from reskin.models.recipe import FineTuningRecipe, Recipe
from reskin.models.train import BLOCK_STEPS_N, CHECKED_STEPS_N, train_stack
from reskin.seeds import rng_for

AREA = "learning"
ROWS_N, TRAIN_N, CHANNELS_N = 240, 160, 15
SIGNAL_uT = 50.0
# Middle and half range of the targets (x in mm, y in mm, force in N); forces are 0.6 to 9.4 N, as in recordings.
MIDDLE, REACH = np.array([8.0, 8.0, 5.0]), np.array([8.0, 8.0, 4.4])
STEPS_N = BLOCK_STEPS_N  # number of steps after which the training loop checks the loss for the first time
CONSTANT_uT = 12.3
BOTTLENECK = "layer3.weight"
# Tolerance for weights, whose size is about 0.1. Another order of summation changes a float32 sum by 6e-8, and 50 steps
# amplify the change.
ROUNDING = 1e-4
NEGLIGIBLE_RATE = 1e-12  # learning rate at which the weights hardly change
SCALE_POWERS = (-20, -10, 10, 20)  # labels are multiplied by 2^power (1e-6 to 1e6), which causes no rounding errors
RECIPE = Recipe(
    architecture="paper", inputs="raw", scaling="standard", triplet_weight=0.0, steps_n=STEPS_N, batch_n=32,
    rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.0,
)  # fmt: skip


def learning_cases(seed: int) -> list[Case]:
    """Run all cases of learning: scalers, triplets, the training loop and folds."""
    return [*scaling_cases(seed), *triplet_cases(seed), *loop_cases(seed), *fold_cases()]


def scaling_cases(seed: int) -> list[Case]:
    """Run cases of constant channels, and of labels multiplied by large and small factors."""
    job, rows = _job(seed), _rows(seed)
    return [
        _constant(job, rows, [7], "a constant channel"),
        _constant(job, rows, list(range(CHANNELS_N)), "all channels are constant, as without a magnet"),
        *_label_scales(job, rows),
    ]


def triplet_cases(seed: int) -> list[Case]:
    """Run cases of the triplet loss with identical readings, and with places at equal distances."""
    job, rows = _job(seed), _rows(seed)
    return [_identical(job, rows), *_equidistant(job, rows)]


def loop_cases(seed: int) -> list[Case]:
    """Run cases of the training loop: overflow, a collapsed network, very few rows, and two runs with the same seed."""
    job, rows = _job(seed), _rows(seed)
    overflow = [
        _exploding_weights(job, rows, 1e1),
        _exploding_weights(job, rows, 1e10),
        _overflowing_neighbour(job, rows),
    ]
    return [*overflow, _collapsed(job, rows), *_few_rows(job, rows), _same_seed(job, rows)]


def fold_cases() -> list[Case]:
    """Run cases of folds that need more boards or skins than the data have."""
    boards = ["b1", "b2", "b3"]
    folds = {
        "one board, which is left out for testing": ("lobo", boards[:1], Split()),
        "two boards, both for training, and none left for testing": ("transfer", boards[:2], Split(transfer_skins_n=2)),
        "three training skins required, but only two available": (
            "sensors",
            boards,
            Split(sensors_skins_n=(3,), sensors_draws_n=1),
        ),
    }
    return [
        rejection_case(AREA, case, should="an error that states how many there are",
                       attempt=partial(draw_folds, Rows.of_labels(groups, skins=groups), [experiment], split, 0))
        for case, (experiment, groups, split) in folds.items()
    ]  # fmt: skip


def _job(seed: int) -> TrainingJob:
    return TrainingJob("stability", "paper", RECIPE, "f", seed, 0, np.arange(TRAIN_N), np.arange(TRAIN_N, ROWS_N))


def _rows(seed: int) -> TrainingData:
    signal = rng_for(seed, "stability", "learning").normal(0, 1, (ROWS_N, CHANNELS_N))
    target = MIDDLE + REACH * np.tanh(signal[:, :3])
    return TrainingData((SIGNAL_uT * signal).astype(np.float32), target.astype(np.float32), np.arange(ROWS_N) % 2)


def _constant(job: TrainingJob, rows: TrainingData, channels: list[int], case: str) -> Case:
    db_uT = rows.db_uT.copy()
    db_uT[:, channels] = CONSTANT_uT
    trained = _train(job, replace(rows, db_uT=db_uT))
    scaler = trained.scaler
    largest_input = float(np.abs(scaler.encode(db_uT)[:, channels]).max())
    observed = (
        f"scale {scaler.input_scale[channels].min():.0e} uT, scaled inputs at most {largest_input:g}; "
        f"{_outcome(trained)}"
    )
    return error_case(AREA, case, should="the scale has a minimum, so that the scaled input is 0; training succeeds",
                      happened=observed,
                      error=largest_input if _is_sound(trained) else np.inf, limit=0.0)  # fmt: skip


def _identical(job: TrainingJob, rows: TrainingData) -> Case:
    identical = replace(rows, db_uT=np.full_like(rows.db_uT, CONSTANT_uT))
    plain, pulled = (_train(_with(job, triplet_weight=weight), identical) for weight in (0.0, 1e3))
    distance = _distance(plain.weights, pulled.weights)
    observed = f"{STEPS_N} steps; weights differ by {distance:g} from those without triplet loss; {_outcome(pulled)}"
    should = "the triplet loss has a gradient of exactly 0, so that the weights equal those without triplet loss"
    return error_case(AREA, "triplet loss of identical readings, with a weight of 1000", should=should,
                      happened=observed, error=distance if _is_sound(pulled) else np.inf, limit=0.0)  # fmt: skip


def _equidistant(job: TrainingJob, rows: TrainingData) -> list[Case]:
    job = _with(job, triplet_weight=0.1)
    target = rows.target.copy()
    target[:, :2] = MIDDLE[:2]
    attempts = {
        "triplets if all pokes of a skin are at the same place": (job, replace(rows, target=target)),
        "triplets if each skin has only two pokes": (replace(job, train=np.arange(4)), rows),
    }
    should = "an error instead of an endless search, because no poke has a nearer and a farther neighbour"
    return [
        rejection_case(AREA, case, should=should, attempt=partial(_train, *arguments))
        for case, arguments in attempts.items()
    ]


def _exploding_weights(job: TrainingJob, rows: TrainingData, rate: float) -> Case:
    start, steps_n = _start(job, rows, 1e3), 3 * STEPS_N
    trained = _train(_tuned(job, start, steps_n=steps_n, rate_max=rate), rows)
    kept_step = curve_steps(steps_n)[len(trained.curve) - 1] if trained.curve else 0
    stopped = "never stopped" if trained.stopped_step is None else f"diverged at step {trained.stopped_step}"
    losses = f"; largest loss {max(trained.curve):.1e}, last loss {trained.curve[-1]:.2g}" if trained.curve else ""
    sound = all(np.isfinite(value).all() for value in trained.weights.values())
    observed = f"{stopped}; weights of step {kept_step} of {steps_n}, {'all' if sound else 'not all'} finite{losses}"
    case = f"weights of the bottleneck multiplied by 1e3, learning rate {rate:g}"
    should = "training stops, reports the step, and keeps the last finite weights"
    return condition_case(AREA, case, should=should, happened=observed,
                holds=sound and trained.stopped_step == kept_step + STEPS_N)  # fmt: skip


def _overflowing_neighbour(job: TrainingJob, rows: TrainingData) -> Case:
    sound, broken = (_tuned(job, _start(job, rows, scale)) for scale in (1.0, 1e30))
    alone = _train(sound, rows)
    beside, overflowing = train_stack([sound, broken], rows)
    change = _distance(alone.weights, beside.weights)
    observed = (
        f"{_outcome(overflowing)}; other network: {_outcome(beside)}, weights differ by {change:g} from training alone"
    )
    holds = _is_sound(beside) and overflowing.stopped_step == STEPS_N
    return error_case(AREA, "a network that overflows, trained together with another network",
                      should="the other network is the same as if it were trained alone",
                      happened=observed, limit=ROUNDING,
                      error=change if holds else np.inf)  # fmt: skip


def _collapsed(job: TrainingJob, rows: TrainingData) -> Case:
    dead, alive = (
        _train(_tuned(job, _start(job, rows, scale), steps_n=CHECKED_STEPS_N, rate_max=NEGLIGIBLE_RATE), rows)
        for scale in (0.0, 1.0)
    )
    spread = float(np.ptp(dead.predicted, axis=0).max())
    observed = (
        f"{_outcome(dead)}, predictions differ by {spread:.1g}; explained variance {dead.explained_min:.2g}, "
        f"{'counted as collapsed' if dead.collapsed else 'not counted as collapsed'}; with the original weights: "
        f"{alive.explained_min:.2g}, {'counted as collapsed' if alive.collapsed else 'not counted as collapsed'}"
    )
    return condition_case(AREA, "a network that predicts a constant, with a finite loss",
                          should="counted as collapsed; the network with the original weights is not",
                          happened=observed,
                          holds=_is_sound(dead) and dead.collapsed and not alive.collapsed)  # fmt: skip


def _few_rows(job: TrainingJob, rows: TrainingData) -> list[Case]:
    single = _train(replace(job, train=job.train[:1], test=job.train[:1]), rows)
    error = float(np.abs(single.predicted - rows.target[job.train[:1]]).max())
    by_one = _train(_with(job, batch_n=1), rows)
    return [
        condition_case(AREA, "batches of one row", should="training succeeds", happened=_outcome(by_one),
                       holds=_is_sound(by_one)),
        error_case(AREA, "one training row", should="predicts the place and the force of this row",
                   happened=f"largest error {error:.1e} (x, y in mm, force in N); {_outcome(single)}",
                   error=error if _is_sound(single) else np.inf, limit=ROUNDING),
        rejection_case(AREA, "one training row, with triplets", should="an error, because one row contains no triplet",
                       attempt=partial(_train, _with(replace(job, train=job.train[:1]), triplet_weight=0.1), rows)),
    ]  # fmt: skip


def _label_scales(job: TrainingJob, rows: TrainingData) -> list[Case]:
    true = rows.target[job.test]
    unscaled = score(true, _train(job, rows).predicted)
    cases = []
    for power in SCALE_POWERS:
        scale = 2.0**power
        trained = _train(job, replace(rows, target=_scale(rows.target, scale)))
        rescaled = score(true, _scale(trained.predicted, 1 / scale))
        error = max(abs(rescaled[name] / unscaled[name] - 1) for name in METRICS)
        observed = "; ".join(f"{name} {rescaled[name]:.4g}, unscaled {unscaled[name]:.4g}" for name in METRICS)
        cases.append(error_case(AREA, f"labels multiplied by 2^{power}",
                                should="predictions, scaled back, have exactly the same scores as without scaling",
                                happened=observed, error=error, limit=0.0))  # fmt: skip
    return cases


def _same_seed(job: TrainingJob, rows: TrainingData) -> Case:
    job = _with(job, triplet_weight=0.1)
    first, again = (_train(job, rows) for _ in range(2))
    pairs = [
        (first.predicted, again.predicted),
        *((first.weights[name], again.weights[name]) for name in again.weights),
    ]
    identical_n = sum(value.tobytes() == other.tobytes() for value, other in pairs)
    seed_distance = _distance(first.weights, _train(replace(job, seed_i=1), rows).weights)
    observed = (
        f"{identical_n} of {len(pairs)} arrays identical bit for bit; weights with another seed differ by "
        f"{seed_distance:.2g}"
    )
    return condition_case(AREA, "two training runs with the same seed",
                should="weights and predictions are identical; another seed gives other weights",
                happened=observed, holds=identical_n == len(pairs) and seed_distance > 0)  # fmt: skip


def _train(job: TrainingJob, rows: TrainingData) -> TrainingResult:
    return train_stack([job], rows)[0]


def _with(job: TrainingJob, **settings: float | int) -> TrainingJob:
    return replace(job, recipe=RECIPE.model_copy(update=settings))


def _start(job: TrainingJob, rows: TrainingData, scale: float) -> Pretrained:
    """Return a trained network whose bottleneck weights are multiplied by `scale`, as the start of fine-tuning."""
    trained = _train(job, rows)
    weights = {**trained.weights, BOTTLENECK: trained.weights[BOTTLENECK] * np.float32(scale)}
    return Pretrained("", weights, trained.scaler)


def _tuned(
    job: TrainingJob, start: Pretrained, *, steps_n: int = STEPS_N, rate_max: float = RECIPE.rate_max
) -> TrainingJob:
    settings = FineTuningRecipe(
        steps_n=steps_n, batch_n=RECIPE.batch_n, rate_max=rate_max, gradient_norm_max=RECIPE.gradient_norm_max,
        weight_decay=0.0, own_weight=1.0,
    )  # fmt: skip
    return replace(job, tuning=FineTuning(start, settings, job.test[:20]))


def _scale(target: Float32[np.ndarray, "f 3"], scale: float) -> Float32[np.ndarray, "f 3"]:
    return (target.astype(np.float64) * scale).astype(np.float32)


def _distance(weights: Mapping[str, np.ndarray], others: Mapping[str, np.ndarray]) -> float:
    return max(float(np.abs(others[name] - weights[name]).max()) for name in others)


def _is_sound(trained: TrainingResult) -> bool:
    return trained.stopped_step is None and bool(np.isfinite(trained.predicted).all())


def _outcome(trained: TrainingResult) -> str:
    if trained.stopped_step is not None:
        return f"diverged at step {trained.stopped_step}"
    finite_n = int(np.isfinite(trained.predicted).all(axis=1).sum())
    return f"loss {trained.curve[-1]:.2g}, {finite_n} of {len(trained.predicted)} predictions finite"
