"""AdamW on all parameters of a model as one vector: one norm and one update a step, not one per parameter."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Optimizer:
    """AdamW without weight decay. It moves the model's parameters and their gradients into one array each.

    Args:
        model: its parameters stay the same objects; from now on they are views, and so are their `grad`s.
    """

    def __init__(self, model: nn.Module) -> None:
        parameters = list(model.parameters())
        self._vector = nn.Parameter(torch.cat([p.detach().flatten() for p in parameters]))
        self._vector.grad = torch.zeros_like(self._vector)
        sizes = [p.numel() for p in parameters]
        values, gradients = self._vector.detach().split(sizes), self._vector.grad.split(sizes)
        for parameter, value, gradient in zip(parameters, values, gradients, strict=True):
            parameter.data, parameter.grad = value.view_as(parameter), gradient.view_as(parameter)
        self._adam = torch.optim.AdamW([self._vector], lr=0.0, weight_decay=0.0, fused=True)

    @property
    def gradient(self) -> Tensor:
        """The gradients of all parameters, one after the other."""
        return self._vector.grad

    def zero_gradient(self) -> None:
        self._vector.grad.zero_()

    def clip(self, largest: float) -> float:
        """Scale the gradient down to norm `largest` if it is longer; returns the norm it had."""
        norm = float(torch.linalg.vector_norm(self._vector.grad))
        if norm > largest:
            self._vector.grad.mul_(largest / norm)
        return norm

    def step(self, rate: float) -> None:
        """Move the parameters against the gradient with this learning rate."""
        self._adam.param_groups[0]["lr"] = rate
        self._adam.step()

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint needs beside the parameters: moments and the number of steps; empty before the first."""
        return dict(self._adam.state[self._vector])

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take up what `state` gave."""
        self._adam.state[self._vector] = dict(state)
