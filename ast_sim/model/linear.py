"""The dense layer of the model: one fused op with what follows it."""

from __future__ import annotations

from torch import Tensor, nn

from ast_sim.ops.linear import linear


class Linear(nn.Linear):
    """y = act(W x + b) + residual."""

    def forward(self, x: Tensor, activation: str = "none", residual: Tensor | None = None) -> Tensor:
        """x [M, inputs] -> [M, outputs], or half of them with "geglu"; residual has the shape of the result."""
        return linear(x, self.weight, self.bias, activation, residual)
