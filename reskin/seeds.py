"""Make independent random generators, one for each purpose, from one seed.

A generator is identified by a sequence of names, such as `rng_for(seed, "skin", "b3_s1")`. The numbers that it draws
depend only on the seed and on these names. Therefore, they do not change if another board, skin or fold is added.
"""

from __future__ import annotations

import hashlib

import numpy as np


def seed_for(seed: int, *names: str | int) -> int:
    """Derive a seed of 63 bits from a base seed and a sequence of names, by computing a hash of them."""
    text = "\x1f".join([str(seed), *map(str, names)])
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def rng_for(seed: int, *names: str | int) -> np.random.Generator:
    """Create the random generator (PCG64) for a base seed and a sequence of names."""
    return np.random.Generator(np.random.PCG64(seed_for(seed, *names)))
