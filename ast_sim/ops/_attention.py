"""Attention within each scene of a batch, without a score matrix in memory.

Legend: B scenes, T tokens (Tq queries, Tk keys), H heads, D channels of a head.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops.derivatives import differentiate, differentiate_by_composition

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


def dropout_factors(p: float, seed: int, scene: int, shape: tuple[int, int, int], like: Tensor) -> Tensor:
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


_SPEC = (
    "q[Q,H,D] rows, k[K,H,D] rows, v[K,H,D] rows, q_offsets[B+1] offsets(Q), k_offsets[B+1] offsets(K), scale number,"
    " dropout_p number, seed bits"
)
_kernel = library.Kernel("attention", f"{_SPEC} -> out[Q,H,D], maximum[Q,H], sum[Q,H]")
_backward_kernel = library.Kernel(
    "attention_backward",
    f"{_SPEC}, out[Q,H,D], maximum[Q,H], sum[Q,H], dout[Q,H,D] -> dq[Q,H,D] rows, dk[K,H,D] rows, dv[K,H,D] rows",
)


def _check(kernel: library.Kernel, q, k, v, q_offsets, k_offsets, dropout_p: float) -> None:
    kernel.check(q, k, v, q_offsets, k_offsets)
    if q.shape[2] % 16 or not 16 <= q.shape[2] <= 128:
        raise ValueError(f"{kernel.name}: the head dimension must be a multiple of 16 up to 128, not {q.shape[2]}")
    if not 0 <= dropout_p < 1:
        raise ValueError(f"{kernel.name}: dropout_p must lie in [0, 1)")


def _scenes(q_offsets: Tensor, k_offsets: Tensor) -> Iterator[tuple[int, slice, slice]]:
    """The number, the query rows and the key rows of each scene that has queries and keys."""
    q, k = q_offsets.tolist(), k_offsets.tolist()
    for b in range(len(q) - 1):
        if q[b] < q[b + 1] and k[b] < k[b + 1]:
            yield b, slice(q[b], q[b + 1]), slice(k[b], k[b + 1])


def _scores(q: Tensor, k: Tensor, scale: float) -> Tensor:
    return torch.einsum("qhd,khd->hqk", q * scale, k)


def _join(like: Tensor, fill: float, parts: list[tuple[slice, Tensor]]) -> Tensor:
    """The rows of all scenes; the rows between these parts hold `fill`. Nothing is written to: vmap could not do it."""
    rows, end = [], 0
    for where, x in (*parts, (slice(len(like), len(like)), like[:0])):
        rows += [like.new_full((where.start - end, *like.shape[1:]), fill), x]
        end = where.stop
    return torch.cat(rows)


def _factors(scores: Tensor, dropout_p: float, seed: int, scene: int) -> Tensor | float:
    return dropout_factors(dropout_p, seed, scene, tuple(scores.shape), scores) if dropout_p else 1.0


def _reference(q, k, v, q_offsets, k_offsets, scale, dropout_p, seed):
    _check(_kernel, q, k, v, q_offsets, k_offsets, dropout_p)
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


def _backward_reference(q, k, v, q_offsets, k_offsets, scale, dropout_p, seed, out, maximum, total, dout):
    _check(_backward_kernel, q, k, v, q_offsets, k_offsets, dropout_p)
    dq, dk, dv = [], [], []
    for b, i, j in _scenes(q_offsets, k_offsets):
        x = _scores(q[i], k[j], scale)
        kept = out is not None  # `out`, `maximum` and `total` are None where second derivatives are wanted
        weights = (x - maximum[i].T[:, :, None]).exp() / total[i].T[:, :, None] if kept else x.softmax(2)
        factors = _factors(x, dropout_p, seed, b)
        dweights = factors * torch.einsum("qhd,khd->hqk", dout[i], v[j])
        mean = (dout[i] * out[i]).sum(2).T[:, :, None] if kept else (weights * dweights).sum(2, keepdim=True)
        dx = scale * weights * (dweights - mean)
        dq.append((i, torch.einsum("hqk,khd->qhd", dx, k[j])))
        dk.append((j, torch.einsum("hqk,qhd->khd", dx, q[i])))
        dv.append((j, torch.einsum("hqk,qhd->khd", weights * factors, dout[i])))
    return _join(q, 0, dq), _join(k, 0, dk), _join(v, 0, dv)


# ---- C core ----


def _new(q, *_):
    return q.new_empty(q.shape), q.new_empty(q.shape[:2]), q.new_empty(q.shape[:2])


# ---- ops ----


def _define(name: str, schema: str, split: Callable, together: Callable):
    """Define one op and its gradient, for one way of storing q, k and v in tensors.

    Args:
        name: of the op.
        schema: the op's tensors in torch's schema language. Their gradients have the same shapes.
        split: returns q, k and v as views of these tensors, so that nothing is copied. It also splits gradients.
        together: returns the gradients of the tensors, given those of q, k and v. The composition needs it, because it
            has no views to write to.
    """
    num = schema.count("Tensor")

    def after_split(body: Callable) -> Callable:
        return lambda *arguments: body(*split(*arguments[:num]), *arguments[num:])

    def call(outputs, *arguments) -> None:
        _kernel(*split(*arguments[:num]), *arguments[num:], *outputs)

    def new_gradients(*arguments):
        gradients = tuple(x.new_empty(x.shape) for x in arguments[:num])
        return gradients if num > 1 else gradients[0]

    def call_backward(gradients, *arguments) -> None:
        gradients = gradients if num > 1 else (gradients,)
        _backward_kernel(*split(*arguments[:num]), *arguments[num:], *split(*gradients))

    arguments = f"{schema}, Tensor q_offsets, Tensor k_offsets, float scale, float dropout_p, int seed"
    outputs = ", ".join(["Tensor"] * num)
    schema = f"{name}({arguments}) -> (Tensor, Tensor, Tensor)"
    op = library.define(schema, after_split(_reference), after_split(_new), call)
    backward = library.define(
        f"{name}_backward({arguments}, Tensor out, Tensor maximum, Tensor total, Tensor dout) -> ({outputs})",
        lambda *arguments: together(*after_split(_backward_reference)(*arguments)),
        new_gradients,
        call_backward,
    )

    def save(ctx, inputs, output) -> None:
        ctx.save_for_backward(*inputs[: num + 2], *output)
        ctx.settings = inputs[num + 2 :]
        ctx.set_materialize_grads(False)  # the other outputs have no gradients
        ctx.mark_non_differentiable(*output[1:])

    def gradient(ctx, dout, *_):
        *arguments, out, maximum, total = ctx.saved_tensors
        gradients = backward(*arguments, *ctx.settings, out, maximum, total, dout)
        return *(gradients if num > 1 else (gradients,)), *[None] * 5

    differentiate(op, save, gradient)
    differentiate_by_composition(backward, (num + 5, num + 6, num + 7))
    return op, backward


def _split_key_value(q: Tensor, key_value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if key_value.dim() != 4 or key_value.shape[1] != 2:
        raise ValueError(f"attention_kv: key_value must have shape [K, 2, H, D], not {tuple(key_value.shape)}")
    return q, *key_value.unbind(1)


def _split_qkv(qkv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if qkv.dim() != 4 or qkv.shape[1] != 3:
        raise ValueError(f"attention_qkv: qkv must have shape [T, 3, H, D], not {tuple(qkv.shape)}")
    return qkv.unbind(1)


_attention, _attention_backward = _define(
    "attention", "Tensor q, Tensor k, Tensor v", lambda q, k, v: (q, k, v), lambda dq, dk, dv: (dq, dk, dv)
)
_attention_kv, _attention_kv_backward = _define(
    "attention_kv", "Tensor q, Tensor key_value", _split_key_value, lambda dq, dk, dv: (dq, torch.stack([dk, dv], 1))
)
_attention_qkv, _attention_qkv_backward = _define(
    "attention_qkv", "Tensor qkv", _split_qkv, lambda dq, dk, dv: torch.stack([dq, dk, dv], 1)
)


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


def cross_attention(
    q: Tensor, key_value: Tensor, q_offsets: Tensor, k_offsets: Tensor, dropout_p: float = 0.0, seed: int = 0
) -> Tensor:
    """`attention` with keys and values in one tensor [Tk, 2, H, D], and with scale D^-1/2.

    Their gradient has the same layout, so nothing is copied forward or backward. Returns only out [Tq, H, D].
    """
    return _attention_kv(q, key_value, q_offsets, k_offsets, *_settings(q.shape[-1], None, dropout_p, seed))[0]


def self_attention(qkv: Tensor, offsets: Tensor, dropout_p: float = 0.0, seed: int = 0) -> Tensor:
    """`attention` among the tokens of each scene, with q, k and v in one tensor [T, 3, H, D], and with scale D^-1/2.

    The gradient has the same layout, so nothing is copied forward or backward. Returns only out [T, H, D].
    """
    return _attention_qkv(qkv, offsets, offsets, *_settings(qkv.shape[-1], None, dropout_p, seed))[0]
