"""Tests of the table that shows our protocol beside that of the paper."""

from pipeline.report.page import read_sections
from pipeline.report.protocol import protocols
from tests.report.synthetic import all_experiments


def test_numbers_of_the_papers_protocol_are_beside_ours():
    ran = {one.experiment: one for one in protocols(all_experiments())}
    single = ran["one skin, random readings held out"]
    assert "45,000 for training, 5,000 for testing" in single.paper
    assert "7,020 readings of one skin for training, 780 for testing" in single.ours
    many = ran["table 2, many training skins"]
    assert "6 boards, 18 skins, about 10,000 indentations of each" in many.paper
    assert "2 boards, 4 skins, 250 readings of each" in many.ours  # The four skins have 1,000 readings in total.
    assert "390 unlabelled" in ran["table 2, adaptation"].paper
    assert "0, 390 and 780" in ran["figure 6a"].ours


def test_protocol_of_an_experiment_that_was_not_run_is_omitted():
    numbers = {name: value for name, value in all_experiments().items() if name != "sweep_pokes"}
    numbers["protocol"] = {"lobo": numbers["protocol"]["lobo"]}
    assert [one.experiment for one in protocols(numbers)] == ["table 2, many training skins", "figure 6b"]
    assert protocols({}) == []


def test_count_of_one_is_followed_by_a_singular():
    drift = {"unit": "pass", "train_n": 1, "test_n": 1, "every_n": 2, "skins_n": 1, "seeds_n": 1}
    (one,) = protocols({"drift": drift | {"initial": [{"contacts_n": 961}]}})
    assert "first 1 pass, tested on 1 pass after every 2 passes; 1 network per policy of no-load" in one.ours


def test_page_has_a_section_for_each_protocol():
    assert {one.section for one in protocols(all_experiments())} <= {section.key for section in read_sections()}
