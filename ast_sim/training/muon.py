"""Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon), an optimizer for matrices.

The step of a matrix is its momentum with all singular values set to about 1. Matrices of the same shape are computed
together, in float32, by a kernel of the C core. torch's implementation computes them one by one in bfloat16. For a
small model that takes four times as long on a processor with bfloat16 instructions, and more without them.

Legend: K matrices of R rows and C columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import prod

import torch
from torch import Tensor

from ast_sim.ops.derivatives import differentiate_by_composition
from ast_sim.ops.library import Kernel, Op

MOMENTUM = 0.95
# x <- A x + B (x x^T) x + C (x x^T)^2 x. Five iterations move each singular value from [0.002, 1] into [0.68, 1.21].
A, B, C = 3.4445, -4.7750, 2.0315
ITERATIONS = 5
LEAST = 1e-37  # a smaller norm counts as this


class Muon:
    """Updates matrices that are stored one after the other in one array; matrices of the same shape are adjacent.

    Args:
        values, gradients: [P] float32, the P numbers of all matrices.
        shapes: rows and columns of each matrix, in order.
    """

    def __init__(self, values: Tensor, gradients: Tensor, shapes: Sequence[tuple[int, ...]]) -> None:
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


def _reference(x: Tensor) -> Tensor:
    if x.shape[1] > x.shape[2]:
        return _reference(x.mT).mT.contiguous()
    wide = x.double()  # squares may overflow float32, and so may the norm
    x = (wide / torch.linalg.vector_norm(wide, dim=(1, 2), keepdim=True).clamp(min=LEAST)).to(x.dtype)
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=B, alpha=C), x, beta=A)
    return x


_orthogonalize = Op(Kernel("orthogonalize", "x[K,R,C] -> out[K,R,C]"), _reference)
differentiate_by_composition(_orthogonalize)


def orthogonalized(x: Tensor) -> Tensor:
    """About U V^T of each matrix x = U S V^T, by Newton-Schulz iterations (Jordan et al. 2024,
    kellerjordan.github.io/posts/muon). The result has the same bits for any number of threads.

    Args:
        x: [K, R, C]; entries may have any magnitude.

    Returns:
        [K, R, C]. Singular values below 0.002 of the norm of a matrix stay smaller; 0 stays 0. A matrix with an entry
        that is not finite becomes NaN.

    Raises:
        ValueError: x is not [K, R, C].
    """
    return _orthogonalize(x)
