"""What the report says of the bound: a row a depth, and one in all with the network beside it."""

from pipeline.experiments.bound import figures, tables
from tests.report.synthetic import scores

BOUND = {"accuracy_pct": 99.5, "mse_xy_mm2": 0.01, "mse_f_N2": 0.002}
ROW = {"signal": BOUND, "with_label_errors": BOUND | {"mse_xy_mm2": 0.04}}
NUMBERS = {
    "board": "b0", "skin": "b0_s0", "places_n": 65, "above_the_skin_n": 0, "readings_n": 1, "noload_frames_n": 10,
    "labels": {"place_sd_mm": 0.05, "force_sd_N": 0.00625},
    "by_depth": [{"depth_mm": 0.2, **ROW}, {"depth_mm": 1.2, **ROW}], "all": ROW, "network": scores(),
}  # fmt: skip


def test_the_network_stands_beside_the_bound_over_all_depths():
    table = tables(NUMBERS, "simulated")["bound"]
    assert table["depth, mm"].tolist() == ["0.2", "1.2", "all"]
    assert table["MSE_xy, mm² (bound)"].tolist() == ["0.01"] * 3
    assert table["MSE_xy, mm² (bound, labels' errors added)"].tolist() == ["0.04"] * 3
    assert table["MSE_xy, mm² (network)"].tolist() == ["–", "–", "1 ± 0.5"]
    assert set(table["source"]) == {"simulated"}
    assert figures(NUMBERS, {}, "simulated") == {}


def test_pokes_that_touch_nothing_are_told_of():
    assert "left out" not in tables(NUMBERS, "simulated")["bound"].attrs["meaning"]
    told = tables(NUMBERS | {"above_the_skin_n": 65}, "simulated")["bound"].attrs["meaning"]
    assert "65 pokes that do not touch the skin are left out" in told
