"""Synthetic results for tests of the report: model cards, which describe trained networks and their scores, and the
numbers that each experiment would write.
"""

import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
from scipy.stats import t

from reskin.metrics import METRICS, score_groups
from reskin.seeds import rng_for
from tests.scenes import RECIPE


def texts_of(svg: str) -> str:
    """Return the texts in a figure (SVG)."""
    return " ".join(
        "".join(element.itertext()) for element in ET.fromstring(svg).iter() if element.tag.endswith("text")
    )


def stat(mean: float = 1.0, sd: float = 0.5, n: int = 3) -> dict:
    return {"mean": mean, "sd": sd, "n": n}


def over_boards(low: float = 0.5, high: float = 1.5, n: int = 6) -> dict:
    """Return a summary of scores over boards, whose 95 % confidence interval is (low, high)."""
    reach, middle = (high - low) / 2, (low + high) / 2
    se = reach / t.ppf(0.975, n - 1)
    return {"mean": middle, "sd": se * n**0.5, "n": n, "ci95": [low, high], "df": n - 1}


def p_value(low: float, high: float, n: int = 6) -> float:
    """Return the p-value of the null hypothesis that the mean of `over_boards(low, high, n)` is 0."""
    se = (high - low) / 2 / t.ppf(0.975, n - 1)
    return 2 * t.sf(abs(low + high) / 2 / se, n - 1)


def difference(low: float = 0.5, high: float = 1.5) -> dict:
    """Return a paired difference, whose 95 % confidence interval is (low, high) for every metric."""
    by_board = {board: dict.fromkeys(METRICS, (low + high) / 2) for board in ("b0", "b1")}
    return {name: over_boards(low, high) for name in METRICS} | {"by_board": by_board}


def scores(names: tuple[str, ...] = METRICS) -> dict:
    return {name: stat() for name in names}


def cost(seconds: float = 1.0) -> dict:
    return {"seconds": seconds, "cpu_s": 3.0, "peak_process_memory_MB": 2.0}


NETWORKS = {
    "folds_n": 2, "seeds_n": 3, "boards_n": 2, "skins_n": 4, "trained_on_skins_n": 2, "trained_on_rows_n": 7020,
    "rows_n": 780,
}  # fmt: skip


def all_experiments(source: str = "simulated") -> dict:
    plain = dict.fromkeys(METRICS, 1.0)
    windows = [{"contacts_n": 5000, "accuracy_pct": 90.0, "mse_xy_mm2": 0.1, "mse_f_N2": 0.1, "spread": {}}]
    contrasts = ("pokes_first", "pokes_gain", "pokes_plateau", "sensors_gain_fewer")
    contrasts += tuple(f"sensors_more_{method}" for method in ("multi", "triplet", "adapted"))
    counts = {"from_pokes_n": 780, "to_pokes_n": 780}
    return {
        "provenance": {
            "scene": "x", "source": source, "git": "abc", "seed": 1, "trained": "abc", "device": "z",
            "versions": {"numpy": "1", "torch": "2"},
        },
        "capture": {"captures_n": 2, "frames_n": 10, "indentations_n": 5, "left_out": {"low_force_rows_n": 3}},
        "lobo": {
            "registered": scores(),
            "by_board": {"b0": {"trained_on_skins_n": 15, "as_labelled": plain, "registered": plain}},
        },
        "protocol": {experiment: dict(NETWORKS) for experiment in ("single_random", "transfer", "lobo", "adapt")},
        "table2": {method: scores() for method in ("single", "multi", "triplet", "adapted")},
        "adapt": {"pokes_n": 390, "control": scores()},
        "paired": [
            {"of": of, "over": over, **difference()}
            for of, over in (("multi", "single"), ("triplet", "multi"), ("adapted", "triplet"), ("adapted", "multi"))
        ],
        "contrasts": {name: counts | difference() for name in contrasts}
        | {f"sensors_adapted_over_{name}": [{"skins_n": 1, **difference()}] for name in ("multi", "triplet")},
        "sweep_pokes": [{"pokes_n": pokes_n, **scores()} for pokes_n in (0, 390, 780)],
        "sweep_sensors": [{"method": "multi", "skins_n": 1, **scores()}],
        "single_random": scores(), "single_indentation": scores(), "single_pass": scores(),
        "single_sensor": {"split": "single_random", **scores()},
        "variants": {"lobo": {"paper": scores()}},
        "described": {"grid": {"source": source, "counts": {"captures_n": 2, "readings_n": 1000}, "over_skins": {}}},
        "drift": {
            "regular_n": 390, "initial": windows, "regular": windows, "each": windows,
            "claims": {
                **dict.fromkeys(("higher", "faster", "each_is_worse"), scores(("mse_xy_mm2", "mse_f_N2"))),
                "lasting": {"contacts_n": 49000} | scores(("accuracy_pct",)), "overestimates": {"bias_f_N": stat()},
            },
            "late": {"contacts_n": 45000, "bias_N": 0.1, "bias_pct": 5.0},
        },
        "variation": {"contacts_n": 10000},
        "shear": scores(("mse_xy_mm2", "mse_fxy_N2", "mse_fz_N2", "accuracy_pct")),
        "manual": {
            "pokes_n": 325, "before": scores(), "after": scores(), "control": scores(),
            "paired": {"after_minus_before": difference()},
        },
        "flexible": {
            "before": scores(), "after": scores(), "bias_f_N": {"before": stat(), "after": stat()},
            "gap_less_pct": 45.0,
        },
        "sleeve": {"chips_n": 40, "rate_hz": 133.0, "accuracy_pct": 90.0, "median_error_mm": 0.5},
        "sensitivity": {
            "smallest_step_N": {"one_reading": 0.05, "five_readings": 0.02},
            "smallest_step_mL": {"one_reading": 5.0, "five_readings": 2.0},
            "monotonic": {"holds": True, "spearman": 0.99},
        },
        "logs": {"rate_hz": 250.0, "accuracy_pct": 80.0, "mse_f_N2": 0.1},
        "compare": {"by_board": {}},
        "interference": {"fields_uT": [1.0]},
        "runtime": {"stages": {"report": cost()}},
    }  # fmt: skip


def new_board(methods: tuple[str, ...] = ("shipped", "rig")) -> list[dict]:
    """Return rows of experiment new_board for two boards.

    There are rows of the methods with 0, 10 and 40 labels, of a constant force, and of contact. With the most labels, a
    constant force has rms errors of 1 N on board b0 and 3 N on board b1.
    """
    split = {"split": "checkerboard", "pokes_n": 65}

    def of_boards(mean: float, half: float) -> dict:
        return {"mean": mean, "by_board": {"b0": mean - half, "b1": mean + half}, "sd_draws": 0.5}

    rows = [
        {"method": method, **split, "labels_n": labels_n, "accuracy_pct": of_boards(40.0 + 20 * i + labels_n, 1.0)}
        | {
            "median_mm": of_boards(0.8, 0.1),
            "mse_xy_mm2": of_boards(0.6, 0.1),
            "mse_f_N2": of_boards(2.5, 1.5),
            "rms_f_N": of_boards(1.5, 0.5),
        }
        | {"r2_f": of_boards(0.1 + labels_n / 100, 0.05)}
        for i, method in enumerate(methods)
        for labels_n in (0, 10, 40)
    ]
    constant = {"method": "constant", **split, "rms_f_N": of_boards(2.0, 1.0)}
    contact = {
        "method": "contact",
        "split": "each",
        "false_pct": of_boards(1.0, 1.0),
        "missed_pct": of_boards(0.5, 0.5),
    }
    contact |= {"force_min_N": of_boards(0.3, 0.1), "force_max_N": of_boards(4.0, 1.0)}
    return [*rows, *(constant | {"labels_n": labels_n} for labels_n in (10, 40)), contact]


SKINS = [("b0", "s0"), ("b0", "s1"), ("b1", "s2"), ("b1", "s3")]


def card(experiment: str, fold: str, scores: dict, recipe: str = "paper", seed_i: int = 0, **changes: Any) -> dict:
    """Return the model card of a trained network. Adapted networks were adapted to 390 pokes."""
    values = {
        "question": experiment, "recipe_name": recipe, "recipe": dict(RECIPE), "fold": fold, "seed_i": seed_i,
        "scores": scores, "train_skins": ["s8", "s9"], "train_rows_n": 100,
    }  # fmt: skip
    tuning = {"tuning": {"pokes_n": 390, "settings": {"base": "paper"}}} if experiment == "adapt" else {}
    return values | tuning | changes


def adapted_card(fold: str, skin: str, seed_i: int, *, off_mm: float = 1.0, force: bool = True) -> dict:
    """Return the model card of a network that was adapted to a skin. Its place errors are about `off_mm`."""
    rng = rng_for(seed_i, "adapted", fold, skin)
    true = rng.uniform(0, 16, (10, 3))
    predicted = true + rng.normal(0, off_mm, true.shape)
    if not force:
        true[:, 2] = np.nan
    scores = score_groups(true, predicted, np.repeat(fold, 10), np.repeat(skin, 10))
    return card("adapt", fold, scores, seed_i=seed_i)


def adapted_cards(**changes: Any) -> list[dict]:
    """Return the model cards of adapted networks: three seeds, two boards, two skins per board."""
    return [adapted_card(fold, skin, seed_i, **changes) for seed_i in range(3) for fold, skin in SKINS]
