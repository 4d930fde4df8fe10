"""Prepare the data of networks that are trained together: scaled rows, initial weights, and batches.

Networks are trained together as a stack (several networks in one computation, see `reskin.models.network`). Each
network of a stack has its own training job, rows and random generator.

A triplet consists of three rows: an anchor, a positive and a negative. The triplet loss (`reskin.models.losses`)
compares the distances between their features.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64, Shaped

from reskin.models.inputs import FIT, VIEW, Scaler
from reskin.models.job import Adaptation, FineTuning, TrainingData, TrainingJob, Weights
from reskin.models.losses import TripletPoints, draw_triplets, triplet_points
from reskin.models.network import LAYERS, draw_weights
from reskin.models.recipe import Augmentation, AugmentedRecipe
from reskin.seeds import rng_for

AXES_N = 3


@dataclass(frozen=True)
class LabelledRows:
    """The scaled inputs and targets of labelled rows.

    `points` contains the places of the rows, from which triplets are drawn. It is None if there is no triplet loss.
    """

    inputs: Float32[np.ndarray, "n c"]
    targets: Float32[np.ndarray, "n t"]
    points: TripletPoints | None


@dataclass(frozen=True)
class UnlabelledRows:
    """The scaled inputs of unlabelled pokes. Only the order of the pokes along straight lines is known.

    `points` contains the points of all lines, from which triplets are drawn. `row` contains, for each point, the number
    of its row in `inputs`. A row can belong to two points, because a poke may be part of two lines.
    """

    inputs: Float32[np.ndarray, "p c"]
    points: TripletPoints
    row: Int64[np.ndarray, " q"]


@dataclass(frozen=True)
class PreparedJob:
    """The data of one network of a stack, ready for training: initial weights, random generator, and scaled rows.

    `labelled` contains the rows of the skins in the training set. The other rows are from a new skin: `unlabelled` is
    used for adaptation, and `few_labels` for fine-tuning. They are None if they are not needed.
    """

    initial_weights: Weights
    rng: np.random.Generator
    labelled: LabelledRows
    unlabelled: UnlabelledRows | None = None
    few_labels: LabelledRows | None = None


def prepare(job: TrainingJob, data: TrainingData) -> tuple[PreparedJob, Scaler]:
    """Prepare a job for training: fit a scaler, scale the rows, and draw the initial weights.

    The scaler is fitted to the training rows. Adaptation and fine-tuning start from a trained network. In this case,
    the scaler and the initial weights are taken from the trained network.

    Returns the prepared job and the scaler.
    """
    recipe, target = job.recipe, data.target[job.train]
    # The random generator is made from these names. They do not include the name of the recipe, so that all recipes
    # start from the same initial weights and draw the same batches.
    retry = ("again", job.attempt_i) if job.attempt_i else ()
    rng = rng_for(job.seed, "train", job.fold, job.skin, job.seed_i, *retry)
    if job.tuning is None:
        view = VIEW[recipe.inputs](data.db_uT[job.train])
        scaler = FIT[recipe.scaling](view, target)
        layers = LAYERS[recipe.architecture](view.shape[1], target.shape[1])
        # The initial bias of an output is the mean of the scaled target, because the released architecture has a ReLU
        # on its outputs. If the biases were random, about one in three of these networks would have an output that is
        # always 0. The gradient of such an output is 0 too, so it would never learn.
        known = ~np.isnan(target).all(axis=0)
        mean = np.zeros(target.shape[1], np.float32)
        mean[known] = np.nanmean(scaler.encode_target(target)[:, known], axis=0, dtype=np.float64)
        weights: Weights = draw_weights(layers, rng) | {f"layer{len(layers)}.bias": mean}
    else:
        scaler, weights = job.tuning.start.scaler, job.tuning.start.weights

    unlabelled = few_labels = None
    if job.loss_weights.unlabelled:
        assert isinstance(job.tuning, Adaptation)
        # Of the data of the new skin, only the field changes and the order of the pokes along lines are used.
        lines = job.tuning.lines
        row, point_row = np.unique(lines.row, return_inverse=True)
        view = VIEW[recipe.inputs](data.db_uT[row])
        points = triplet_points(lines.order_i[:, None].astype(np.float64), lines.line_i)
        unlabelled = UnlabelledRows(scaler.encode(view), points, point_row.astype(np.int64))
    if job.loss_weights.few_labels:
        assert isinstance(job.tuning, FineTuning)
        view = VIEW[recipe.inputs](data.db_uT[job.tuning.row])
        few_labels = LabelledRows(scaler.encode(view), scaler.encode_target(data.target[job.tuning.row]), None)
    return PreparedJob(weights, rng, _labelled_rows(job, data, scaler), unlabelled, few_labels), scaler


def _labelled_rows(job: TrainingJob, data: TrainingData, scaler: Scaler) -> LabelledRows:
    db_uT, target, skin = (values[job.train] for values in (data.db_uT, data.target, data.skin))
    if isinstance(job.recipe, AugmentedRecipe):
        rng = rng_for(job.seed, "augment", job.fold, job.seed_i)
        virtual_uT, virtual_skin = virtual_boards(db_uT, skin, job.recipe.augmentation, rng)
        skin_i = np.unique(skin, return_inverse=True)[1]
        skin = np.concatenate([skin_i, virtual_skin + skin_i.max() + 1])
        db_uT = np.concatenate([db_uT, virtual_uT])
        target = np.tile(target, (1 + job.recipe.augmentation.copies_n, 1))
    points = triplet_points(target[:, :2], skin) if job.recipe.triplet_weight else None
    return LabelledRows(scaler.encode(VIEW[job.recipe.inputs](db_uT)), scaler.encode_target(target), points)


def virtual_boards(
    db_uT: Float32[np.ndarray, "f ch"],
    skin: Shaped[np.ndarray, " f"],
    settings: Augmentation,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "v ch"], Shaped[np.ndarray, " v"]]:
    """Copy all rows `copies_n` times, and modify the field changes of each copy as if another board had measured them.

    A virtual board differs from the real one by random gains of its channels and random tilts of its chips. They are
    drawn once for each copy of each skin. In addition, noise is drawn for each reading.

    Returns
    -------
    db_uT : field changes [v ch] with v = copies_n * f; row c * f + i is copy c of row i
    skin : number of the virtual skin of each row; each copy of a skin has its own number
    """
    from scipy.spatial.transform import Rotation  # imported here, because only few recipes use virtual boards

    codes = np.unique(skin, return_inverse=True)[1]
    skins_n, chips_n = codes.max() + 1, db_uT.shape[1] // AXES_N
    copies = []
    for _ in range(settings.copies_n):
        tilt = Rotation.from_rotvec(
            np.radians(settings.lean_sd_deg) * rng.standard_normal((skins_n * chips_n, AXES_N))
        ).as_matrix()
        gain = 1.0 + settings.gain_sd * rng.standard_normal((skins_n, chips_n, AXES_N, 1))
        response = (gain * tilt.reshape(skins_n, chips_n, AXES_N, AXES_N)).astype(np.float32)
        read = np.einsum("fkij,fkj->fki", response[codes], db_uT.reshape(len(db_uT), chips_n, AXES_N))
        noise = settings.noise_uT * rng.standard_normal(db_uT.shape, dtype=np.float32)
        copies.append(read.reshape(db_uT.shape) + noise)
    names = [codes + copy_i * skins_n for copy_i in range(settings.copies_n)]
    return np.concatenate(copies).astype(np.float32), np.concatenate(names)


Batch = dict[str, torch.Tensor]
# For each tensor of a batch: the name of the array in `BatchSampler.rows` from which the tensor's rows are taken.
_SOURCE = {
    "inputs": "inputs", "targets": "targets", "positive": "inputs", "negative": "inputs",
    "unlabelled": "unlabelled", "unlabelled_positive": "unlabelled", "unlabelled_negative": "unlabelled",
    "few_labels": "few_labels", "few_labels_targets": "few_labels_targets",
}  # fmt: skip
# Names of the random generators. Each loss term has a generator of its own, so that an additional loss term does not
# change the rows that are drawn for the other terms.
_STREAMS = ("labelled", "pairs", "unlabelled", "few_labels")


class BatchSampler:
    """Draws random batches of rows for all networks of a stack.

    The rows of all networks are concatenated in one array, which is stored on the device that trains the networks.
    """

    def __init__(self, jobs: Sequence[PreparedJob], batch_n: int, device: str) -> None:
        self.jobs, self.batch_n, self.device = jobs, batch_n, device
        self.rngs = [dict(zip(_STREAMS, job.rng.spawn(len(_STREAMS)), strict=True)) for job in jobs]
        rows: dict[str, list[np.ndarray]] = {
            "inputs": [job.labelled.inputs for job in jobs],
            "targets": [job.labelled.targets for job in jobs],
            "unlabelled": [job.unlabelled.inputs for job in jobs if job.unlabelled],
            "few_labels": [job.few_labels.inputs for job in jobs if job.few_labels],
            "few_labels_targets": [job.few_labels.targets for job in jobs if job.few_labels],
        }
        self.rows = {
            name: torch.from_numpy(np.concatenate(values)).to(device) for name, values in rows.items() if values
        }
        self.first_row = {name: np.cumsum([0, *map(len, values)])[:-1] for name, values in rows.items()}

    def sample(self, steps_n: int) -> Iterator[Batch]:
        """Draw the batches of `steps_n` steps. A batch is a dictionary of tensors [networks, rows of a batch, ...].

        A batch contains `inputs` and `targets` of labelled rows. If the recipe has a triplet loss, `positive` and
        `negative` form triplets with `inputs` as the anchors. For adaptation, `unlabelled` (the anchors),
        `unlabelled_positive` and `unlabelled_negative` are triplets of unlabelled rows of the new skin. For
        fine-tuning, `few_labels` and `few_labels_targets` are the inputs and targets of labelled rows of the new skin.
        """
        shape = (steps_n, self.batch_n)
        drawn = [_draw_rows(job, shape, rngs) for job, rngs in zip(self.jobs, self.rngs, strict=True)]
        batches = {name: self._gather(_SOURCE[name], [rows[name] for rows in drawn]) for name in drawn[0]}
        return ({name: values[i] for name, values in batches.items()} for i in range(steps_n))

    def _gather(self, source: str, drawn: Sequence[Int64[np.ndarray, "s b"]]) -> torch.Tensor:
        pairs = zip(drawn, self.first_row[source], strict=True)
        rows = np.stack([row + first for row, first in pairs], axis=1)  # [steps networks batch]
        return self.rows[source][torch.from_numpy(rows).to(self.device)]


def _draw_rows(
    job: PreparedJob, shape: tuple[int, int], rngs: Mapping[str, np.random.Generator]
) -> dict[str, Int64[np.ndarray, "s b"]]:
    rows = rngs["labelled"].integers(len(job.labelled.inputs), size=shape)
    drawn = {"inputs": rows, "targets": rows}
    if job.labelled.points is not None:
        positive, negative = draw_triplets(job.labelled.points, rows.ravel(), rngs["pairs"])
        drawn |= {"positive": positive.reshape(shape), "negative": negative.reshape(shape)}
    if job.unlabelled is not None:
        points, row, rng = job.unlabelled.points, job.unlabelled.row, rngs["unlabelled"]
        anchor = points.anchors[rng.integers(len(points.anchors), size=shape[0] * shape[1])]
        positive, negative = draw_triplets(points, anchor, rng)
        drawn["unlabelled"] = row[anchor].reshape(shape)
        drawn["unlabelled_positive"] = row[positive].reshape(shape)
        drawn["unlabelled_negative"] = row[negative].reshape(shape)
    if job.few_labels is not None:
        rows = rngs["few_labels"].integers(len(job.few_labels.inputs), size=shape)
        drawn |= {"few_labels": rows, "few_labels_targets": rows}
    return drawn
