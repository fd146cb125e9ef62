"""The optimizers, on all parameters of a model as one vector: one norm and one update a step, not one per parameter.

AdamW as in the paper, or Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon; torch's own): the step of a
matrix is its momentum with all singular values set to about 1. What is no matrix, and narrow ones, are AdamW's.
"""

from __future__ import annotations

from itertools import compress
from typing import Literal

import torch
from torch import Tensor, nn

Name = Literal["adamw", "muon"]
NARROW = 16  # rows or columns: below it a matrix takes inputs in or gives outputs, which AdamW serves better


class Optimizer:
    """AdamW or Muon without weight decay. It moves the model's parameters and their gradients into one array each.

    Args:
        model: its parameters stay the same objects; from now on they are views, and so are their `grad`s.
        name: "muon" for the matrices with at least 16 rows and columns, AdamW for all else; or "adamw" for everything.
    """

    def __init__(self, model: nn.Module, name: Name = "adamw") -> None:
        parameters = list(model.parameters())
        inside = [name == "muon" and p.dim() == 2 and min(p.shape) >= NARROW for p in parameters]
        matrices = list(compress(parameters, inside))
        others = [p for p, is_inside in zip(parameters, inside, strict=True) if not is_inside]
        self._values, self._gradients = _in_one_array([*others, *matrices])
        rest = sum(p.numel() for p in others)
        self._rest = nn.Parameter(self._values[:rest])
        self._rest.grad = self._gradients[:rest]
        self._adam = torch.optim.AdamW([self._rest], lr=0.0, weight_decay=0.0, fused=True)
        self._matrices = matrices
        self._muon = None
        if matrices:
            # Scaled so that the rates of AdamW suit it, too (Liu et al. 2025, arXiv 2502.16982).
            self._muon = torch.optim.Muon(matrices, lr=0.0, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")

    @property
    def gradient(self) -> Tensor:
        """The gradients of all parameters, one after the other."""
        return self._gradients

    def zero_gradient(self) -> None:
        self._gradients.zero_()

    def clip(self, largest: float) -> float:
        """Scale the gradient down to norm `largest` if it is longer; returns the norm it had."""
        norm = float(torch.linalg.vector_norm(self._gradients))
        if norm > largest:
            self._gradients.mul_(largest / norm)
        return norm

    def step(self, rate: float) -> None:
        """Move the parameters against the gradient with this learning rate."""
        for optimizer in (self._adam, self._muon):
            if optimizer is not None:
                optimizer.param_groups[0]["lr"] = rate
                optimizer.step()

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint needs beside the parameters: moments and the number of steps; empty before the first."""
        state = dict(self._adam.state[self._rest])
        if state and self._muon is not None:
            state["momentum"] = torch.cat([self._muon.state[p]["momentum_buffer"].flatten() for p in self._matrices])
        return state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        state = dict(state)
        if self._muon is not None and state:
            parts = state.pop("momentum").split([p.numel() for p in self._matrices])
            for matrix, part in zip(self._matrices, parts, strict=True):
                self._muon.state[matrix] = {"momentum_buffer": part.view_as(matrix).clone()}
        self._adam.state[self._rest] = state


def _in_one_array(parameters: list[nn.Parameter]) -> tuple[Tensor, Tensor]:
    """The values of all parameters, and their gradients, which are zero; the parameters become views of them."""
    values = torch.cat([p.detach().flatten() for p in parameters])
    gradients = torch.zeros_like(values)
    sizes = [p.numel() for p in parameters]
    for parameter, value, gradient in zip(parameters, values.split(sizes), gradients.split(sizes), strict=True):
        parameter.data, parameter.grad = value.view_as(parameter), gradient.view_as(parameter)
    return values, gradients
