"""Two experts on one skin, multiplied: a map's hypotheses and a network's opinion -> places, forces, how sure.

Both read the same field, so they err together: answers come from the product, intervals from a power of it below 1.
Refuses to know how either was made.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.twin.network import Opinion
from pipeline.twin.skin_map import CELL_SD_MM, Estimate, Reader, Weighed, believe

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
    off_mm = labels.place_mm - labels.said_mm
    told_mm = off_mm.sum(axis=0) / (len(off_mm) + (LABEL_SD_MM / OFFSET_SD_MM) ** 2)
    return replace(opinion, place_mm=opinion.place_mm + told_mm)


def multiply(reader: Reader, weighed: Weighed, opinion: Opinion, temper: float) -> Estimate:
    """Give places and forces: the map's probabilities times the network's normals, and the mean over all places."""
    by_map = believe(weighed, MAP_TEMPER).reshape(len(weighed.chi2), len(reader.place_mm), -1)
    of_place = product(by_map.sum(axis=2), reader.place_mm, opinion.place_mm, np.maximum(opinion.sd_mm, SD_MIN_MM))
    place_mm = of_place @ reader.place_mm
    likely = of_place**temper
    likely /= likely.sum(axis=1, keepdims=True)
    # About the answer, which the power moves a little.
    var_mm2 = likely @ reader.place_mm**2 - 2 * place_mm * (likely @ reader.place_mm) + place_mm**2
    sd_mm = np.sqrt(np.maximum(var_mm2, CELL_SD_MM**2))
    sd_log_N = np.maximum(opinion.sd_log_N, SD_MIN_LOG_N)[:, None]
    of_force = product(by_map.sum(axis=1), reader.log_N[:, None], opinion.log_N[:, None], sd_log_N)
    return Estimate(place_mm, sd_mm, np.exp(of_force @ reader.log_N), weighed.misfit())


def product(
    probability: Float[np.ndarray, "n p"],
    at: Float[np.ndarray, "p d"],
    mean: Float[np.ndarray, "n d"],
    sd: Float[np.ndarray, "n d"],
) -> Float[np.ndarray, "n p"]:
    """Multiply probabilities of points with independent normals, and bring their sum to 1."""
    # (a - m)^2 / s^2 as products of matrices: a row a point would be the larger array.
    apart = (at**2 @ (1 / sd**2).T - 2 * at @ (mean / sd**2).T).T
    log = np.log(np.maximum(probability, np.finfo(np.float32).tiny)) - 0.5 * apart
    together = np.exp(log - log.max(axis=1, keepdims=True))
    return together / together.sum(axis=1, keepdims=True)
