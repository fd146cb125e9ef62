"""The optimizers, on all parameters of a model as one vector: one norm and one update a step, not one per parameter.

AdamW as in the paper, or Muon; what is no matrix, and narrow ones, are AdamW's then, too.
"""

from __future__ import annotations

from itertools import compress
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.muon import Muon

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
        matrices = sorted(compress(parameters, inside), key=lambda p: p.shape)  # those of a shape side by side
        others = [p for p, is_inside in zip(parameters, inside, strict=True) if not is_inside]
        self._values, self._gradients = _in_one_array([*others, *matrices])
        rest = sum(p.numel() for p in others)
        self._rest = nn.Parameter(self._values[:rest])
        self._rest.grad = self._gradients[:rest]
        self._adam = torch.optim.AdamW([self._rest], lr=0.0, weight_decay=0.0, fused=True)
        self._muon = None
        if matrices:
            self._muon = Muon(self._values[rest:], self._gradients[rest:], [tuple(p.shape) for p in matrices])

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
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()
        if self._muon is not None:
            self._muon.step(rate)

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint needs beside the parameters: moments and the number of steps; empty before the first."""
        state = dict(self._adam.state[self._rest])
        return {**state, "momentum": self._muon.momentum} if state and self._muon is not None else state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        state = dict(state)
        if self._muon is not None and state:
            self._muon.momentum.copy_(state.pop("momentum"))
        self._adam.state[self._rest] = state


def _in_one_array(parameters: list[nn.Parameter]) -> tuple[Tensor, Tensor]:
    """The values of all parameters, and their gradients, which are zero; the parameters become views of them."""
    values = torch.cat([p.detach().flatten() for p in parameters])
    gradients = torch.zeros_like(values)
    sizes = [p.numel() for p in parameters]
    for parameter, value, gradient in zip(parameters, values.split(sizes), gradients.split(sizes), strict=True):
        parameter.data, parameter.grad = value.view_as(parameter), gradient.view_as(parameter)
    return values, gradients
