"""Tests of the layers and the initial weights of the networks."""

import numpy as np
import pytest
from torch import nn

from reskin.models.network import FEATURE_LAYERS_N, FEATURES_N, LAYERS, draw_weights, paper_layers
from reskin.seeds import rng_for
from tests.models.plain import PRINTED


@pytest.mark.parametrize("name", sorted(LAYERS))
def test_layers_equal_those_in_the_paper_and_in_its_released_code(name):
    layers = []
    for layer in LAYERS[name](15):
        layers += [f"{layer.in_n}-{layer.out_n}"] + ["ReLU"] * layer.relu
    assert tuple(layers) == PRINTED[name]


def test_first_layer_has_an_input_for_each_channel():
    assert [layer.in_n for layer in paper_layers(120)] == [120, 200, 200, 40, 200, 200]


def test_network_for_shear_has_two_more_outputs():
    assert paper_layers(15, 5)[:-1] == paper_layers(15)[:-1]
    assert paper_layers(15, 5)[-1].out_n == 5


def test_third_layer_gives_forty_features_without_a_relu():
    for layers in LAYERS.values():
        third = layers(15)[FEATURE_LAYERS_N - 1]
        assert (third.out_n, third.relu) == (FEATURES_N, False) == (40, False)


def test_equal_generators_give_equal_initial_weights():
    one, other, third = (draw_weights(paper_layers(15), rng_for(seed, "net")) for seed in (0, 0, 1))
    assert all((one[name] == other[name]).all() for name in one)
    assert all((one[name] != third[name]).any() for name in one)


def test_layers_have_different_initial_weights():
    weights = draw_weights(paper_layers(15), rng_for(0, "net"))
    assert not np.isin(weights["layer2.weight"].ravel()[:50], weights["layer5.weight"]).any()


@pytest.mark.parametrize("i", range(1, 7))
def test_initial_weights_have_the_distribution_of_pytorch(i):
    layer = paper_layers(15)[i - 1]
    weights = draw_weights(paper_layers(15), rng_for(0, "net"))
    theirs = nn.Linear(layer.in_n, layer.out_n)
    for part in ("weight", "bias"):
        ours, pytorch = weights[f"layer{i}.{part}"], getattr(theirs, part).detach().numpy()
        assert ours.shape == pytorch.shape
        assert ours.dtype == pytorch.dtype == np.float32
        limit = np.float32(layer.in_n**-0.5)
        assert max(np.abs(ours).max(), np.abs(pytorch).max()) <= limit
    # The distribution is uniform between -limit and limit, so its mean is 0 and its standard deviation is limit /
    # sqrt(3). The tolerances are six standard errors.
    values, n = weights[f"layer{i}.weight"].astype(float), weights[f"layer{i}.weight"].size
    assert (values**2).mean() == pytest.approx(limit**2 / 3, rel=6 * (4 / 5) ** 0.5 / n**0.5)
    assert abs(values.mean()) < 6 * limit / (3 * n) ** 0.5
