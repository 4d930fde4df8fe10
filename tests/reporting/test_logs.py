"""Table and figure of a log say what the numbers say, and what is not known."""

from pipeline.reporting.experiments.logs import figures, tables

ACCOUNT = {"rows_read_n": 101, "rows_n": 100, "gap_frames_n": 2, "gaps_n": 1}
NUMBERS = {
    "rate_hz": 250.0, "duration_s": 4.0, "readings_n": 100, "contacts_n": 3, "contact_readings_n": 40,
    "account": ACCOUNT,
}  # fmt: skip
SERIES = {name: [None, 1.0, 2.0] for name in ("x_mm", "y_mm", "F_N")}


def test_a_log_without_truth_has_no_scores_and_says_so():
    table = tables(NUMBERS, "recorded")["logs"].set_index("what")["ours"]
    assert table["accuracy, %"] == table["contacts made"] == "unknown"
    assert table["readings lost to failed reads and stuck chips"] == "1"
    assert table["contacts found"] == "3"


def test_the_figure_draws_the_truth_where_there_is_one():
    drawn = {"t_s": [0.0, 0.1, 0.2], "estimated": SERIES}
    assert ">true<" not in figures(NUMBERS, drawn, "recorded")["logs.svg"]
    both = figures(NUMBERS, drawn | {"true": SERIES}, "simulated")["logs.svg"]
    assert ">true<" in both
    assert "(simulated)" in both
