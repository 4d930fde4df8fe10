"""What one network of a stack starts from and learns from. In: a trial and rows. Out: a `Job` of scaled rows, a scaler.

Recipes may add virtual boards: the same pokes under other chips. `Feed` draws the batches of a stack: each network's
come from its own generator, so its neighbours change nothing. Refuses to know losses, optimisers and the loop.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64, Shaped

from pipeline.core.seeds import rng_for
from pipeline.learning.inputs import FIT, VIEW, Scaler
from pipeline.learning.model import LAYERS, draw_weights
from pipeline.learning.recipe import Augmentation, AugmentedRecipe
from pipeline.learning.trial import Adapting, FewLabels, Measured, Trial, Weights
from pipeline.learning.triplets import Points, draw_pairs, make_points

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
