"""Tables and figures of sensitivity and dynamics say what the numbers say, and no more."""

import numpy as np

from pipeline.experiments import dynamics, sensitivity
from pipeline.experiments.sensitivity import analyse_levels
from reskin.seeds import rng_for

ERROR = {"mean": 0.5, "sd": 0.1, "n": 3}
RISES = "mean response rises at every step above the noise"
BETTER = {"mean": 0.25, "n": 1}


def score(error):
    return {"accuracy_pct": error, "mse_xy_mm2": error, "mse_f_N2": error}


LESS = {"mean5_minus_one": score({"mean": -0.25, "n": 1})}
WAYS = {"one": score(ERROR), "mean5": score(BETTER), "mean5_of_middle": score(ERROR), "paired": LESS}
NUMBERS = {
    "readings_n": 20, "presses_n": 3, "rate_hz": 400.0, "window_n": 5, "force_min_N": 0.2,
    "by_duration": [
        {"duration_s": 0.1, "n": 8, "presses_n": 1} | WAYS, {"duration_s": 0.5, "n": 12, "presses_n": 2} | WAYS,
    ],
    "all": WAYS, "lag_ms": {"one": {"mean": 0.9, "n": 1}, "mean5": {"n": 0}},
}  # fmt: skip


def glass(noise_uT):
    noise = noise_uT * rng_for(0, "glass").standard_normal((8, 11, 5, 3))
    levels = np.arange(11)[:, None, None] * np.array([3.0, 4.0, 0.0]) + noise
    return analyse_levels(levels.astype(np.float32), 0.1 * np.arange(11))


def test_a_step_finer_than_was_tried_is_said_to_be_an_upper_limit():
    table = sensitivity.tables(glass(0.0)[0], "simulated")["sensitivity"]
    assert table["ours"][0] == "at most 0.1"
    assert table["ours"][1] == "at most 10"  # 0.1 N is 10.2 mL
    assert set(table["source"]) == {"simulated"}
    assert table["paper"][0] == "< 0.2"


def test_what_is_not_told_apart_is_said_so():
    table = sensitivity.tables(glass(1e3)[0], "simulated")["sensitivity"]
    assert table["ours"][0] == "none up to 1"
    assert table["ours"][1] == "none"
    assert "undecided: no step is above the noise" in table.set_index("what")["ours"][RISES]


def test_the_verdict_on_rising_says_at_which_step_it_was_judged():
    table = sensitivity.tables(glass(0.0)[0], "simulated")["sensitivity"]
    found = table.set_index("what")["ours"]
    assert found[RISES].startswith("not judged (fewer than 4 boards); rises on this one: 10 of 10 pairs 0.1 N apart")
    assert found["falls from level to level, 0.1 N apart"] == "0 of 10"  # no noise, no error
    assert "at least 95 % of the pairs" in table.attrs["meaning"]


def test_both_ways_are_compared_in_every_row_group_and_unknown_lags_are_dashes():
    table = dynamics.tables(NUMBERS, "simulated")["dynamics"]
    judged = table[dynamics.LESS] != ""
    assert list(table.loc[judged, "answered by"].unique()) == ["mean of the last five"]
    assert set(table.loc[judged, dynamics.LESS]) == {"not judged (fewer than 4 boards): -0.25"}
    assert list(table["lag / ms"][-3:]) == ["0.9", "–", "–"]
    assert table["MSE_F / N²"][0] == "0.5 ± 0.1"


def test_figures_say_where_the_data_come_from_and_repeat_to_the_byte():
    numbers, drawn = glass(0.0)
    for draw, name in ((lambda: sensitivity.figures(numbers, drawn, "simulated"), "sensitivity.svg"),
                       (lambda: dynamics.figures(NUMBERS, {}, "simulated"), "dynamics.svg")):  # fmt: skip
        figure = draw()[name]
        assert "(simulated)" in figure
        assert figure == draw()[name]
