"""The two-layer MLPs of the paper (section Model Details), with random weight factorization."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class FactorizedLinear(nn.Module):
    """y = W x + b with W = diag(g) V (random weight factorization, Wang et al. 2022).

    At the start W is Glorot uniform, g = exp(s) with s ~ N(1.0, 0.1) for each output unit, V = W / g and b = 0;
    g and V are both trained.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        weight = nn.init.xavier_uniform_(torch.empty(outputs, inputs))
        scale = torch.exp(1.0 + 0.1 * torch.randn(outputs))
        self.g = nn.Parameter(scale)
        self.V = nn.Parameter(weight / scale[:, None])
        self.bias = nn.Parameter(torch.zeros(outputs))

    @property
    def weight(self) -> Tensor:
        return self.g[:, None] * self.V

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x, self.weight, self.bias)


def linear(inputs: int, outputs: int, factorized: bool) -> nn.Module:
    """A layer of an MLP: factorized, or plain with the same start W = Glorot uniform, b = 0."""
    if factorized:
        return FactorizedLinear(inputs, outputs)
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class MLP(nn.Module):
    """Linear, ReLU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int, factorized: bool):
        super().__init__()
        self.first = linear(inputs, hidden, factorized)
        self.second = linear(hidden, outputs, factorized)

    def forward(self, x: Tensor) -> Tensor:
        return self.second(F.relu(self.first(x)))
