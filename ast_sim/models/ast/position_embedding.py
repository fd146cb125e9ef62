"""How attention knows places: they are embedded and added to vectors, or they rotate queries and keys."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.models.layers import Linear


class PositionEmbedding(nn.Module):
    """c + Linear([x, sin(2^j pi x), cos(2^j pi x)]) per axis, j = 0..7 (paper, section Overall Architecture).

    At the centres of cells of level L the waves with j >= L are constant, so they are left out.
    """

    frequency: Tensor

    def __init__(self, width: int, level: int):
        super().__init__()
        self.register_buffer("frequency", math.pi * 2.0 ** torch.arange(min(8, level)), persistent=False)
        self.project = Linear(3 * (1 + 2 * min(8, level)), width)

    def forward(self, features: Tensor, centers: Tensor) -> Tensor:
        """features [C, width], centers [C, 3] in units of the half width of the domain -> [C, width]."""
        phase = (centers[:, :, None] * self.frequency).flatten(1)
        waves = torch.cat([centers, phase.sin(), phase.cos()], dim=1)
        return self.project(waves, residual=features)


def rotations(places: Tensor, head_dim: int) -> Tensor:
    """Rotary embedding (Su et al. 2021, arXiv 2104.09864): places [T, 3] float64, in cell sides -> [T, D].

    Each pair of components of a query or key is rotated by an angle, of which this is cosine and sine, float32. The
    product of a query and a key then depends only on the offset between their places. The angles are pi 2^-j times x, y
    and z, waves of 2, 4, 8, ... cells, for j = 0, 1, ... as long as pairs are left. Up to two pairs at the end are not
    rotated.
    """
    pairs = head_dim // 2
    angles = (places[:, :, None] * (math.pi * 0.5 ** torch.arange(pairs // 3, dtype=torch.float64))).flatten(1)
    angles = F.pad(angles, (0, pairs - angles.shape[1]))
    return torch.stack([angles.cos(), angles.sin()], dim=2).flatten(1).float()
