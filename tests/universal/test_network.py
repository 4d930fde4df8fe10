"""Tests of the network, whose estimates depend on a set of presses.

The set may have any number of presses, or none, in any order.
"""

import numpy as np
import pytest
import torch

from reskin.seeds import rng_for
from reskin.universal.network import LOG_N, PLACE_MM, draw_weights, predict
from reskin.universal.training import Network, inputs

RNG = rng_for(0, "network")
PRESSES_uT, READ_uT, REST_uT = (RNG.normal(0, 300, shape) for shape in ((20, 15), (7, 15), (15,)))
ONE, OTHER = (draw_weights(15, rng_for(0, name)) for name in ("one", "other"))


def test_order_of_presses_does_not_matter():
    forward, backward = predict([ONE], READ_uT, REST_uT, PRESSES_uT), predict([ONE], READ_uT, REST_uT, PRESSES_uT[::-1])
    # The tolerance is rounding, because sums are computed in another order.
    np.testing.assert_allclose(forward.place_mm, backward.place_mm, atol=1e-4)
    other = predict([ONE], READ_uT, REST_uT, 2 * PRESSES_uT)
    assert np.abs(forward.place_mm - other.place_mm).max() > 1e-3


def test_network_ignores_masked_presses():
    network, rest = Network(ONE), torch.from_numpy(REST_uT[None].astype(np.float32))
    presses = torch.from_numpy(PRESSES_uT[None].astype(np.float32))
    kept = (torch.arange(20) < 5).float()[None]
    torch.testing.assert_close(
        network.encode(presses, rest, kept), network.encode(presses[:, :5], rest, torch.ones(1, 5))
    )
    none = predict([ONE], READ_uT, REST_uT, np.empty((0, 15)))
    assert np.isfinite(none.place_mm).all()


def test_inputs_are_the_direction_and_the_log_length_of_field_changes():
    """Fields that are five times as large have the same direction, and a log length that is larger by log(5)."""
    rest = torch.zeros(1, 15)
    near, far = (inputs(torch.from_numpy(size * READ_uT[None].astype(np.float32)), rest) for size in (1.0, 5.0))
    torch.testing.assert_close(near[..., :15], far[..., :15])
    torch.testing.assert_close(far[..., 15] - near[..., 15], torch.full((1, 7), float(np.log(5.0))), atol=1e-5, rtol=0)


def test_variance_of_several_networks_includes_their_disagreement():
    one, other = (predict([each], READ_uT, REST_uT, PRESSES_uT) for each in (ONE, OTHER))
    both = predict([ONE, OTHER], READ_uT, REST_uT, PRESSES_uT)
    np.testing.assert_allclose(both.place_mm, (one.place_mm + other.place_mm) / 2, rtol=1e-6)
    variance = (one.sd_mm**2 + other.sd_mm**2) / 2 + (one.place_mm - other.place_mm) ** 2 / 4
    np.testing.assert_allclose(both.sd_mm**2, variance, rtol=1e-6)


@pytest.mark.parametrize("chips_n", [1, 5])
def test_network_can_be_built_for_any_number_of_chips(chips_n):
    weights = draw_weights(3 * chips_n, rng_for(0, "chips"))
    assert predict(
        [weights], READ_uT[:, : 3 * chips_n], REST_uT[: 3 * chips_n], PRESSES_uT[:, : 3 * chips_n]
    ).log_N.shape


@pytest.mark.parametrize("presses_n", [0, 20])
def test_network_in_numpy_equals_that_in_pytorch(presses_n):
    weights = {name: value + 0.05 * RNG.standard_normal(value.shape).astype(np.float32) for name, value in ONE.items()}
    found = predict([weights], READ_uT, REST_uT, PRESSES_uT[:presses_n])
    read, rest, presses = (torch.from_numpy(part.astype(np.float32))[None] for part in (READ_uT, REST_uT, PRESSES_uT))
    with torch.no_grad():
        network = Network(weights)
        kept = (torch.arange(20) < presses_n).float()[None]
        mean, log_sd = (part[0].numpy() for part in network(read, rest, network.encode(presses, rest, kept)))
    found_mean = np.column_stack([found.place_mm / PLACE_MM, found.log_N / LOG_N])
    found_sd = np.column_stack([found.sd_mm / PLACE_MM, found.sd_log_N / LOG_N])
    # The tolerance is rounding, because sums are computed in another order.
    np.testing.assert_allclose(found_mean, mean, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(np.log(found_sd), log_sd, rtol=1e-5, atol=1e-5)
