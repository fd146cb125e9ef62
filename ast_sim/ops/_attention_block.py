"""An attention block as a whole, for where no gradient is wanted: one call instead of a dozen.

Legend: B scenes, Q vectors of width W that attend, K vectors of width C that are attended to, H heads of D channels,
I = H D, F hidden units of the feed-forward part.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import _attention
from ast_sim.ops._mlp import layer_norm
from ast_sim.ops.derivatives import differentiate_by_composition
from ast_sim.ops.library import Kernel, Op
from ast_sim.ops.spec import Given, Sizes

_SPEC = (
    "x[Q,W], context[K,C], rotations?[Q,E], context_rotations?[K,E], q_offsets[B+1] offsets(Q),"
    " k_offsets[B+1] offsets(K), gamma[W], beta[W], context_gamma[C], context_beta[C], query[I,W] filled,"
    " key_value[2I,C] filled, weight[W,I], bias[W], inner_gamma[W], inner_beta[W], first[2F,W] filled, first_bias[2F],"
    " second[W,F], second_bias[W], heads integer(1,1024) -> out[Q,W]"
)


def _check_heads(name: str, sizes: Sizes, given: Given) -> None:
    width, rest = divmod(sizes["I"], given["heads"])
    if rest or width % 16 or not 16 <= width <= 128 or sizes.get("E", width) != width:
        raise ValueError(
            f"{name}: the head dimension must be a multiple of 16 up to 128, and that of the rotations, not"
            f" {sizes['I'] / given['heads']:g} and {sizes.get('E', 'none')}"
        )


def rotated(x: Tensor, by: Tensor | None) -> Tensor:
    """x [..., D] with each pair (x_2i, x_2i+1) multiplied by a complex number of `by` [..., D / 2]. None: x itself."""
    if by is None:
        return x
    return torch.view_as_real(torch.view_as_complex(x.unflatten(-1, (-1, 2))) * by).flatten(-2)


def _turned(x: Tensor, rotations: Tensor | None) -> Tensor:
    """`rotated` [T, H, D] by cosines and sines [T, D]."""
    return rotated(x, None if rotations is None else torch.view_as_complex(rotations.unflatten(1, (-1, 2)))[:, None])


def _reference(
    x, context, rotations, context_rotations, q_offsets, k_offsets, gamma, beta, context_gamma, context_beta, query,
    key_value, weight, bias, inner_gamma, inner_beta, first, first_bias, second, second_bias, heads,
):  # fmt: skip
    q = F.linear(layer_norm(x, gamma, beta), query).unflatten(1, (heads, -1))
    of_context = F.linear(layer_norm(context, context_gamma, context_beta), key_value)
    k, v = of_context.unflatten(1, (2, heads, -1)).unbind(1)
    q, k = _turned(q, rotations), _turned(k, context_rotations)
    mixed = _attention._reference(q, k, v, q_offsets, k_offsets, q.shape[-1] ** -0.5, 0.0, 0)[0]
    y = x + F.linear(mixed.flatten(1), weight, bias)
    a, b = F.linear(layer_norm(y, inner_gamma, inner_beta), first, first_bias).chunk(2, dim=1)
    return y + F.linear(a * F.gelu(b), second, second_bias)


_block = Op(Kernel("attention_block", _SPEC, _check_heads), _reference)
differentiate_by_composition(_block)


def attention_block(
    x: Tensor,
    context: Tensor,
    rotations: Tensor | None,
    context_rotations: Tensor | None,
    q_offsets: Tensor,
    k_offsets: Tensor,
    parameters: Sequence[Tensor],
    heads: int,
) -> Tensor:
    """The vectors x after they have attended to the context of their scene and passed the feed-forward part:

    q = W_q LN(x), [k, v] = W_kv LN_c(context), y = x + W_o attention(rotated q, rotated k, v) + b_o,
    [a, b] = W_1 LN_f(y) + b_1, out = y + W_2 (a gelu(b)) + b_2.

    A row of the result depends only on the scene of that row, bit for bit.

    Args:
        x, context: [Q, W] and [K, C].
        rotations, context_rotations: [Q, D] and [K, D], cosine and sine of each pair of channels of a head; None: they
            are not rotated.
        q_offsets, k_offsets: [B + 1] int64, from 0 to Q and K, where each scene's vectors start and end.
        parameters: gamma and beta [W] of LN, [C] of LN_c; W_q [I, W], W_kv [2 I, C], W_o [W, I], b_o [W]; gamma and
            beta [W] of LN_f; W_1 [2 F, W], b_1 [2 F], W_2 [W, F], b_2 [W].
        heads: H; D is a multiple of 16 up to 128.

    Returns:
        [Q, W].

    Raises:
        ValueError: shapes, offsets or heads are not as above.
    """
    return _block(x, context, rotations, context_rotations, q_offsets, k_offsets, *parameters, heads)
