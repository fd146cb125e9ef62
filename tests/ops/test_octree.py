"""The octree ops against their compositions, their contracts and a dictionary of cells."""

import numpy as np
import pytest
import torch
from checks import assert_same_everywhere, assert_same_for_threads, misaligned_read_only
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ast_sim.ops import CellMap, Octree, octree
from ast_sim.ops import _octree as ops

ORIGIN = (0.0, 0.0, 0.0)


def tensors(x: Octree | CellMap) -> list[Tensor]:
    values = [getattr(x, name) for name in x.__dataclass_fields__]
    return [v for v in values if isinstance(v, Tensor)] + [
        t for v in values if isinstance(v, Octree) for t in tensors(v)
    ]


def assert_equal(a: Octree | CellMap, b: Octree | CellMap) -> None:
    for x, y in zip(tensors(a), tensors(b), strict=True):
        assert x.dtype == y.dtype and torch.equal(x, y)


def composed(positions, offsets, center, half_width, depth) -> Octree:
    return Octree(*ops._octree.reference(positions, offsets, *center, half_width, depth), depth)


def composed_map(tree: Octree) -> CellMap:
    keys, cell_offsets, node_offsets, node_cell, *pairs = ops._coarsen.reference(tree.keys, tree.cell_offsets, 1)
    order = torch.arange(len(tree.keys))
    return CellMap(Octree(keys, cell_offsets, node_cell, order, node_offsets, tree.depth - 1), len(tree.keys), *pairs)


def assert_levels_agree(positions, offsets, center=ORIGIN, half_width=1.0, depth=5) -> None:
    tree = octree(positions, offsets, center, half_width, depth)
    assert_equal(tree, composed(positions, offsets, center, half_width, depth))
    for coarser in tree.coarsen_all(min(depth, 4)):
        assert_equal(coarser, composed_map(tree))
        assert_equal(coarser, tree.coarsen())
        tree = coarser.coarse


def cloud(kind: str, n: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    x = 2 * torch.rand(n, 3, generator=g) - 1
    if kind == "sphere":
        return 0.9 * torch.nn.functional.normalize(x, dim=1)
    if kind == "coincident":
        return x[:1].expand(n, 3).clone()
    if kind == "collinear":
        return x[:, :1] * torch.tensor([1.0, -0.5, 0.25])
    if kind == "planar":
        return x * torch.tensor([1.0, 0.0, 1.0])
    if kind == "faces":
        return torch.randint(-16, 17, (n, 3), generator=g) / 16
    if kind == "nextafter":
        faces = torch.randint(-16, 17, (n, 3), generator=g) / 16
        return torch.nextafter(faces, torch.randint(0, 2, (n, 3), generator=g) * 4.0 - 2)
    if kind == "tiny":
        return x * 1e-40
    return x


KINDS = ["random", "sphere", "coincident", "collinear", "planar", "faces", "nextafter", "tiny"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n, depth", [(0, 3), (1, 0), (2, 1), (65, 4), (1001, 12), (3000, 5), (300, 21)])
def test_kernel_equals_composition(kind, n, depth):
    cuts = sorted({0, n // 3, n // 2, n})
    offsets = torch.tensor([0, *cuts, n])  # with empty scenes before and after
    assert_levels_agree(cloud(kind, n), offsets, depth=depth)


@given(
    counts=st.lists(st.integers(0, 12), max_size=5),
    depth=st.integers(0, 21),
    kind=st.sampled_from(KINDS),
    center=st.tuples(*[st.floats(-100, 100)] * 3),
    half_width=st.floats(1e-3, 1e6),
    seed=st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=25, derandomize=True)
def test_any_batch_in_any_domain(counts, depth, kind, center, half_width, seed):
    offsets = torch.tensor([0, *np.cumsum(counts)], dtype=torch.int64)
    unit = 0.99 * cloud(kind, int(offsets[-1]), seed).double()
    positions = (torch.tensor(center, dtype=torch.float64) + half_width * unit).float()
    inside = ((positions.double() - torch.tensor(center)).abs() <= half_width).all()
    if inside:  # rounding to float32 may leave a small domain far from the origin
        assert_levels_agree(positions, offsets, center, half_width, depth)


@given(st.lists(st.tuples(*[st.floats(-1, 1, width=32)] * 3), max_size=30), st.integers(0, 21))
@settings(deadline=None, max_examples=100, derandomize=True)
def test_cells_and_nodes_by_a_dictionary(points, depth):
    tree = octree(
        torch.tensor(points, dtype=torch.float32).reshape(-1, 3), torch.tensor([0, len(points)]), ORIGIN, 1, depth
    )
    cells: dict[tuple, list[int]] = {}
    for node, p in enumerate(points):
        cell = tuple(min(int(np.floor((x + 1) / 2 * 2**depth)), 2**depth - 1) for x in p)
        cells.setdefault(cell, []).append(node)
    morton = {c: sum((c[a] >> i & 1) << (3 * i + 2 - a) for i in range(21) for a in range(3)) for c in cells}
    expected = sorted(cells, key=morton.get)
    assert tree.keys.tolist() == [morton[c] for c in expected]
    assert [tuple(c) for c in tree.coordinates().tolist()] == expected
    bounds = tree.node_offsets.tolist()
    nodes = [tree.node_order[a:b].tolist() for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    assert nodes == [cells[c] for c in expected]
    assert [expected[c] for c in tree.node_cell.tolist()] == [
        c for p in range(len(points)) for c in cells if p in cells[c]
    ]


def test_coordinates_and_centers_by_hand():
    tree = octree(torch.tensor([[0.9, -0.9, 0.1]]), torch.tensor([0, 1]), ORIGIN, 1, 2)
    assert tree.keys.tolist() == [0b101100]  # x = 11, y = 00, z = 10, x first
    assert tree.coordinates().tolist() == [[3, 0, 2]] and tree.coordinates().dtype == torch.int32
    assert tree.centers().tolist() == [[0.75, -0.75, 0.25]] and tree.centers().dtype == torch.float32
    assert octree(torch.zeros(1, 3), torch.tensor([0, 1]), ORIGIN, 1, 0).centers().tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("depth", [1, 12, 21])
def test_centers_are_exact_and_lie_in_their_cells(depth):
    positions = cloud("random", 200)
    tree = octree(positions, torch.tensor([0, 200]), ORIGIN, 1, depth)
    exact = (2 * tree.coordinates().double() + 1) / 2**depth - 1
    assert torch.equal(tree.centers().double(), exact)
    assert ((positions.double() - exact[tree.node_cell]).abs() <= 0.5**depth).all()


def test_the_far_face_belongs_to_the_last_cell_and_minus_zero_is_zero():
    ends = torch.tensor(
        [[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0], [-0.0, -0.0, -0.0], [0.0, 0.0, 0.0], [1.0000019, -1.0000019, 0.0]]
    )
    tree = octree(ends, torch.tensor([0, 5]), ORIGIN, 1, 3)
    assert tree.coordinates()[tree.node_cell].tolist() == [[7, 7, 7], [0, 0, 0], [4, 4, 4], [4, 4, 4], [7, 0, 4]]


def test_the_pairs_of_two_cells_by_hand():
    """Fine cells x = 1 and x = 2 of four; coarse cells 0 and 1. 1 = 2*0 + 1 = 2*1 - 1 and 2 = 2*1 + 0."""
    tree = octree(torch.tensor([[-0.25, -0.9, -0.9], [0.25, -0.9, -0.9]]), torch.tensor([0, 2]), ORIGIN, 1, 2)
    m = tree.coarsen()
    pairs = {
        k: (m.fine[a:b].tolist(), m.coarse_index[a:b].tolist())
        for k, (a, b) in enumerate(zip(m.pair_offsets[:-1].tolist(), m.pair_offsets[1:].tolist(), strict=True))
        if a != b
    }
    assert pairs == {4: ([0], [1]), 13: ([1], [1]), 22: ([0], [0])}
    assert m.coarse.keys.tolist() == [0, 4] and m.coarse.node_cell.tolist() == [0, 1] and m.num_fine == 2


def test_every_pair_of_a_full_grid():
    axis = (torch.arange(8) + 0.5) / 4 - 1
    tree = octree(torch.cartesian_prod(axis, axis, axis), torch.tensor([0, 512]), ORIGIN, 1, 3)
    m = tree.coarsen()
    per_axis = [3, 4, 4]  # fine = 2P + a within 0..7, for a = -1, 0, 1 and P = 0..3
    assert m.pair_offsets.diff().tolist() == [a * b * c for a in per_axis for b in per_axis for c in per_axis]
    k = torch.repeat_interleave(torch.arange(27), m.pair_offsets.diff())
    step = torch.stack([k // 9 - 1, k // 3 % 3 - 1, k % 3 - 1], 1)
    for fine, coarse in ((m.fine, m.coarse_index), (m.fine_by_fine, m.coarse_by_fine)):
        assert torch.equal(tree.coordinates()[fine].long(), 2 * m.coarse.coordinates()[coarse].long() + step)


def test_cells_of_different_scenes_never_pair():
    """Neighbouring cells in two scenes: each scene has the pairs that it has alone."""
    a, b = torch.tensor([[-0.25, -0.9, -0.9]]), torch.tensor([[0.25, -0.9, -0.9]])
    both = octree(torch.cat([a, b]), torch.tensor([0, 1, 2]), ORIGIN, 1, 2).coarsen()
    assert both.pair_offsets[-1] == 2 and both.fine.tolist() == [1, 0] and both.coarse_index.tolist() == [1, 0]


def test_scene_alone_equals_scene_in_batch():
    parts = [cloud("sphere", 700, 1), cloud("random", 0), cloud("planar", 900, 2), cloud("random", 1, 3)]
    offsets = torch.tensor([0, *np.cumsum([len(p) for p in parts])])
    batch = octree(torch.cat(parts), offsets, ORIGIN, 1, 6)
    m = batch.coarsen()
    scene_of = torch.repeat_interleave(torch.arange(4), batch.cell_offsets.diff())
    for s, part in enumerate(parts):
        alone = octree(part, torch.tensor([0, len(part)]), ORIGIN, 1, 6)
        cells, nodes = slice(*batch.cell_offsets[s : s + 2].tolist()), slice(*offsets[s : s + 2].tolist())
        first = int(batch.cell_offsets[s])
        assert torch.equal(batch.keys[cells], alone.keys)
        assert torch.equal(batch.node_cell[nodes] - first, alone.node_cell)
        assert torch.equal(batch.node_order[nodes] - offsets[s], alone.node_order)
        own, alone_map = scene_of[m.fine] == s, alone.coarsen()
        assert torch.equal(m.fine[own] - first, alone_map.fine)
        assert torch.equal(m.coarse_index[own] - m.coarse.cell_offsets[s], alone_map.coarse_index)


def test_the_order_is_stable():
    tree = octree(torch.tensor([[0.5] * 3, [-0.5] * 3] * 50), torch.tensor([0, 100]), ORIGIN, 1, 1)
    assert tree.node_order.tolist() == [*range(1, 100, 2), *range(0, 100, 2)]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_other_dtypes_take_the_composition(dtype):
    positions, offsets = cloud("random", 50).to(dtype), torch.tensor([0, 20, 50])
    assert_equal(octree(positions, offsets, ORIGIN, 1, 6), composed(positions, offsets, ORIGIN, 1, 6))


def test_bitwise_equal_for_threads():
    positions, offsets = cloud("sphere", 50000), torch.tensor([0, 30000, 30000, 50000])

    def run():
        tree = octree(positions, offsets, ORIGIN, 1, 12)
        return [t for x in (tree, tree.coarsen(), tree.coarsen().coarse.coarsen()) for t in tensors(x)]

    assert_same_for_threads(run)


CODE = """
import hashlib, torch
from ast_sim.ops._octree import octree
g = torch.Generator().manual_seed(5)
digest = hashlib.sha256()
for depth in (4, 12, 21):
    tree = octree(2 * torch.rand(20001, 3, generator=g) - 1, torch.tensor([0, 9, 9, 20001]), (0, 0, 0), 1, depth)
    m = tree.coarsen_all(2)[1]
    for x in (tree.keys, tree.cell_offsets, tree.node_cell, tree.node_order, tree.node_offsets, tree.coordinates()):
        digest.update(x.numpy().tobytes())
    for x in (m.coarse.keys, m.pair_offsets, m.fine, m.coarse_index, m.fine_by_fine, m.coarse_by_fine):
        digest.update(x.numpy().tobytes())
print(digest.hexdigest())
"""


def test_every_instruction_set_and_backend():
    assert_same_everywhere(CODE)


def test_opcheck():
    positions, offsets = cloud("random", 40).requires_grad_(), torch.tensor([0, 15, 40])
    tree = octree(positions, offsets, ORIGIN, 1, 3)
    torch.library.opcheck(ops._octree.overload, (positions, offsets, *ORIGIN, 1.0, 3))
    torch.library.opcheck(ops._coordinates.overload, (tree.keys,))
    torch.library.opcheck(ops._coarsen.overload, (tree.keys, tree.cell_offsets, 2))


def test_traced_sizes_depend_on_data():
    @torch.compile(backend="eager", fullgraph=True)
    def cells(positions, offsets):
        tree = octree(positions, offsets, ORIGIN, 1, 4)
        return tree.coarsen().coarse.centers()

    offsets = torch.tensor([0, 30])
    for seed in range(2):
        positions = cloud("random", 30, seed)
        assert torch.equal(
            cells(positions, offsets), octree(positions, offsets, ORIGIN, 1, 4).coarsen().coarse.centers()
        )


def test_unusual_layouts_and_unchanged_inputs():
    positions, offsets = cloud("random", 60), torch.tensor([0, 60])
    expected = octree(positions, offsets, ORIGIN, 1, 4)
    read_only = misaligned_read_only(positions)
    transposed, strided = positions.t().contiguous().t(), torch.stack([positions, positions], 1)[:, 1]
    for x in (transposed, strided, read_only, positions.clone().requires_grad_()):
        before = x.detach().clone()
        assert_equal(octree(x, offsets, ORIGIN, 1, 4), expected)
        assert torch.equal(x.detach(), before)
    expanded = positions[:1].expand(60, 3)
    assert_equal(octree(expanded, offsets, ORIGIN, 1, 4), octree(expanded.clone(), offsets, ORIGIN, 1, 4))
    keys, cell_offsets = expected.keys, expected.cell_offsets
    strided = ops._coarsen(torch.stack([keys, keys], 1)[:, 0], torch.stack([cell_offsets] * 2, 1)[:, 0], 2)
    assert all(torch.equal(a, b) for a, b in zip(strided, ops._coarsen(keys, cell_offsets, 2), strict=True))


POSITIONS = cloud("random", 30)
OFFSETS = torch.tensor([0, 10, 30])


def with_node(node: int, *position: float) -> Tensor:
    positions = POSITIONS.clone()
    positions[node] = torch.tensor(position)
    positions[-1] = float("nan")
    return positions


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            (with_node(7, 0.5, float("nan"), 0.5), OFFSETS, ORIGIN, 1, 3),
            r"positions\[7\] = \(0.5, nan, 0.5\) is not finite",
        ),
        (
            (with_node(0, 0.0, 1.0, -float("inf")), OFFSETS, ORIGIN, 1, 3),
            r"positions\[0\] = \(0, 1, -inf\) is not finite",
        ),
        (
            (with_node(9, 1.5, 0.0, 0.0), OFFSETS, ORIGIN, 1, 3),
            r"positions\[9\] = \(1.5, 0, 0\) lies outside .* half width 1",
        ),
        ((with_node(3, 0.0, 0.0, -1.00001), OFFSETS, ORIGIN, 1, 3), r"positions\[3\].* lies outside"),
        ((POSITIONS[:, :2], OFFSETS, ORIGIN, 1, 3), r"positions must have shape \[N, 3\], not \(30, 2\)"),
        ((POSITIONS.int(), OFFSETS, ORIGIN, 1, 3), "positions must be float32"),
        ((POSITIONS, OFFSETS.int(), ORIGIN, 1, 3), "offsets must be int64"),
        ((POSITIONS, OFFSETS[:0], ORIGIN, 1, 3), r"offsets must have shape \[B\+1\], not \(0,\)"),
        ((POSITIONS, OFFSETS + 1, ORIGIN, 1, 3), "offsets must start with 0"),
        ((POSITIONS, torch.tensor([0, 20, 10, 30]), ORIGIN, 1, 3), "offsets must never fall, but falls to 10 at 2"),
        ((POSITIONS, torch.tensor([0, 29]), ORIGIN, 1, 3), "offsets must end at the number of rows 30, not 29"),
        ((POSITIONS, OFFSETS, ORIGIN, 1, 22), "depth must lie in 0..21, not 22"),
        ((POSITIONS, OFFSETS, ORIGIN, 1, -1), "depth must lie in 0..21, not -1"),
        ((POSITIONS, OFFSETS, ORIGIN, 0, 3), "half_width must be positive and finite"),
        ((POSITIONS, OFFSETS, ORIGIN, float("nan"), 3), "half_width must be positive and finite"),
        ((POSITIONS, OFFSETS, (0, float("inf"), 0), 1, 3), "center must be finite"),
        ((POSITIONS, OFFSETS, (0, 0), 1, 3), "center must be three numbers, not 2"),
    ],
)
@pytest.mark.parametrize("build", [octree, composed])
def test_errors_name_op_argument_and_value(build, arguments, message):
    if build is composed and len(arguments[2]) != 3:
        return  # checked before either body
    with pytest.raises((ValueError, TypeError), match=f"octree: {message}"):
        build(*arguments)


@pytest.mark.parametrize("coarsen", [ops._coarsen, ops._coarsen.reference])
def test_errors_of_the_coarser_level(coarsen):
    with pytest.raises(ValueError, match="cell_offsets must end at the number of rows 2, not 1"):
        coarsen(torch.tensor([1, 2]), torch.tensor([0, 1]), 1)
    for keys, offsets, at in (([3, 3], [0, 2], 1), ([5, 4], [0, 2], 1), ([2, 1, 0], [0, 1, 3], 2), ([-1], [0, 1], 0)):
        with pytest.raises(ValueError, match=rf"keys\[{at}\] is {keys[at]}"):
            coarsen(torch.tensor(keys), torch.tensor(offsets), 1)


def test_no_level_lies_above_depth_zero():
    with pytest.raises(ValueError, match="depth 0 has no coarser level 1 steps up"):
        octree(POSITIONS, OFFSETS, ORIGIN, 1, 0).coarsen()
    for levels in (-1, 4):
        with pytest.raises(ValueError, match=f"depth 3 has no coarser level {levels} steps up"):
            octree(POSITIONS, OFFSETS, ORIGIN, 1, 3).coarsen_all(levels)
    assert octree(POSITIONS, OFFSETS, ORIGIN, 1, 3).coarsen_all(0) == []


@pytest.mark.parametrize("offsets", [[0], [0, 0], [0, 0, 0]])
def test_no_nodes_give_no_cells(offsets):
    tree = octree(torch.empty(0, 3), torch.tensor(offsets), ORIGIN, 1, 4)
    m = tree.coarsen()
    assert len(tree.keys) == len(m.coarse.keys) == len(m.fine) == 0 and tree.node_offsets.tolist() == [0]
    assert tree.cell_offsets.tolist() == m.coarse.cell_offsets.tolist() == offsets and tree.centers().shape == (0, 3)
    assert m.pair_offsets.tolist() == [0] * 28
