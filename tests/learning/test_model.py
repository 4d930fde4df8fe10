import pytest
import torch
from torch import nn

from pipeline.learning.model import BUILD, paper_net, released_net
from pipeline.seeds import torch_generator_for


def words(net: nn.Module) -> list[str]:
    layers = [*net.feat, *net.head]
    return [f"{one.in_features}-{one.out_features}" if isinstance(one, nn.Linear) else "ReLU" for one in layers]


def test_the_network_is_the_one_that_the_paper_prints():
    # paper section 4: B(15) -> MLP+ReLU(200) -> MLP(200) -> MLP(40) -> MLP+ReLU(200) -> MLP+ReLU(200) -> xyF(3)
    expected = ["15-200", "ReLU", "200-200", "200-40", "40-200", "ReLU", "200-200", "ReLU", "200-3"]
    assert words(paper_net(15, torch_generator_for(0, "net"))) == expected


def test_the_released_network_has_two_more_relus():
    net = released_net(15, torch_generator_for(0, "net"))
    expected = ["15-200", "ReLU", "200-200", "ReLU", "200-40", "40-200", "ReLU", "200-200", "ReLU", "200-3", "ReLU"]
    assert words(net) == expected
    assert (net(torch.randn(64, 15, generator=torch_generator_for(0, "x"))) >= 0).all()


def test_features_are_the_forty_numbers_after_the_third_layer():
    net = paper_net(15, torch_generator_for(0, "net"))
    assert net.feat(torch.zeros(2, 15)).shape == (2, 40)


@pytest.mark.parametrize("name", sorted(BUILD))
def test_weights_come_from_the_generator_alone(name):
    torch.rand(3)  # global dice
    one = BUILD[name](15, torch_generator_for(0, "net"))
    torch.rand(5)
    other = BUILD[name](15, torch_generator_for(0, "net"))
    third = BUILD[name](15, torch_generator_for(1, "net"))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert not torch.equal(next(one.parameters()), next(third.parameters()))


def test_weights_lie_within_one_over_root_fan_in():
    layer = paper_net(15, torch_generator_for(0, "net")).feat[2]
    assert float(layer.weight.detach().abs().max()) <= 200**-0.5
    assert float(layer.weight.detach().std()) == pytest.approx(200**-0.5 / 3**0.5, rel=0.02)  # 40,000 draws
