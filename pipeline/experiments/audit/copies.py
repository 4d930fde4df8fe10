"""Is a capture another skin's recording under a new name? In: readings of both. Out: the share that looks copied.

Indentations are compared by the direction of their mean dB, so a copy is found whatever factor or small noise was put
on it. Refuses to know folds and files.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

# One reading's noise by axis of a chip (x, y, z), measured on the lab's recordings: 3.0-3.3 and 4.4-5.0 uT.
NOISE_uT = np.array([3.3, 3.3, 5.0])
STRONG_NOISES = 10.0  # below, the direction of dB is more noise than skin
# Two readings of one state are 1.4 noises apart (22 uT over 15 channels), a copy with 5 uT added to each channel 1.3.
ALIKE_NOISES = 2.0
FACTOR_TOLERANCE = 0.1  # a copy was multiplied by one factor, while honest look-alikes differ in depth
# Alike are, measured: between four recorded skins 0 %, between honest simulated ones at most 11 % (60 skins, 4 draws);
# in a copy with up to 8 uT added to single readings 55 % or more, and with 5 % of random gain a channel 42 %.
COPIED_SHARE_MAX = 0.3
PAIRS_MAX_N = 100_000_000  # indentations compared in a fold: a second at most, unless samples became too small to judge
SAMPLE_MIN_N = 100  # of a capture
CHUNK_PAIRS_N = 4_000_000  # of these at once: 16 MB


@dataclass(frozen=True)
class Indented:
    """The mean dB of each indentation whose field is well above the noise, and the name of its capture or skin."""

    name: np.ndarray
    db_uT: Float32[np.ndarray, "n ch"]


@dataclass(frozen=True)
class Likeness:
    """The training skin most like a test capture, and the share of the capture's indentations that look copied."""

    capture: str
    train_skin: str
    share: float
    compared_n: int


def strong_indentations(
    name: np.ndarray, indentation: Int[np.ndarray, " f"], db_uT: Float[np.ndarray, "f ch"]
) -> Indented:
    """Average the readings of each indentation, and keep those with |dB| above ten noises of a reading."""
    _, first, group = np.unique(indentation, return_index=True, return_inverse=True)
    sums = np.stack([np.bincount(group, weights=channel) for channel in db_uT.T], axis=1)
    mean_uT = (sums / np.bincount(group)[:, None]).astype(np.float32)
    strong = np.linalg.norm(mean_uT, axis=1) > STRONG_NOISES * noise_uT(db_uT.shape[1])
    return Indented(name[first][strong], mean_uT[strong])


def noise_uT(ch_n: int) -> float:
    """Give the norm of one reading's noise over all channels."""
    return float(np.sqrt(ch_n / len(NOISE_uT) * (NOISE_uT**2).sum()))


def liken(test: Indented, train: Indented, *, rng: np.random.Generator) -> list[Likeness]:
    """Compare each test capture with all training skins: all of their indentations, and a sample of its own."""
    captures = np.unique(test.name)
    sample_n = max(SAMPLE_MIN_N, PAIRS_MAX_N // len(train.name) // len(captures))
    likest = []
    for capture in captures:
        own_uT = test.db_uT[test.name == capture]
        own_uT = own_uT[rng.permutation(len(own_uT))[:sample_n]]
        shares = _copied_shares(own_uT, train)
        most = max(shares, key=lambda skin: shares[skin])
        likest.append(Likeness(str(capture), most, shares[most], len(own_uT)))
    return likest


def nearest_rays(
    db_uT: Float32[np.ndarray, "n ch"], others_uT: Float32[np.ndarray, "m ch"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Find for each row the one of `others_uT` nearest in direction, and how far off that one's ray (uT) it lies."""
    rays = others_uT / np.linalg.norm(others_uT, axis=1, keepdims=True)
    rows_n = max(1, CHUNK_PAIRS_N // len(rays))
    chunks = [db_uT[i : i + rows_n] for i in range(0, len(db_uT), rows_n)]
    nearest = np.concatenate([(chunk @ rays.T).argmax(axis=1) for chunk in chunks])
    ray = rays[nearest].astype(np.float64)
    along_uT = (db_uT * ray).sum(axis=1, keepdims=True)
    return nearest, np.linalg.norm(db_uT - along_uT * ray, axis=1)


def _copied_shares(own_uT: Float32[np.ndarray, "n ch"], train: Indented) -> dict[str, float]:
    nearest, off_uT = nearest_rays(own_uT, train.db_uT)
    alike = off_uT < ALIKE_NOISES * noise_uT(own_uT.shape[1])
    factor = np.linalg.norm(own_uT, axis=1) / np.linalg.norm(train.db_uT[nearest], axis=1)
    shares = {}
    for skin in np.unique(train.name):
        hit = factor[alike & (train.name[nearest] == skin)]
        steady = np.abs(hit / np.median(hit) - 1) < FACTOR_TOLERANCE if len(hit) else hit
        shares[str(skin)] = float(steady.sum() / len(own_uT))
    return shares
