"""Boards that might have been: the same pokes under other chips. In: changes of field of some skins. Out: copies.

Chips of another board differ in gain and lean, so a model that has seen few boards is shown copies of what it has; each
copy of a skin has gains and leans of its own. Refuses to know targets and scalers.
"""

import numpy as np
from jaxtyping import Float32, Shaped
from scipy.spatial.transform import Rotation

from pipeline.learning.recipe import Augmentation

AXES_N = 3


def virtual_boards(
    db_uT: Float32[np.ndarray, "f ch"], skin: Shaped[np.ndarray, " f"], asked: Augmentation, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "v ch"], Shaped[np.ndarray, " v"]]:
    """Copy all rows `copies_n` times, every copy of a skin as another board would read it; also the copies' skins.

    Copy c of row i is row c * f + i. Gains are drawn a channel, leans a chip, noise a reading.
    """
    codes = np.unique(skin, return_inverse=True)[1]
    skins_n, chips_n = codes.max() + 1, db_uT.shape[1] // AXES_N
    copies = []
    for _ in range(asked.copies_n):
        lean = Rotation.from_rotvec(
            np.radians(asked.lean_sd_deg) * rng.standard_normal((skins_n * chips_n, AXES_N))
        ).as_matrix()
        gain = 1.0 + asked.gain_sd * rng.standard_normal((skins_n, chips_n, AXES_N, 1))
        read = (gain * lean.reshape(skins_n, chips_n, AXES_N, AXES_N)).astype(np.float32)
        turned = np.einsum("fkij,fkj->fki", read[codes], db_uT.reshape(len(db_uT), chips_n, AXES_N))
        noise = asked.noise_uT * rng.standard_normal(db_uT.shape, dtype=np.float32)
        copies.append(turned.reshape(db_uT.shape) + noise)
    names = [codes + copy_i * skins_n for copy_i in range(asked.copies_n)]
    return np.concatenate(copies).astype(np.float32), np.concatenate(names)
