"""Attention within each scene of a batch, without a score matrix in memory; and a whole attention block: one call
instead of a dozen.

Legend: B scenes, T tokens (Tq queries, Tk keys), H heads, D channels of a head. In a block, Q vectors of width W attend
to K vectors of width C, I = H D, and the feed-forward part has F hidden units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops._linear import SAVED
from ast_sim.ops._mlp import layer_norm
from ast_sim.ops.derivatives import gradient_op
from ast_sim.ops.library import Kernel, Op, is_at_most
from ast_sim.ops.spec import Given, Sizes

# ---- dropout: the generator of the C core in torch ----

_ROTATIONS = ((10, 26), (11, 21), (13, 27), (23, 5), (6, 20), (17, 11), (25, 10), (18, 20))
_WORD = 0xFFFFFFFF


def _rotate(x: Tensor, n: int) -> Tensor:
    return (x << n | x >> (32 - n)) & _WORD


def _threefry(rounds: int, key: list[Tensor], x: list[Tensor]) -> list[Tensor]:
    """Threefry-4x32 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, 2011), in int64."""
    key = [*key, key[0] ^ key[1] ^ key[2] ^ key[3] ^ 0x1BD11BDA]
    x = [(word + k) & _WORD for word, k in zip(x, key, strict=False)]
    for i in range(rounds):
        a, b = (3, 1) if i % 2 else (1, 3)
        x[0] = (x[0] + x[a]) & _WORD
        x[a] = _rotate(x[a], _ROTATIONS[i % 8][0]) ^ x[0]
        x[2] = (x[2] + x[b]) & _WORD
        x[b] = _rotate(x[b], _ROTATIONS[i % 8][1]) ^ x[2]
        if i % 4 == 3:
            s = i // 4 + 1
            x = [(x[j] + key[(j + s) % 5] + (s if j == 3 else 0)) & _WORD for j in range(4)]
    return x


def dropout_factors(p: float, seed: int, scene: int, shape: Sequence[int], like: Tensor) -> Tensor:
    """[H, Tq, Tk]: the factors by which dropout multiplies the weights of a scene, 0 or 1 / (share kept).

    They depend on seed, scene, head, query and key alone. Each weight gets 16 random bits and is dropped if these lie
    below round(65536 p), so the share kept is within 1e-5 of 1 - p. The bits of key 128 g + 16 slot + lane are half
    slot % 2 of word slot // 2 of the counter (16 g + lane, query).
    """
    heads, queries, keys = shape
    blocks = -(-keys // 128)
    threshold = min(65535, int(p * 65536 + 0.5))
    head, query, group = (torch.arange(n, device=like.device) for n in (heads, queries, 16 * blocks))
    zero = torch.zeros_like(head)[:, None, None]
    words = [zero + (seed & _WORD), zero + (seed >> 32 & _WORD), zero + scene, head[:, None, None]]
    words = _threefry(12, words, [group + zero, query[:, None] + zero, zero, zero])
    bits = torch.stack([words[slot // 2] >> slot % 2 * 16 & 0xFFFF for slot in range(8)], -2)
    bits = (
        bits.reshape(heads, queries, 8, blocks, 16).transpose(2, 3).reshape(heads, queries, 128 * blocks)[:, :, :keys]
    )
    return (bits >= threshold).to(like.dtype) * (65536 / (65536 - threshold))


# ---- composition ----


def _check_heads(name: str, sizes: Sizes, given: Given) -> None:
    if sizes["D"] % 16 or not 16 <= sizes["D"] <= 128:
        raise ValueError(f"{name}: the head dimension must be a multiple of 16 up to 128, not {sizes['D']}")


def _scenes(q_offsets: Tensor, k_offsets: Tensor) -> Iterator[tuple[int, slice, slice]]:
    """The number, the query rows and the key rows of each scene that has queries and keys."""
    q, k = q_offsets.tolist(), k_offsets.tolist()
    for b in range(len(q) - 1):
        if q[b] < q[b + 1] and k[b] < k[b + 1]:
            yield b, slice(q[b], q[b + 1]), slice(k[b], k[b + 1])


def _scores(q: Tensor, k: Tensor, scale: float) -> Tensor:
    if abs(scale) > 1:  # scale q could overflow where the score does not
        return torch.einsum("qhd,khd->hqk", q, k) * scale
    return torch.einsum("qhd,khd->hqk", q * scale, k)


def _join(like: Tensor, fill: float, parts: list[tuple[slice, Tensor]]) -> Tensor:
    """The rows of all scenes; the rows between these parts hold `fill`. Nothing is written to: vmap could not do it."""
    rows = []
    end = 0
    for where, x in (*parts, (slice(len(like), len(like)), like[:0])):
        rows += [like.new_full((where.start - end, *like.shape[1:]), fill), x]
        end = where.stop
    return torch.cat(rows)


def _factors(scores: Tensor, dropout_p: float, seed: int, scene: int) -> Tensor | float:
    return dropout_factors(dropout_p, seed, scene, scores.shape, scores) if dropout_p else 1.0


def _reference(q, k, v, q_offsets, k_offsets, scale, dropout_p, seed):
    out, maximum, total = [], [], []
    for b, i, j in _scenes(q_offsets, k_offsets):
        x = _scores(q[i], k[j], scale)
        m = x.detach().amax(2, keepdim=True)
        weights = (x - m).exp()
        sums = weights.sum(2, keepdim=True)
        weights = weights / sums * _factors(x, dropout_p, seed, b)
        out.append((i, torch.einsum("hqk,khd->qhd", weights, v[j])))
        for parts, y in ((maximum, m), (total, sums.detach())):
            parts.append((i, torch.where(sums > 0, y, torch.nan)[:, :, 0].T))
    return _join(q, 0, out), _join(q[:, :, 0], -torch.inf, maximum), _join(q[:, :, 0], 0, total)


# ---- ops ----

_SETTINGS = "q_offsets[B+1] offsets(Q), k_offsets[B+1] offsets(K), scale number, dropout_p number(0,1), seed bits"
_OUTPUTS = "out[Q,H,D], maximum[Q,H], total[Q,H]"


_INPUTS = f"q[Q,H,D] rows_apart, k[K,H,D] rows_apart, v[K,H,D] rows_apart, {_SETTINGS}"
_attention = Op(Kernel("attention", f"{_INPUTS} -> {_OUTPUTS}", _check_heads), _reference)
_GRADIENTS = f"{_INPUTS}, {_OUTPUTS}, dout[Q,H,D] -> dq[Q,H,D], dk[K,H,D], dv[K,H,D]"
_attention_backward = gradient_op(_attention, Kernel("attention_backward", _GRADIENTS, _check_heads))


def _settings(width: int, scale: float | None, dropout_p: float, seed: int) -> tuple[float, float, int]:
    """The settings as the ops take them: D^-1/2 if there is no scale, and the seed as a signed number of 64 bits."""
    return width**-0.5 if scale is None else float(scale), float(dropout_p), (seed + (1 << 63)) % (1 << 64) - (1 << 63)


def attention(
    q: Tensor,
    k: Tensor,
    v: Tensor,
    q_offsets: Tensor,
    k_offsets: Tensor,
    scale: float | None = None,
    dropout_p: float = 0.0,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """softmax(scale q k^T) v of each scene and head, with dropout on the weights.

    Memory grows with the number of tokens, not with its square, forward and backward; second derivatives and tangents
    do store the scores. A scene's result has the same bits for any number of threads. Without dropout it has the same
    bits in any batch; dropout depends on the number of the scene in the batch.

    Args:
        q: [Tq, H, D]; rows may lie apart, as in a slice of a fused projection. D is a multiple of 16 up to 128.
        k, v: [Tk, H, D], likewise.
        q_offsets, k_offsets: [B + 1] int64; scene b has the queries q_offsets[b]:q_offsets[b + 1] and the keys
            k_offsets[b]:k_offsets[b + 1].
        scale: factor of the scores; D^-1/2 by default.
        dropout_p: the probability with which a weight is dropped, 0 <= p < 1; the others are scaled up.
        seed: of the dropout, 64 bits; the same seed drops the same weights.

    Returns:
        out [Tq, H, D] and the log sum exp of the scores [Tq, H], which carries no gradient. A scene without keys gives
        0 and -inf. A row with a NaN or +inf score, or with only -inf, is NaN.

    Raises:
        ValueError: shapes, offsets or dropout_p are not as above.
    """
    settings = _settings(q.shape[-1], scale, dropout_p, seed)
    out, maximum, total = _attention(q, k, v, q_offsets, k_offsets, *settings)
    return out, maximum + total.log()


# ---- the block ----

_BLOCK_PARAMETERS = (
    "gamma, beta, context_gamma, context_beta, query, key_value, weight, bias, inner_gamma, inner_beta, first,"
    " first_bias, second, second_bias"
)
_BLOCK_INPUTS = (
    "x[Q,W], context[K,C], rotations?[Q,E], context_rotations?[K,E], q_offsets[B+1] offsets(Q),"
    " k_offsets[B+1] offsets(K), gamma[W], beta[W], context_gamma[C], context_beta[C], query[I,W] filled,"
    " key_value[2I,C] filled, weight[W,I], bias[W], inner_gamma[W], inner_beta[W], first[2F,W] filled, first_bias[2F],"
    " second[W,F], second_bias[W], heads size(H)"
)
_BLOCK_SPEC = (
    f"{_BLOCK_INPUTS}; save switch, save_z switch -> out[Q,W], queries[Q,I] if(save), keys_values[K,2I] if(save),"
    " mixed[Q,I] if(save), maximum[Q,H] if(save), total[Q,H] if(save), y[Q,W] if(save), z[Q,2F] if(save_z),"
    " hidden[Q,F] if(save)"
)
_BLOCK_BACKWARD_SPEC = (
    f"dout[Q,W] late, {_BLOCK_INPUTS}, queries[Q,I], keys_values[K,2I], mixed[Q,I], maximum[Q,H], total[Q,H], y[Q,W],"
    f" z?[Q,2F], hidden[Q,F]; wanted wants(x,context,{_BLOCK_PARAMETERS.replace(' ', '')}) -> dx[Q,W] if(wanted),"
    " dcontext[K,C] if(wanted), dgamma[W] if(wanted), dbeta[W] if(wanted), dcontext_gamma[C] if(wanted),"
    " dcontext_beta[C] if(wanted), dquery[I,W] if(wanted), dkey_value[2I,C] if(wanted), dweight[W,I] if(wanted),"
    " dbias[W] if(wanted), dinner_gamma[W] if(wanted), dinner_beta[W] if(wanted), dfirst[2F,W] if(wanted),"
    " dfirst_bias[2F] if(wanted), dsecond[W,F] if(wanted), dsecond_bias[W] if(wanted)"
)


def _check_block_heads(name: str, sizes: Sizes, given: Given) -> None:
    width, rest = divmod(sizes["I"], sizes["H"]) if sizes["H"] else (0, 1)
    if rest or width % 16 or not 16 <= width <= 128 or sizes.get("E", width) != width:
        raise ValueError(
            f"{name}: the head dimension must be a multiple of 16 up to 128, and equal to the one of the rotations, not"
            f" {sizes['I']} / {sizes['H']} and {sizes.get('E', 'none')}"
        )


def rotated(x: Tensor, by: Tensor | None) -> Tensor:
    """x [T, H, D] with each pair (x_2i, x_2i+1) turned by the angle whose cosine and sine are (by_2i, by_2i+1), `by`
    [T, D]. None: x itself."""
    if by is None:
        return x
    (a, b), (cosine, sine) = (pairs.unflatten(-1, (-1, 2)).unbind(-1) for pairs in (x, by[:, None].to(x.dtype)))
    return torch.stack([a * cosine - b * sine, b * cosine + a * sine], dim=-1).flatten(-2)


def _block_reference(
    x, context, rotations, context_rotations, q_offsets, k_offsets, gamma, beta, context_gamma, context_beta, query,
    key_value, weight, bias, inner_gamma, inner_beta, first, first_bias, second, second_bias, heads, save, save_z,
):  # fmt: skip
    q = F.linear(layer_norm(x, gamma, beta), query).unflatten(1, (heads, -1))
    of_context = F.linear(layer_norm(context, context_gamma, context_beta), key_value)
    k, v = of_context.unflatten(1, (2, heads, -1)).unbind(1)
    q, k = rotated(q, rotations), rotated(k, context_rotations)
    mixed, maximum, total = _reference(q, k, v, q_offsets, k_offsets, q.shape[-1] ** -0.5, 0.0, 0)
    y = x + F.linear(mixed.flatten(1), weight, bias)
    z = F.linear(layer_norm(y, inner_gamma, inner_beta), first, first_bias)
    a, b = z.chunk(2, dim=1)
    hidden = a * F.gelu(b)
    out = y + F.linear(hidden, second, second_bias)
    if not save:
        return out, *[None] * 6, z if save_z else None, None
    keys_values = torch.cat([k.flatten(1), v.flatten(1)], dim=1)
    return out, q.flatten(1), keys_values, mixed.flatten(1), maximum, total, y, z if save_z else None, hidden


_block = Op(Kernel("attention_block", _BLOCK_SPEC, _check_block_heads), _block_reference)
_block_backward = gradient_op(_block, Kernel("attention_block_backward", _BLOCK_BACKWARD_SPEC, _check_block_heads))


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

    A row of the result depends only on the scene of that row, bit for bit. The gradients have the same bits for any
    number of threads. If a rotation has a gradient, the composition gives all of them, and stores the scores.

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
    given = (x, context, rotations, context_rotations, q_offsets, k_offsets, *parameters, heads)
    if torch.is_grad_enabled() and any(
        turn is not None and turn.requires_grad for turn in (rotations, context_rotations)
    ):
        return _block.compose(*given, False, False)[0]
    save = torch.is_grad_enabled() and any(y.requires_grad for y in (x, context, *parameters))
    return _block(*given, save, save and is_at_most(x.shape[0] * parameters[11].shape[0], SAVED))[0]
