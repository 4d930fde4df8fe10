"""Tests that the training code passes extreme cases, and that a fault planted in the code makes one case fail."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.experiments.stability import learning
from pipeline.experiments.stability.learning import fold_cases, learning_cases, scaling_cases, triplet_cases
from reskin.data import splits
from reskin.models import batches, inputs, job, losses, network, train

SEED = 2021
ROWS, JOB = learning._rows(SEED), learning._job(SEED)


def failed(cases):
    return {case.case for case in cases if not case.holds}


@pytest.fixture(scope="module")
def cases():
    return learning_cases(SEED)


def test_training_code_passes_every_case(cases):
    assert failed(cases) == set()


def test_each_case_has_one_row_that_describes_its_outcome(cases):
    assert len({case.case for case in cases}) == len(cases)
    assert {case.area for case in cases} == {"learning"}
    assert all(case.should and case.happened for case in cases)
    assert all((case.error is None) == (case.limit is None) for case in cases)


def test_outcomes_of_cases_are_reproducible(cases):
    assert set(triplet_cases(SEED)) <= set(cases)


# Each of the following tests disables one guard of the training code, such as a check or a lower limit. One of the
# cases must then fail.


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.filterwarnings("ignore:divide by zero encountered")
def test_scaler_without_a_minimum_scale_is_detected(monkeypatch):
    monkeypatch.setattr(inputs, "SCALE_FLOOR", np.float32(0))
    constant = {"a constant channel", "all channels are constant, as without a magnet"}
    assert failed(scaling_cases(SEED)) == constant


def test_scaler_with_a_too_large_minimum_scale_is_detected(monkeypatch):
    monkeypatch.setattr(inputs, "SCALE_FLOOR", np.float32(1e-3))
    assert failed(scaling_cases(SEED)) == {"labels multiplied by 2^-20"}


def test_triplet_loss_without_squared_distances_is_detected(monkeypatch):
    def triplet_loss_of_roots(anchor, positive, negative):
        nearer, farther = ((anchor - one).pow(2).sum(-1).sqrt() for one in (positive, negative))
        return torch.relu(nearer - farther + 1e-3).mean(-1)

    monkeypatch.setattr(train, "triplet_loss", triplet_loss_of_roots)
    assert failed(triplet_cases(SEED)) == {"triplet loss of identical readings, with a weight of 1000"}


def test_missing_check_for_equal_distances_in_triplets_is_detected(monkeypatch):
    monkeypatch.setattr(losses, "_find_anchors", lambda place: np.ones(len(place), bool))
    monkeypatch.setattr(batches, "draw_triplets", lambda points, anchor, rng: (anchor, anchor))
    assert failed(triplet_cases(SEED)) == {"triplets if each skin has only two pokes"}


def test_training_that_does_not_check_the_loss_is_detected(monkeypatch):
    def unchecked(self, errors, step):
        self.errors.append(errors)
        for i in range(errors.shape[1]):
            self.sound_steps_n[i] = step
            self.weights[i] = self.net.weights_of(i)
        return True

    monkeypatch.setattr(train.Monitor, "check", unchecked)
    cases = [learning._exploding_weights(JOB, ROWS, 1e10), learning._overflowing_neighbour(JOB, ROWS)]
    assert failed(cases) == {case.case for case in cases}


def test_training_that_does_not_notice_a_collapse_is_detected(monkeypatch):
    monkeypatch.setattr(job, "COLLAPSED", -np.inf)
    assert not learning._collapsed(JOB, ROWS).holds


def test_influence_between_networks_of_a_stack_is_detected(monkeypatch):
    original = network.Stack.features

    def mixed(self, inputs):
        features = original(self, inputs)
        return features + 0 * features.sum(0, keepdim=True)

    monkeypatch.setattr(network.Stack, "features", mixed)
    assert not learning._overflowing_neighbour(JOB, ROWS).holds


def test_batches_that_ignore_the_seed_are_detected(monkeypatch):
    original = train.prepare

    def prepare_without_seed(job, rows):
        prepared, scaler = original(replace(job, seed_i=0), rows)
        return prepared, scaler

    monkeypatch.setattr(train, "prepare", prepare_without_seed)
    assert not learning._same_seed(JOB, ROWS).holds


def test_missing_check_for_too_few_groups_in_folds_is_detected(monkeypatch):
    monkeypatch.setattr(learning, "draw_folds", lambda *_: [splits.NO_POOL])
    assert len(failed(fold_cases())) == 3
