"""The model as a whole and part by part, against the formulas of docs/reference/model.md."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import toy
from checks import run_python
from safetensors.torch import load_file
from stand_ins import trajectory, write

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.batches.pairs import PairSampler
from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.ast.cells import build_cells, places
from ast_sim.models.ast.message_passing import MessagePassing
from ast_sim.models.ast.position_embedding import PositionEmbedding, rotations
from ast_sim.models.ast.presets import PRESETS
from ast_sim.models.ast.transformer import AttentionBlock, Vectors
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.layers import FactorizedLinear
from ast_sim.models.normalizer import Normalizer
from ast_sim.models.registry import build_model
from ast_sim.ops import EdgeSet, rotated
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError, DatasetError, RolloutError

RELATIVE, EXCHANGES = {"places": "relative"}, {"places": "relative", "exchanges": 2}
SMALL = {"hidden": 32, "decoder_hidden": 16, "d_token": 32, "heads": 2, "head_dim": 16, "ffn_inner": 32, "L_SA": 2}

DATA = {
    "deforming_plate": DataFacts(stress="node"),
    "sphere_simple": DataFacts(integration="dynamic"),
    "abcd": DataFacts(columns=("stiffness",)),
    "abcd_xl": DataFacts(columns=("stiffness",), stress="element"),
}


def small(family: str, **changes) -> ASTConfig:
    """The family's preset on its data, with narrow layers: the same parts, quick to run."""
    return replace(PRESETS[family].model, **{**SMALL, "boundary_motion": True, "data": DATA[family], **changes})


def sampler(path, config: ASTConfig, noise: float = 1e-3) -> PairSampler:
    return PairSampler(
        Dataset(path), "train", batch_size=2, seed=0, noise=noise, make_graph=build_model(config).graph,
        scheme=config.scheme, gamma=1.0,
    )  # fmt: skip


def batch_of(config: ASTConfig, *seeds: int, family: str = "deforming_plate") -> Batch:
    scenes = [trajectory(family, seed) for seed in seeds]
    graph = Graph.concatenate([Graph.from_scene(t.scene, bool(config.element_inputs)) for t in scenes])
    now, after, before = (torch.from_numpy(np.concatenate([t.position[i] for t in scenes])) for i in (2, 3, 1))
    motion = torch.where(graph.prescribed[:, None], after - now, 0.0)
    stress = (
        torch.from_numpy(np.concatenate([t.stress[2] for t in scenes])) if "stress" in config.element_inputs else None
    )
    return Batch(
        graph, now, before if config.data.dynamic else None, motion, stress, [f"scene {seed}" for seed in seeds]
    )


@pytest.mark.parametrize("family", ["deforming_plate", "sphere_simple", "abcd", "abcd_xl"])
def test_every_preset_takes_a_training_step(family, tmp_path):
    """The full-size preset on a structured scene of its family's kind: finite loss, and a step that lowers it."""
    torch.manual_seed(0)
    path = write(tmp_path / "data.h5", family)
    with Dataset(path) as dataset:
        material = trajectory(family).scene.material
        config = PRESETS[family].model.resolve(
            DataFacts.of(dataset.info, () if material is None else ("stiffness",), 0.08)
        )
    assert config.data.stress == {"deforming_plate": "node", "abcd_xl": "element"}.get(family, "none")
    model, pairs = build_model(replace(config, dropout=0.0)), sampler(path, config)
    model.fit_statistics(pairs.batch(i) for i in range(3))
    batch, target = pairs.batch(0)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, weight_decay=0.0)
    losses = []
    for _ in range(4):
        optimizer.zero_grad()
        loss = model.loss(model(batch), batch, target)["loss"]
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert all(np.isfinite(losses)) and losses[-1] < losses[0], losses
    without = [name for name, p in model.named_parameters() if p.grad is None]
    assert not without, without


BACKEND_CASES = [
    (family, changes)
    for family in ("deforming_plate", "sphere_simple", "abcd", "abcd_xl")
    for changes in ({}, RELATIVE, EXCHANGES)
]


def outputs_and_gradients(family: str, changes: dict) -> dict[str, torch.Tensor]:
    """Of a small model of a family on two scenes."""
    deep = {"L_cell": 7, "l_ocnn": 3} if family == "abcd_xl" else {}
    config = small(family, dropout=0.0, **changes, **deep)
    torch.manual_seed(1)
    model = build_model(config)
    out = model(batch_of(config, 0, 1, family=family))
    value = out.motion.square().sum() + sum(x.square().sum() for x in out.fields.values())
    value.backward()
    gradient = torch.cat([p.grad.flatten() for p in model.parameters()])
    return {"motion": out.motion.detach().contiguous(), "gradient": gradient}


@pytest.fixture(scope="module")
def by_backend(tmp_path_factory) -> dict[str, dict[str, torch.Tensor]]:
    """The outputs and gradients of all cases, named "motion 0" and so on, by each backend in a process of its own.

    Torch computes with the processor's best instructions, and without: where rounding alone says on which side of a
    ReLU's kink a number lies, the gradient has two values, and the two often differ.
    """
    folder = tmp_path_factory.mktemp("backends")
    code = """
import sys
from safetensors.torch import save_file
sys.path[:0] = ["tests", "tests/models"]
from test_ast import *
cases = [outputs_and_gradients(*case) for case in BACKEND_CASES]
save_file({f"{name} {number}": x for number, case in enumerate(cases) for name, x in case.items()}, PATH)
"""
    backends = {"c": {}, "torch": {}, "torch, plain": {"ATEN_CPU_CAPABILITY": "default"}}
    for backend, variables in backends.items():
        run_python(f"PATH = {str(folder / backend)!r}\n{code}", AST_SIM_BACKEND=backend.split(",")[0], **variables)
    return {backend: load_file(folder / backend) for backend in backends}


@pytest.mark.parametrize("number", range(len(BACKEND_CASES)), ids=[str(case) for case in BACKEND_CASES])
def test_c_core_and_torch_composition_agree(number, by_backend):
    """The same weights and batch give the same outputs and gradients on both backends, for each parameter there is."""
    for name in (f"motion {number}", f"gradient {number}"):
        ours, *references = (by_backend[backend][name] for backend in ("c", "torch", "torch, plain"))
        off = [float((ours - there).abs().max() / there.abs().max()) for there in references]
        assert min(off) <= 2e-5, off


def test_scene_alone_equals_scene_in_a_batch():
    torch.manual_seed(0)
    config = small("deforming_plate")
    model = build_model(config).eval()
    both, alone = model(batch_of(config, 0, 1)), [model(batch_of(config, seed)) for seed in (0, 1)]
    for values in (lambda x: x.motion, lambda x: x.fields["stress"]):
        torch.testing.assert_close(values(both), torch.cat(list(map(values, alone))), rtol=1e-4, atol=1e-5)


def test_bitwise_equal_from_run_to_run():
    """Outputs and gradients, with dropout, for one number of threads (torch's own products depend on that number)."""
    torch.manual_seed(0)
    config = small("deforming_plate", dropout=0.1)
    model, batch = build_model(config), batch_of(small("deforming_plate"), 0, 1)

    def step():
        torch.manual_seed(5)
        model.zero_grad()
        out = model(batch)
        (out.motion.square().sum() + out.fields["stress"].sum()).backward()
        return [out.motion.detach(), *(p.grad.clone() for p in model.parameters())]

    for first, second in zip(step(), step(), strict=True):
        assert torch.equal(first, second)


def test_bodies_exchange_information_through_cells():
    """A change of the obstacle's motion changes the plate's prediction, though no edge joins them."""
    torch.manual_seed(0)
    config = small("deforming_plate")
    model = build_model(config).eval()
    batch = batch_of(config, 0)
    obstacle = batch.graph.node_type == NodeType.OBSTACLE
    moved = replace(batch, boundary_motion=torch.where(obstacle[:, None], 0.05, batch.boundary_motion))
    difference = (model(moved).motion - model(batch).motion)[batch.graph.normal_nodes].abs().amax(dim=1)
    assert float(difference.detach().min()) > 0


def test_more_steps_on_the_mesh():
    """Steps whose last norm gives zero change nothing; each of the others changes the outputs."""
    torch.manual_seed(0)
    config = small("deforming_plate", element_inputs=(), mesh_steps=2)
    model, plain = build_model(config).eval(), build_model(replace(config, mesh_steps=0)).eval()
    missing, unexpected = plain.load_state_dict(model.state_dict(), strict=False)
    assert not missing and {name.split(".")[0] for name in unexpected} == {"before_cells", "after_cells"}
    batch = batch_of(config, 0)
    steps = [*model.before_cells, *model.after_cells]
    assert len(steps) == 4
    with torch.no_grad():
        for step in steps:
            torch.nn.init.zeros_(step.norm_v.weight)
        silent = model(batch).motion
        torch.testing.assert_close(silent, plain(batch).motion, rtol=0, atol=1e-6)
        for step in steps:
            torch.nn.init.ones_(step.norm_v.weight)
            assert float((model(batch).motion - silent).abs().max()) > 1e-3
            torch.nn.init.zeros_(step.norm_v.weight)


@pytest.mark.parametrize("changes", [{"mesh_steps": -1, "element_inputs": ()}, {"mesh_steps": 1}])
def test_steps_on_the_mesh_that_there_cannot_be(changes):
    with pytest.raises(
        ConfigError,
        match="model.mesh_steps is -1; it must be at least 0|model.mesh_steps must be 0 with element_inputs",
    ):
        small("deforming_plate", **changes)


def test_message_passing_is_the_formula():
    """Split first layer and folded encoder against LN(f_e([e, v_s, v_r])) and LN(f_v([v_r, sum])) as written."""
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(1)
    senders, receivers = (
        torch.randint(0, 9, (40,), generator=generator),
        torch.randint(0, 7, (40,), generator=generator),
    )
    edges = EdgeSet.from_pairs(senders, receivers, 9, 7)
    v_s, v_r, raw = torch.randn(9, 16).double(), torch.randn(7, 16).double(), torch.randn(40, 8).double()
    for residual in (False, True):
        step = MessagePassing(ASTConfig(hidden=16), 8, residual).double()
        for p in step.parameters():
            torch.nn.init.normal_(p)
        e = step.edge_encoder(raw)
        message = step.norm_e(step.f_e(torch.cat([e, v_s[edges.senders], v_r[edges.receivers]], dim=1)))
        total = torch.zeros(7, 16).double().index_add_(0, edges.receivers, message)
        expected = step.norm_v(step.f_v(torch.cat([v_r, total], dim=1))) + (v_r if residual else 0)
        torch.testing.assert_close(step(edges, v_s, v_r, raw), expected, rtol=1e-10, atol=1e-10)
    free = MessagePassing(ASTConfig(hidden=16, factorized=False), 0, False).double()
    message = free.norm_e(free.f_e(torch.cat([v_s[edges.senders], v_r[edges.receivers]], dim=1)))
    total = torch.zeros(7, 16).double().index_add_(0, edges.receivers, message)
    torch.testing.assert_close(free(edges, v_s, v_r), free.norm_v(free.f_v(torch.cat([v_r, total], dim=1))))


def test_attention_block_is_the_formula():
    torch.manual_seed(0)
    config = small("deforming_plate", dropout=0.0)
    block = AttentionBlock(config, 32, 32)
    x, context = torch.randn(5, 32), torch.randn(11, 32)
    out = block(Vectors(x, torch.tensor([0, 5])), Vectors(context, torch.tensor([0, 11]))).x
    q = block.query(block.norm(x)).view(5, 2, 16).transpose(0, 1)
    k, v = block.key_value(block.norm_context(context)).view(11, 2, 2, 16).permute(1, 2, 0, 3)
    mixed = ((q @ k.transpose(1, 2) / 4).softmax(-1) @ v).transpose(0, 1).reshape(5, 32)
    y = x + block.out(mixed)
    a, b = block.feed_forward.first(block.feed_forward.norm(y)).chunk(2, dim=1)
    torch.testing.assert_close(out, y + block.feed_forward.second(a * F.gelu(b)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rotates", [True, False])
@pytest.mark.parametrize("to_itself", [True, False])
def test_a_block_at_once_is_the_block_in_steps_and_follows_its_parameters(to_itself, rotates):
    torch.manual_seed(0)
    block = AttentionBlock(small("deforming_plate", dropout=0.0), 32, None if to_itself else 48)
    vectors, context = (
        Vectors(
            torch.randn(n, width),
            torch.tensor([0, 5, n]),
            rotations(torch.randn(n, 3).double(), 16) if rotates else None,
        )
        for n, width in ((9, 32), (11, 48))
    )
    given = (vectors,) if to_itself else (vectors, context)
    for change in (0.0, 0.3):
        with torch.no_grad():
            for parameter in block.parameters():
                parameter.add_(change * torch.randn(parameter.shape))
            at_once = block(*given).x
        torch.testing.assert_close(at_once, block(*given).x.detach(), rtol=1e-5, atol=1e-5)


def test_rotations_turn_each_pair_by_its_angle():
    """(a, b) as a rotation matrix turns it by pi 2^-j x; two pairs of eight are left over."""
    x, place = torch.randn(6, 2, 16), torch.randn(6, 3).double() * 5
    turned = rotated(x, rotations(place, 16))
    for axis in range(3):
        for j in range(2):
            pair = 2 * axis + j
            angle = (torch.pi * 0.5**j * place[:, None, axis]).float()
            a, b = x[:, :, 2 * pair], x[:, :, 2 * pair + 1]
            expected = torch.stack([a * angle.cos() - b * angle.sin(), a * angle.sin() + b * angle.cos()], dim=2)
            torch.testing.assert_close(turned[:, :, 2 * pair : 2 * pair + 2], expected, rtol=0, atol=1e-5)
    assert torch.equal(turned[:, :, 12:], x[:, :, 12:])


def test_rotations_far_from_the_centre():
    """2^20 cells away, the farthest that there is, the way between two places is what it is near the centre."""
    near = torch.rand(5, 3, dtype=torch.float64)
    far = near + 2**20
    q, k = torch.randn(5, 1, 32), torch.randn(5, 1, 32)

    def products(at):
        return (rotated(q, rotations(at, 32)) * rotated(k, rotations(at.flip(0), 32))).sum(dim=2)

    torch.testing.assert_close(products(far), products(near), rtol=0, atol=1e-5)


@pytest.mark.parametrize("changes, follows", [({}, False), (RELATIVE, True), (EXCHANGES, True)])
def test_relative_places_follow_a_scene_that_is_moved_by_whole_cells(changes, follows):
    torch.manual_seed(0)
    config = small("deforming_plate", l_ocnn=1, **changes)
    model, batch = build_model(config).eval(), batch_of(config, 0)
    way = 2 * config.cell_side * torch.tensor([1.0, -2.0, 1.0])  # in whole coarse cells
    rest = batch.graph.rest_position + way
    moved = replace(batch, graph=replace(batch.graph, rest_position=rest), position=batch.position + way)
    with torch.no_grad():
        difference = model(moved).motion - model(batch).motion
    assert (float(difference.abs().max()) < 1e-4) == follows, difference.abs().max()


def test_places_of_nodes_and_cells_are_measured_alike():
    """A node in the middle of a coarse cell is where the cell is, also after the domain has grown."""
    config = small(
        "deforming_plate", L_cell=4, l_ocnn=1, data=DataFacts(domain_center=(1.0, 2.0, 3.0), domain_half_width=2.0)
    )
    side = 2 * config.cell_side
    middle = torch.tensor([[0.5, 0.5, 0.5], [-2.5, 1.5, 0.5], [5.5, -8.5, 3.5]])
    position = middle * side + torch.tensor(config.data.domain_center)
    for count, growth in ((2, 0), (3, 2)):
        cells = build_cells(config, position[:count], torch.tensor([0, count]), may_grow=True)
        assert cells.growth == growth
        coarse = cells.maps[0].coarse.node_cell[cells.finest.node_cell]
        assert torch.equal(cells.places()[coarse], middle[:count].double())
        torch.testing.assert_close(places(config, position[:count]), middle[:count].double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("exchanges", [1, 2, 3])
def test_every_part_of_the_exchanges_counts(exchanges):
    """Two blocks between one to three exchanges: each parameter has a gradient that is not zero."""
    torch.manual_seed(0)
    config = small("deforming_plate", dropout=0.0, places="relative", exchanges=exchanges)
    model = build_model(config)
    assert (len(model.processor), len(model.to_nodes), len(model.from_nodes)) == (2, exchanges, exchanges - 1)
    out = model(batch_of(config, 0))
    (out.motion.square().sum() + out.fields["stress"].square().sum()).backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not silent, silent


def test_nodes_of_a_cell_read_for_themselves():
    """Nodes of one cell that only differ in where they are learn different things from the tokens, by a step as small
    as the way between them."""
    torch.manual_seed(0)
    config = small("deforming_plate", **EXCHANGES)
    model = build_model(config).eval()
    tokens = Vectors(torch.randn(7, 32), torch.tensor([0, 7]), rotations(torch.randn(7, 3).double(), 16))
    x = torch.randn(32).expand(3, 32)
    place = torch.tensor([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1001, 0.0, 0.0]]).double()
    with torch.no_grad():
        out = model.to_nodes[0](Vectors(x, torch.tensor([0, 3]), rotations(place, 16)), tokens).x
    far, near = (float((out[i] - out[0]).norm()) for i in (1, 2))
    assert far > 1e-3 and near == pytest.approx(far / 1000, rel=0.3)


def test_random_weight_factorization():
    torch.manual_seed(0)
    layer = FactorizedLinear(400, 600)
    logs = layer.g.detach().log()
    assert abs(float(logs.mean()) - 1.0) < 0.02 and abs(float(logs.std()) - 0.1) < 0.01
    glorot = (6 / (400 + 600)) ** 0.5
    weight = layer.weight.detach()
    assert float(weight.abs().max()) <= glorot * 1.0001 and float(weight.std()) == pytest.approx(
        glorot / 3**0.5, rel=0.02
    )
    assert float(layer.bias.detach().abs().max()) == 0


def test_position_embedding_drops_constant_frequencies():
    """At cell centres of level 3 the frequencies 2^j pi with j >= 3 are constant; lower ones are not."""
    centers = (torch.arange(8) + 0.5) / 4 - 1
    for j in range(8):
        wave = torch.stack([torch.sin(2.0**j * torch.pi * centers), torch.cos(2.0**j * torch.pi * centers)])
        assert (float(wave.std(dim=1).max()) > 0.1) == (j < 3), j
    embedding = PositionEmbedding(16, level=3)
    assert embedding.project.in_features == 3 * (1 + 2 * 3)
    assert PositionEmbedding(16, level=12).project.in_features == 51
    x = torch.zeros(2, 16)
    inputs = torch.tensor([[0.25, -0.5, 0.75], [0.0, 0.0, 0.0]])
    phase = torch.cat(
        [inputs]
        + [f(inputs[:, :, None] * torch.pi * torch.tensor([1.0, 2, 4])).flatten(1) for f in (torch.sin, torch.cos)],
        1,
    )
    torch.testing.assert_close(embedding(x, inputs), embedding.project(phase))


def test_normalizers_by_hand():
    vector, scalar, constant = Normalizer("vector"), Normalizer("scalar"), Normalizer("scalar")
    vector.observe(torch.tensor([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]))
    scalar.observe(torch.tensor([[1.0], [2.0]]))
    scalar.observe(torch.tensor([[6.0]]))
    constant.observe(torch.full((5, 1), 7.0))
    for normalizer in (vector, scalar, constant):
        normalizer.fix()
    assert float(vector.mean) == 0 and float(vector.scale) == pytest.approx((25 / 6) ** 0.5)
    assert float(scalar.mean) == 3 and float(scalar.scale) == pytest.approx((14 / 3) ** 0.5)
    assert float(constant.mean) == 7 and float(constant.scale) == 7
    x = torch.randn(4, 1)
    torch.testing.assert_close(scalar.inverse(scalar(x)), x)


def test_statistics_do_not_suffer_cancellation():
    """1e6 samples around 1e4 with deviation 1: float32 sums of squares would lose all digits."""
    normalizer = Normalizer("scalar")
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        normalizer.observe(1e4 + torch.randn(100_000, generator=generator))
    normalizer.fix()
    assert float(normalizer.scale) == pytest.approx(1.0, rel=5e-3)


def test_loss_counts_the_right_nodes(tmp_path):
    torch.manual_seed(0)
    config = small("deforming_plate", dropout=0.0)
    path = write(tmp_path / "data.h5", "deforming_plate")
    model, pairs = build_model(config), sampler(path, config)
    model.fit_statistics(pairs.batch(i) for i in range(3))
    batch, target = pairs.batch(0)
    losses = model.loss(model(batch), batch, target, stress_weight=0.3)
    out = model(batch)
    normal, free = batch.graph.normal_nodes, batch.graph.node_type != NodeType.OBSTACLE
    motion = (out.motion - target.motion / model.motion_normalizer.scale)[normal].square().mean()
    stress = (out.fields["stress"] - model.stress_normalizer(target.fields["stress"]))[free].square().mean()
    torch.testing.assert_close(losses["motion"], motion)
    torch.testing.assert_close(losses["stress"], stress)
    torch.testing.assert_close(losses["loss"], motion + 0.3 * stress)
    assert "strain" not in losses
    weighed = model.loss(out, batch, target, stress_weight=0.3, strain_weight=2.0)
    torch.testing.assert_close(weighed["loss"], motion + 0.3 * stress + 2 * weighed["strain"])
    wrong = (model.motion_normalizer.scale * out.motion - target.motion).detach()
    wrong[batch.graph.prescribed] = 0
    rest = batch.graph.rest_position
    squares = []
    for element in batch.graph.elements[batch.graph.deforming_elements].tolist():
        for a, b in itertools.combinations(element, 2):
            length = float((rest[a] - rest[b]).norm())
            squares.append(float((wrong[a] - wrong[b]).square().mean()) / length**2)
    scale = float(model.strain_normalizer.scale)
    assert weighed["strain"].item() == pytest.approx(np.mean(squares) / scale**2, rel=1e-4)


def test_domain_grows_in_a_rollout_and_cells_keep_their_size():
    config = small("deforming_plate", L_cell=4)
    position = torch.rand(200, 3) * 0.8 - 0.4
    offsets = torch.tensor([0, 200])
    inside = build_cells(config, position, offsets, may_grow=True)
    far = torch.cat([position, torch.tensor([[2.5, 0.0, 0.0]])])
    grown = build_cells(config, far, torch.tensor([0, 201]), may_grow=True)
    assert (inside.growth, grown.growth) == (0, 2) and grown.finest.depth == 6

    def groups(cells):
        return {
            tuple(nodes.tolist()) for nodes in cells.finest.node_order.split(cells.finest.node_offsets.diff().tolist())
        }

    assert groups(grown) == groups(inside) | {(200,)}
    centers = grown.centers()[grown.finest.node_cell]
    assert float((centers - far).abs().max()) <= 2.0**-4 + 1e-6
    with pytest.raises(DatasetError, match=r"positions\[200\].*outside.*domain_half_width"):
        build_cells(config, far, torch.tensor([0, 201]), may_grow=False)
    with pytest.raises(RolloutError, match="pass level 21"):
        build_cells(config, far * 1e7, torch.tensor([0, 201]), may_grow=True)
    far[3, 1] = float("nan")
    with pytest.raises(RolloutError, match=r"positions\[3\].*not finite"):
        build_cells(config, far, torch.tensor([0, 201]), may_grow=True)


def test_mesh_and_cell_edges():
    position = torch.rand(50, 3) - 0.5
    cells = build_cells(small("deforming_plate", L_cell=3), position, torch.tensor([0, 30, 50]), may_grow=False)
    num = len(cells.finest.keys)
    nodes = torch.arange(50)
    again = EdgeSet.from_pairs(nodes, cells.finest.node_cell, 50, num)
    back = EdgeSet.from_pairs(cells.finest.node_cell, nodes, num, 50)
    for ours, expected in ((cells.from_mesh(), again), (cells.to_mesh(), back)):
        for name in ("senders", "receivers", "receiver_offsets"):
            assert torch.equal(getattr(ours, name), getattr(expected, name)), name
        assert ours.num_senders == expected.num_senders


def test_what_the_dataset_decides():
    """Level by mesh spacing, a stress on elements with the element nodes that it needs, domain and kind of dynamics."""
    info = DatasetInfo("own", "quasi_static", "element", (1.0, 2.0, 3.0), 4.0, 0.01, 0.0)
    tiny = PRESETS["tiny"].model
    config = tiny.resolve(DataFacts.of(info, ("young", "poisson"), mesh_spacing=0.1))
    assert config.element_inputs == ("displacement", "material") and config.data.stress == "element"
    assert config.node_inputs == ("displacement", "proximity", "material", "out_of_balance")
    assert config.data.material_width == 2
    assert (config.places, config.exchanges) == ("relative", 2)
    assert config.data.domain_center == (1.0, 2.0, 3.0) and config.data.domain_half_width == 4.0
    assert config.L_cell == 6 and config.cell_side == pytest.approx(0.125)  # 1 + log2(4 / 0.15) = 5.7
    nodal = tiny.resolve(DataFacts.of(replace(info, stress_location="node"), (), mesh_spacing=0.1))
    assert nodal.element_inputs == () and nodal.data.stress == "node"
    moving = DataFacts.of(replace(info, integration="dynamic"), (), mesh_spacing=0.1)
    dynamic = tiny.resolve(moving)
    assert dynamic.node_inputs == ("displacement", "velocity") and dynamic.element_inputs == ("displacement",)
    assert (dynamic.places, dynamic.exchanges) == ("absolute", 0)
    assert replace(tiny, places="absolute").resolve(DataFacts.of(info, (), 0.1)).exchanges == 0
    chosen = replace(tiny, places="relative", exchanges=1, node_inputs=(), element_inputs=("velocity",))
    found = chosen.resolve(moving)
    assert (found.places, found.exchanges) == ("relative", 1)
    assert found.node_inputs == () and found.element_inputs == ("velocity",)


def test_integration():
    quasi = build_model(small("deforming_plate"))
    dynamic = build_model(small("sphere_simple"))
    batch = batch_of(small("deforming_plate"), 0)
    motion = torch.randn_like(batch.position)
    assert torch.equal(quasi.integrate(batch, motion), batch.position + motion)
    moving = replace(batch, previous_position=batch.position - 0.25)
    torch.testing.assert_close(dynamic.integrate(moving, motion), batch.position + 0.25 + motion)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"node_inputs": ("displacment",)}, "displacment"),
        ({"head_dim": 24}, "multiple of 16"),
        ({"residual": ("m2x",)}, "m2x"),
        ({"L_cell": 3, "l_ocnn": 4}, "l_ocnn"),
        ({"exchanges": 1}, "model.places=relative"),
        ({"exchanges": -1, "places": "relative"}, "model.exchanges is -1"),
    ],
)
def test_settings_that_do_not_fit(changes, message):
    with pytest.raises(ConfigError, match=message):
        ASTConfig(**changes)


@pytest.mark.parametrize(
    "changes, stress, message",
    [
        ({"element_inputs": ("stress",)}, "node", "model.element_inputs: stress needs a dataset with stress on elem"),
        ({"element_inputs": ()}, "element", "what is predicted on elements needs some"),
        ({"element_inputs": ("velocity",)}, "node", "model.element_inputs: velocity is an input of dynamic scenes"),
        ({"node_inputs": ("velocity",)}, "node", "model.node_inputs: velocity is an input of dynamic scenes"),
        ({"node_inputs": ("material",)}, "none", "model.node_inputs: material is an input, but the dataset has no"),
        ({"exchanges": 1, "places": None}, "dynamic", "model.exchanges needs model.places=relative"),
    ],
)
def test_settings_that_the_data_does_not_fit(changes, stress, message):
    dynamic = stress == "dynamic"
    info = replace(toy.info(dynamic), stress_location="none" if dynamic else stress)
    with pytest.raises(ConfigError, match=message):
        ASTConfig(**changes).resolve(DataFacts.of(info, (), 0.1))
