"""What a stack of networks learns from, and its batches. In: scaled rows of each network. Out: tensors [m b ...].

Every network's batches come from its own generator, so its neighbours in the stack change nothing. Refuses to know
losses and optimisers.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Int64

from pipeline.learning.job import Job
from pipeline.learning.triplets import draw_pairs

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
