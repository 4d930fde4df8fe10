"""Random generators by name.

The numbers of `rng_for(seed, "skin", "b3_s1")` stay the same when another board, skin or fold is added.
"""

from __future__ import annotations

import hashlib

import numpy as np


def seed_for(seed: int, *names: str | int) -> int:
    """Derive a 63-bit seed from a base seed and a path of names."""
    text = "\x1f".join([str(seed), *map(str, names)])
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Return the generator of `names` under `seed` (PCG64)."""
    return np.random.Generator(np.random.PCG64(seed_for(seed, *names)))
