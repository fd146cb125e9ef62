"""The positional embedding of cells (paper, section Overall Architecture)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ast_sim.models.layers import Linear


class PositionEmbedding(nn.Module):
    """c + Linear([x, sin(2^j pi x), cos(2^j pi x)]) per axis, j = 0..7.

    At the centres of cells of level L the waves with j >= L are constant, so they are left out.
    """

    def __init__(self, width: int, level: int):
        super().__init__()
        self.register_buffer("frequency", math.pi * 2.0 ** torch.arange(min(8, level)), persistent=False)
        self.project = Linear(3 * (1 + 2 * min(8, level)), width)

    def forward(self, features: Tensor, centers: Tensor) -> Tensor:
        """features [C, width], centers [C, 3] in units of the half width of the domain -> [C, width]."""
        phase = (centers[:, :, None] * self.frequency).flatten(1)
        waves = torch.cat([centers, phase.sin(), phase.cos()], dim=1)
        return self.project(waves, residual=features)
