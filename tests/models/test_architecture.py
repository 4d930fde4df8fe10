"""Tests of the layers and the initial weights of the networks."""

import numpy as np
import pytest
from torch import nn

from reskin.models.network import LAYERS, draw_weights, paper_layers
from reskin.seeds import rng_for
from tests.models.plain import PRINTED


@pytest.mark.parametrize("name", sorted(LAYERS))
def test_layers_equal_those_in_the_paper_and_in_its_released_code(name):
    layers = []
    for layer in LAYERS[name](15):
        layers += [f"{layer.in_n}-{layer.out_n}"] + ["ReLU"] * layer.relu
    assert tuple(layers) == PRINTED[name]


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
