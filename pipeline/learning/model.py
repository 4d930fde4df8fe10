"""The paper's five-layer perceptron. In: scaled changes of field. Out: scaled x, y, F, and the 40 features.

Refuses to know how it is trained, and in which units.
"""

import torch
from jaxtyping import Float
from torch import nn

HIDDEN_N = 200
FEATURES_N = 40  # the bottleneck that the triplet term acts on (paper section 4)
OUTPUTS_N = 3


class SkinNet(nn.Module):
    """`feat`: the first three layers, `head`: the last three; weights are drawn from `generator` only."""

    def __init__(self, feat: nn.Sequential, head: nn.Sequential, generator: torch.Generator) -> None:
        super().__init__()
        self.feat = feat
        self.head = head
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                _draw(layer, generator)

    def forward(self, inputs: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b 3"]:
        """Answer for a batch of scaled changes of field."""
        answer: torch.Tensor = self.head(self.feat(inputs))
        return answer


def paper_net(channels_n: int, generator: torch.Generator) -> SkinNet:
    """B(15) -> MLP+ReLU(200) -> MLP(200) -> MLP(40) -> MLP+ReLU(200) -> MLP+ReLU(200) -> xyF(3), as printed."""
    feat = nn.Sequential(
        _linear(channels_n, HIDDEN_N), nn.ReLU(), _linear(HIDDEN_N, HIDDEN_N), _linear(HIDDEN_N, FEATURES_N)
    )
    return SkinNet(feat, nn.Sequential(*_head()), generator)


def released_net(channels_n: int, generator: torch.Generator) -> SkinNet:
    """The network that the authors released: also a ReLU after layer 2 and one on the output."""
    feat = nn.Sequential(
        _linear(channels_n, HIDDEN_N), nn.ReLU(), _linear(HIDDEN_N, HIDDEN_N), nn.ReLU(), _linear(HIDDEN_N, FEATURES_N)
    )
    return SkinNet(feat, nn.Sequential(*_head(), nn.ReLU()), generator)


BUILD = {"paper": paper_net, "released": released_net}


def _head() -> list[nn.Module]:
    wide = _linear(HIDDEN_N, HIDDEN_N)
    return [_linear(FEATURES_N, HIDDEN_N), nn.ReLU(), wide, nn.ReLU(), _linear(HIDDEN_N, OUTPUTS_N)]


def _linear(in_n: int, out_n: int) -> nn.Linear:
    # skip_init: the constructor would draw from torch's global generator.
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, in_n, out_n)
    return layer


def _draw(layer: nn.Linear, generator: torch.Generator) -> None:
    """PyTorch's own default for linear layers, uniform within 1/sqrt(fan in), from a named generator."""
    limit = layer.in_features**-0.5
    nn.init.uniform_(layer.weight, -limit, limit, generator=generator)
    nn.init.uniform_(layer.bias, -limit, limit, generator=generator)
