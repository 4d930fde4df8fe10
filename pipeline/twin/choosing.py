"""Which poke to label next: a map of a skin, and places under forces -> how much less would be unknown after each.

In closed form, by what the map's numbers and the law's errors still leave open over the skin; no reading is needed.
Refuses to know readings and what people can reach.
"""

import numpy as np
from jaxtyping import Float

from pipeline.twin.hypotheses import NOISE_uT
from pipeline.twin.residual import kernel
from pipeline.twin.skin_map import SkinMap, between

Pokes = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, " _"]]  # places in mm from the board's middle, log F


def worth(skin: SkinMap, place_mm: Float[np.ndarray, "c 2"], force_N: Float[np.ndarray, " c"]) -> np.ndarray:
    """Give what each poke is expected to take from the variance of fields, relative to |dB|: the mean over places.

    All channels together, under the middle one of the map's forces. Errors of the law that labels have shown are known.
    """
    of, error_cov, known = skin.hypotheses, skin.error_cov, []
    every = slice(len(of.log_N) // 2, None, len(of.log_N))
    mean_uT, slope_uT = (part[every].astype(float) for part in (of.mean_uT, of.slope_uT))
    of_all = slope_uT / np.linalg.norm(mean_uT, axis=1)[:, None, None] @ skin.cov
    at_mm, at_log_N = (part[every] for part in of.at)
    poke_uT, poke_slope_uT, _ = between(skin, place_mm, force_N)
    poke_log_N = np.log(force_N)
    shared = open_errors(skin, (at_mm, at_log_N), (place_mm, poke_log_N))
    for i, length_uT in enumerate(np.linalg.norm(poke_uT, axis=1)):
        one = slice(i, i + 1)
        slope = poke_slope_uT[i] / length_uT
        own = open_errors(skin, (place_mm[one], poke_log_N[one]), (place_mm[one], poke_log_N[one]))[0, 0]
        cov = slope @ skin.cov @ slope.T + (own + skin.residual.noise) * error_cov
        cov += (NOISE_uT / length_uT) ** 2 * np.eye(len(cov))
        with_all = (of_all @ slope.T + shared[:, i, None, None] * error_cov).reshape(-1, len(cov))
        known.append(float(((with_all @ np.linalg.inv(cov)) * with_all).sum() / len(at_mm)))
    return np.array(known)


def open_errors(skin: SkinMap, a: Pokes, b: Pokes) -> Float[np.ndarray, "n m"]:
    """Give how the law's errors vary together at two sets of pokes, given those that labels have shown."""
    alike, shown = kernel(a[0], b[0], a[1], b[1]), skin.labelled
    if shown is None:
        return alike
    to_a, to_b = (kernel(one[0], shown.place_mm, one[1], shown.log_N) for one in (a, b))
    return alike - to_a @ shown.inverse @ to_b.T
