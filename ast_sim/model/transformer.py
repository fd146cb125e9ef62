"""Position embedding and the pre-norm attention blocks on cells and tokens (paper, section Transformer)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.model.ast_config import ASTConfig
from ast_sim.model.linear import Linear
from ast_sim.ops.attention import cross_attention, self_attention


class PositionEmbedding(nn.Module):
    """c + Linear([x, sin(2^j pi x), cos(2^j pi x)]) per axis, j = 0..7.

    At the centres of the cells of level L every frequency with j >= L is constant, so it is left out.
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


class FeedForward(nn.Module):
    """x + GEGLU (Shazeer 2020): W_2 (a * gelu(b)) with [a, b] = W_1 LN(x), and dropout before the sum."""

    def __init__(self, config: ASTConfig):
        super().__init__()
        self.norm = nn.LayerNorm(config.d_token)
        self.first = Linear(config.d_token, 2 * config.ffn_inner)
        self.second = Linear(config.ffn_inner, config.d_token)
        self.dropout = config.dropout

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.first(self.norm(x), "geglu")
        if self.training and self.dropout:
            return x + F.dropout(self.second(hidden), self.dropout)
        return self.second(hidden, residual=x)


class AttentionBlock(nn.Module):
    """x + attention(LN(x), LN(context)), then the feed-forward part; the context of a self-attention is x itself."""

    def __init__(self, config: ASTConfig, cross: bool):
        super().__init__()
        inner = config.heads * config.head_dim
        self.heads, self.dropout = config.heads, config.dropout
        self.norm = nn.LayerNorm(config.d_token)
        if cross:
            self.norm_context = nn.LayerNorm(config.d_token)
            self.query = Linear(config.d_token, inner, bias=False)
            self.key_value = Linear(config.d_token, 2 * inner, bias=False)
        else:
            self.query_key_value = Linear(config.d_token, 3 * inner, bias=False)
        self.out = Linear(inner, config.d_token)
        self.feed_forward = FeedForward(config)

    def forward(
        self, x: Tensor, offsets: Tensor, context: Tensor | None = None, context_offsets: Tensor | None = None
    ) -> Tensor:
        """x [T, d_token] in the scenes of `offsets`, context [C, d_token] in those of `context_offsets` -> as x."""
        dropout = self.dropout if self.training else 0.0
        options = {"dropout_p": dropout, "seed": int(torch.randint(2**62, (1,))) if dropout else 0}
        if context is None:
            together = self.query_key_value(self.norm(x)).unflatten(1, (3, self.heads, -1))
            mixed = self_attention(together, offsets, **options)
        else:
            query = self.query(self.norm(x)).unflatten(1, (self.heads, -1))
            key_value = self.key_value(self.norm_context(context)).unflatten(1, (2, self.heads, -1))
            mixed = cross_attention(query, key_value, offsets, context_offsets, **options)
        return self.feed_forward(self.out(mixed.flatten(1), residual=x))
