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
            "poked": [job.unlabelled.inputs for job in jobs if job.unlabelled],
            "own": [job.own.inputs for job in jobs if job.own],
            "own_targets": [job.own.targets for job in jobs if job.own],
        }
        self.rows = {name: torch.from_numpy(np.concatenate(own)).to(device) for name, own in sets.items() if own}
        self.first = {name: np.cumsum([0, *map(len, own)])[:-1] for name, own in sets.items()}

    def draw(self, steps_n: int) -> Iterator[Batch]:
        """Draw the batches of so many steps: `labelled`, `targets`, and what else the jobs hold.

        `near` and `far` are the positives and negatives of the labelled rows, `poked`, `poked_near` and `poked_far` a
        triplet of unlabelled ones, `own` and `own_targets` the new skin's labelled rows.
        """
        chosen = [_choose(job, (steps_n, self.batch_n), rngs) for job, rngs in zip(self.jobs, self.rngs, strict=True)]
        block = {name: self._gather(name, [one[name] for one in chosen]) for name in chosen[0]}
        return ({name: values[i] for name, values in block.items()} for i in range(steps_n))

    def _gather(self, name: str, chosen: list[np.ndarray]) -> torch.Tensor:
        source = _SOURCE[name]
        rows = np.stack([one + first for one, first in zip(chosen, self.first[source], strict=True)], axis=1)  # [s m b]
        return self.rows[source][torch.from_numpy(rows).to(self.device)]


# batch -> the rows that it is drawn from
_SOURCE = {
    "labelled": "labelled", "targets": "targets", "near": "labelled", "far": "labelled", "poked": "poked",
    "poked_near": "poked", "poked_far": "poked", "own": "own", "own_targets": "own_targets",
}  # fmt: skip
_STREAMS = ("labelled", "pairs", "poked", "own")


def _choose(job: Job, shape: tuple[int, int], rngs: Mapping[str, np.random.Generator]) -> Chosen:
    rows = rngs["labelled"].integers(len(job.labelled.inputs), size=shape)
    chosen = {"labelled": rows, "targets": rows}
    if job.labelled.points is not None:
        near, far = draw_pairs(job.labelled.points, rows.ravel(), rngs["pairs"])
        chosen |= {"near": near.reshape(shape), "far": far.reshape(shape)}
    if job.unlabelled is not None:
        points, row = job.unlabelled.points, job.unlabelled.row
        anchor = points.anchors[rngs["poked"].integers(len(points.anchors), size=shape[0] * shape[1])]
        near, far = draw_pairs(points, anchor, rngs["poked"])
        names = ("poked", "poked_near", "poked_far")
        chosen |= {name: row[one].reshape(shape) for name, one in zip(names, (anchor, near, far), strict=True)}
    if job.own is not None:
        own = rngs["own"].integers(len(job.own.inputs), size=shape)
        chosen |= {"own": own, "own_targets": own}
    return chosen
