"""Magnetometers and the steps of their values, from their data sheets.

To add a chip, add a line to `CHIPS`. Its steps tell whether recorded values can be in uT.
"""

STEP_TOLERANCE = 0.01  # relative; the steps of an MLX90393 in gauss differ by more from those of other chips in uT


CHIPS = {  # steps in uT along x and y, one per gain
    # Table 17 of its data sheet, resolution 0 to 3
    "MLX90393": [
        step * 2**res for step in (0.751, 0.601, 0.451, 0.376, 0.300, 0.250, 0.200, 0.150) for res in range(4)
    ],
    "LIS3MDL": [100 / steps for steps in (6842, 3421, 2281, 1711)],  # steps per gauss
    "LIS2MDL": [0.15],
    "QMC5883P": [100 / steps for steps in (15000, 3750, 2500, 1000)],
    "QMC5883L": [100 / steps for steps in (12000, 3000)],
    "HMC5883L": [100 / steps for steps in (1370, 1090, 820, 660, 440, 390, 330, 230)],
    "MMC5983MA": [100 / 16384, 100 / 4096],
    "RM3100": [1 / 75, 1 / 150, 1 / 38, 1 / 20],
    "BMM150": [0.3, 1 / 16],
    "TLV493D": [98.0],
    "TLE493D-W2B6": [130.0, 65.0],
    "TMAG5273": [1.22, 2.44],
}


def is_step(step_uT: float) -> bool:
    """Return whether a chip has a step of this size."""
    return any(abs(step_uT / known_uT - 1) <= STEP_TOLERANCE for steps_uT in CHIPS.values() for known_uT in steps_uT)
