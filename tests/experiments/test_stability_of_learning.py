"""Extreme trainings end as they should, and an engine that lets one through is found out."""

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


def broken(cases):
    return {case.case for case in cases if not case.holds}


@pytest.fixture(scope="module")
def cases():
    return learning_cases(SEED)


def test_every_case_but_one_ends_as_it_should(cases):
    assert broken(cases) == set()


def test_every_row_is_its_own_and_says_what_happened(cases):
    assert len({case.case for case in cases}) == len(cases)
    assert {case.area for case in cases} == {"learning"}
    assert all(case.should and case.happened for case in cases)
    assert all((case.error is None) == (case.limit is None) for case in cases)


def test_the_same_seed_gives_the_same_words(cases):
    assert set(triplet_cases(SEED)) <= set(cases)


# Each fault is planted where the product has its guard.


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.filterwarnings("ignore:divide by zero encountered")
def test_a_scale_without_a_floor_is_found_out(monkeypatch):
    monkeypatch.setattr(inputs, "SCALE_FLOOR", np.float32(0))
    constant = {"a channel that never moves", "no channel ever moves, as without a magnet"}
    assert broken(scaling_cases(SEED)) == constant


def test_a_floor_so_high_that_labels_stay_small_is_found_out(monkeypatch):
    monkeypatch.setattr(inputs, "SCALE_FLOOR", np.float32(1e-3))
    assert broken(scaling_cases(SEED)) == {"labels times 2^-20"}


def test_a_triplet_loss_of_roots_is_found_out(monkeypatch):
    def of_roots(anchor, positive, negative):
        nearer, farther = ((anchor - one).pow(2).sum(-1).sqrt() for one in (positive, negative))
        return torch.relu(nearer - farther + 1e-3).mean(-1)

    monkeypatch.setattr(train, "triplet_loss", of_roots)
    assert broken(triplet_cases(SEED)) == {"triplets of identical readings, weighed 1000"}


def test_a_sampler_that_takes_ties_is_found_out(monkeypatch):
    monkeypatch.setattr(losses, "_find_anchors", lambda place: np.ones(len(place), bool))
    monkeypatch.setattr(batches, "draw_triplets", lambda points, anchor, rng: (anchor, anchor))
    assert broken(triplet_cases(SEED)) == {"two pokes a skin: from each, only the other one"}


def test_a_loop_that_never_looks_at_its_loss_is_found_out(monkeypatch):
    def blind(self, error, step):
        for i in range(len(error)):
            self.curves[i].append(float(error[i]))
            self.weights[i] = self.net.weights_of(i)
        return True

    monkeypatch.setattr(train.Monitor, "check", blind)
    cases = [learning._explodes(JOB, ROWS, 1e10), learning._beside_one_that_overflows(JOB, ROWS)]
    assert broken(cases) == {case.case for case in cases}


def test_a_network_that_died_and_is_taken_as_sound_is_found_out(monkeypatch):
    monkeypatch.setattr(job, "COLLAPSED", -np.inf)
    assert not learning._collapsed(JOB, ROWS).holds


def test_a_network_that_touches_its_neighbour_is_found_out(monkeypatch):
    right = network.Stack.features

    def mixed(self, inputs):
        features = right(self, inputs)
        return features + 0 * features.sum(0, keepdim=True)

    monkeypatch.setattr(network.Stack, "features", mixed)
    assert not learning._beside_one_that_overflows(JOB, ROWS).holds


def test_a_batch_that_ignores_the_seed_is_found_out(monkeypatch):
    right = train.prepare

    def of_no_seed(job, rows):
        prepared, scaler = right(replace(job, seed_i=0), rows)
        return prepared, scaler

    monkeypatch.setattr(train, "prepare", of_no_seed)
    assert not learning._again(JOB, ROWS).holds


def test_folds_that_are_drawn_from_too_few_groups_are_found_out(monkeypatch):
    monkeypatch.setattr(learning, "draw_folds", lambda *_: [splits.NO_POOL])
    assert len(broken(fold_cases())) == 3
