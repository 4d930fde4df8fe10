"""Independent random generators, one for each sequence of names.

The numbers of `rng_for(seed, "skin", "b3_s1")` do not change if another board, skin or fold is added.
"""

from __future__ import annotations

import hashlib

import numpy as np


def seed_for(seed: int, *names: str | int) -> int:
    """Derive a 63-bit seed from a base seed and a sequence of names, by a hash."""
    text = "\x1f".join([str(seed), *map(str, names)])
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Create the PCG64 generator for a base seed and a sequence of names."""
    return np.random.Generator(np.random.PCG64(seed_for(seed, *names)))
