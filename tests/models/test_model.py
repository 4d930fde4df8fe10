import numpy as np
import pytest
import torch
from torch import nn

from reskin.models import network
from reskin.models.network import LAYERS, Predictor, Stack, draw_weights
from reskin.seeds import rng_for
from tests.models.plain import features_of, plain_net, weights_of

# float32 sums of up to 200 terms, in another order, six layers deep; numbers near 1
CLOSE = {"rtol": 1e-4, "atol": 1e-6}


def drawn(architecture: str = "paper", name: int = 0) -> dict[str, np.ndarray]:
    return draw_weights(LAYERS[architecture](15), rng_for(0, "net", name))


def batch(members_n: int, b: int = 16) -> torch.Tensor:
    return torch.from_numpy(rng_for(0, "batch").normal(size=(members_n, b, 15)).astype(np.float32))


def stack(members_n: int, architecture: str = "paper") -> Stack:
    return Stack(LAYERS[architecture](15), [drawn(architecture, i) for i in range(members_n)])


def descend(net: nn.Module, inputs: torch.Tensor) -> tuple[torch.Tensor, list[torch.Tensor]]:
    answer = net(inputs)
    (answer**2).sum().backward()
    return answer.detach(), [one.grad for one in net.parameters()]


@pytest.mark.parametrize("architecture", sorted(LAYERS))
@pytest.mark.parametrize("members_n", [1, 3])
def test_each_network_of_a_stack_is_the_plain_network_that_is_printed(architecture, members_n):
    net, inputs = stack(members_n, architecture), batch(members_n)
    answers, _ = descend(net, inputs)
    for i in range(members_n):
        alone = plain_net(architecture, drawn(architecture, i))
        answer, _ = descend(alone, inputs[i])
        torch.testing.assert_close(answers[i], answer, **CLOSE)
        features = features_of(alone)(inputs[i])
        torch.testing.assert_close(net.features(inputs)[i], features, **CLOSE)
        gradients = _with_gradients_for_weights(net).weights_of(i)
        for name, values in weights_of(alone, gradient=True).items():
            # gradients are sums over the batch, too
            np.testing.assert_allclose(gradients[name], values, rtol=1e-3, atol=1e-5, err_msg=name)


def _with_gradients_for_weights(net: Stack) -> Stack:
    twin = Stack(LAYERS["paper"](15), [net.weights_of(i) for i in range(net.members_n)])
    for own, one in zip(twin.parameters(), net.parameters(), strict=True):
        own.data = one.grad
    return twin


def test_networks_of_a_stack_never_touch_each_other():
    inputs = batch(3)
    answers, gradients = descend(stack(3), inputs)
    others = Stack(LAYERS["paper"](15), [drawn(name=0), drawn(name=9), drawn(name=2)])
    inputs[1] = 1e3 * inputs[1] + 5
    again, again_gradients = descend(others, inputs)
    for i, same in enumerate([True, False, True]):
        assert torch.equal(again[i], answers[i]) == same
        assert all(torch.equal(a[i], b[i]) == same for a, b in zip(again_gradients, gradients, strict=True))


def test_numbers_that_are_not_finite_stay_in_their_network():
    inputs = batch(3)
    _, gradients = descend(stack(3), inputs)
    inputs[1] = torch.nan
    answers, poisoned = descend(stack(3), inputs)
    assert torch.isfinite(answers).flatten(1).all(1).tolist() == [True, False, True]
    assert all(torch.equal(a[[0, 2]], b[[0, 2]]) for a, b in zip(poisoned, gradients, strict=True))


def test_a_network_is_taken_out_of_a_stack_as_it_was_put_in():
    net = stack(3)
    for i in range(3):
        put, taken = drawn(name=i), net.weights_of(i)
        assert list(taken) == list(put)
        assert all((taken[name] == put[name]).all() for name in put)


def test_what_is_taken_out_does_not_change_when_the_stack_goes_on():
    net = stack(2)
    taken = net.weights_of(1)
    with torch.no_grad():
        for one in net.parameters():
            one += 1
    assert all((taken[name] == values).all() for name, values in drawn(name=1).items())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_weight_that_is_not_finite_tells_on_its_network_alone(bad):
    members = [drawn(name=i) for i in range(3)]
    members[1]["layer4.bias"][7] = bad
    assert Stack(LAYERS["paper"](15), members).is_finite().tolist() == [True, False, True]


def test_features_are_forty_numbers_and_the_answer_is_made_of_them_alone():
    net, inputs = stack(2), batch(2)
    features = net.features(inputs)
    assert features.shape == (2, 16, 40)
    assert (features < 0).any()  # no ReLU stands behind the bottleneck
    assert torch.equal(net.head(features), net(inputs))


def test_the_released_network_answers_no_number_below_zero():
    answers, plain = stack(1, "released")(batch(1)), stack(1)(batch(1))
    assert (answers >= 0).all()
    assert (plain < 0).any()


@pytest.mark.parametrize("block_n", [1, 7, 16, 100])
def test_prediction_does_not_depend_on_the_block(monkeypatch, block_n):
    inputs = batch(1)[0].numpy()
    monkeypatch.setattr(network, "BLOCK_ROWS_N", block_n)
    predict = Predictor(drawn(), "paper", "cpu")
    answers = predict(inputs)
    one_by_one = np.concatenate([predict(row[None]) for row in inputs])
    np.testing.assert_allclose(answers, one_by_one, **CLOSE)
    np.testing.assert_allclose(answers, plain_net("paper", drawn())(torch.from_numpy(inputs)).detach(), **CLOSE)
