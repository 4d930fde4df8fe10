import pytest
import torch

from pipeline.errors import TrainingError
from pipeline.learning.train import predict, train
from pipeline.seeds import torch_generator_for
from tests.learning.recipes import recipe


def rows(n: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    inputs = torch.randn(n, 15, generator=torch_generator_for(0, "inputs"))
    return inputs, torch.tanh(inputs[:, :3] - inputs[:, 3:6])


def test_thirty_two_rows_are_learned_by_heart():
    inputs, targets = rows()
    net, curve = train(inputs, targets, recipe(epochs_n=300), torch_generator_for(0, "train"))
    assert float(((predict(net, inputs) - targets) ** 2).mean()) < 1e-3  # of a variance near one
    assert curve[-1] < 1e-3 < curve[0]


def test_same_seed_same_weights():
    inputs, targets = rows()
    one, _ = train(inputs, targets, recipe(), torch_generator_for(3, "train"))
    other, _ = train(inputs, targets, recipe(), torch_generator_for(3, "train"))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_a_learning_rate_that_explodes_is_an_error_and_no_result():
    inputs, targets = rows()
    with pytest.raises(TrainingError, match="the loss must be finite"):
        train(inputs * 1e20, targets, recipe(rate_max=1e6, epochs_n=20), torch_generator_for(0, "train"))


@pytest.mark.parametrize("n", [1, 2, 17])
def test_fewer_rows_than_a_batch_still_train(n):
    inputs, targets = rows(n)
    _, curve = train(inputs, targets, recipe(epochs_n=1), torch_generator_for(0, "train"))
    assert len(curve) == 1


def test_prediction_does_not_depend_on_the_block():
    inputs, targets = rows()
    net, _ = train(inputs, targets, recipe(), torch_generator_for(0, "train"))
    one_by_one = torch.cat([predict(net, row[None]) for row in inputs])
    # another order of float32 sums
    torch.testing.assert_close(predict(net, inputs), one_by_one, rtol=1e-4, atol=1e-5)
