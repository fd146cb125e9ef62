"""The optimizers: AdamW as in the paper, or Muon for large matrices with AdamW for all other parameters.

All parameters of a model are stored in one vector, so that a step computes one norm and one update instead of one for
each parameter.
"""

from __future__ import annotations

from itertools import compress

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.optim.adamw import adamw

from ast_sim.runs.train_config import OptimizerName
from ast_sim.training.muon import Muon

# A matrix with fewer rows or columns belongs to an input or output layer; AdamW trains these better than Muon.
NARROW = 16


class Optimizer:
    """AdamW or Muon, without weight decay. It moves all parameters into one array, and all gradients into another.

    Args:
        model: its parameters stay the same objects; their values and their `grad`s become views of the two arrays.
        name: "adamw"; or "muon": Muon for matrices with at least 16 rows and columns, AdamW for all other parameters.

    Attributes:
        gradient: the gradients of all parameters, one after the other.
    """

    def __init__(self, model: nn.Module, name: OptimizerName = "adamw") -> None:
        parameters = list(model.parameters())
        inside = [name == "muon" and p.dim() == 2 and min(p.shape) >= NARROW for p in parameters]
        matrices = sorted(compress(parameters, inside), key=lambda p: p.shape)  # same shapes become adjacent
        others = [p for p, is_inside in zip(parameters, inside, strict=True) if not is_inside]
        values, self.gradient = _in_one_array([*others, *matrices])
        rest = sum(p.numel() for p in others)
        self._rest = values[:rest]
        self._rest_gradient = self.gradient[:rest]
        self._moments: dict[str, Tensor] = {}
        self._muon = None
        if matrices:
            self._muon = Muon(values[rest:], self.gradient[rest:], [p.shape for p in matrices])

    def zero_gradient(self) -> None:
        self.gradient.zero_()

    def clip(self, largest: float) -> float:
        """Scale a gradient whose norm exceeds `largest` down to it; returns the norm before."""
        norm = float(torch.linalg.vector_norm(self.gradient))
        if norm > largest:
            self.gradient.mul_(largest / norm)
        return norm

    def step(self, rate: float) -> None:
        """Move the parameters against the gradient with this learning rate."""
        if not self._moments:
            zeros = {name: torch.zeros_like(self._rest) for name in ("exp_avg", "exp_avg_sq")}
            self._moments = {"step": torch.zeros((), device=self._rest.device), **zeros}
        # The class AdamW would import the compiler of torch and SymPy: three seconds of the processor a training.
        adamw(
            [self._rest], [self._rest_gradient], [self._moments["exp_avg"]], [self._moments["exp_avg_sq"]], [],
            [self._moments["step"]], fused=True, amsgrad=False, beta1=0.9, beta2=0.999, lr=rate, weight_decay=0.0,
            eps=1e-8, maximize=False,
        )  # fmt: skip
        if self._muon is not None:
            self._muon.step(rate)

    def state(self) -> dict[str, Tensor]:
        """The moments and the number of steps, which a checkpoint keeps beside the parameters; empty before a step."""
        state = dict(self._moments)
        return {**state, "momentum": self._muon.momentum} if state and self._muon is not None else state

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore a state that `state` returned."""
        state = dict(state)
        if self._muon is not None and state:
            self._muon.momentum.copy_(state.pop("momentum"))
        self._moments = state


def _in_one_array(parameters: list[nn.Parameter]) -> tuple[Tensor, Tensor]:
    """An array of all values and an array of all gradients (zero). The parameters become views of these arrays."""
    values = parameters_to_vector(parameters).detach()
    vector_to_parameters(values, parameters)
    gradients = torch.zeros_like(values)
    for parameter, gradient in zip(parameters, gradients.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = gradient.view_as(parameter)
    return values, gradients
