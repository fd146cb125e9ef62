"""Position embedding, and attention blocks on cells, tokens and nodes (paper, section Transformer).

Legend: T vectors (cells, tokens or nodes), C cells, B scenes, H heads of width D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.layers import Linear
from ast_sim.ops._attention import cross_attention, self_attention


@dataclass(frozen=True)
class Vectors:
    """The vectors of several scenes, which attend or are attended to.

    Attributes:
        x: [T, width].
        offsets: [B + 1] int64; the vectors of scene b are offsets[b]:offsets[b + 1].
        rotations: `rotations` of the places of the vectors. None: attention does not depend on places.
    """

    x: Tensor
    offsets: Tensor
    rotations: Tensor | None = None


class PositionEmbedding(nn.Module):
    """c + Linear([x, sin(2^j pi x), cos(2^j pi x)]) per axis, j = 0..7 (paper, section Overall Architecture).

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


def rotations(places: Tensor, head_dim: int) -> Tensor:
    """Rotary embedding (Su et al. 2021, arXiv 2104.09864): places [T, 3] float64, in cell sides -> [T, 1, D / 2].

    Each pair of components of a query or key is rotated by one of these complex64 numbers of length 1. The product of a
    query and a key then depends only on the offset between their places. The angles are pi 2^-j times x, y and z, waves
    of 2, 4, 8, ... cells, for j = 0, 1, ... as long as pairs are left. Up to two pairs at the end are not rotated.
    """
    pairs = head_dim // 2
    angles = (places[:, :, None] * (math.pi * 0.5 ** torch.arange(pairs // 3, dtype=torch.float64))).flatten(1)
    angles = F.pad(angles, (0, pairs - angles.shape[1]))
    return torch.polar(torch.ones_like(angles), angles)[:, None].to(torch.complex64)


def rotated(x: Tensor, by: Tensor | None) -> Tensor:
    """x [..., D] with each pair (x_2i, x_2i+1) rotated by `rotations` [..., D / 2]. None: x itself."""
    if by is None:
        return x
    return torch.view_as_real(torch.view_as_complex(x.unflatten(-1, (-1, 2))) * by).flatten(-2)


class FeedForward(nn.Module):
    """x + dropout(W_2 (a * gelu(b))) with [a, b] = W_1 LN(x): GEGLU (Shazeer 2020)."""

    def __init__(self, config: ASTConfig, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.first = Linear(width, 2 * config.ffn_inner)
        self.second = Linear(config.ffn_inner, width)
        self.dropout = config.dropout

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.first(self.norm(x), "geglu")
        if self.training and self.dropout:
            return x + F.dropout(self.second(hidden), self.dropout)
        return self.second(hidden, residual=x)


class AttentionBlock(nn.Module):
    """x + attention(LN(x), LN(context)), then the feed-forward part.

    Args:
        width: of x.
        context: width of the context. None: x attends to itself.
    """

    def __init__(self, config: ASTConfig, width: int, context: int | None = None):
        super().__init__()
        inner = config.heads * config.head_dim
        self.heads, self.dropout = config.heads, config.dropout
        self.norm = nn.LayerNorm(width)
        if context is None:
            self.query_key_value = Linear(width, 3 * inner, bias=False)
        else:
            self.norm_context = nn.LayerNorm(context)
            self.query = Linear(width, inner, bias=False)
            self.key_value = Linear(context, 2 * inner, bias=False)
        self.out = Linear(inner, width)
        self.feed_forward = FeedForward(config, width)

    def forward(self, vectors: Vectors, context: Vectors | None = None) -> Vectors:
        """The vectors after they have attended to the context, or without one to themselves."""
        dropout = self.dropout if self.training else 0.0
        options = {"dropout_p": dropout, "seed": int(torch.randint(2**62, (1,))) if dropout else 0}
        mixed = self._among(vectors, options) if context is None else self._to(context, vectors, options)
        return replace(vectors, x=self.feed_forward(self.out(mixed.flatten(1), residual=vectors.x)))

    def _among(self, vectors: Vectors, options: dict[str, Any]) -> Tensor:
        """[T, H, D]: the vectors attend to themselves."""
        together = self.query_key_value(self.norm(vectors.x)).unflatten(1, (3, self.heads, -1))
        if vectors.rotations is not None:
            query_key, value = together.split((2, 1), dim=1)
            together = torch.cat([rotated(query_key, vectors.rotations[:, None]), value], dim=1)
        return self_attention(together, vectors.offsets, **options)

    def _to(self, context: Vectors, vectors: Vectors, options: dict[str, Any]) -> Tensor:
        """[T, H, D]: the vectors attend to the context."""
        query = rotated(self.query(self.norm(vectors.x)).unflatten(1, (self.heads, -1)), vectors.rotations)
        key_value = self.key_value(self.norm_context(context.x)).unflatten(1, (2, self.heads, -1))
        if context.rotations is not None:
            key, value = key_value.unbind(1)
            key_value = torch.stack([rotated(key, context.rotations), value], dim=1)
        return cross_attention(query, key_value, vectors.offsets, context.offsets, **options)
