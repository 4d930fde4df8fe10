"""Magnetometers: the steps of their values and their ranges, from their data sheets.

To add a chip, add a line to `CHIPS`. Its steps tell whether recorded values can be in uT.
"""

from typing import NamedTuple

STEP_TOLERANCE = 0.01  # relative; the steps of an MLX90393 in gauss differ by more from those of other chips in uT


class Chip(NamedTuple):
    """A magnetometer: steps of its values in uT (one per gain, along x and y), and the largest field it measures."""

    name: str
    steps_uT: tuple[float, ...]
    range_uT: float


CHIPS = (
    # Table 17 of its data sheet, resolution 0 to 3
    Chip(
        "MLX90393",
        tuple(step * 2**res for step in (0.751, 0.601, 0.451, 0.376, 0.300, 0.250, 0.200, 0.150) for res in range(4)),
        50_000.0,
    ),
    Chip("LIS3MDL", tuple(100 / steps for steps in (6842, 3421, 2281, 1711)), 1_600.0),  # steps per gauss
    Chip("LIS2MDL", (0.15,), 5_000.0),
    Chip("QMC5883P", tuple(100 / steps for steps in (15000, 3750, 2500, 1000)), 3_000.0),
    Chip("QMC5883L", tuple(100 / steps for steps in (12000, 3000)), 800.0),
    Chip("HMC5883L", tuple(100 / steps for steps in (1370, 1090, 820, 660, 440, 390, 330, 230)), 810.0),
    Chip("MMC5983MA", (100 / 16384, 100 / 4096), 800.0),
    Chip("RM3100", (1 / 75, 1 / 150, 1 / 38, 1 / 20), 800.0),
    Chip("BMM150", (0.3, 1 / 16), 1_300.0),
    Chip("TLV493D", (98.0,), 130_000.0),
    Chip("TLE493D-W2B6", (130.0, 65.0), 160_000.0),
    Chip("TMAG5273", (1.22, 2.44), 80_000.0),
)


def with_step(step_uT: float) -> list[str]:
    """Return the names of the chips that have a step of this size."""
    return [
        chip.name for chip in CHIPS if any(abs(step_uT / known_uT - 1) <= STEP_TOLERANCE for known_uT in chip.steps_uT)
    ]
