"""Tests of the tables and the figure of experiment contacts."""

from pipeline.experiments.contacts import figures, tables
from tests.report.synthetic import texts_of


def stat(mean):
    return {"mean": mean, "sd": mean / 10, "n": 3, "ci95": [0.8 * mean, 1.2 * mean]}


def row(separation_mm, **more):
    rates = {name: stat(10.0 * separation_mm + i) for i, name in enumerate(("direction", "residual"))}
    falls = {"near_either_pct": stat(42.0), "nearest_mm": stat(1.5)} | more
    return {"separation_mm": separation_mm, "detected_pct": rates, "auc": {"direction": stat(0.5)}} | falls


NUMBERS = {
    "by_separation": [row(4.0, along=stat(0.75), force_over_sum=stat(0.9), force_over_larger=stat(1.3)), row(8.0)],
    "same_place": row(0.0),
    "false_alarm_pct": {
        "direction": {"asked": 5.0, "realised": stat(3.0)}, "residual": {"asked": 5.0, "realised": stat(17.0)},
    },
}  # fmt: skip
SUPERPOSED = [{"depth_mm": 1.2, "separation_mm": 4.0, "pairs_n": 6, "error_pct": 13.2, "orders_differ_pct": 7.3}]
DRAWN = {"along": {"4": [0.5, 0.6, 1.1], "8": [0.2, 0.9, 0.7]}}


def test_table_has_a_row_for_single_contacts_and_for_each_distance():
    table = tables(NUMBERS, "recorded")["contacts"]
    assert table["distance of the contacts, mm"].tolist() == ["0", "4", "8", "single contacts"]
    assert set(table["source"]) == {"recorded"}
    assert table["along the line (0 weaker, 1 stronger)"].tolist() == ["–", "0.75 [0.60, 0.90]", "–", "–"]
    assert table["detected by residual, %"].tolist()[-1] == "17.0 [13.6, 20.4]"
    assert "noise is that of two readings" in table.attrs["meaning"]
    assert "`residual` and `networks disagree` were trained on" in table.attrs["meaning"]
    assert "5 % false alarms" in table.attrs["meaning"]


def test_recorded_scenes_have_no_table_of_superposition_errors():
    assert set(tables(NUMBERS, "recorded")) == {"contacts"}
    table = tables(NUMBERS | {"superposition": SUPERPOSED}, "simulated")["superposition"]
    assert table["error of the sum, % of the change of field"].tolist() == ["13.2"]


def test_figure_has_labels():
    svgs = figures(NUMBERS, DRAWN, "recorded")
    labels = texts_of(svgs["contacts.svg"])
    for label in ("direction", "residual", "stronger contact", "distance of the contacts / mm", "%", "(recorded)"):
        assert label in labels
    assert figures(NUMBERS, DRAWN, "recorded") == svgs
    nearer = figures(NUMBERS | {"same_place": row(2.0)}, DRAWN, "recorded")
    assert nearer != svgs  # Two contacts at one place have no distance, but are plotted too.
