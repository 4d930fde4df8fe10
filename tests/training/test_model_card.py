"""Tests of model cards, which describe trained networks and their scores."""

import numpy as np
import pytest

from pipeline.training.jobs import model_card
from reskin.data.rows import Rows
from reskin.models.job import TrainingJob, TrainingResult
from reskin.models.train import train_stack
from tests.models.example_jobs import (
    LABELLED,
    POKED,
    ROWS_N,
    TEST,
    TRAIN,
    adaptation,
    example_data,
    fine_tuning,
    pooled,
)


def rows() -> Rows:
    data = example_data()
    board = np.array([skin[:2] for skin in data.skin])
    indentation = np.arange(ROWS_N) // 2
    passes = np.zeros(ROWS_N, np.int32)
    return Rows(np.array(["c"] * ROWS_N), board, data.skin, data.db_uT, data.target, passes, indentation, {})


def card(job: TrainingJob, **changes: object) -> dict:
    (one,) = train_stack([job], example_data())
    trained = TrainingResult(**{**vars(one), "key": "k", **changes})
    return model_card(job, trained, rows(), scene="lab")


def test_model_card_describes_the_data_for_training_and_tests():
    result = card(pooled())
    assert (result["scene"], result["key"], result["question"]) == ("lab", "k", "triplet")
    assert (result["train_boards"], result["train_skins"]) == (["b0"], ["b0_s0", "b0_s1"])
    assert (result["test_boards"], result["test_skins"]) == (["b1"], ["b1_s1"])
    assert result["train_rows_n"] == len(TRAIN)
    assert result["recipe"] == pooled().recipe.model_dump()
    assert (result["fold"], result["seed"], result["seed_i"]) == ("b1", 7, 0)
    assert "tuning" not in result


def test_model_card_describes_the_network():
    (one,) = train_stack([pooled()], example_data())
    result = card(pooled())
    assert result["architecture"] == {name: list(values.shape) for name, values in one.weights.items()}
    assert result["architecture"]["layer6.bias"] == [3]
    assert result["input"] == {"quantity": "change of field", "unit": "uT", "channels_n": 15, "view": "raw"}
    assert result["output"] == {"x_mm": "mm", "y_mm": "mm", "Fz_N": "N"}
    for name, values in one.scaler.arrays().items():
        assert (np.array(result["scaler"][name], np.float32) == values).all()


@pytest.mark.parametrize(("explained", "collapsed"), [(None, False), (0.9, False), (0.049, True), (-3.0, True)])
def test_model_card_states_whether_and_how_often_the_training_collapsed(explained, collapsed):
    result = card(pooled(), explained_min=explained, collapsed_before_n=1)
    assert (result["explained_min"], result["collapsed"], result["collapsed_before_n"]) == (explained, collapsed, 1)


@pytest.mark.parametrize(
    ("job", "kind", "used"),
    [(adaptation(), "unlabelled", POKED), (fine_tuning(), "labelled", LABELLED)],
    ids=["unlabelled", "labelled"],
)
def test_model_card_of_an_adapted_network_describes_the_adaptation(job, kind, used):
    tuning = card(job)["tuning"]
    assert (tuning["from"], tuning["kind"], tuning["skins"]) == ("start", kind, ["b1_s1"])
    assert tuning["settings"] == job.tuning.settings.model_dump()
    assert tuning["pokes_n"] == len({row // 2 for row in used})  # An indentation has two readings.
    assert not set(used) & set(TEST)
