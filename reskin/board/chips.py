"""Magnetometers: the steps of their values, and the limits of their readings, from their data sheets.

To add a chip, add a line to `CHIPS`. Its steps tell whether recorded values can be in uT. In most cases, nothing else
is needed to record with another chip, to train and to predict. The other numbers are those of the MLX90393, the chip of
ReSkin and AnySkin boards. They have these effects on other chips:

- `B_MAX_uT`, `TEMPERATURE_MIN_degC`, `TEMPERATURE_MAX_degC`: readings beyond them count as saturated or too hot.
- `FULL_SCALE_uT`: recordings with stronger fields are refused, because they are probably not in uT.
- `STEP_MIN_uT`: the steps of finer chips are not measured in a stream, so a chip that lost its settings is not noticed.
- `RESET_LSB_XY_uT`, `RESET_LSB_Z_uT`: a chip with these steps is taken for a chip that lost its settings.
- Numbers of 16 bits: module `faults` takes 2^15 steps for the end of the range of a chip whose steps it has measured.
- `B_PLAUSIBLE_uT`: used only for the binary formats of ReSkin and AnySkin firmware.
- Gains, noise and times of a conversion, in `reskin.physics.chip`: used for simulated skins, for the name of the gain
  (`find`), and to explain the frame rate (`rates`, which also has the numbers of bits that its commands need on I2C).
- What firmware sends for a chip that does not answer: `FAILED_B_uT` in module `faults`.
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

# The MLX90393 measures up to 50 mT, with LSBs from 0.150 uT to 9.680 uT along z with GAIN_SEL 0 and RES 3 (data sheet,
# table 17). The LSB is the step between neighbouring values that the chip can send.
B_MAX_uT = 49_000.0
B_PLAUSIBLE_uT = 60_000.0
STEP_MIN_uT = 0.1
FULL_SCALE_uT = 32768 * 9.680  # the largest field that it can send: 2^15 steps of the coarsest LSB
TEMPERATURE_MIN_degC, TEMPERATURE_MAX_degC = -50.0, 125.0
# The LSBs of an MLX90393 with its power-on settings, found in AFG_test_new_board15 and piezo, two public recordings of
# layout `ini`.
RESET_LSB_XY_uT, RESET_LSB_Z_uT = 0.98, 1.58


def is_step(step_uT: float) -> bool:
    """Return whether a chip has a step of this size."""
    return any(abs(step_uT / known_uT - 1) <= STEP_TOLERANCE for steps_uT in CHIPS.values() for known_uT in steps_uT)
