"""Shear, manual and flexible in words and pictures: source, the paper's numbers, units, and the same bytes again."""

import xml.etree.ElementTree as ET

import pytest

from pipeline.experiments import flexible, manual, shear
from pipeline.report.formatting import to_markdown
from pipeline.report.paper import FLEXIBLE, MANUAL, SHEAR
from tests.report.synthetic import texts_of


def stat(mean: float, n: int = 3) -> dict[str, float]:
    return {"mean": float(mean), "sd": 0.1, "n": float(n), "sd_seeds": 0.02}


def metrics(accuracy_pct: float) -> dict:
    return {"accuracy_pct": stat(accuracy_pct), "mse_xy_mm2": stat(0.4), "mse_f_N2": stat(0.2)}


DRAGGED = {
    "accuracy_pct": stat(96), "mse_xy_mm2": stat(0.12), "mse_fxy_N2": stat(0.02), "mse_fz_N2": stat(0.002),
    "explained_xy": stat(0.99), "explained_fxy": stat(0.98), "explained_fz": stat(0.999),
}  # fmt: skip
SHEARED = DRAGGED | {
    "by_line": DRAGGED | {"accuracy_pct": stat(58)}, "readings_n": 4590, "lines_n": 54, "passes_n": 1, "seeds_n": 3,
    "fx_rms_N": 1.06, "fy_rms_N": 1.07, "fz_rms_N": 1.97,
}  # fmt: skip
POKED = {
    "pokes_n": 321, "lines_n": 13, "skins_n": 6, "seeds_n": 3,
    "before": metrics(80), "after": metrics(83), "control": metrics(81), "grid": metrics(84),
    "paired": {f"after_minus_{other}": metrics(2) for other in ("before", "control", "grid")},
}  # fmt: skip
BENT = {
    "skins_n": 3, "boards_n": 3, "seeds_n": 3, "pokes_n": 390, "fold": "b0", "trained_on_skins_n": 15,
    "gap_mm": {"rigid": 1.0, "flexible": 0.7}, "gap_less_pct": 30.0, "strength_ratio": {"mean": 1.44, "n": 1.0},
    **{arm: metrics(70 + i) for i, arm in enumerate(("before", "after", "control"))},
    "bias_f_N": {"before": stat(0.96), "after": stat(-0.83), "control": stat(0.97)},
    "bias_f_pct": {"before": stat(91), "after": stat(-79), "control": stat(92)},
}  # fmt: skip
CURVES = {"true": [[-1.0, 0, 1]] * 3, "predicted": [[-0.9, 0, 1.2]] * 3}
ARMS = {arm: {"true_N": [0.1, 3.0], "predicted_N": [0.3, 4.5]} for arm in ("before", "after")}
CASES = {"shear": (shear, SHEARED, CURVES), "manual": (manual, POKED, {}), "flexible": (flexible, BENT, ARMS)}


@pytest.mark.parametrize("experiment", CASES)
@pytest.mark.parametrize("source", ["simulated", "recorded"])
def test_every_row_and_every_figure_names_its_source(experiment, source):
    module, numbers, drawn = CASES[experiment]
    (table,) = module.tables(numbers, source).values()
    assert set(table["source"]) == {source}
    if drawn:
        (text,) = module.figures(numbers, drawn, source).values()
        assert f"({source})" in texts_of(text)
        ET.fromstring(text)
        assert [text] == list(module.figures(numbers, drawn, source).values())


def test_shear_shows_both_splits_beside_the_papers_numbers_and_what_is_explained():
    text = to_markdown(shear.tables(SHEARED, "simulated")["shear"])
    for mean, sd in SHEAR.values():
        assert f"{mean:g} ± {sd:g}" in text
    table = shear.tables(SHEARED, "simulated")["shear"]
    assert table["accuracy, % (ours)"].tolist() == ["96 ± 0.1 ± 0.02 (seeds)", "58 ± 0.1 ± 0.02 (seeds)"]
    assert "± (seeds) is the sd over 3 network seeds" in text
    assert table["split"].tolist()[0] == "random readings held out (ours; the paper names no split)"
    assert "4590 readings of 54 dragged lines in 1 passes" in text
    words = texts_of(shear.figures(SHEARED, CURVES, "simulated")["shear.svg"])
    assert "0.980 ± 0.020 (seeds) sideways, 0.999 ± 0.020 (seeds) normal" in words
    assert words.count("/ N") == 6


def test_manual_shows_each_arm_and_the_differences_with_their_signs():
    table = manual.tables(POKED, "simulated")["manual"].set_index("networks")
    for arm, name in (("before", "before"), ("after", "adapted by hand")):
        assert table.loc[name, "accuracy, % (paper)"] == f"{MANUAL[arm]['accuracy_pct']:g}"
    difference = table.loc["by hand less before, on the same skin", "accuracy, % (ours)"]
    assert difference == "not judged (fewer than 4 boards): +2 ± 0.1 ± 0.02 (seeds)"
    assert table.loc["adapted by hand", "accuracy, % (ours)"] == "83 ± 0.1 ± 0.02 (seeds)"
    assert "over 3 network seeds" in to_markdown(manual.tables(POKED, "simulated")["manual"])
    assert len(table) == 7
    without = {name: value for name, value in POKED.items() if name != "control"}
    without["paired"] = {"after_minus_before": metrics(2)}
    assert len(manual.tables(without, "simulated")["manual"]) == 4


def test_flexible_states_the_bias_with_its_sign_and_how_our_boards_differ_from_the_papers():
    text = to_markdown(flexible.tables(BENT, "simulated")["flexible"])
    assert f"{FLEXIBLE['mse_xy_mm2']:g}" in text
    assert "30 % less; the paper's 80 % less" in text
    table = flexible.tables(BENT, "simulated")["flexible"]
    assert table["bias of F, N"].tolist() == [f"{mean} ± 0.1 ± 0.02 (seeds)" for mean in ("+0.96", "-0.83", "+0.97")]
    assert "over 3 network seeds" in text
    words = texts_of(flexible.figures(BENT, ARMS, "simulated")["flexible.svg"])
    assert "bias +0.96 ± 0.1 ± 0.02 (seeds) N" in words
    assert "bias -0.83 ± 0.1 ± 0.02 (seeds) N" in words


def test_directions_stand_below_where_the_scene_has_such_networks():
    shape = {name: BENT[name] for name in ("before", "after", "bias_f_N", "bias_f_pct")}
    table = flexible.tables(BENT | {"shape": shape}, "simulated")["flexible"]
    assert table["networks"].str.startswith("direction and length").tolist() == [False] * 3 + [True] * 2
