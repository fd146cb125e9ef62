"""BSMS-GNN against its formulas in float64, its contacts, batches, training and rollout."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import toy
from graph_models import assert_follows, batch_of, deep_mlp, made, resolved, with_stress

from ast_sim.models.bsms import PRESETS, BSMSConfig
from ast_sim.models.node_inputs import node_features
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError

SMALL = BSMSConfig(hidden=16, levels=2)


def formulas(model, batch):
    """The U-Net with dense matrices: adjacency, pooling weights and contacts of each mesh, messages edge by edge."""
    levels, own = model.config.levels, batch.graph.own

    def of(p, dtype):
        def normal(name, x):
            return (x.to(dtype) - p[f"{name}.mean"]) / p[f"{name}.scale"]

        def norm_mlp(name, x):
            return F.layer_norm(deep_mlp(p, name, x), (model.config.hidden,))

        def vector(x, pairs):
            d = x[pairs[1]] - x[pairs[0]]
            return torch.cat([d, torch.sqrt((d * d).sum(1, keepdim=True))], 1)

        def block(name, level, x):
            inputs = torch.cat([vector(rests[level], meshes[level]), vector(positions[level], meshes[level])], 1)
            sums = []
            for part, pairs, features in (
                ("mesh", meshes[level], normal(f"mesh_inputs.{level}", inputs)),
                (
                    "contact",
                    contacts[level],
                    normal(f"world_inputs.{level}", vector(positions[level], contacts[level])),
                ),
            ):
                found = norm_mlp(f"{name}.{part}.mlp", torch.cat([features, x[pairs[1]], x[pairs[0]]], 1))
                sums.append(torch.zeros_like(x).index_add(0, pairs[0], found))
            return x + norm_mlp(f"{name}.node", torch.cat([x, *sums], 1))

        def steps(name, level, x, end):
            for _ in range(2 if end and model.config.repeat_ends else 1):
                x = block(name, level, x)
            return x

        # meshes and contacts as [2, M] pairs (receiver, sender), pooling weights as dense matrices
        adjacency = torch.zeros(len(batch.position), len(batch.position), dtype=dtype)
        adjacency[own.edges[0].receivers, own.edges[0].senders] = 1
        contact = torch.zeros_like(adjacency)
        world = model.world(batch)
        contact[world.receivers, world.senders] = 1
        meshes, contacts, pools, w = [], [], [], torch.ones(len(adjacency), dtype=dtype)
        rests, positions = [batch.graph.rest_position.to(dtype)], [batch.position.to(dtype)]
        for level in range(levels + 1):
            meshes.append(adjacency.nonzero().T)
            contacts.append(contact.nonzero().T)
            if level < levels:
                kept, eye = own.poolings[level].kept, torch.eye(len(adjacency), dtype=dtype)
                walk = adjacency + torch.diag((adjacency.sum(1) == 0).to(dtype))
                share = w / walk.sum(1)
                pools.append((walk * share / (walk @ share)[:, None])[kept])
                w, reach = (walk @ share)[kept], adjacency + eye
                both = (((reach @ reach) > 0)[kept][:, kept], ((reach @ contact @ reach) > 0)[kept][:, kept])
                adjacency, contact = (x * (1 - torch.eye(len(kept), dtype=dtype)) for x in both)
                rests.append(pools[-1] @ rests[-1])
                positions.append(pools[-1] @ positions[-1])

        x, skipped = norm_mlp("node_encoder", normal("node_inputs", node_features(model.config, batch))), []
        for level in range(levels):
            skipped.append(steps(f"down.{level}", level, x, level == 0))
            x = pools[level] @ skipped[-1]
        x = steps("bottom", levels, x, True)
        for level in reversed(range(levels)):
            x = skipped[level] + steps(f"up.{level}", level, pools[level].T @ x, level == 0)
        out = deep_mlp(p, "decoder.of_nodes", x)
        if model.config.data.stress != "element":
            return Prediction(out[:, :3], {"stress": out[:, 3:]} if model.config.data.stress == "node" else {})
        return Prediction(
            out[:, :3], {"stress": deep_mlp(p, "decoder.of_elements", x[batch.graph.elements].mean(dim=1))}
        )

    return of


@pytest.mark.parametrize(
    ("stress", "more"),
    [
        ("node", {}),
        ("element", {"contacts": "components", "hidden_layers": 1}),
        ("none", {"repeat_ends": True, "contacts": "components", "prescribed_edges": False}),
    ],
)
def test_it_follows_the_formulas(stress, more):
    model, batch = made(with_stress(resolved(SMALL, 0.07), stress, **more), 0, 1)
    assert all(len(contacts) > 4 for contacts in model.contacts(batch))
    assert_follows(model, batch, formulas(model, batch))


def test_contacts_of_components_join_no_component_with_itself():
    every, batch = made(resolved(SMALL, 0.15), 0, 1)
    apart, same = made(replace(every.config, contacts="components"), 0, 1)
    body = torch.from_numpy(np.concatenate([toy.plate(seed).scene.body for seed in (0, 1)]))
    found, world = apart.world(same), every.world(batch)
    crossing = body[world.senders] != body[world.receivers]
    assert 0 < len(found) == int(crossing.sum()) < len(world)
    assert (body[found.senders] != body[found.receivers]).all()


def test_edges_between_prescribed_nodes_can_be_left_out():
    model, batch = made(replace(resolved(SMALL), prescribed_edges=False), 0)
    edges, graph = batch.graph.own.edges[0], batch.graph
    both = graph.prescribed[graph.edges.senders] & graph.prescribed[graph.edges.receivers]
    assert len(edges) == len(graph.edges) - int(both.sum()) < len(graph.edges)
    assert not (graph.prescribed[edges.senders] & graph.prescribed[edges.receivers]).any()
    kept = batch.graph.own.poolings[0].kept  # the nodes of the block are left without neighbours, and stay
    assert set((graph.node_type == NodeType.OBSTACLE).nonzero()[:, 0].tolist()) <= set(kept.tolist())
    assert torch.isfinite(model(batch).motion).all()


def test_without_world_edges_it_is_the_mesh_alone():
    model, batch = made(replace(resolved(SMALL), world_radius=0.0), 0)
    assert all(len(contacts) == 0 for contacts in model.contacts(batch))
    out = model(batch).motion
    exact = formulas(model, batch)({k: v.double() for k, v in model.state_dict().items()}, torch.float64).motion
    torch.testing.assert_close(out.double(), exact, rtol=1e-4, atol=1e-5)
    out.square().sum().backward()


def test_a_scene_alone_equals_a_scene_in_a_batch():
    model, both = made(resolved(SMALL, 0.07), 0, 1)
    alone = [model(batch_of(model, seed)) for seed in (0, 1)]
    assert torch.equal(model(both).motion, torch.cat([x.motion for x in alone]))
    assert torch.equal(model(both).fields["stress"], torch.cat([x.fields["stress"] for x in alone]))


def test_levels_below_one_are_refused():
    with pytest.raises(ConfigError, match="model.levels is 0; it must be at least 1"):
        BSMSConfig(levels=0)


def test_the_presets_come_from_the_papers():
    original, paper = PRESETS["original"], PRESETS["paper"]
    for preset in (original, paper):
        assert (preset.model.hidden, preset.model.levels, preset.train["peak_rate"]) == (128, 6, 1e-4)
    assert (original.train["batch_size"], paper.train["batch_size"]) == (12, 48)
    assert original.model.repeat_ends and not paper.model.repeat_ends


def test_the_number_of_parameters():
    """Hidden h, L levels: a block has MLPs of 8 + 2h, 4 + 2h and 3h inputs; the LayerNorms have none."""

    def mlp(inputs, h, outputs):
        return inputs * h + h + h * h + h + h * outputs + outputs

    h, levels = 128, 6
    block = mlp(8 + 2 * h, h, h) + mlp(4 + 2 * h, h, h) + mlp(3 * h, h, h)
    total = mlp(6, h, h) + (2 * levels + 1) * block + mlp(h, h, 4)
    model = build_model(resolved(PRESETS["paper"].model))
    assert sum(p.numel() for p in model.parameters()) == total == 2_871_300
