"""Attention beside torch's scaled_dot_product_attention (fused only without dropout) and beside a composition."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import dropout, scaled_dot_product_attention

from ast_sim.ops import attention
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case

# scenes, queries and keys of a scene, heads, channels of a head
SMALL = [(4, 90, 90, 4, 32), (4, 90, 360, 4, 32), (4, 360, 90, 4, 32)]
FORWARD = [(1, 512, 512, 8, 64), (1, 512, 100_000, 8, 64), (1, 100_000, 512, 8, 64), (1, 4096, 4096, 8, 64)]
TRAINING = [(1, 512, 512, 8, 64), (1, 512, 8192, 8, 64), (1, 4096, 4096, 8, 64)]
LARGEST = 3e9  # bytes of arrays of all scores that a peer may hold
TOLERANCE = {"rtol": 1e-4, "atol": 1e-5}


def _composition(q: Tensor, k: Tensor, v: Tensor, p: float) -> Tensor:
    weights = torch.softmax(q @ k.mT * q.shape[-1] ** -0.5, -1)
    return dropout(weights, p) @ v


def _with_gradients(function: Callable[..., Tensor], inputs: list[Tensor], dout: Tensor) -> Callable[[], list[Tensor]]:
    leaves = [x.detach().requires_grad_() for x in inputs]

    def call() -> list[Tensor]:
        out = function(*leaves)
        return [out, *torch.autograd.grad(out, leaves, dout)]

    return call


def _without_gradients(function: Callable[..., Tensor], inputs: list[Tensor]) -> Callable[[], list[Tensor]]:
    def call() -> list[Tensor]:
        with torch.no_grad():
            return [function(*inputs)]

    return call


def cases() -> list[Case]:
    wanted = [(size, p, backward) for size in SMALL for backward in (False, True) for p in (0.0, 0.1)]
    wanted += [(size, 0.0, False) for size in FORWARD]
    wanted += [(size, 0.1, True) for size in TRAINING]
    return [_case(*one) for one in wanted]


def _bytes_of_composition(scenes: int, queries: int, keys: int, heads: int, p: float, backward: bool) -> int:
    """Of the arrays of scores alive at once: scores, weights, mask and dropped weights; backward, their gradients."""
    return 4 * scenes * heads * queries * keys * (2 + 2 * (p > 0) + 3 * backward)


def _case(size: tuple[int, int, int, int, int], p: float, backward: bool) -> Case:
    scenes, queries, keys, heads, width = size
    g = torch.Generator().manual_seed(0)
    q, k, v, dout = (torch.randn(scenes * n, heads, width, generator=g) for n in (queries, keys, keys, queries))
    q_offsets, k_offsets = torch.arange(scenes + 1) * queries, torch.arange(scenes + 1) * keys

    def batched(x: Tensor) -> Tensor:
        return x.unflatten(0, (scenes, -1)).transpose(1, 2)

    def ours(q, k, v):
        return attention(q, k, v, q_offsets, k_offsets, dropout_p=p)[0]

    def sdpa(q, k, v):
        return scaled_dot_product_attention(q, k, v, dropout_p=p)

    functions, missing = {"torch SDPA": sdpa}, {}
    if _bytes_of_composition(scenes, queries, keys, heads, p, backward) <= LARGEST:
        functions["torch composition"] = lambda *x: _composition(*x, p)
    else:
        missing["torch composition"] = f"its arrays of scores exceed {LARGEST / 1e9:.0f} GB"
    views, dviews = [batched(x) for x in (q, k, v)], batched(dout)
    if backward:
        call = _with_gradients(ours, [q, k, v], dout)
        peers = {name: _with_gradients(function, views, dviews) for name, function in functions.items()}
    else:
        call = _without_gradients(ours, [q, k, v])
        peers = {name: _without_gradients(function, views) for name, function in functions.items()}

    def check() -> None:
        """Without dropout against the peers; with it one head against the composition that draws the same mask."""
        if p == 0:
            for peer in peers.values():
                for mine, theirs in zip(call(), peer(), strict=True):
                    torch.testing.assert_close(batched(mine), theirs, **TOLERANCE)
            return
        one = [x[:, :1].contiguous() for x in (q, k, v)]
        drawn = (q_offsets, k_offsets, width**-0.5, p, 0)
        mine = _with_gradients(lambda *x: attention(*x, *drawn)[0], one, dout[:, :1])()
        composed = _with_gradients(lambda *x: OPS["attention"].composition(*x, *drawn)[0], one, dout[:, :1])()
        for a, b in zip(mine, composed, strict=True):
            torch.testing.assert_close(a, b, **TOLERANCE)

    return Case(
        f"attention, {'forward and backward' if backward else 'forward'}{', dropout 0.1' if p else ''}",
        f"{scenes} x {queries} queries, {keys} keys, {heads} heads x {width}",
        call,
        peers,
        None,
        (14 if backward else 4) * scenes * heads * queries * keys * width,
        check,
        missing,
    )
