"""Sums over segments, in stored order and through a permutation, beside torch's scatter functions."""

from __future__ import annotations

import torch

from ast_sim.ops import offsets_of, segment_sum
from benchmarks.kernels.case import Case

SIZES = [(3000, 500, 64), (300_000, 50_000, 128)]  # rows, segments, channels


def cases() -> list[Case]:
    return [_case(*size, permuted) for size in SIZES for permuted in (False, True)]


def _case(rows: int, segments: int, channels: int, permuted: bool) -> Case:
    g = torch.Generator().manual_seed(0)
    index, x = torch.randint(0, segments, (rows,), generator=g), torch.randn(rows, channels, generator=g)
    if not permuted:
        index = index.sort().values
    order, wide = index.argsort(stable=True), index[:, None].expand(x.shape)
    offsets = offsets_of(index[order], segments)
    peers = {
        "index_add_": lambda: x.new_zeros(segments, channels).index_add_(0, index, x),
        "scatter_add_": lambda: x.new_zeros(segments, channels).scatter_add_(0, wide, x),
    }

    def ours() -> torch.Tensor:
        return segment_sum(x, order, offsets)

    def check() -> None:
        for peer in peers.values():
            torch.testing.assert_close(ours(), peer(), rtol=1e-5, atol=1e-4)

    op = "segment_sum by a permutation" if permuted else "segment_sum"
    return Case(op, f"{rows} rows to {segments} segments, {channels} channels", ours, peers, rows, None, check)
