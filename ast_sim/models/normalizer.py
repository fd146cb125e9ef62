"""Normalisation of inputs and targets with fixed statistics. All components of a vector share one scale."""

from __future__ import annotations

from itertools import accumulate
from typing import Any, Literal

import torch
from torch import Tensor, nn

Kind = Literal["vector", "scalar"]
Columns = tuple[Kind | None, int]  # a quantity and its number of columns; one of kind None is not changed


class Statistics:
    """Mean and scale of one quantity, in float64.

    The mean of a vector is 0, and its scale is the root mean square of its components. The scale of a scalar is its
    standard deviation.
    """

    def __init__(self, kind: Kind):
        self.kind = kind
        self.forget()

    def forget(self) -> None:
        """Begin without samples."""
        self._count = 0
        self._sum = 0.0
        self._squares = 0.0

    def observe(self, x: Tensor) -> None:
        """Add samples."""
        x = x.double()
        self._count += x.numel()
        self._sum += float(x.sum())
        self._squares += float(x.square().sum())

    def result(self) -> tuple[float, float]:
        """Mean and scale of all samples. A quantity that never varies has the size of its value for a scale, or 1: so
        another value than in training does not become a huge input."""
        if not self._count:
            return 0.0, 1.0
        mean = 0.0 if self.kind == "vector" else self._sum / self._count
        variance = max(self._squares / self._count - mean**2, 0.0)
        negligible = 1e-12 * self._squares / self._count
        return mean, variance**0.5 if variance > negligible else abs(mean) or 1.0


class Normalizer(nn.Module):
    """(x - mean) / scale with one mean and one scale for all components, which `fix` sets."""

    mean: Tensor
    scale: Tensor

    def __init__(self, kind: Kind | None, shape: tuple[int, ...] = ()):
        super().__init__()
        self.register_buffer("mean", torch.zeros(shape))
        self.register_buffer("scale", torch.ones(shape))
        self._statistics: list[tuple[Any, Statistics]] = [(..., Statistics(kind))] if kind else []

    def observe(self, x: Tensor) -> None:
        """Add samples."""
        for columns, statistics in self._statistics:
            statistics.observe(x[:, columns])

    def fix(self) -> None:
        """Set mean and scale from all samples, and forget these."""
        for columns, statistics in self._statistics:
            self.mean[columns], self.scale[columns] = statistics.result()
            statistics.forget()

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.scale

    def inverse(self, x: Tensor) -> Tensor:
        return x * self.scale + self.mean


class FeatureNormalizer(Normalizer):
    """A `Normalizer` for several quantities in the columns of one array.

    Args:
        kinds: of each quantity, in the order of the columns.
    """

    def __init__(self, kinds: list[Columns]):
        width = sum(width for _, width in kinds)
        super().__init__(None, (width,))
        self.width = width
        ends = accumulate(width for _, width in kinds)
        self._statistics = [
            (slice(end - width, end), Statistics(kind)) for end, (kind, width) in zip(ends, kinds, strict=True) if kind
        ]
