"""MeshGraphNets against its formulas in float64, its two edge sets, batches, training and rollout."""

from dataclasses import replace

import pytest
import torch
from graph_models import assert_follows, batch_of, deep_mlp, made, resolved, with_stress

from ast_sim.batches.graph import edge_vectors
from ast_sim.models.mgn import PRESETS, MGNConfig
from ast_sim.models.node_inputs import node_features
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction

SMALL = MGNConfig(hidden=16, blocks=2)


def formulas(model, batch):
    """Section 3 of the paper: concatenated inputs, sums of the new edges at the receivers, residuals."""

    def of(p, dtype):
        def normal(name, x):
            return (x.to(dtype) - p[f"{name}.mean"]) / p[f"{name}.scale"]

        mesh, world, position, rest = batch.graph.edges, model.world(batch), batch.position, batch.graph.rest_edges
        vectors = edge_vectors(mesh, position, position)
        on_mesh = torch.cat([rest, vectors - rest if model.config.edge_strain else vectors], dim=1)
        v = deep_mlp(p, "node_encoder", normal("node_inputs", node_features(model.config, batch)))
        e = deep_mlp(p, "mesh_encoder", normal("mesh_inputs", on_mesh))
        w = deep_mlp(p, "world_encoder", normal("world_inputs", edge_vectors(world, position, position)))
        for i in range(model.config.blocks):
            e_new = deep_mlp(p, f"blocks.{i}.mesh.update", torch.cat([e, v[mesh.senders], v[mesh.receivers]], 1))
            w_new = deep_mlp(p, f"blocks.{i}.world.update", torch.cat([w, v[world.senders], v[world.receivers]], 1))
            sums = [torch.zeros_like(v).index_add(0, s.receivers, x) for s, x in ((mesh, e_new), (world, w_new))]
            v, e, w = v + deep_mlp(p, f"blocks.{i}.node", torch.cat([v, *sums], 1)), e + e_new, w + w_new
        out = deep_mlp(p, "decoder.of_nodes", v)
        if model.config.data.stress != "element":
            return Prediction(out[:, :3], {"stress": out[:, 3:]} if model.config.data.stress == "node" else {})
        means = v[batch.graph.elements].mean(dim=1)
        return Prediction(out[:, :3], {"stress": deep_mlp(p, "decoder.of_elements", means)})

    return of


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("stress", ["none", "node", "element"])
def test_it_follows_the_formulas(stress, layers):
    model, batch = made(with_stress(resolved(SMALL), stress, hidden_layers=layers), 0, 1)
    assert len(model.world(batch)) > 20
    assert_follows(model, batch, formulas(model, batch))


def test_its_mesh_edges_may_hold_strains():
    model, batch = made(replace(resolved(SMALL), edge_strain=True), 0, 1)
    assert_follows(model, batch, formulas(model, batch))


def test_without_world_edges_it_is_the_mesh_alone():
    model, batch = made(replace(resolved(SMALL), world_radius=0.0), 0)
    assert len(model.world(batch)) == 0
    out = model(batch)
    assert torch.isfinite(out.motion).all()
    exact = formulas(model, batch)({k: v.double() for k, v in model.state_dict().items()}, torch.float64)
    torch.testing.assert_close(out.motion.double(), exact.motion, rtol=1e-4, atol=1e-5)
    out.motion.square().sum().backward()


def test_both_edge_sets_count_and_have_weights_of_their_own():
    model, batch = made(resolved(SMALL), 0)
    before = model(batch).motion
    for part in ("mesh", "world"):
        changed = build_model(model.config)
        changed.load_state_dict(model.state_dict())
        with torch.no_grad():
            getattr(changed.blocks[0], part).update.norm.bias.add_(0.5)
        assert float((changed(batch).motion - before).detach().abs().max()) > 1e-3, part


def test_it_is_differentiated_by_positions():
    """The search for near nodes is not, but the lengths of the edges are that it finds."""
    model, batch = made(resolved(SMALL), 0)
    weights = torch.randn(batch.position.shape, generator=torch.Generator().manual_seed(1))

    def value(position: torch.Tensor) -> torch.Tensor:
        return (model(replace(batch, position=position)).motion * weights).sum()

    position = batch.position.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(position), position)
    step = 1e-4 * gradient / gradient.norm()
    with torch.no_grad():
        change = value(position + step) - value(position - step)
    assert float(change) == pytest.approx(2e-4 * float(gradient.norm()), rel=0.02)


def test_a_scene_alone_equals_a_scene_in_a_batch():
    model, both = made(resolved(SMALL), 0, 1)
    alone = torch.cat([model(batch_of(model, seed)).motion for seed in (0, 1)])
    assert torch.equal(model(both).motion, alone)


def test_the_presets_come_from_the_papers():
    original, paper = PRESETS["original"], PRESETS["paper"]
    for preset in (original, paper):
        assert (preset.model.hidden, preset.model.blocks, preset.train["noise"]) == (128, 15, 0.003)
    assert (original.train["batch_size"], paper.train["batch_size"]) == (2, 48)
    assert original.train["peak_rate"] == paper.train["peak_rate"] == 1e-4
