"""Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon), an optimizer for matrices.

The step of a matrix is its momentum with all singular values set to about 1. Matrices of the same shape are computed
together, in float32. torch's implementation computes them one by one in bfloat16. For a small model that takes 1.5
times as long on a processor with bfloat16 instructions, and 15 times as long on a processor without them.

Legend: K matrices of R rows and C columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import prod

import torch
from torch import Tensor

MOMENTUM = 0.95
# x <- A x + B (x x^T) x + C (x x^T)^2 x. Five iterations move each singular value from [0.002, 1] into [0.68, 1.21].
A, B, C = 3.4445, -4.7750, 2.0315
ITERATIONS = 5


class Muon:
    """Updates matrices that are stored one after the other in one array; matrices of the same shape are adjacent.

    Args:
        values, gradients: [P] float32, the P numbers of all matrices.
        shapes: rows and columns of each matrix, in order.
    """

    def __init__(self, values: Tensor, gradients: Tensor, shapes: Sequence[tuple[int, int]]) -> None:
        self.values = values
        self.gradients = gradients
        self.momentum = torch.zeros_like(values)
        self.stacks = [(sum(1 for _ in same), *shape) for shape, same in groupby(shapes)]

    def step(self, rate: float) -> None:
        """Update the matrices by Nesterov's momentum. The root mean square of the entries of a step is 0.2 times the
        rate, so that learning rates of AdamW fit (Liu et al. 2025, arXiv 2502.16982)."""
        self.momentum.lerp_(self.gradients, 1 - MOMENTUM)
        ahead = self.gradients.lerp(self.momentum, MOMENTUM)
        sizes = [prod(stack) for stack in self.stacks]
        for stack, value, step in zip(self.stacks, self.values.split(sizes), ahead.split(sizes), strict=True):
            moved = orthogonalized(step.view(stack))
            value.view(stack).sub_(moved, alpha=0.2 * rate * max(stack[1:]) ** 0.5)


def orthogonalized(x: Tensor) -> Tensor:
    """[K, R, C] -> [K, R, C]: about U V^T, where x = U S V^T. Singular values below 0.002 of the norm stay smaller."""
    if x.shape[1] > x.shape[2]:
        return orthogonalized(x.mT).mT
    norm = torch.linalg.vector_norm(x, dim=(1, 2), keepdim=True, dtype=torch.float64)  # squares may overflow float32
    x = x / norm.float().clamp(min=1e-37)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=B, alpha=C), x, beta=A)
    return x
