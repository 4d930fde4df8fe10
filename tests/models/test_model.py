"""Tests of stacks. A stack consists of several networks that are computed together."""

import numpy as np
import pytest
import torch
from torch import nn

from reskin.models import network
from reskin.models.network import LAYERS, Predictor, Stack, draw_weights
from reskin.seeds import rng_for
from tests.models.plain import features_of, plain_net, weights_of

# Tolerance: the six layers sum up to 200 single-precision terms near 1, in another order.
CLOSE = {"rtol": 1e-4, "atol": 1e-6}


def draw_parameters(architecture: str = "paper", name: int = 0) -> dict[str, np.ndarray]:
    return draw_weights(LAYERS[architecture](15), rng_for(0, "net", name))


def batch(members_n: int, b: int = 16) -> torch.Tensor:
    return torch.from_numpy(rng_for(0, "batch").normal(size=(members_n, b, 15)).astype(np.float32))


def stack(members_n: int, architecture: str = "paper") -> Stack:
    return Stack(LAYERS[architecture](15), [draw_parameters(architecture, i) for i in range(members_n)])


def output_and_gradients(net: nn.Module, inputs: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
    output = net(inputs)
    (output**2).sum().backward()
    return output.detach(), [one.grad for one in net.parameters()]


@pytest.mark.parametrize("architecture", sorted(LAYERS))
@pytest.mark.parametrize("members_n", [1, 3])
def test_networks_in_a_stack_equal_plain_networks(architecture, members_n):
    net, inputs = stack(members_n, architecture), batch(members_n)
    outputs, _ = output_and_gradients(net, inputs)
    for i in range(members_n):
        alone = plain_net(architecture, draw_parameters(architecture, i))
        output, _ = output_and_gradients(alone, inputs[i])
        torch.testing.assert_close(outputs[i], output, **CLOSE)
        features = features_of(alone)(inputs[i])
        torch.testing.assert_close(net.features(inputs)[i], features, **CLOSE)
        gradients = _with_gradients_for_weights(net).weights_of(i)
        for name, values in weights_of(alone, gradient=True).items():
            # The tolerance for gradients is larger, because they are also summed over the batch.
            np.testing.assert_allclose(gradients[name], values, rtol=1e-3, atol=1e-5, err_msg=name)


def _with_gradients_for_weights(net: Stack) -> Stack:
    copied = Stack(LAYERS["paper"](15), [net.weights_of(i) for i in range(net.members_n)])
    for own, one in zip(copied.parameters(), net.parameters(), strict=True):
        own.data = one.grad
    return copied


def test_networks_of_a_stack_do_not_influence_each_other():
    inputs = batch(3)
    outputs, gradients = output_and_gradients(stack(3), inputs)
    others = Stack(LAYERS["paper"](15), [draw_parameters(name=0), draw_parameters(name=9), draw_parameters(name=2)])
    inputs[1] = 1e3 * inputs[1] + 5
    again, again_gradients = output_and_gradients(others, inputs)
    for i, same in enumerate([True, False, True]):
        assert torch.equal(again[i], outputs[i]) == same
        assert all(torch.equal(a[i], b[i]) == same for a, b in zip(again_gradients, gradients, strict=True))


def test_nan_input_of_a_network_affects_no_other_network_of_the_stack():
    inputs = batch(3)
    _, gradients = output_and_gradients(stack(3), inputs)
    inputs[1] = torch.nan
    outputs, poisoned = output_and_gradients(stack(3), inputs)
    assert torch.isfinite(outputs).flatten(1).all(1).tolist() == [True, False, True]
    assert all(torch.equal(a[[0, 2]], b[[0, 2]]) for a, b in zip(poisoned, gradients, strict=True))


def test_weights_taken_out_of_a_stack_equal_those_put_in():
    net = stack(3)
    for i in range(3):
        put, taken = draw_parameters(name=i), net.weights_of(i)
        assert list(taken) == list(put)
        assert all((taken[name] == put[name]).all() for name in put)


@pytest.mark.parametrize("block_n", [1, 7, 16, 100])
def test_predictions_do_not_depend_on_the_size_of_blocks(monkeypatch, block_n):
    inputs = batch(1)[0].numpy()
    monkeypatch.setattr(network, "BLOCK_ROWS_N", block_n)
    predict = Predictor(draw_parameters(), "paper", "cpu")
    outputs = predict(inputs)
    one_by_one = np.concatenate([predict(row[None]) for row in inputs])
    np.testing.assert_allclose(outputs, one_by_one, **CLOSE)
    np.testing.assert_allclose(
        outputs, plain_net("paper", draw_parameters())(torch.from_numpy(inputs)).detach(), **CLOSE
    )
