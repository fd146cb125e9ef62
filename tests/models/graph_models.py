"""What the tests of the models with world edges share: a batch of small scenes and the formulas in plain torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
import toy
from torch import Tensor

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction, Simulator

Parameters = dict[str, Tensor]


def resolved(config: ModelConfig, radius: float = 0.06, **kind: bool) -> ModelConfig:
    """The settings on the data of tests/toy.py, with world edges between plate and block, and within the plate."""
    return replace(config, world_radius=radius).resolve(DataFacts.of(toy.info(**kind), (), 0.1))


def with_stress(config: ModelConfig, stress: str, **changes: object) -> ModelConfig:
    """The settings with another place of the stress in the data."""
    return replace(config, data=replace(config.data, stress=stress), **changes)


def batch_of(model: Simulator, *seeds: int) -> Batch:
    """One batch of toy scenes in frame 3."""
    scenes = [toy.plate(seed, dynamic=model.config.data.dynamic) for seed in seeds]
    graph = Graph.concatenate([model.graph(t.scene) for t in scenes])
    before, now, after = (torch.from_numpy(np.concatenate([t.position[i] for t in scenes])) for i in (2, 3, 4))
    motion = torch.where(graph.prescribed[:, None], after - now, 0.0)
    return Batch(graph, now, before if model.config.data.dynamic else None, motion, None, [f"scene {s}" for s in seeds])


def made(config: ModelConfig, *seeds: int) -> tuple[Simulator, Batch]:
    """A model with statistics of its inputs, and the batch that they are taken from."""
    torch.manual_seed(0)
    model = build_model(config)
    batch = batch_of(model, *seeds)
    model.observe(batch)
    for module in model.modules():
        if hasattr(module, "fix"):
            module.fix()
    return model, batch


def deep_mlp(p: Parameters, name: str, x: Tensor) -> Tensor:
    """Linear, ReLU, as often as it has hidden layers, Linear, and LayerNorm if it has one."""
    two = f"{name}.rest.first.weight" in p
    *hidden, last = ("first", "rest.first", "rest.second") if two else ("first", "rest")
    for layer in hidden:
        x = F.relu(F.linear(x, p[f"{name}.{layer}.weight"], p[f"{name}.{layer}.bias"]))
    x = F.linear(x, p[f"{name}.{last}.weight"], p[f"{name}.{last}.bias"])
    if f"{name}.norm.weight" in p:
        x = F.layer_norm(x, x.shape[-1:], p[f"{name}.norm.weight"], p[f"{name}.norm.bias"])
    return x


def assert_follows(model: Simulator, batch: Batch, formulas: Callable[[Parameters, torch.dtype], Prediction]) -> None:
    """Outputs and the gradients of all parameters against the formulas in float64: no worse than twice the formulas in
    float32, relative to the largest entry of each."""

    def results(out: Prediction, parameters: list[Tensor]) -> list[Tensor]:
        outputs = [out.motion, *out.fields.values()]
        generator = torch.Generator().manual_seed(7)
        weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x.dtype) for x in outputs]
        total = sum((x * w).sum() for x, w in zip(outputs, weights, strict=True))
        return [*outputs, *torch.autograd.grad(total, parameters)]

    def by_formulas(dtype: torch.dtype) -> list[Tensor]:
        p = {
            k: v.detach().to(dtype).requires_grad_(v.requires_grad) for k, v in model.state_dict(keep_vars=True).items()
        }
        return results(formulas(p, dtype), [p[k] for k, _ in model.named_parameters()])

    names = ["motion", *(["stress"] if model.config.data.stress != "none" else [])]
    names += [name for name, _ in model.named_parameters()]
    ours, plain, exact = (
        results(model(batch), list(model.parameters())),
        by_formulas(torch.float32),
        by_formulas(torch.float64),
    )
    triples = [[x.detach() for x in found] for found in zip(ours, plain, exact, strict=True)]
    size = [float(e.abs().max()) for _, _, e in triples]
    # What rounding does to one of many results is a draw: the plain form's worst of all says what to expect of each.
    worst = max(float((t - e).abs().max()) / s for (_, t, e), s in zip(triples, size, strict=True))
    for name, (c, _, e), s in zip(names, triples, size, strict=True):
        assert s > 0, name
        error = float((c - e).abs().max()) / s
        assert error <= 2 * worst + 1e-6, (name, error, worst)
    assert worst < 1e-4
