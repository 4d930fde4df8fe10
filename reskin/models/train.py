"""The training loop, for a stack of networks with equal settings."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, Shaped

from reskin.errors import TrainingError
from reskin.models.inputs import FIT, VIEW, Scaler
from reskin.models.losses import Points, draw_pairs, make_points
from reskin.models.network import LAYERS, Predictor, Stack, draw_weights
from reskin.models.recipe import Augmentation, AugmentedRecipe, Schedule
from reskin.models.trial import Adapting, FewLabels, Measured, Terms, Trained, Trial, Weights, median_s
from reskin.numerics import device
from reskin.seeds import rng_for

AXES_N = 3


@dataclass(frozen=True)
class Labelled:
    """Rows with scaled targets; `points` orders them, for a recipe with a triplet term."""

    inputs: Float32[np.ndarray, "n c"]
    targets: Float32[np.ndarray, "n t"]
    points: Points | None


@dataclass(frozen=True)
class Unlabelled:
    """Rows of which only the order along lines is known; a row may lie on two lines, so each point names its row."""

    inputs: Float32[np.ndarray, "p c"]
    points: Points
    row: Int64[np.ndarray, " q"]


@dataclass(frozen=True)
class Job:
    """What one network starts from and learns from; `unlabelled` and `few_labels` are pokes of a new skin."""

    start: Weights
    rng: np.random.Generator
    labelled: Labelled
    unlabelled: Unlabelled | None = None
    few_labels: Labelled | None = None


def make_job(trial: Trial, rows: Measured) -> tuple[Job, Scaler]:
    """Scale what a trial learns from: by a scaler fitted on its training rows, or by that of its first network."""
    recipe = trial.recipe
    target = rows.target[trial.train]
    # Without the recipe in its name: recipes are compared from equal starts on equal batches.
    again = ("again", trial.attempt_i) if trial.attempt_i else ()
    rng = rng_for(trial.seed, "train", trial.fold, trial.skin, trial.seed_i, *again)
    if trial.tuning is None:
        view = VIEW[recipe.inputs](rows.db_uT[trial.train])
        scaler = FIT[recipe.scaling](view, target)
        layers = LAYERS[recipe.architecture](view.shape[1], target.shape[1])
        # A ReLU on the output (the released network) begins dead for some target in about every third network if its
        # bias is random too, and what is dead never learns.
        start: Weights = draw_weights(layers, rng) | {f"layer{len(layers)}.bias": _mean_target(scaler, target)}
    else:
        scaler, start = trial.tuning.start.scaler, trial.tuning.start.weights
    job = Job(
        start,
        rng,
        _labelled(trial, rows, scaler),
        _unlabelled(trial, rows, scaler) if trial.terms.unlabelled else None,
        _few_labels(trial, rows, scaler) if trial.terms.few_labels else None,
    )
    return job, scaler


def virtual_boards(
    db_uT: Float32[np.ndarray, "f ch"],
    skin: Shaped[np.ndarray, " f"],
    settings: Augmentation,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "v ch"], Shaped[np.ndarray, " v"]]:
    """Copy all rows `copies_n` times, every copy of a skin as another board would read it; also the copies' skins.

    Copy c of row i is row c * f + i. Each copy of a skin has random gains for each channel and leans for each chip;
    noise is random for each reading.
    """
    from scipy.spatial.transform import Rotation  # late: only a recipe with virtual boards pays for it

    codes = np.unique(skin, return_inverse=True)[1]
    skins_n, chips_n = codes.max() + 1, db_uT.shape[1] // AXES_N
    copies = []
    for _ in range(settings.copies_n):
        lean = Rotation.from_rotvec(
            np.radians(settings.lean_sd_deg) * rng.standard_normal((skins_n * chips_n, AXES_N))
        ).as_matrix()
        gain = 1.0 + settings.gain_sd * rng.standard_normal((skins_n, chips_n, AXES_N, 1))
        read = (gain * lean.reshape(skins_n, chips_n, AXES_N, AXES_N)).astype(np.float32)
        turned = np.einsum("fkij,fkj->fki", read[codes], db_uT.reshape(len(db_uT), chips_n, AXES_N))
        noise = settings.noise_uT * rng.standard_normal(db_uT.shape, dtype=np.float32)
        copies.append(turned.reshape(db_uT.shape) + noise)
    names = [codes + copy_i * skins_n for copy_i in range(settings.copies_n)]
    return np.concatenate(copies).astype(np.float32), np.concatenate(names)


def _mean_target(scaler: Scaler, target: np.ndarray) -> Float32[np.ndarray, " t"]:
    """Give the mean of every scaled target; 0 for one that is not known."""
    known = ~np.isnan(target).all(axis=0)
    mean = np.zeros(target.shape[1], np.float32)
    mean[known] = np.nanmean(scaler.encode_target(target)[:, known], axis=0, dtype=np.float64)
    return mean


def _labelled(trial: Trial, rows: Measured, scaler: Scaler) -> Labelled:
    db_uT, target, skin = (values[trial.train] for values in (rows.db_uT, rows.target, rows.skin))
    if isinstance(trial.recipe, AugmentedRecipe):
        rng = rng_for(trial.seed, "augment", trial.fold, trial.seed_i)
        copies_uT, copied_skin = virtual_boards(db_uT, skin, trial.recipe.augmentation, rng)
        skin_i = np.unique(skin, return_inverse=True)[1]
        skin = np.concatenate([skin_i, copied_skin + skin_i.max() + 1])
        db_uT = np.concatenate([db_uT, copies_uT])
        target = np.tile(target, (1 + trial.recipe.augmentation.copies_n, 1))
    points = make_points(target[:, :2], skin) if trial.recipe.triplet_weight else None
    return Labelled(scaler.encode(VIEW[trial.recipe.inputs](db_uT)), scaler.encode_target(target), points)


def _unlabelled(trial: Trial, rows: Measured, scaler: Scaler) -> Unlabelled:
    """Take of a new skin's unlabelled pokes the change of field and the order along lines, and nothing else."""
    assert isinstance(trial.tuning, Adapting)
    lines = trial.tuning.lines
    row, point_row = np.unique(lines.row, return_inverse=True)
    view = VIEW[trial.recipe.inputs](rows.db_uT[row])
    points = make_points(lines.order_i[:, None].astype(np.float64), lines.line_i)
    return Unlabelled(scaler.encode(view), points, point_row.astype(np.int64))


def _few_labels(trial: Trial, rows: Measured, scaler: Scaler) -> Labelled:
    assert isinstance(trial.tuning, FewLabels)
    row = trial.tuning.row
    view = VIEW[trial.recipe.inputs](rows.db_uT[row])
    return Labelled(scaler.encode(view), scaler.encode_target(rows.target[row]), None)


Batch = dict[str, torch.Tensor]
Chosen = dict[str, Int64[np.ndarray, "s b"]]


class Feed:
    """Holds the rows of a stack on the device, each network's below the other's, and draws its batches."""

    def __init__(self, jobs: Sequence[Job], batch_n: int, device: str) -> None:
        self.jobs, self.batch_n, self.device = jobs, batch_n, device
        # A stream for each kind of draw: one more term of the loss leaves all other batches as they are.
        self.rngs = [dict(zip(_STREAMS, job.rng.spawn(len(_STREAMS)), strict=True)) for job in jobs]
        sets: dict[str, list[np.ndarray]] = {
            "labelled": [job.labelled.inputs for job in jobs],
            "targets": [job.labelled.targets for job in jobs],
            "unlabelled": [job.unlabelled.inputs for job in jobs if job.unlabelled],
            "few_labels": [job.few_labels.inputs for job in jobs if job.few_labels],
            "few_labels_targets": [job.few_labels.targets for job in jobs if job.few_labels],
        }
        self.rows = {name: torch.from_numpy(np.concatenate(rows)).to(device) for name, rows in sets.items() if rows}
        self.first = {name: np.cumsum([0, *map(len, rows)])[:-1] for name, rows in sets.items()}

    def draw(self, steps_n: int) -> Iterator[Batch]:
        """Draw the batches of so many steps: `labelled`, `targets`, and what else the jobs hold.

        `near` and `far` are the positives and negatives of the labelled rows, those in `UNLABELLED` a triplet of
        unlabelled ones, `few_labels` and `few_labels_targets` the new skin's labelled rows.
        """
        chosen = [_choose(job, (steps_n, self.batch_n), rngs) for job, rngs in zip(self.jobs, self.rngs, strict=True)]
        block = {name: self._gather(name, [rows[name] for rows in chosen]) for name in chosen[0]}
        return ({name: values[i] for name, values in block.items()} for i in range(steps_n))

    def _gather(self, name: str, chosen: list[np.ndarray]) -> torch.Tensor:
        source = _SOURCE.get(name, name)
        pairs = zip(chosen, self.first[source], strict=True)
        rows = np.stack([row + first for row, first in pairs], axis=1)  # [s m b]
        return self.rows[source][torch.from_numpy(rows).to(self.device)]


UNLABELLED = ("unlabelled", "unlabelled_near", "unlabelled_far")
# batch -> the rows that it is drawn from, where they are named differently
_SOURCE = {"near": "labelled", "far": "labelled", "unlabelled_near": "unlabelled", "unlabelled_far": "unlabelled"}
_STREAMS = ("labelled", "pairs", "unlabelled", "few_labels")


def _choose(job: Job, shape: tuple[int, int], rngs: Mapping[str, np.random.Generator]) -> Chosen:
    rows = rngs["labelled"].integers(len(job.labelled.inputs), size=shape)
    chosen = {"labelled": rows, "targets": rows}
    if job.labelled.points is not None:
        near, far = draw_pairs(job.labelled.points, rows.ravel(), rngs["pairs"])
        chosen |= {"near": near.reshape(shape), "far": far.reshape(shape)}
    if job.unlabelled is not None:
        points, row = job.unlabelled.points, job.unlabelled.row
        anchor = points.anchors[rngs["unlabelled"].integers(len(points.anchors), size=shape[0] * shape[1])]
        triplet = (anchor, *draw_pairs(points, anchor, rngs["unlabelled"]))
        chosen |= {name: row[point].reshape(shape) for name, point in zip(UNLABELLED, triplet, strict=True)}
    if job.few_labels is not None:
        rows = rngs["few_labels"].integers(len(job.few_labels.inputs), size=shape)
        chosen |= {"few_labels": rows, "few_labels_targets": rows}
    return chosen


BLOCK_STEPS_N = 50  # batches drawn at once, and how often the loss is looked at
LOST = 1e8  # mean squared error past which a network is lost, where predicting the mean has 1; few come back from it
JUDGED_STEPS_N = 200  # a shorter training from random weights may not have left its start
JUDGED_ROWS_N = 2000  # of the training rows, evenly spaced


def train_stack(trials: Sequence[Trial], rows: Measured) -> list[Trained]:
    """Train trials of equal settings side by side, and predict their test rows."""
    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    start_s, on, first = time.monotonic(), device(), trials[0]
    if on == "cuda" and not torch.cuda.is_available():
        raise TrainingError("RESKIN_DEVICE", "cuda", "there", "none that torch finds", "Unset it for cpu.")
    jobs, scalers = zip(*(make_job(trial, rows) for trial in trials), strict=True)
    architecture = first.recipe.architecture
    outcomes = train(jobs, architecture, first.schedule, first.terms, on)
    seconds = (time.monotonic() - start_s) / len(trials)
    trained = []
    for trial, scaler, outcome in zip(trials, scalers, outcomes, strict=True):
        view = VIEW[trial.recipe.inputs](rows.db_uT[trial.test])
        predict = Predictor(outcome.weights, architecture, on)
        trained.append(
            Trained(
                key="", weights=outcome.weights, scaler=scaler, curve=outcome.curve,
                predicted=_answer(scaler, predict, view), stopped_step=outcome.stopped_step, seconds=seconds,
                explained_min=_explained(trial, rows, scaler, predict),
                one_reading_s=median_s(partial(_answer, scaler, predict, view[:1])),
            )
        )  # fmt: skip
    return trained


@dataclass(frozen=True)
class Outcome:
    """A trained network, and the mean L2 loss of every block of steps (scaled units).

    `stopped_step` says when a loss or a weight was no longer finite, or the loss past `LOST`; the weights are then the
    last ones before.
    """

    weights: Weights
    curve: list[float]
    stopped_step: int | None


def train(jobs: Sequence[Job], architecture: str, schedule: Schedule, terms: Terms, device: str) -> list[Outcome]:
    """Descend the L2 loss and the terms beside it; AdamW under torch's one-cycle rate and momentum are our choice."""
    layers = LAYERS[architecture](jobs[0].labelled.inputs.shape[1], jobs[0].labelled.targets.shape[1])
    net = Stack(layers, [job.start for job in jobs]).to(device)
    optimizer = AdamW(net.parameters(), schedule.weight_decay)
    feed, watch = Feed(jobs, schedule.batch_n, device), Watch(net)
    for first in range(0, schedule.steps_n, BLOCK_STEPS_N):
        steps_n = min(BLOCK_STEPS_N, schedule.steps_n - first)
        total = torch.zeros(len(jobs), device=device)
        for step_i, batch in enumerate(feed.draw(steps_n), first):
            features = net.features(batch["labelled"])  # [m b 40]
            error = loss = squared_error(net.answer(features), batch["targets"])  # [m]
            if terms.triplet:
                near, far = net.features(batch["near"]), net.features(batch["far"])
                loss = loss + terms.triplet * triplet(features, near, far)
            if terms.unlabelled:
                anchor, near, far = (net.features(batch[name]) for name in UNLABELLED)
                loss = loss + terms.unlabelled * triplet(anchor, near, far)
            if terms.few_labels:
                loss = loss + terms.few_labels * squared_error(net(batch["few_labels"]), batch["few_labels_targets"])
            net.zero_grad()
            loss.sum().backward()  # of a sum, each network's gradient is its own
            clip(net, schedule.gradient_norm_max)  # one step too long can leave all ReLUs of a layer dead for good
            optimizer.step(*one_cycle(step_i, schedule.steps_n, schedule.rate_max))
            total += error.detach()
        if not watch.look(total / steps_n, first + steps_n):
            break
    return watch.outcomes()


def clip(net: Stack, norm_max: float) -> None:
    """Shorten the gradient of each network of a stack, all its weights as one vector, to at most `norm_max`."""
    gradients = [parameter.grad for parameter in net.parameters() if parameter.grad is not None]  # [m i o]
    norm = torch.linalg.vector_norm(
        torch.stack([torch.linalg.vector_norm(gradient, dim=(1, 2)) for gradient in gradients]), dim=0
    )
    part = (norm_max / norm).clamp(max=1.0)[:, None, None]  # of a gradient of 0, 1
    for gradient in gradients:
        gradient.mul_(part)


def squared_error(
    predicted: Float[torch.Tensor, "m b t"], truth: Float[torch.Tensor, "m b t"]
) -> Float[torch.Tensor, " m"]:
    """Mean of squared errors over all known targets of a batch; an unknown target (NaN) has no gradient."""
    known = ~torch.isnan(truth)
    # Filled before it is squared: NaN times zero is NaN, in the gradient too.
    difference = torch.where(known, predicted - truth, 0.0)
    return (difference**2).sum((1, 2)) / known.sum((1, 2))


def triplet(
    anchor: Float[torch.Tensor, "m b d"], positive: Float[torch.Tensor, "m b d"], negative: Float[torch.Tensor, "m b d"]
) -> Float[torch.Tensor, " m"]:
    """Batch mean of max(0, |a - p|^2 - |a - n|^2), squared distances of features without a margin (section 5).

    Squares, not roots: the gradient of identical points is 0 and finite.
    """
    nearer = ((anchor - positive) ** 2).sum(-1)
    farther = ((anchor - negative) ** 2).sum(-1)
    return torch.relu(nearer - farther).mean(-1)


class Watch:
    """Remembers each network's curve and its last finite weights."""

    def __init__(self, net: Stack) -> None:
        self.net = net
        self.last = [net.member(i) for i in range(net.members_n)]
        self.curves: list[list[float]] = [[] for _ in self.last]
        self.stopped: dict[int, int] = {}

    def look(self, error: Float[torch.Tensor, " m"], step: int) -> bool:
        """Note a block's mean errors; false when no network of the stack is finite any more."""
        sound = (self.net.finite() & (error <= LOST)).tolist()  # of NaN, nothing is true
        for i in set(range(len(sound))) - set(self.stopped):
            if sound[i]:
                self.curves[i].append(float(error[i]))
                self.last[i] = self.net.member(i)
            else:
                self.stopped[i] = step
        return len(self.stopped) < len(sound)

    def outcomes(self) -> list[Outcome]:
        parts = zip(self.last, self.curves, strict=True)
        return [Outcome(weights, curve, self.stopped.get(i)) for i, (weights, curve) in enumerate(parts)]


def _explained(
    trial: Trial, rows: Measured, scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray]
) -> float | None:
    """Give the least explained variance (R2) over the known targets, on training rows."""
    if trial.schedule.steps_n < JUDGED_STEPS_N:
        return None
    some = trial.train[:: -(-len(trial.train) // JUDGED_ROWS_N)]
    target = rows.target[some].astype(np.float64)
    off = _answer(scaler, predict, VIEW[trial.recipe.inputs](rows.db_uT[some])) - target
    known = np.flatnonzero(~np.isnan(target).all(axis=0))
    varying = [i for i in known if np.nanvar(target[:, i]) > 0]
    return min((float(1 - np.nanmean(off[:, i] ** 2) / np.nanvar(target[:, i])) for i in varying), default=None)


def _answer(scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray], view: np.ndarray) -> np.ndarray:
    return scaler.decode(predict(scaler.encode(view)))


# Defaults of torch.optim.lr_scheduler.OneCycleLR: the rate rises to its peak, then falls to nearly nothing; the first
# momentum falls meanwhile, then rises.
RISING = 0.3  # of all steps
FIRST_RATE, LAST_RATE = 1 / 25, 1e-4  # of the peak; of the first
MOMENTUM_MAX, MOMENTUM_MIN = 0.95, 0.85
BETA2, EPS = 0.999, 1e-8  # defaults of torch.optim.AdamW


def one_cycle(step_i: int, steps_n: int, rate_max: float) -> tuple[float, float]:
    """Give rate and first momentum of a step: two half cosines.

    >>> [round(one_cycle(i, 10, 25.0)[0], 4) for i in (0, 2, 9)]
    [1.0, 25.0, 0.0001]
    """
    steps_n = max(steps_n, 2)
    peak_i = RISING * steps_n - 1
    first = rate_max * FIRST_RATE
    if step_i <= peak_i:
        part = step_i / peak_i
        return _cosine(first, rate_max, part), _cosine(MOMENTUM_MAX, MOMENTUM_MIN, part)
    part = (step_i - peak_i) / (steps_n - 1 - peak_i)
    return _cosine(rate_max, first * LAST_RATE, part), _cosine(MOMENTUM_MIN, MOMENTUM_MAX, part)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * part) + 1)


class AdamW:
    """Remembers the moments of each weight's gradient."""

    def __init__(self, weights: Iterable[torch.Tensor], weight_decay: float) -> None:
        self.weights, self.weight_decay = list(weights), weight_decay
        self.first, self.second = ([torch.zeros_like(weight) for weight in self.weights] for _ in range(2))
        self.steps_n = [torch.zeros((), device=weight.device) for weight in self.weights]

    @torch.no_grad()
    def step(self, rate: float, momentum: float) -> None:
        """Move all weights by their gradients; torch raises if one has none."""
        gradients = [weight.grad for weight in self.weights if weight.grad is not None]
        torch._foreach_add_(self.steps_n, 1)
        torch._fused_adamw_(
            self.weights, gradients, self.first, self.second, [], self.steps_n, amsgrad=False, lr=rate,
            beta1=momentum, beta2=BETA2, weight_decay=self.weight_decay, eps=EPS, maximize=False,
        )  # fmt: skip
