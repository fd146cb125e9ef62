"""Fixed statistics of inputs and targets: one scale for a vector, so that no component drowns another."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

Kind = Literal["vector", "scalar"]


class Normalizer(nn.Module):
    """(x - mean) / scale with one mean and one scale for all components, fixed after `fix`.

    A vector has mean 0 and the root mean square of its components as scale; a scalar its mean and standard deviation.
    """

    def __init__(self, kind: Kind):
        super().__init__()
        self.kind = kind
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("scale", torch.ones(()))
        self._count, self._sum, self._squares = 0, 0.0, 0.0

    def observe(self, x: Tensor) -> None:
        """Add samples, in float64."""
        x = x.double()
        self._count += x.numel()
        self._sum += float(x.sum())
        self._squares += float(x.square().sum())

    def fix(self) -> None:
        """Take the statistics of all samples observed; a quantity that never varies keeps the scale 1."""
        if not self._count:
            return
        mean = 0.0 if self.kind == "vector" else self._sum / self._count
        variance = max(self._squares / self._count - mean**2, 0.0)
        negligible = 1e-12 * self._squares / self._count
        self.mean.fill_(mean)
        self.scale.fill_(variance**0.5 if variance > negligible else 1.0)

    def forward(self, x: Tensor) -> Tensor:
        return x / self.scale if self.kind == "vector" else (x - self.mean) / self.scale

    def inverse(self, x: Tensor) -> Tensor:
        return x * self.scale if self.kind == "vector" else x * self.scale + self.mean
