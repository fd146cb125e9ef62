"""Dense layers, and the paper's MLPs of two layers (section Model Details) with random weight factorization."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn

from ast_sim.ops import linear, mlp


class Linear(nn.Linear):
    """y = act(W x + b) + residual."""

    def forward(self, input: Tensor, activation: str = "none", residual: Tensor | None = None) -> Tensor:
        """input [M, inputs] -> [M, outputs], or half of them with "geglu"; residual has the shape of the result."""
        return linear(input, self.weight, self.bias, activation, residual)


class Norm(Protocol):
    """A LayerNorm, by its weight and bias."""

    @property
    def weight(self) -> Tensor: ...

    @property
    def bias(self) -> Tensor: ...


class FactorizedLinear(nn.Module):
    """y = W x + b with W = diag(g) V (random weight factorization, Wang et al. 2022).

    At the start W is Glorot uniform, g = exp(s) with s ~ N(1.0, 0.1) for each output unit, V = W / g and b = 0. g,
    V and b are trained.
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


def layer(inputs: int, outputs: int, factorized: bool = False, bias: bool = True) -> Linear | FactorizedLinear:
    """A layer, factorized or plain. Both start with W = Glorot uniform and b = 0."""
    if factorized:
        return FactorizedLinear(inputs, outputs)
    plain = Linear(inputs, outputs, bias)
    nn.init.xavier_uniform_(plain.weight)
    if bias:
        nn.init.zeros_(plain.bias)
    return plain


class MLP(nn.Module):
    """Linear, ReLU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int, factorized: bool = False):
        super().__init__()
        self.first = layer(inputs, hidden, factorized)
        self.second = layer(hidden, outputs, factorized)

    def forward(
        self, x: Tensor, beside: Tensor | None = None, norm: Norm | None = None, residual: Tensor | None = None
    ) -> Tensor:
        """LN(W_2 relu(W_1 [x, beside] + b_1) + b_2) + residual, where `norm` is LN.

        x [M, I], beside [M, J] with I + J inputs, residual [M, outputs] -> [M, outputs].
        """
        weights = (self.first.weight, self.first.bias, self.second.weight, self.second.bias)
        return mlp(x, *weights, beside, None if norm is None else (norm.weight, norm.bias), residual)
