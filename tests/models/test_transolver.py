"""Transolver against its formulas written out with loops, against slices by hand, and trained on small data."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import toy
from checks import errors
from meshes import box
from torch import Tensor
from torch.func import functional_call

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.evaluation.evaluate import evaluate
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import build_model
from ast_sim.models.transolver import PRESETS, PhysicsAttention, Transolver, TransolverConfig
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.train_config import RunConfig, TrainConfig
from ast_sim.scene import NodeType, Scene
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import from_values, to_toml
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training

SMALL = {"hidden": 32, "blocks": 2, "heads": 2, "slices": 5, "mlp_ratio": 2}


def small(stress: str = "node", **changes) -> TransolverConfig:
    data = DataFacts(domain_center=(0.1, 0.0, -0.2), stress=stress)
    fitting = {"data": data, "boundary_motion": True, "node_inputs": ("displacement",)}
    return replace(TransolverConfig(**SMALL, **fitting), **changes)


def scene(seed: int) -> Scene:
    """A block of tetrahedra with some nodes of each kind."""
    nodes, elements = box((2 + seed, 2, 1), (0.2, 0.2, 0.1))
    kind = np.where(nodes[:, 0] < -0.09, NodeType.HANDLE, NodeType.NORMAL)
    kind[-3:] = NodeType.OBSTACLE
    return Scene(
        nodes.astype(np.float32), elements.astype(np.int32), kind.astype(np.uint8), np.zeros(len(nodes), np.int32)
    )


def batch_of(model: Transolver, *scenes: Scene, seed: int = 0) -> Batch:
    """The scenes in a random state, each drawn for itself."""
    graph = Graph.concatenate([model.graph(s) for s in scenes])
    drawn = [np.random.default_rng([seed, s.num_nodes]).standard_normal((2, s.num_nodes, 3)) for s in scenes]
    moved, motion = torch.tensor(np.concatenate(drawn, axis=1), dtype=torch.float32) * 0.01
    motion = torch.where(graph.prescribed[:, None], motion, 0.0)
    return Batch(graph, graph.rest_position + moved, None, motion, None, [f"scene {i}" for i in range(len(scenes))])


def model_of(config: TransolverConfig, scale: float = 10.0) -> Transolver:
    """A model with weights far from their small start, so that no two slices are alike."""
    torch.manual_seed(0)
    model = Transolver(config)
    for p in model.parameters():
        p.data = p * scale + 0.1 * torch.randn_like(p) if p.dim() == 2 else p + 0.1 * torch.randn_like(p)
    model.observe(batch_of(model, scene(0), scene(1)))
    for part in (model.node_inputs, model.positions):
        part.fix()
    return model


# Formulas


def layer(p: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    return x @ p[f"{name}.weight"].T + p.get(f"{name}.bias", 0)


def physics_attention(p: dict[str, Tensor], x: Tensor, heads: int, slices: int) -> Tensor:
    """The four formulas on one scene [n, hidden], one head at a time, with the parameters of the module by name."""
    both, found = layer(p, "project", x), []
    a, v = both.chunk(2, dim=1)
    for h in range(heads):
        width = a.shape[1] // heads
        columns = slice(h * width, (h + 1) * width)
        scale, shift = (p[f"slice.{part}"] / p["temperature"][h] for part in ("weight", "bias"))
        w = (a[:, columns] @ scale.T + shift).softmax(1)
        z = torch.stack([(w[:, [s]] * v[:, columns]).sum(0) / (w[:, s].sum() + 1e-5) for s in range(slices)])
        q, k, z = (layer(p, f"slice_{part}", z) for part in ("query", "key", "value"))
        found.append(w @ ((q @ k.T / width**0.5).softmax(1) @ z))
    return layer(p, "out", torch.cat(found, 1))


def transcribed(model: Transolver, batch: Batch) -> list[Tensor]:
    """The whole model, one scene at a time, in the type of its parameters."""
    config, graph, p = model.config, batch.graph, dict(model.named_parameters())
    center = torch.tensor(config.data.domain_center)
    kind = torch.stack([graph.node_type == k for k in NodeType], 1)
    node = torch.cat([kind, batch.position - graph.rest_position, batch.boundary_motion], 1)
    node = (node - model.node_inputs.mean) / model.node_inputs.scale
    place = torch.cat([graph.rest_position - center, batch.position - center], 1)
    place = (place - model.positions.mean) / model.positions.scale

    def mlp(name: str, x: Tensor) -> Tensor:
        return layer(p, f"{name}.second", F.gelu(layer(p, f"{name}.first", x)))

    def norm(name: str, x: Tensor) -> Tensor:
        centred = x - x.mean(1, keepdim=True)
        return (
            centred / (centred.square().mean(1, keepdim=True) + 1e-5).sqrt() * p[f"{name}.weight"] + p[f"{name}.bias"]
        )

    motions, stresses = [], []
    bounds = graph.node_offsets.tolist()
    for first, last in zip(bounds, bounds[1:], strict=False):
        x = mlp("encoder", torch.cat([node[first:last], place[first:last]], 1))
        for b in range(config.blocks):
            start = f"blocks.{b}.attention."
            own = {name.removeprefix(start): value for name, value in p.items() if name.startswith(start)}
            x = x + physics_attention(own, norm(f"blocks.{b}.norm", x), config.heads, config.slices)
            x = x + mlp(f"blocks.{b}.mlp", norm(f"blocks.{b}.norm_mlp", x))
        x = norm("norm", x)
        motions.append(layer(p, "decoder", x)[:, :3])
        if config.data.stress == "node":
            stresses.append(layer(p, "decoder", x)[:, 3:])
        if config.data.stress == "element":
            inside = (graph.elements >= first).all(1) & (graph.elements < last).all(1)
            corners = [x[element - first].mean(0) for element in graph.elements[inside]]
            stresses.append(layer(p, "element_decoder", torch.stack(corners)))
    return [torch.cat(motions), *([torch.cat(stresses)] if stresses else [])]


@pytest.mark.parametrize("stress", ["none", "node", "element"])
def test_the_model_is_its_formulas(stress):
    """In float64: outputs, and gradients with respect to the state and all parameters."""
    model = model_of(small(stress)).double()
    batch = batch_of(model, scene(0), scene(1))
    position, motion = (x.double().requires_grad_() for x in (batch.position, batch.boundary_motion))
    rest = replace(batch.graph, rest_position=batch.graph.rest_position.double(), one_hot=batch.graph.one_hot.double())
    batch = replace(batch, graph=rest, position=position, boundary_motion=motion)
    out = model(batch)
    ours = [out.motion, *out.fields.values()]
    theirs = transcribed(model, batch)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in theirs]
    leaves = [position, motion, *model.parameters()]
    gradients = [torch.autograd.grad(outputs, leaves, weights) for outputs in (ours, theirs)]
    for x, y in zip([*ours, *gradients[0]], [*theirs, *gradients[1]], strict=True):
        torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-9 * float(y.detach().abs().max()))


def test_physics_attention_is_as_accurate_as_its_formulas():
    """In float32: outputs and gradients of the module within the accuracy rule, the errors the largest of four draws,
    since the error of a sum over all nodes in a single one is luck."""
    torch.manual_seed(0)
    module, found = PhysicsAttention(small()), []
    names, offsets = [name for name, _ in module.named_parameters()], torch.tensor([0, 40, 101])

    def fused(x, residual, *values):
        return functional_call(module, dict(zip(names, values, strict=True)), (x, offsets, residual))

    def reference(x, residual, *values):
        p = dict(zip(names, values, strict=True))
        return residual + torch.cat([physics_attention(p, scene, heads=2, slices=5) for scene in x.split([40, 61])])

    for _ in range(4):
        values = [torch.randn_like(p) * p.shape[-1] ** -0.5 for _, p in module.named_parameters()]
        values[names.index("temperature")] = torch.tensor([0.3, 0.9])[:, None, None]
        found.append(errors(fused, reference, [torch.randn(101, 32), torch.randn(101, 32), *values]))
    for name, *each in zip(["y", "dx", "d residual", *names], *found, strict=True):
        error_c, error_t, magnitude = (max(column) for column in zip(*each, strict=True))
        assert error_c <= 2 * error_t + 1e-6 * magnitude, (name, error_c, error_t, magnitude)


# Slices by hand


def by_hand(slices: int) -> PhysicsAttention:
    """One head of width 16: a = v = x, W_V and W_O the identity, W_Q = 0: slices attend to all alike; tau = 0.5."""
    attention = PhysicsAttention(TransolverConfig(hidden=16, heads=1, slices=slices))
    with torch.no_grad():
        for p in attention.parameters():
            p.zero_()
        attention.project.weight.copy_(torch.eye(16).repeat(2, 1))
        attention.slice_value.weight.copy_(torch.eye(16))
        attention.out.weight.copy_(torch.eye(16))
        attention.temperature.fill_(0.5)
    return attention


def test_slice_weights_by_hand():
    """Scores (0, ln 3) / 2 over a temperature of 1/2 give shares of 1 : 3, and four times the feature 1 : 81."""
    attention = by_hand(2)
    with torch.no_grad():
        attention.slice.weight[1, 0] = 0.5 * np.log(3.0)
    a = torch.zeros(1, 3, 16)
    a[0, :, 0] = torch.tensor([0.0, 1.0, 4.0])
    expected = torch.tensor([[[1 / 2, 1 / 2], [1 / 4, 3 / 4], [1 / 82, 81 / 82]]])
    torch.testing.assert_close(attention.weights(a), expected)


def test_slices_are_means_over_their_nodes_and_every_node_takes_its_share_back():
    """The sign of feature 0 assigns nodes to slices: two to one, four to the other. Slices are the means of their
    nodes, (2, 4) and (10, 20) in features 1 and 2; attention to both alike makes (6, 12) of them, in every node."""
    attention = by_hand(2)
    with torch.no_grad():
        attention.slice.weight[:, 0] = torch.tensor([-100.0, 100.0])
    x = torch.zeros(6, 16)
    x[:, 0] = torch.tensor([-1.0, -1, 1, 1, 1, 1])
    x[:, 1] = torch.tensor([1.0, 3, 8, 9, 11, 12])
    x[:, 2] = 2 * x[:, 1]
    out = attention(x, torch.tensor([0, 6]), residual=torch.ones(6, 16))
    expected = torch.ones(6, 16)
    expected[:, 1:3] += torch.tensor([6.0, 12.0])  # feature 0: the mean of -1 and 1
    torch.testing.assert_close(out, expected, rtol=2e-5, atol=2e-5)  # epsilon over two nodes is 5e-6
    # Without attention between them (only its own slice counts), a node gets its slice's mean.
    with torch.no_grad():
        attention.slice_query.weight[0, 0] = attention.slice_key.weight[0, 0] = 100.0
    out = attention(x, torch.tensor([0, 6]), residual=torch.zeros(6, 16))
    torch.testing.assert_close(out[:, 1], torch.tensor([2.0, 2, 10, 10, 10, 10]), rtol=2e-5, atol=2e-5)


def test_a_temperature_that_falls_to_zero_stays_at_a_tenth():
    attention = by_hand(3)
    torch.nn.init.normal_(attention.slice.weight)
    a = torch.randn(1, 7, 16)
    found = []
    for temperature in (0.1, 0.0, -1.0):
        attention.temperature.data.fill_(temperature)
        found.append(attention.weights(a))
    assert found[0].isfinite().all()
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


# Scenes, nodes, settings


def test_scenes_of_a_batch_do_not_see_each_other():
    model = model_of(small())
    both = batch_of(model, scene(0), scene(2))
    out = model(both)
    for nodes, alone in ((slice(0, 18), scene(0)), (slice(18, None), scene(2))):
        single = model(batch_of(model, alone))
        torch.testing.assert_close(out.motion[nodes], single.motion, rtol=1e-5, atol=2e-6)
        torch.testing.assert_close(out.fields["stress"][nodes], single.fields["stress"], rtol=1e-5, atol=2e-6)
    # Whatever happens in the second scene, the first keeps its bits.
    elsewhere = both.position.clone()
    elsewhere[18:] *= 3.0
    moved = model(replace(both, position=elsewhere))
    assert torch.equal(moved.motion[:18], out.motion[:18])
    assert not torch.equal(moved.motion[18:], out.motion[18:])


def test_the_order_of_the_nodes_does_not_matter():
    model, one = model_of(small("element")), scene(1)
    order = np.random.default_rng(0).permutation(one.num_nodes)
    place = np.argsort(order)
    mixed = Scene(one.rest_position[order], place[one.elements].astype(np.int32), one.node_type[order], one.body[order])
    batch = batch_of(model, one)
    index = torch.from_numpy(order)
    again = replace(
        batch,
        graph=model.graph(mixed),
        position=batch.position[index],
        boundary_motion=batch.boundary_motion[index],
    )
    torch.testing.assert_close(model(again).motion, model(batch).motion[index], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(model(again).fields["stress"], model(batch).fields["stress"], rtol=1e-4, atol=1e-5)


def test_it_knows_no_edges():
    graph = model_of(small()).graph(scene(0))
    assert len(graph.edges) == len(graph.rest_edges) == 0


def test_number_of_parameters_of_the_original():
    """Encoder 12 -> 256 -> 128, eight blocks, LayerNorm, decoder 128 -> 4; type 3, motion 3, positions 6.

    A block: a and v 128 -> 256: 33024; slices 16 -> 64: 1088; temperatures 8; query, key, value 3 * 256; out 16512;
    MLP 128 -> 128 -> 128: 33024; two norms 512: 84936.
    """
    model = build_model(replace(PRESETS["original"].model, data=DataFacts(stress="node"), boundary_motion=True))
    expected = 12 * 256 + 256 + 256 * 128 + 128 + 8 * 84936 + 256 + 128 * 4 + 4
    assert sum(p.numel() for p in model.parameters()) == expected == 716484


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"hidden": 40, "heads": 3}, "hidden = 40 must be a multiple of model.heads = 3"),
        ({"slices": 0}, "model.slices is 0; it must be at least 1"),
        ({"heads": 0}, "model.heads is 0"),
    ],
)
def test_settings_that_do_not_fit(changes, message):
    with pytest.raises(ConfigError, match=message):
        TransolverConfig(**changes)


def test_settings_survive_toml():
    config = RunConfig(replace(small("element"), data=DataFacts()), TrainConfig(steps=3), "data.h5")
    assert from_values(RunConfig, tomllib.loads(to_toml(config))) == config


# Training


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Trained for 80 steps on three toy plates."""
    folder = tmp_path_factory.mktemp("transolver")
    data = toy.write(folder / "toy.h5")
    # Along rollouts the states grow harder while it learns, so that losses tell nothing.
    settings = [
        *("train.steps=80", "train.validate_every=80", "train.log_every=20"),
        "train.rollout_pool=0",
    ]
    config = configure(data, "tiny", settings, model="transolver")
    start_training(folder / "run", config)
    return folder / "run", data


def test_training_lowers_the_loss(trained):
    losses = [record["loss"] for record in Metrics(trained[0]) if "loss" in record]
    assert len(losses) == 4 and min(losses) < 0.7 * losses[0], losses


def test_a_trained_run_rolls_out_and_is_evaluated(trained):
    trained_run = RunFolder(trained[0])
    model, settings, step = trained_run.load_model(), trained_run.settings, trained_run.chosen.step
    assert isinstance(model, Transolver) and settings.model.name == "transolver" and step == 80
    assert (
        settings.model.node_inputs == ("displacement", "proximity", "out_of_balance")
        and settings.model.data.stress == "node"
    )
    with Dataset(trained[1]) as dataset:
        truths = [dataset.load("test", index) for index in range(2)]
        found = evaluate(model, dataset, "test")
    for truth, result in zip(truths, toy.answers(model, truths, ["a", "b"]), strict=True):
        assert result.failure is None and result.position.shape == truth.position.shape
        prescribed = truth.scene.prescribed
        assert np.array_equal(result.position[:, prescribed], truth.position[:, prescribed])
        assert result.stress.shape == truth.stress.shape
    model, still = (found.error("displacement", key).rmse_sequence for key in ("model", "hold_still"))
    assert model < still and found.failures == 0
