"""The paper's own numbers (Bhirangi et al., CoRL 2021), each with its place. No result of ours stands here."""

# mean, sd
Number = tuple[float, float]

SINGLE_SENSOR: dict[str, Number] = {  # section 4: 50K samples, random 45K / 5K
    "accuracy_pct": (99.58, 0.34),
    "mse_xy_mm2": (0.037, 0.014),
    "mse_f_N2": (0.005, 0.002),
}
TABLE_2: dict[str, dict[str, Number]] = {
    "single": {"accuracy_pct": (25.24, 10.12), "mse_xy_mm2": (6.453, 3.363), "mse_f_N2": (0.420, 0.149)},
    "multi": {"accuracy_pct": (84.43, 12.88), "mse_xy_mm2": (0.733, 0.707), "mse_f_N2": (0.155, 0.025)},
}
TABLE_2_ROWS = {"single": "Single-sensor", "multi": "Multi-sensor without triplet loss"}
