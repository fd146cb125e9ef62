"""Attention blocks on cells, tokens and nodes (paper, section Transformer).

Legend: T vectors (cells, tokens or nodes), C cells, B scenes, H heads of width D.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.layers import Linear
from ast_sim.ops import attention, attention_block, rotated
from ast_sim.ops.library import is_differentiated


class Vectors(NamedTuple):
    """The vectors of several scenes, which attend or are attended to.

    Attributes:
        x: [T, width].
        offsets: [B + 1] int64; the vectors of scene b are offsets[b]:offsets[b + 1].
        rotations: `rotations` of the places of the vectors. None: attention does not depend on places.
    """

    x: Tensor
    offsets: Tensor
    rotations: Tensor | None = None


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
        self.heads = config.heads
        self.dropout = config.dropout
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
        turned = [x.rotations for x in (vectors, context) if x is not None and x.rotations is not None]
        if not dropout and not any(map(is_differentiated, turned)):
            return vectors._replace(x=self._at_once(vectors, context or vectors))
        mixed = self._mixed(vectors, context, dropout).flatten(1)
        return vectors._replace(x=self.feed_forward(self.out(mixed, residual=vectors.x)))

    def _at_once(self, vectors: Vectors, context: Vectors) -> Tensor:
        """[T, width]: the same in one call, which has neither dropout nor a gradient by the rotations."""
        if vectors is context:
            norm_context = self.norm
            inner = self.query_key_value.out_features // 3
            query, key_value = self.query_key_value.weight.split((inner, 2 * inner))
        else:
            norm_context = self.norm_context
            query = self.query.weight
            key_value = self.key_value.weight
        layers = (self.out, self.feed_forward.norm, self.feed_forward.first, self.feed_forward.second)
        parameters = (
            *_of(self.norm),
            *_of(norm_context),
            query,
            key_value,
            *(one for layer in layers for one in _of(layer)),
        )
        return attention_block(
            vectors.x,
            context.x,
            vectors.rotations,
            context.rotations,
            vectors.offsets,
            context.offsets,
            parameters,
            self.heads,
        )

    def _mixed(self, vectors: Vectors, context: Vectors | None, dropout: float) -> Tensor:
        """[T, H, D]: what attention makes of the values."""
        x = self.norm(vectors.x)
        if context is None:
            q, k, v = self.query_key_value(x).unflatten(1, (3, self.heads, -1)).unbind(1)
            context = vectors
        else:
            q = self.query(x).unflatten(1, (self.heads, -1))
            k, v = self.key_value(self.norm_context(context.x)).unflatten(1, (2, self.heads, -1)).unbind(1)
        q, k = rotated(q, vectors.rotations), rotated(k, context.rotations)
        seed = int(torch.randint(2**62, (1,))) if dropout else 0
        return attention(q, k, v, vectors.offsets, context.offsets, dropout_p=dropout, seed=seed)[0]


def _of(layer: nn.LayerNorm | Linear) -> tuple[Tensor, Tensor]:
    return layer.weight, layer.bias
