"""Tests of the network: its two implementations agree, and its estimates have the symmetries of their inputs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from reskin.seeds import rng_for
from reskin.universal import network
from reskin.universal.calibration import LabelledPresses, SkinData
from reskin.universal.episodes import Episodes
from reskin.universal.network import LOG_N, PLACE_MM
from reskin.universal.training import SkinReader, draw_weights

RNG = rng_for(0, "network")
REST_uT, UNLABELLED_uT, LABELLED_uT, READ_uT = (
    RNG.normal(0, 300, shape) for shape in ((15,), (20, 15), (6, 15), (7, 15))
)
LABELS = LabelledPresses(RNG.uniform(-8, 8, (6, 2)), np.array([0.5, np.nan, 2.0, 3.0, np.nan, 9.0]), LABELLED_uT)
# Weights with which labels have an effect, unlike those with which a training begins.
WEIGHTS = {
    name: value + 0.05 * RNG.standard_normal(value.shape).astype(np.float32)
    for name, value in draw_weights(REST_uT, RNG).items()
}
COMPILED = network.compile_weights(WEIGHTS)


def estimate(rest_uT=REST_uT, unlabelled_uT=UNLABELLED_uT, labels=LABELS, read_uT=READ_uT, **more):
    context = network.read_skin(WEIGHTS, SkinData(rest_uT, unlabelled_uT, labels), **more)
    return np.column_stack(network.estimate(COMPILED, context, read_uT))


@pytest.mark.parametrize(("unlabelled_n", "labels_n", "external_uT"), [(0, 0, 0.0), (20, 0, 0.0), (5, 6, 100.0)])
def test_numba_equals_pytorch(unlabelled_n, labels_n, external_uT):
    known = np.isfinite(LABELS.force_N[:labels_n])
    log_N = np.where(known, np.log(np.where(known, LABELS.force_N[:labels_n], 1)), 0) / LOG_N
    of_labels = np.column_stack([LABELS.place_mm[:labels_n] / PLACE_MM, log_N, np.ones(labels_n), known])
    context_uT = np.concatenate([LABELLED_uT[:labels_n], UNLABELLED_uT[:unlabelled_n]])
    parts = (REST_uT, context_uT, of_labels, READ_uT, np.zeros((7, 3)))
    episodes = Episodes(*(part[None].astype(np.float32) for part in parts), external_uT)
    with torch.no_grad():
        mean, log_sd = (part[0].double().numpy() for part in SkinReader(WEIGHTS)(episodes))
    found = estimate(REST_uT, UNLABELLED_uT[:unlabelled_n], LABELS[:labels_n], external_uT=external_uT)
    scale = np.array([PLACE_MM, PLACE_MM, LOG_N])
    expected = np.column_stack([mean * scale, np.exp(log_sd) * scale])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)  # single precision


def test_order_of_presses_does_not_matter_and_each_one_counts():
    found = estimate()
    np.testing.assert_allclose(estimate(REST_uT, UNLABELLED_uT[::-1], LABELS[::-1]), found, atol=1e-4)
    changes = (
        {"unlabelled_uT": UNLABELLED_uT[:-1]}, {"labels": LABELS[:5]}, {"rest_uT": REST_uT + 100},
        {"labels": replace(LABELS, place_mm=LABELS.place_mm + 1)},
        {"labels": replace(LABELS, force_N=LABELS.force_N / 2)},
        {"external_uT": 100.0},
    )  # fmt: skip
    for change in changes:
        assert np.abs(estimate(**change) - found).max() > 1e-3


def test_a_reading_is_estimated_by_itself():
    np.testing.assert_allclose(estimate(read_uT=READ_uT[2:3]), estimate()[2:3], rtol=1e-6)
    assert estimate(read_uT=READ_uT[:0]).shape == (0, 6)


def test_reversed_magnets_do_not_matter():
    negated = estimate(-REST_uT, -UNLABELLED_uT, replace(LABELS, db_uT=-LABELLED_uT), -READ_uT)
    np.testing.assert_allclose(negated, estimate(), rtol=1e-6)


def test_a_reading_that_is_not_a_number_gives_no_number():
    read_uT = READ_uT.copy()
    read_uT[3, 4] = math.nan
    found = estimate(read_uT=read_uT)
    assert np.isnan(found[3]).all()
    assert np.isfinite(np.delete(found, 3, axis=0)).all()


@pytest.mark.parametrize("chips_n", [1, 8])
def test_network_for_any_number_of_chips(chips_n):
    channels_n = 3 * chips_n
    weights = draw_weights(np.ones(channels_n), rng_for(0, "chips"))
    assert {name: value.shape for name, value in weights.items()} == network.shapes(channels_n)
    context = network.read_skin(weights, SkinData.at_rest(np.ones(channels_n)))
    found = network.estimate(network.compile_weights(weights), context, RNG.normal(0, 100, (4, channels_n)))
    assert np.isfinite(np.column_stack(found)).all()
