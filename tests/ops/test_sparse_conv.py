"""sparse_conv and sparse_conv_transposed against a dense convolution, their compositions and their contracts."""

import pytest
import torch
from checks import assert_accurate, assert_same_for_threads, instruction_sets, misaligned_read_only, run_forked
from torch import Tensor
from torch.nn import functional as F

from ast_sim.ops import CellMap, octree, sparse_conv, sparse_conv_transposed
from ast_sim.ops import _sparse_conv as ops


def level(*nodes: int, depth: int = 4, seed: int = 0) -> CellMap:
    """The map from a level to the next coarser one, for scenes with these numbers of random nodes."""
    g = torch.Generator().manual_seed(seed)
    positions = 2 * torch.rand(sum(nodes), 3, generator=g) - 1
    return octree(positions, torch.tensor([0, *nodes]).cumsum(0), (0.0, 0.0, 0.0), 1.0, depth).coarsen()


def features(cells: int, weights: tuple[int, int], seed: int = 1) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(cells, weights[0], generator=g), torch.randn(27, *weights, generator=g)


def composed(map: CellMap):
    lists = (map.pair_offsets, map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine)
    return lambda x, weight, bias=None: ops._reference(x, weight, bias, False, *lists, len(map.coarse.keys))


def composed_transposed(map: CellMap):
    lists = (map.pair_offsets, map.coarse_by_fine, map.fine_by_fine, map.fine, map.coarse_index)
    return lambda x, weight, bias=None: ops._reference(x, weight, bias, False, *lists, map.num_fine)


CHANNELS = [(1, 1), (3, 5), (16, 8), (17, 33), (64, 64), (128, 96)]


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("nodes", [(1,), (2,), (300, 0, 5), (1500,)])
def test_accuracy(nodes, channels):
    map = level(*nodes)
    assert_accurate(lambda x, w: sparse_conv(x, w, map), composed(map), features(map.num_fine, channels))
    inputs = features(len(map.coarse.keys), channels)
    assert_accurate(lambda x, w: sparse_conv_transposed(x, w, map), composed_transposed(map), inputs)


@pytest.mark.parametrize("channels", [(4096, 8), (8, 4096)])
def test_accuracy_of_many_channels(channels):
    """A sum over channels is cut into chains, forward over x's channels and backward over the output's."""
    map = level(60)
    assert_accurate(lambda x, w: sparse_conv(x, w, map), composed(map), features(map.num_fine, channels))
    inputs = features(len(map.coarse.keys), channels)
    assert_accurate(lambda x, w: sparse_conv_transposed(x, w, map), composed_transposed(map), inputs)


def test_dense_convolution():
    """Zeros in place of the absent cells, kernel 3, stride 2, padding 1."""
    map, depth = level(700, depth=3), 3
    fine_keys = octree_keys(700, depth)
    x, weight = features(map.num_fine, (5, 7))
    grid = torch.zeros(1, 5, 8, 8, 8, dtype=torch.float64)
    grid[0, :, *fine_keys.T] = x.double().T
    kernel = weight.double().reshape(3, 3, 3, 5, 7).permute(4, 3, 0, 1, 2)
    dense = F.conv3d(grid, kernel, stride=2, padding=1)[0]
    coarse = map.coarse.coordinates().long()
    torch.testing.assert_close(sparse_conv(x, weight, map).double(), dense[:, *coarse.T].T, rtol=1e-5, atol=1e-5)
    y, weight = features(len(coarse), (7, 5))
    grid = torch.zeros(1, 7, 4, 4, 4, dtype=torch.float64)
    grid[0, :, *coarse.T] = y.double().T
    kernel = weight.double().reshape(3, 3, 3, 7, 5).permute(3, 4, 0, 1, 2)
    dense = F.conv_transpose3d(grid, kernel, stride=2, padding=1, output_padding=1)[0]
    expected = dense[:, *fine_keys.T].T
    torch.testing.assert_close(sparse_conv_transposed(y, weight, map).double(), expected, rtol=1e-5, atol=1e-5)


def octree_keys(nodes: int, depth: int) -> Tensor:
    """[C, 3]: the coordinates of the fine cells of level(nodes, depth=depth)."""
    positions = 2 * torch.rand(nodes, 3, generator=torch.Generator().manual_seed(0)) - 1
    tree = octree(positions, torch.tensor([0, nodes]), (0.0, 0.0, 0.0), 1.0, depth)
    return tree.coordinates().long()


def test_transposed_form_is_the_adjoint():
    map = level(800, 300)
    x, weight = features(map.num_fine, (12, 20))
    y, _ = features(len(map.coarse.keys), (20, 12))
    left = (sparse_conv(x, weight, map).double() * y).sum()
    right = (x * sparse_conv_transposed(y, weight.mT.contiguous(), map).double()).sum()
    assert abs(left - right) <= 1e-5 * abs(left)


def test_absent_cells_and_other_scenes_cannot_leak():
    map = level(200, 200)
    x, weight = features(map.num_fine, (4, 6))
    boundary = int(map.coarse.cell_offsets[1])
    children = int(map.coarse.node_offsets[boundary])
    expected = sparse_conv(x, weight, map)
    x[children:] = torch.nan
    out = sparse_conv(x, weight, map)
    assert torch.equal(out[:boundary], expected[:boundary]) and out[boundary:].isnan().any()
    one = (map.fine == 3).nonzero()[0]
    x[:children] = 1.0
    x[3] = torch.inf
    reached = sparse_conv(x, weight, map)[:boundary].isfinite().all(1).logical_not()
    coarse = map.coarse_index[map.fine == 3].unique()
    assert len(one) and torch.equal(reached.nonzero()[:, 0], coarse)


def test_scene_alone_equals_scene_in_batch():
    positions = 2 * torch.rand(900, 3) - 1
    box = ((0.0, 0.0, 0.0), 1.0, 4)
    both = octree(positions, torch.tensor([0, 400, 400, 900]), *box).coarsen()
    alone = octree(positions[400:], torch.tensor([0, 500]), *box).coarsen()
    x, weight = features(both.num_fine, (24, 40))
    first, first_coarse = both.num_fine - alone.num_fine, int(both.coarse.cell_offsets[2])
    mine = x[first:].clone().requires_grad_()
    x.requires_grad_()
    out, expected = sparse_conv(mine, weight, alone), sparse_conv(x, weight, both)
    assert torch.equal(out, expected[first_coarse:])
    dout = torch.randn_like(expected)
    (dx,), (expected_dx,) = (
        torch.autograd.grad(out, mine, dout[first_coarse:]),
        torch.autograd.grad(expected, x, dout),
    )
    assert torch.equal(dx, expected_dx[first:])


def test_empty_levels_give_empty_outputs_and_zero_gradients():
    map = level(0, 0)
    x, weight = features(0, (4, 6))
    x.requires_grad_(), weight.requires_grad_()
    for function in (sparse_conv, sparse_conv_transposed):
        out = function(x, weight, map)
        assert out.shape == (0, 6)
        gradients = torch.autograd.grad(out.sum(), (x, weight))
        assert gradients[0].shape == (0, 4) and torch.equal(gradients[1], torch.zeros(27, 4, 6))


@pytest.mark.parametrize("channels", [(0, 3), (3, 0)])
def test_no_channels(channels):
    map = level(50)
    x, weight = features(map.num_fine, channels)
    assert torch.equal(sparse_conv(x, weight, map), torch.zeros(len(map.coarse.keys), channels[1]))


def test_bitwise_equal_for_threads():
    for nodes, depth in ((60, 3), (6000, 6), (60000, 5)):  # the last has groups that are cut into parts
        map = level(nodes, depth=depth)
        x, weight = features(map.num_fine, (40, 24))
        dout = torch.randn(len(map.coarse.keys), 24)

        def function(x=x, weight=weight, dout=dout, map=map):
            leaves = [x.clone().requires_grad_(), weight.clone().requires_grad_(), torch.zeros(24, requires_grad=True)]
            out = with_bias(sparse_conv, map)(*leaves)
            return out, *torch.autograd.grad(out, leaves, dout)

        assert_same_for_threads(function)


CODE = """
import sys; sys.path[:0] = ["tests", "tests/ops"]
from checks import assert_accurate
import torch
from test_sparse_conv import composed, features, level, sparse_conv, with_bias
map = level(700, 30)
for channels in ((3, 5), (64, 48)):
    inputs = (*features(map.num_fine, channels), torch.randn(channels[1]))
    assert_accurate(with_bias(sparse_conv, map), composed(map), inputs)
from ast_sim.ops.library import configuration
print(configuration()["instruction_set"])
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == isa


def test_opcheck():
    map = level(40)
    x, weight = (leaf.requires_grad_() for leaf in features(map.num_fine, (3, 5)))
    lists = (map.pair_offsets, map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine)
    for bias in (None, torch.randn(5, requires_grad=True)):
        torch.library.opcheck(ops._conv.overload, (x, weight, bias, False, *lists, len(map.coarse.keys)))
    dout = torch.randn(len(map.coarse.keys), 5)
    torch.library.opcheck(ops._conv_weight.overload, (x.detach(), dout, *lists[:3]))


def with_bias(function, map: CellMap):
    return lambda x, weight, bias: function(x, weight, map, bias)


@pytest.mark.parametrize("channels", [(1, 1), (3, 5), (17, 33), (64, 48)])
@pytest.mark.parametrize("nodes", [(1,), (700, 0, 5)])
def test_bias(nodes, channels):
    """Also rows without pairs hold the bias."""
    map = level(*nodes)
    bias = torch.linspace(-1, 2, channels[1])
    inputs = (*features(map.num_fine, channels), bias)
    assert_accurate(with_bias(sparse_conv, map), composed(map), inputs)
    inputs = (*features(len(map.coarse.keys), channels), bias)
    assert_accurate(with_bias(sparse_conv_transposed, map), composed_transposed(map), inputs)
    x, weight = features(map.num_fine, channels)
    none = torch.zeros(28, dtype=torch.int64), *[torch.zeros(0, dtype=torch.int64)] * 4
    assert torch.equal(ops._conv(x, weight, bias, False, *none, 7), bias.expand(7, -1))
    assert torch.equal(ops._conv(x, weight, None, False, *none, 7), torch.zeros(7, channels[1]))


def test_every_row_alone_gives_the_bits_it_gives_among_all():
    """Ranges, tiles and strips are cut by size: a cut never shows."""
    map = level(3000, depth=5)
    x, weight = features(map.num_fine, (40, 33))
    bias = torch.randn(33)
    expected = sparse_conv(x, weight, map, bias)
    for row in (0, 1, 700, len(expected) - 1):
        mine = map.coarse_index == row
        counts = torch.stack([mine[a:b].sum() for a, b in zip(map.pair_offsets, map.pair_offsets[1:], strict=False)])
        offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        sources = map.fine[mine]
        alone = ops._conv(x, weight, bias, False, offsets, sources, sources * 0, sources, sources * 0, 1)
        assert torch.equal(alone[0], expected[row])


def test_gradients_in_float64():
    map = level(12)
    x, weight = (leaf.double().requires_grad_() for leaf in features(map.num_fine, (2, 3)))
    assert torch.autograd.gradcheck(lambda x, w: sparse_conv(x, w, map), (x, weight))
    y, weight = (leaf.double().requires_grad_() for leaf in features(len(map.coarse.keys), (2, 3)))
    bias = torch.randn(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(with_bias(sparse_conv_transposed, map), (y, weight, bias))


@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (0, 2), (1, 2)])
def test_any_subset_requires_grad(wanted):
    map = level(100)
    x, weight = features(map.num_fine, (6, 7))
    inputs = (x, weight, torch.randn(7))
    every = [x.clone().requires_grad_() for x in inputs]
    with_bias(sparse_conv, map)(*every).square().sum().backward()
    for i in wanted:
        inputs[i].requires_grad_()
    with_bias(sparse_conv, map)(*inputs).square().sum().backward()
    for i in range(3):
        assert torch.equal(inputs[i].grad, every[i].grad) if i in wanted else inputs[i].grad is None


def test_unusual_layouts_and_unchanged_inputs():
    map = level(60)
    x, weight = features(map.num_fine, (8, 6))
    n, expected = len(x), sparse_conv(x, weight, map)
    wide = torch.randn(n, 16)
    wide[:, ::2] = x
    transposed = x.t().contiguous().t()
    for y in (wide[:, ::2], transposed, misaligned_read_only(x)):
        before = y.clone()
        assert torch.equal(sparse_conv(y, weight, map), expected) and torch.equal(y, before)
    one = x[:1].expand(n, 8)
    assert torch.equal(sparse_conv(one, weight, map), sparse_conv(one.clone(), weight, map))
    assert torch.equal(sparse_conv(x, weight.mT.contiguous().mT, map), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_name_op_argument_and_value(dtype):
    map = level(60)
    x, weight = (x.to(dtype) for x in features(map.num_fine, (8, 6)))
    lists = [map.pair_offsets, map.fine, map.coarse_index, map.coarse_by_fine, map.fine_by_fine]
    num = len(map.coarse.keys)

    def call(x=x, weight=weight, bias=None, num=num, **changes):
        return ops._conv(x, weight, bias, False, *[changes.get(str(i), value) for i, value in enumerate(lists)], num)

    changed = map.fine.clone()
    changed[5] = map.num_fine
    for message, wrong in {
        "x must have shape": lambda: call(x=x[0]),
        r"weight must have shape \[27, 8, O\], not \(26, 8, 6\)": lambda: call(weight=weight[1:]),
        r"weight must have shape \[27, 7, O\], not \(27, 8, 6\)": lambda: call(x=x[:, 1:]),
        r"bias must have shape \[6\], not \(5,\)": lambda: call(bias=x.new_zeros(5)),
        "pair_offsets must end at the number of rows": lambda: call(**{"0": map.pair_offsets.clamp(max=3)}),
        rf"source\[5\] = {map.num_fine} is not an index below {map.num_fine}": lambda: call(**{"1": changed}),
        rf"is not an index below {num - 1}": lambda: call(num=num - 1),
        f"x has {len(x) - 1} rows for {len(x)} fine cells": lambda: sparse_conv(x[1:], weight, map),
        f"x has {num + 1} rows for {num} coarse cells": lambda: sparse_conv_transposed(
            x.new_zeros(num + 1, 8), weight, map
        ),
    }.items():
        with pytest.raises(ValueError, match=message) as error:
            wrong()
        assert "sparse_conv" in str(error.value)
