import json

import numpy as np
import pytest

from pipeline.training.jobs import model_card
from reskin.data.rows import Rows
from reskin.models.job import TrainingJob, TrainingResult
from reskin.models.train import train_stack
from tests.models.example_jobs import OWN, POKED, ROWS_N, TEST, TRAIN, adaptation, example_data, fine_tuning, pooled


def rows() -> Rows:
    own = example_data()
    board = np.array([skin[:2] for skin in own.skin])
    indentation = np.arange(ROWS_N) // 2
    passes = np.zeros(ROWS_N, np.int32)
    return Rows(np.array(["c"] * ROWS_N), board, own.skin, own.db_uT, own.target, passes, indentation, {})


def card(job: TrainingJob, **changes: object) -> dict:
    (one,) = train_stack([job], example_data())
    trained = TrainingResult(**{**vars(one), "key": "k", **changes})
    return model_card(job, trained, rows(), scene="lab")


def test_a_card_says_what_was_trained_on_what_and_tested_on_what():
    words = card(pooled())
    assert (words["scene"], words["key"], words["question"]) == ("lab", "k", "triplet")
    assert (words["train_boards"], words["train_skins"]) == (["b0"], ["b0_s0", "b0_s1"])
    assert (words["test_boards"], words["test_skins"]) == (["b1"], ["b1_s1"])
    assert words["train_rows_n"] == len(TRAIN)
    assert words["recipe"] == pooled().recipe.model_dump()
    assert (words["fold"], words["seed"], words["seed_i"]) == ("b1", 7, 0)
    assert "tuning" not in words


def test_a_card_says_all_that_a_user_of_the_network_needs():
    (one,) = train_stack([pooled()], example_data())
    words = card(pooled())
    assert words["architecture"] == {name: list(values.shape) for name, values in one.weights.items()}
    assert words["architecture"]["layer6.bias"] == [3]
    assert words["input"] == {"quantity": "change of field", "unit": "uT", "channels_n": 15, "view": "raw"}
    assert words["output"] == {"x_mm": "mm", "y_mm": "mm", "Fz_N": "N"}
    for name, values in one.scaler.arrays().items():
        assert (np.array(words["scaler"][name], np.float32) == values).all()


@pytest.mark.parametrize("job", [pooled(), adaptation(), fine_tuning()], ids=["pooled", "adapting", "few labels"])
def test_a_card_is_json_that_reads_back_as_it_was(job):
    words = card(job)
    assert json.loads(json.dumps(words, allow_nan=False)) == words


@pytest.mark.parametrize(("explained", "collapsed"), [(None, False), (0.9, False), (0.049, True), (-3.0, True)])
def test_a_card_says_whether_its_network_learnt_and_how_often_it_was_trained(explained, collapsed):
    words = card(pooled(), explained_min=explained, collapsed_before_n=1)
    assert (words["explained_min"], words["collapsed"], words["collapsed_before_n"]) == (explained, collapsed, 1)


def test_an_early_stop_stands_on_the_card():
    assert card(pooled())["stopped_step"] is None
    assert card(pooled(), stopped_step=150)["stopped_step"] == 150


@pytest.mark.parametrize(
    ("job", "kind", "used"),
    [(adaptation(), "unlabelled", POKED), (fine_tuning(), "labelled", OWN)],
    ids=["unlabelled", "labelled"],
)
def test_a_tuned_network_says_from_what_by_what_and_on_how_many_indentations(job, kind, used):
    tuning = card(job)["tuning"]
    assert (tuning["from"], tuning["kind"], tuning["skins"]) == ("start", kind, ["b1_s1"])
    assert tuning["settings"] == job.tuning.settings.model_dump()
    assert tuning["pokes_n"] == len({row // 2 for row in used})  # two readings an indentation
    assert not set(used) & set(TEST)
