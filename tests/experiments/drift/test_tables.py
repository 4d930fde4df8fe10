"""Tests of the tables and figures of experiment drift."""

import re
import xml.etree.ElementTree as ET

import pytest

from pipeline.experiments.drift import figures, tables
from pipeline.formatting import to_markdown


def numbers(force: bool = True, spread: bool = True, **changed) -> dict:
    """Return the numbers of two windows and three no-load policies.

    With `spread`, the numbers include standard deviations over seeds.
    """
    policies = {}
    for i, policy in enumerate(("initial", "regular", "each")):
        metrics = {"accuracy_pct": 50.0 + i, "mse_xy_mm2": 2.0 - i / 2} | (
            {"mse_f_N2": 0.03 - i / 100} if force else {}
        )
        deviation = {name: value / 50 for name, value in metrics.items()} if spread else {}
        row = {**metrics, "noload_off_uT": 3.0 - i - (i == 2), "spread": deviation}
        policies[policy] = [{"contacts_n": n} | row for n in (5000, 10_000)]
    late = {
        "policy": "regular", "contacts_n": 45_000, "bias_N": 0.0157, "bias_pct": 1.3, "bias_se_N": 8e-4, "slope": 1.01,
        "indentations_n": 1000, "network_bias_N": [0.01, 0.0214], "force_left_pct": 98.1,
    }  # fmt: skip
    findings = [
        {"finding": finding, "verdict": verdict, "of_trainings": of_trainings, "measured": measured}
        for finding, verdict, of_trainings, measured in (
            ("errors grow", "yes", "yes", "MSE_xy 2"),
            ("each is worse", "no", "no", "MSE_xy 1"),
            ("too much force", "not judged (fewer than 4 boards)", "yes", "bias 0.1 N"),
        )
    ]
    about = {
        "unit": "indentation", "train_n": 5000, "test_n": 1000, "every_n": 5000, "regular_n": 390, "skins_n": 1,
        "seeds_n": 2, "left_out_units_n": 90, "contact_every_s": 0.0575, "lasts_s": 1166.2,
        "field": {"contact_uT": 140.0, "noload_noise_uT": 1.25},
        "findings": findings,
    }  # fmt: skip
    return about | policies | ({"late": late} if force else {}) | changed


DRAWN = {"late": {"true_N": [0.1, 1.0, 2.0], "predicted_N": [0.12, 1.02, 2.02]}}


@pytest.mark.parametrize("source", ["simulated", "recorded"])
def test_table_has_one_row_per_test_and_columns_for_each_no_load_policy(source):
    table = tables(numbers(), source)["drift"]
    assert table["contacts"].tolist() == ["5,000", "10,000"]
    assert table["MSE_F, N² (every 390 indentations)"].tolist() == ["0.02000 ± 0.00040"] * 2
    assert table["accuracy, % (once at the start)"].tolist() == ["50.0 ± 1.0"] * 2
    assert set(table["source"]) == {source}


def test_findings_table_has_a_verdict_and_the_measured_differences():
    table = tables(numbers(), "simulated")["drift_findings"]
    assert table["holds"].tolist() == ["yes", "no", "not judged (fewer than 4 boards)"]
    assert table["over these training runs"].tolist() == ["yes", "no", "yes"]
    assert set(table["source"]) == {"simulated"}
    text = to_markdown(table)
    assert "95 % interval over pairs of networks" in text
    assert "A contact changes the field by 140 µT (rms" in text
    assert "by policy: 3 µT (once at the start), 2 µT (every 390 indentations), 0 µT (before every contact)" in text
    assert "is 98.1 % of the force in the training window" in text
    assert "the softening explains a force bias of +1.9 %" in text
    without_forces = to_markdown(tables(numbers(force=False), "recorded")["drift_findings"])
    assert "the softening" not in without_forces


def test_note_states_the_protocol_and_how_many_contacts_were_omitted():
    assert "first 5,000 indentations of each skin, and tested on 1,000 indentations after every 5,000" in to_markdown(
        tables(numbers(), "simulated")["drift"]
    )
    assert "The last 90 indentations are not used" in to_markdown(tables(numbers(), "simulated")["drift"])
    whole = numbers(unit="pass", train_n=1, test_n=1, every_n=1, left_out_units_n=0)
    text = to_markdown(tables(whole, "recorded")["drift"])
    assert "first 1 pass of each skin" in text
    assert "not used" not in text


def test_note_states_the_time_per_contact():
    simulated, recorded = (to_markdown(tables(numbers(), source)["drift"]) for source in ("simulated", "recorded"))
    for text in (simulated, recorded):
        assert "to the next is 0.0575 s, and the longest capture lasts 1,166 s." in text
    assert "A real rig takes several seconds per contact" in simulated
    assert "A real rig" not in recorded
    unknown = {name: value for name, value in numbers().items() if name not in ("contact_every_s", "lasts_s")}
    assert "The times of the contacts are not known." in to_markdown(tables(unknown, "recorded")["drift"])


def test_note_says_whether_standard_deviations_are_over_seeds_or_skins():
    text = to_markdown(tables(numbers(), "simulated")["drift"])
    assert "± is the standard deviation over 2 network seeds, all tested on the same contacts." in text
    text = to_markdown(tables(numbers(skins_n=4), "recorded")["drift"])
    assert "± is the standard deviation over 4 skins with 2 network seeds each." in text


def test_table_of_a_single_network_has_no_standard_deviations():
    text = to_markdown(tables(numbers(spread=False), "simulated")["drift"])
    assert "of one network" in text
    assert "±" not in text


def test_table_without_known_forces_has_no_force_errors():
    unknown = numbers(force=False)
    assert "MSE_xy, mm² (before every contact)" in tables(unknown, "recorded")["drift"]
    assert list(svgs := figures(unknown, {}, "recorded")) == ["drift.svg"]
    assert "MSE_xy / mm²" in svgs["drift.svg"]


def test_figure_has_labels():
    svgs = figures(numbers(), DRAWN, "simulated")
    words = {name: " ".join(" ".join(ET.fromstring(svg).itertext()).split()) for name, svg in svgs.items()}
    for text in words.values():
        assert "(simulated)" in text
    for label in ("accuracy / %", "MSE_F / N²", "contacts of the skin before the test", "every 390 indentations"):
        assert label in words["drift.svg"]
    assert "bars: the standard deviation over 2 network seeds" in words["drift.svg"]
    for label in ("true force / N", "predicted force / N", "bias +0.01570 ± 0.00080 N (+1.3 %)", "45,000 contacts"):
        assert label in words["drift_force.svg"]


def test_table_of_the_added_random_walk_has_a_row_per_step():
    steps = {
        policy: [
            {
                "step_uT": step,
                "noload_off_uT": 3 * step,
                "n": 2,
                "accuracy_pct": 90 - step,
                "mse_f_N2": 0.01 + step,
                "spread": {"accuracy_pct": 1.5, "mse_f_N2": 0.001},
            }
            for step in (0.0, 0.5, 5.0)
        ]
        for policy in ("initial", "regular", "each")
    }
    table = tables(numbers(wander=steps), "simulated")["drift_wander"]
    assert table["added walk, µT per contact"].tolist() == ["0", "0.5", "5"]
    assert table["accuracy, % (once at the start)"].tolist() == ["90.0 ± 1.5", "89.5 ± 1.5", "85.0 ± 1.5"]
    assert "± is the standard deviation over 2 network seeds" in to_markdown(table)
    assert "After 10,000 contacts, with" in figures(numbers(wander=steps), DRAWN, "simulated")["drift_wander.svg"]
    assert "drift_wander" not in tables(numbers(), "simulated")
    assert "drift_wander.svg" not in figures(numbers(), DRAWN, "simulated")


def test_each_no_load_policy_has_a_fixed_colour():
    both = numbers()
    del both["regular"], both["late"]
    colours = set(re.findall(r"stroke: (#\w{6})", figures(both, {}, "recorded")["drift.svg"]))
    assert "#d55e00" in colours  # Policy "before every contact" has the third colour.
    assert "#0072b2" not in colours


def test_equal_data_give_equal_figures():
    points = {"late": DRAWN["late"] | {"predicted_N": [0.1, 0.9, 2.1]}}
    first, again, other = (figures(numbers(), figure_data, "simulated") for figure_data in (DRAWN, DRAWN, points))
    assert first == again != other
