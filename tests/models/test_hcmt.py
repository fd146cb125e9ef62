"""HCMT: its attention by hand, the model against its formulas in float64, batches, training and rollout."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from checks import assert_accurate
from graph_models import assert_follows, batch_of, deep_mlp, made, resolved, with_stress

from ast_sim.models import hcmt as attention_module
from ast_sim.models.hcmt import PRESETS, HCMTConfig, channel_attention
from ast_sim.models.node_inputs import node_features
from ast_sim.models.registry import build_model
from ast_sim.models.simulator import Prediction
from ast_sim.ops import EdgeSet
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError

SMALL = HCMTConfig(hidden=16, levels=2, heads=2)


def test_attention_by_hand():
    """Edges 0 -> 2 and 1 -> 2, two channels, d = 4: weights exp(s), not divided by their sum, and s cut off at 2."""
    edges = EdgeSet.from_pairs(torch.tensor([0, 1]), torch.tensor([2, 2]), 3, 3)
    q = [[9, 9], [9, 9], [1, 2]]
    k = [[2, 1], [-1, 8], [9, 9]]
    v = [[1, 10], [3, -1], [9, 9]]
    p, g = [[1, 0.5], [2, 1]], [[2, 1], [1, 3]]
    out = channel_attention(edges, *(torch.tensor(x, dtype=torch.float32) for x in (q, k, v, p, g)), 4)
    # edge 0: s = (2 * 1 * 1 / 2, 1 * 2 * 0.5 / 2) = (1, 0.5); edge 1: (-1 * 1 * 2 / 2, 8 * 2 * 1 / 2) = (-1, 8 -> 2)
    expected = [2 * math.exp(1) + 3 * math.exp(-1), 10 * math.exp(0.5) - 3 * math.exp(2)]
    torch.testing.assert_close(out, torch.tensor([[0, 0], [0, 0], expected]))


def plain_attention(edges, q, k, v, p, g, d):
    score = torch.clamp(k[edges.senders] * q[edges.receivers] / math.sqrt(d) * p, -2, 2)
    return torch.zeros_like(q).index_add(0, edges.receivers, v[edges.senders] * g * torch.exp(score))


@pytest.mark.parametrize("chunk", [1, 100, 1 << 17])
def test_attention_and_its_gradients_are_accurate(chunk, monkeypatch):
    """Many edges a node, nodes without, scores on both sides of the limits; whatever the size of the chunks."""
    monkeypatch.setattr(attention_module, "CHUNK", chunk)
    generator = torch.Generator().manual_seed(0)
    senders, receivers = torch.randint(0, 20, (2, 150), generator=generator)
    edges = EdgeSet.from_pairs(senders, receivers // 2, 20, 20)
    inputs = [2 * torch.randn(rows, 8, generator=generator) for rows in (20, 20, 20, 150, 150)]
    assert_accurate(lambda *x: channel_attention(edges, *x, 4), lambda *x: plain_attention(edges, *x, 4), inputs)


def test_attention_without_edges_is_zero():
    edges = EdgeSet.from_pairs(*torch.zeros(2, 0, dtype=torch.int64), 5, 5)
    inputs = [torch.randn(rows, 4, requires_grad=True) for rows in (5, 5, 5, 0, 0)]
    out = channel_attention(edges, *inputs, 4)
    out.sum().backward()
    assert out.tolist() == [[0.0] * 4] * 5 and not any(x.grad.any() for x in inputs[:3])
    assert inputs[3].grad.shape == inputs[4].grad.shape == (0, 4)


def formulas(model, batch):
    """The stack of blocks, each projection on its own, messages edge by edge; only the kept nodes are taken over."""
    c, own = model.config, batch.graph.own
    rest, position = batch.graph.rest_position, batch.position

    def of(p, dtype):
        def normal(name, x):
            return (x.to(dtype) - p[f"{name}.mean"]) / p[f"{name}.scale"]

        def norm(name, x):
            return F.layer_norm(x, (c.hidden,), p[f"{name}.weight"], p[f"{name}.bias"])

        def vector(x, edges):
            d = x[edges.senders].to(dtype) - x[edges.receivers].to(dtype)
            return torch.cat([d, torch.sqrt((d * d).sum(1, keepdim=True))], 1)

        def block(name, x, *sets):
            y, found = norm(f"{name}.norm", x), []
            for i, (edges, e) in enumerate(sets):
                e = norm(f"{name}.edge_norms.{i}", e)
                inputs = [
                    F.linear(z, p[f"{name}.{part}.weight"]) for part, z in zip("qkvpg", (y, y, y, e, e), strict=True)
                ]
                found.append(plain_attention(edges, *inputs, c.hidden // c.heads))
            x = x + F.linear(torch.cat(found, 1), p[f"{name}.out.weight"])
            y = norm(f"{name}.forward_norm", x)
            for i in range(3):
                y = F.linear(y if i == 0 else F.relu(y), p[f"{name}.feed_forward.{i}.weight"])
            return x + y

        nodes, meshes = torch.arange(len(position)), []  # of each mesh, in numbers of the finest
        for i, edges in enumerate(own.edges):
            nodes = nodes if i == 0 else nodes[own.poolings[i - 1].kept]
            inputs = torch.cat([vector(rest[nodes], edges), vector(position[nodes], edges)], 1)
            meshes.append((edges, deep_mlp(p, "mesh_encoder", normal("mesh_inputs", inputs))))
        world = model.world(batch)
        contacts = (world, deep_mlp(p, "world_encoder", normal("world_inputs", vector(position, world))))
        x, saved = deep_mlp(p, "node_encoder", normal("node_inputs", node_features(c, batch))), []
        for i in range(c.contact_blocks):
            x = block(f"contact.{i}", x, meshes[0], contacts)
        for i in range(c.levels):
            saved.append(block(f"down.{i}", x, meshes[i]))
            x = saved[-1][own.poolings[i].kept]
        x = block("bottom", x, meshes[-1])
        for i in reversed(range(c.levels)):
            rows = list(saved[i])
            for row, node in enumerate(own.poolings[i].kept.tolist()):
                rows[node] = x[row]
            x = block(f"up.{i}", torch.stack(rows), meshes[i])
        out = deep_mlp(p, "decoder.of_nodes", x)
        if c.data.stress != "element":
            return Prediction(out[:, :3], {"stress": out[:, 3:]} if c.data.stress == "node" else {})
        return Prediction(
            out[:, :3], {"stress": deep_mlp(p, "decoder.of_elements", x[batch.graph.elements].mean(dim=1))}
        )

    return of


@pytest.mark.parametrize("stress", ["none", "node", "element"])
def test_it_follows_the_formulas(stress):
    model, batch = made(with_stress(resolved(SMALL), stress), 0, 1)
    assert len(model.world(batch)) > 20 and len(batch.graph.own.edges[2]) > 10
    assert_follows(model, batch, formulas(model, batch))


def test_contacts_of_obstacles_join_them_with_moving_nodes_only():
    every, batch = made(resolved(SMALL, 0.15), 0, 1)
    model, _ = made(replace(every.config, contacts="obstacles"), 0, 1)
    kind, found, world = batch.graph.node_type, model.world(batch), every.world(batch)
    pairs = {frozenset((int(kind[s]), int(kind[r]))) for s, r in zip(found.senders, found.receivers, strict=True)}
    assert pairs == {frozenset((int(NodeType.OBSTACLE), int(NodeType.NORMAL)))}
    both = kind[world.senders] + kind[world.receivers] == NodeType.OBSTACLE + NodeType.NORMAL
    mixed = both & (kind[world.senders] != kind[world.receivers])
    mixed &= (kind[world.senders] == NodeType.OBSTACLE) | (kind[world.receivers] == NodeType.OBSTACLE)
    assert len(found) == int(mixed.sum()) < len(world)


def test_without_world_edges_it_is_the_mesh_alone():
    model, batch = made(replace(resolved(SMALL), world_radius=0.0), 0)
    assert len(model.world(batch)) == 0
    out = model(batch).motion
    exact = formulas(model, batch)({k: v.double() for k, v in model.state_dict().items()}, torch.float64).motion
    torch.testing.assert_close(out.double(), exact, rtol=1e-4, atol=1e-5)
    out.square().sum().backward()


def test_a_scene_alone_equals_a_scene_in_a_batch():
    model, both = made(resolved(SMALL), 0, 1)
    alone = [model(batch_of(model, seed)) for seed in (0, 1)]
    assert torch.equal(model(both).motion, torch.cat([x.motion for x in alone]))
    assert torch.equal(model(both).fields["stress"], torch.cat([x.fields["stress"] for x in alone]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"levels": 0}, "model.levels is 0"), ({"heads": 3}, "model.hidden = 128 must be a multiple of model.heads = 3")],
)
def test_settings_out_of_range_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        HCMTConfig(**changes)


def test_the_presets_come_from_the_papers():
    original, paper = PRESETS["original"], PRESETS["paper"]
    for preset in (original, paper):
        c = preset.model
        assert (c.hidden, c.heads, c.contact_blocks, c.levels) == (128, 4, 2, 6)
        assert (preset.train["peak_rate"], preset.train["noise"]) == (1e-4, 0.003)
    assert (original.train["batch_size"], paper.train["batch_size"]) == (1, 4)
    assert (original.model.contacts, paper.model.contacts) == ("obstacles", "all")


def test_the_number_of_parameters():
    """About the 2.5 million of the source: h^2 for each of Q, K, V, P, G, O (twice with contacts) and three layers."""

    def mlp(inputs, h, outputs):
        return inputs * h + h + h * h + h + h * outputs + outputs

    h = 128
    mesh_block, contact_block = 9 * h * h + 3 * 2 * h, 10 * h * h + 4 * 2 * h
    encoders = mlp(6, h, h) + mlp(8, h, h) + mlp(4, h, h) + 3 * 2 * h
    total = encoders + 2 * contact_block + 13 * mesh_block + mlp(h, h, 4)
    model = build_model(resolved(PRESETS["paper"].model))
    assert sum(p.numel() for p in model.parameters()) == total
    assert 2.3e6 < total < 2.6e6
