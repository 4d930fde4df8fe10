"""A capture that joins a scene: does it lie under labels, chips and skin as the scene says? Readings -> a sentence.

Asked where `reskin add` has seconds, so on a few pokes, with nothing fitted. Refuses to know what is done about it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.experiments.compare.frames import AS_SAID
from pipeline.experiments.compare.run import Compare, framed, see, setup_of
from reskin.physics.skin import SkinDesign
from reskin.schema import Readings
from reskin.universal.presses import Pokes, pool

CHIPS_N = 5  # frames are told by chips on all sides of the middle
# Fewer pokes tell nothing sure; more tell the same, and take seconds: on lab every third of 65 places tells it right.
POKES_MIN_N, POKES_MAX_N = 20, 70


def departure(blocks: Sequence[Readings], section: Compare, design: SkinDesign) -> str | None:
    """Name what departs from the scene; None where nothing does, or where the capture cannot tell."""
    if blocks[0].chips_n != CHIPS_N or not any(_pressed(block).any() for block in blocks):
        return None
    pokes = _thin(pool(blocks))
    if len(pokes) < POKES_MIN_N or not (np.linalg.norm(pokes.db_uT, axis=(0, 2)) > 0).all():
        return None
    sentence = framed(see(pokes, section), setup_of(section, design), section)["sentence"]
    return None if sentence == AS_SAID else str(sentence)


def _pressed(readings: Readings) -> np.ndarray:
    return np.isfinite(readings.x_mm) & np.isfinite(readings.y_mm) & (readings.Fz_N > 0)


def _thin(pokes: Pokes) -> Pokes:
    """Keep at most so many pokes, evenly over the recording."""
    kept = np.unique(np.linspace(0, len(pokes) - 1, POKES_MAX_N).round().astype(int))
    of_poke = ("group_i", "capture_i", "place_mm", "force_N", "db_uT", "noload_uT")
    return replace(pokes, **{name: getattr(pokes, name)[kept] for name in of_poke})
