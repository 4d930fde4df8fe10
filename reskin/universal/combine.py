"""Two experts on one skin, multiplied: a map's hypotheses and a network's opinion -> places, forces, how sure.

Both read the same field, so they err together: answers come from the product, intervals from a power of it below 1.
Refuses to know how either was made.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from reskin.universal.answers import products
from reskin.universal.map import Estimate, Reader, Weighed
from reskin.universal.network import Opinion

MAP_TEMPER = 0.6  # of the map's log likelihoods, as channels err together; fixed beforehand, told on no board
SD_MIN_MM, SD_MIN_LOG_N = 0.5, 0.3  # of an opinion: a network is never surer than this
FADES_PER_LABEL = 0.15  # of how far an opinion is centred: labels say better where the middle is
OFFSET_SD_MM, LABEL_SD_MM = 0.3, 1.0  # of a board's constant error; of a labelled answer about it


@dataclass(frozen=True)
class Labels:
    """What a network said of labelled pokes, and where they were."""

    said_mm: Float[np.ndarray, "m 2"]
    place_mm: Float[np.ndarray, "m 2"]


def centre(opinion: Opinion, pool_mm: Float[np.ndarray, "c 2"], labels_n: int) -> Opinion:
    """Shift an opinion so that pokes that lie evenly over the skin have the middle as their mean.

    `pool_mm` is where these were said to be; with labels the shift fades.
    """
    return replace(opinion, place_mm=opinion.place_mm - off_middle_mm(pool_mm, labels_n))


def off_middle_mm(pool_mm: Float[np.ndarray, "c 2"], labels_n: int) -> Float[np.ndarray, "2"]:
    """Give by how much an opinion is shifted to be centred."""
    return pool_mm.mean(axis=0) / (1 + FADES_PER_LABEL * labels_n)


def shift(opinion: Opinion, labels: Labels) -> Opinion:
    """Shift an opinion by a constant that labels tell, drawn towards none: Gaussian, with `OFFSET_SD_MM` beforehand."""
    return replace(opinion, place_mm=opinion.place_mm + told_mm(labels))


def told_mm(labels: Labels) -> Float[np.ndarray, "2"]:
    """Give by how much labels shift an opinion."""
    off_mm = labels.place_mm - labels.said_mm
    return off_mm.sum(axis=0) / (len(off_mm) + (LABEL_SD_MM / OFFSET_SD_MM) ** 2)


def multiply(reader: Reader, weighed: Weighed, opinion: Opinion, temper: float) -> Estimate:
    """Give places and forces: the map's probabilities times the network's normals, and the mean over all places."""
    normals = np.empty((len(opinion.log_N), 6))
    normals[:, :2], normals[:, 4] = opinion.place_mm, opinion.log_N
    np.maximum(opinion.sd_mm, SD_MIN_MM, out=normals[:, 2:4])
    np.maximum(opinion.sd_log_N, SD_MIN_LOG_N, out=normals[:, 5])
    return Estimate(*products(weighed.likelihoods, reader.at, normals, MAP_TEMPER, temper), weighed.misfit())
