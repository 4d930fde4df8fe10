"""The numbers and statements of the paper (Bhirangi et al., CoRL 2021), each with its section or table."""

from collections.abc import Mapping

Number = tuple[float, float]  # mean, standard deviation

SINGLE_SENSOR: dict[
    str, Number
] = {  # section 4: 50K samples, of which 45K at random are for training and 5K for testing
    "accuracy_pct": (99.58, 0.34),
    "mse_xy_mm2": (0.037, 0.014),
    "mse_f_N2": (0.005, 0.002),
}
TABLE_2: dict[str, dict[str, Number]] = {
    "single": {"accuracy_pct": (25.24, 10.12), "mse_xy_mm2": (6.453, 3.363), "mse_f_N2": (0.420, 0.149)},
    "multi": {"accuracy_pct": (84.43, 12.88), "mse_xy_mm2": (0.733, 0.707), "mse_f_N2": (0.155, 0.025)},
    "triplet": {"accuracy_pct": (81.03, 12.86), "mse_xy_mm2": (0.756, 0.718), "mse_f_N2": (0.155, 0.030)},
    "adapted": {"accuracy_pct": (87.00, 11.81), "mse_xy_mm2": (0.514, 0.601), "mse_f_N2": (0.142, 0.025)},
}
TABLE_2_ROWS = {
    "single": "Single-sensor",
    "multi": "Multi-sensor without triplet loss",
    "triplet": "Multi-sensor with triplet loss",
    "adapted": "Multi-sensor with triplet loss, adapted using 390 indentations",
}
ADAPTED_POKES_N = 390  # table 2


def _subtract(means: Mapping[str, float], others: Mapping[str, float]) -> dict[str, float]:
    """Return the differences of printed means, rounded to the digits of the means."""
    return {name: round(means[name] - others[name], 3) for name in means}


SHEAR: dict[str, Number] = {  # section 4: dragged lines
    "mse_xy_mm2": (0.085, 0.006),
    "mse_fxy_N2": (0.0011, 0.0002),
    "mse_fz_N2": (0.003, 0.001),
}
MANUAL_POKES_N = 325  # section 5, manual indentations
MANUAL: dict[str, dict[str, float]] = {  # section 5, manual indentations; the paper gives no deviations
    "before": {"accuracy_pct": 79.86, "mse_xy_mm2": 0.676, "mse_f_N2": 0.268},
    "after": {"accuracy_pct": 84.84, "mse_xy_mm2": 0.489, "mse_f_N2": 0.192},
}
_means = {row: {name: mean for name, (mean, _) in scores.items()} for row, scores in TABLE_2.items()}
# The gains that the paper claims: differences of its printed means. It gives no deviations of these differences.
GAINS: dict[str, dict[str, float]] = {
    "multi_over_single": _subtract(_means["multi"], _means["single"]),  # "significantly better"
    # "slightly affects performance"
    "triplet_over_multi": {"accuracy_pct": _subtract(_means["triplet"], _means["multi"])["accuracy_pct"]},
    "adapted_over_triplet": _subtract(_means["adapted"], _means["triplet"]),  # "a sizeable improvement"
    "adapted_over_multi": _subtract(_means["adapted"], _means["multi"]),
    "by_hand": _subtract(MANUAL["after"], MANUAL["before"]),  # "clearly demonstrating the effectiveness"
}
FLEXIBLE: dict[str, float] = {
    "accuracy_pct": 75.0,
    "mse_xy_mm2": 0.72,
    "mse_f_N2": 0.54,
}  # section 5, after adaptation; the paper writes "about" before these numbers
SENSITIVITY_N = 0.2  # section 6, water in a shot glass: "less than 20 mL (< 0.2N) of water"
SENSITIVITY_ML = 20.0
LOG_RATE_HZ = 250.0  # section 6, dog shoe and glove: "logged to an SD card at 250 Hz"
SLEEVE: dict[str, float] = {"rate_hz": 133.0, "chips_n": 40}  # section 6: "samples all 40 magnetometers at 133 Hz"
PLACE_ACCURACY_MIN_PCT = 90.0  # section 1: "spatial resolution (1mm with 90% accuracy)"
LATE_CONTACTS_N = 45_000  # figure 5b: "after 45,000 interactions"
PLATEAU_POKES_N = 780  # section 5: "seems to plateau" beyond this number
MONOTONIC = '"monotonically increasing sensor measurements"'

# Table 1 as printed (section 2): "yes" is a tick, "no" a cross, "?" a question mark.
TABLE_1: dict[str, list[str]] = {
    "property": [
        "Type", "Frequency", "Variable Form Factor", "Thickness < 3mm", "Low Cost", "Easily replaceable",
        "Area coverage", "Durable (> 50k contacts)",
    ],
    "ReSkin": ["Magnetic", "400Hz", "yes", "yes", "yes", "yes", "yes", "yes"],  # the paper itself
    # M. Lambeta et al., IEEE Robotics and Automation Letters 5(3): 3838-3845, 2020
    "DIGIT": ["Optical", "60 Hz", "no", "no", "yes", "yes", "no", "?"],
    # E. Donlon et al., IROS 2018: 1927-1934
    "GelSlim": ["Optical", "60 Hz", "no", "no", "yes", "yes", "no", "no"],
    # B. Sundaralingam et al., ICRA 2019: 9035-9042
    "BioTac": ["MEMS", "100 Hz", "no", "no", "no", "?", "no", "yes"],
    # T. Bhattacharjee et al., World Haptics Conference 2013: 103-108
    "RSkin": ["Piezoresistive", "?", "yes", "yes", "no", "no", "yes", "?"],
}  # fmt: skip
