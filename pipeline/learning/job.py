"""What one network of a stack learns from. In: scaled rows. Out: a `Job`. Knows no loop, and no origin of rows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from pipeline.learning.architecture import Weights
from pipeline.learning.triplets import Points


@dataclass(frozen=True)
class Terms:
    """Weights of what stands beside the L2 loss: triplets of labelled rows, of unlabelled pokes, a few labels."""

    triplet: float
    unlabelled: float = 0.0
    own: float = 0.0


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
    """What one network starts from and learns from; `own` are a few labelled pokes of a new skin."""

    start: Weights
    rng: np.random.Generator
    labelled: Labelled
    unlabelled: Unlabelled | None = None
    own: Labelled | None = None
