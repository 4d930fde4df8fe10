"""Table and figure of a log say what the numbers say, and what is not known."""

from pipeline.experiments.logs import figures, tables

ACCOUNT = {"rows_read_n": 101, "rows_n": 100, "gap_frames_n": 2, "gaps_n": 1}
NUMBERS = {
    "rate_hz": 250.0, "duration_s": 4.0, "readings_n": 100, "contacts_n": 3, "contact_readings_n": 40,
    "account": ACCOUNT, "networks_n": 3,
}  # fmt: skip
SERIES = {name: [None, 1.0, 2.0] for name in ("x_mm", "y_mm", "F_N")}


def test_a_log_without_truth_has_no_scores_and_says_so():
    table = tables(NUMBERS, "recorded")["logs"].set_index("what")["ours"]
    assert table["accuracy, %"] == table["contacts made"] == "unknown"
    assert table["readings lost to failed reads and stuck chips"] == "1"
    assert table["contacts found"] == "3"


FOUND = {"contacts_n": 5, "false_readings_n": 7, "missed_readings_n": 2, "mse_f_N2": 0.25}


def test_a_log_that_was_turned_has_a_table_of_its_own_with_the_remedy_beside_it():
    told = {"pitch_deg": 20.0} | FOUND | {"accuracy_pct": 50.0, "reference_chip": FOUND | {"false_readings_n": 0}}
    numbers = NUMBERS | {"contacts_true_n": 3, "turning": [told], "turning_period_s": 0.7, "earth_uT": 50.0}
    table = tables(numbers, "simulated")["logs_turning"]
    assert list(table["readings without contact taken for one"]) == ["7", "0"]
    assert list(table["contacts made"]) == ["3", "3"]
    assert list(table["accuracy / %"]) == ["50", "unknown"]
    assert set(table["source"]) == {"simulated"}
    assert "once a step (0.7 s) in the earth's field of 50 µT" in table.attrs["meaning"]
    assert "logs_turning" not in tables(NUMBERS, "recorded")


def test_the_rate_in_the_words_is_that_of_the_log():
    table = tables(NUMBERS | {"rate_hz": 133.0}, "recorded")["logs"]
    assert "A log at 133 Hz with" in table.attrs["meaning"]
    assert "The board keeps its place" in table.attrs["meaning"]


def test_the_spread_over_networks_stands_beside_their_mean_and_in_the_figure():
    numbers = NUMBERS | {"accuracy_pct": 80.0, "spread": {"accuracy_pct": 2.5}}
    table = tables(numbers, "simulated")["logs"]
    assert table.set_index("what")["ours"]["accuracy, %"] == "80 ± 2.5"
    assert "over 3 network seeds" in table.attrs["meaning"]
    drawn = {"t_s": [0.0, 0.1, 0.2], "estimated": SERIES, "low": SERIES, "high": SERIES}
    assert "range over 3 network seeds" in figures(numbers, drawn, "simulated")["logs.svg"]


def test_the_figure_draws_the_truth_where_there_is_one():
    drawn = {"t_s": [0.0, 0.1, 0.2], "estimated": SERIES}
    assert ">true<" not in figures(NUMBERS, drawn, "recorded")["logs.svg"]
    both = figures(NUMBERS, drawn | {"true": SERIES}, "simulated")["logs.svg"]
    assert ">true<" in both
    assert "(simulated)" in both
