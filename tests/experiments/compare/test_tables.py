"""Tests of the tables and figures of experiment compare."""

import copy

from pipeline.experiments.compare import figures, tables
from reskin.universal.law import Law
from tests.report.synthetic import texts_of

LAW = dict.fromkeys(Law.__dataclass_fields__, 1.0)
AGREEMENT = {
    "cosine_mean": 0.91, "cosine_by_group": {"soft": 0.90, "hard": 0.92}, "explained_median": 0.82,
    "growth": {"recorded": 0.3, "simulated": 0.25}, "beyond_n": 0,
}  # fmt: skip
CHIP = {"chip": 0, "at": 0, "cosine_as_written": 0.7, "cosine_best": 0.8, "read": ""}
GRIP = {
    "cosine_mean": 0.91, "explained_median": 0.82, "growth": {"recorded": 0.3, "simulated": 0.25}, "grip_N_mm": 8.75,
    "grip_N": 0.5, "light_uT": 3.0,
}  # fmt: skip
BOARD = AGREEMENT | {
    "nominal": AGREEMENT | {"cosine_mean": 0.7, "beyond_n": 3},
    "refitted": AGREEMENT | {"growth": {"recorded": 0.3, "simulated": 0.5}},
    "memory": {"recorded": 0.07, "simulated": 0.065}, "laws": {"fitted": LAW, "refitted": LAW | {"law_of": "b2"}},
    "frames": {"sentence": "Contrary to the scene, chips 1 and 2 are exchanged.", "chips": [CHIP]},
    "grips": [GRIP | {"grip_N_mm": 1e-6, "grip_N": 5e-8, "light_uT": 300.0}, GRIP],
    "noise_uT": {"x": 3.3, "y": 3.3, "z": 5.0}, "pokes_n": 4, "left_out_n": 1,
}  # fmt: skip
STAT = {"mean": 0.91, "n": 2, "ci95": [0.905, 0.915]}
OVER_BOARDS = {
    "cosine_mean": STAT,
    "explained_median": STAT,
    "growth_difference": {"mean": 0.0, "n": 2, "ci95": [-0.2, 0.2]},
}
NUMBERS = {
    "by_board": {"b1": BOARD}, "over_boards": {"fitted": OVER_BOARDS}, "memory_put_in": 0.065, "light_N": 0.001,
    "grip_N_mm": 8.75,
}  # fmt: skip
FIELDS = {"recorded": [[[100.0, 20.0, 5.0], [0.0, -40.0, 5.0]]], "simulated": [[[90.0, 10.0, 5.0], [0.0, -20.0, 5.0]]]}
DRAWN = {
    "curve_N": [0.001, 1.0, 10.0],
    "chips_mm": [[0.0, 0.0], [7.0, 0.0]],
    "boards": {"b1": {
        "group": "soft", "places_mm": [[1.0, 2.0]], "arrows_uT": FIELDS, "force_N": [1.0, 4.0],
        "length_uT": {"recorded": [100.0, 150.0], "simulated": [90.0, 160.0]},
        "curve_uT": {"1e-06": [300.0, 400.0, 500.0], "8.75": [3.0, 300.0, 450.0]},
    }},
}  # fmt: skip


def test_table_says_whether_each_simulation_is_within_the_bounds():
    table = tables(NUMBERS, "recorded")["compare"]
    assert table["within bounds"].tolist() == ["no", "yes", "no", "undecided"]
    assert table["cosine"].tolist()[:3] == ["0.700 (≥ 0.90)", "0.910 (≥ 0.90)", "0.910 (≥ 0.85)"]
    assert table["simulated with"][2] == "law of b2, seven parameters refitted"
    assert table["memory, % (5 to 8)"].tolist()[1] == "6.5 / 7.0"
    assert table["pokes simulated at the largest depth"].tolist() == ["3", "0", "0", "–"]
    assert set(table["source"]) == {"recorded"}
    for words in ("memory is set to 6.5 %", "both boards of scene lab", "does not explain"):
        assert words in table.attrs["meaning"]


def test_table_omits_growth_and_second_fit_for_one_board_with_equal_forces():
    alone = copy.deepcopy(BOARD)
    for section in (alone, alone["nominal"]):
        del section["growth"]
    for section, name in ((alone, "refitted"), (alone["laws"], "refitted"), (alone, "memory")):
        del section[name]
    numbers = NUMBERS | {"by_board": {"b1": alone}, "over_boards": {}}
    table = tables(numbers, "recorded")["compare"]
    assert table["within bounds"].tolist() == ["no", "yes"]
    assert set(table["growth (within 0.10)"]) == {"–"}
    assert "simulated" in texts_of(figures(numbers, DRAWN, "recorded")["compare_growth.svg"])


def test_tables_list_axes_and_parameters():
    found = tables(NUMBERS, "recorded")
    assert found["compare_frames"]["orientation"].tolist() == ["Contrary to the scene, chips 1 and 2 are exchanged."]
    assert found["compare_frames"]["cosine by chip, best"].tolist() == ["0.80"]
    assert {"gap, mm", "slide to the middle, µm/mm", "Young's modulus, MPa"} <= set(found["compare_parameters"].columns)


def test_figures_have_labels():
    svgs = figures(NUMBERS, DRAWN, "recorded")
    for word in ("recorded", "simulated", "µT", "(recorded; ×: poke; number: along z, µT)", "b1"):
        assert word in texts_of(svgs["compare_arrows.svg"])
    assert "recorded: power 0.30" in texts_of(svgs["compare_growth.svg"])
    for word in ("k / μ 8.75 N/mm (used)", "no friction limit", "recorded"):
        assert word in texts_of(svgs["compare_touch.svg"])
    assert figures(NUMBERS, DRAWN, "recorded") == svgs


def test_friction_table_states_the_field_of_a_light_touch():
    table = tables(NUMBERS, "recorded")["compare_grip"]
    assert table["k / mu, N/mm"].tolist() == ["1e-06", "8.75"]
    assert table["|dB| at 1 mN, µT (median place)"].tolist() == ["300", "3"]
    assert "k / mu = 8.75 N/mm is used" in table.attrs["meaning"]
