"""elastic_forces against its composition, forces known by hand, and the energy that it is the slope of."""

import itertools

import pytest
import torch
from checks import assert_accurate, assert_same_for_threads, instruction_sets, misaligned_read_only, run_forked
from torch import Tensor

from ast_sim.ops import TetrahedronSet, elastic_forces
from ast_sim.ops import _elastic_forces as elastic

UNIT = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
NONE = torch.empty(0, 4, dtype=torch.int64)


def box(*cells: int) -> tuple[Tensor, Tensor]:
    """Nodes and elements of a box of unit cubes, each cut into six tetrahedra around its diagonal."""
    axes = [torch.arange(n + 1) for n in cells]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    stride = torch.tensor([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    first = nodes[(nodes < torch.tensor(cells)).all(1)] @ stride
    corners = [
        torch.tensor([[0, 0, 0], *itertools.accumulate(torch.eye(3, dtype=torch.int64)[list(p)].tolist(), plus)])
        for p in itertools.permutations(range(3))
    ]
    elements = torch.stack([first[:, None] + corner @ stride for corner in corners], 1)
    return nodes.float(), elements.reshape(-1, 4)


def plus(a: list[int], b: list[int]) -> list[int]:
    return [x + y for x, y in zip(a, b, strict=True)]


def case(*cells: int, seed: int = 0, scale: float = 1.0, shift: float = 0.0):
    """position, rest_position, lame, tets of a crooked box that is pulled about."""
    g = torch.Generator().manual_seed(seed)
    nodes, elements = box(*cells)
    rest = nodes + 0.15 * torch.rand(nodes.shape, generator=g)
    position = rest + 0.15 * torch.randn(rest.shape, generator=g)
    lame = torch.rand(len(elements), 2, generator=g) + 0.5
    tets = TetrahedronSet.from_elements(elements[torch.randperm(len(elements), generator=g)], len(nodes))
    return position * scale + shift, rest * scale + shift, lame, tets


def composition(rest: Tensor, lame: Tensor, tets: TetrahedronSet):
    def forces(position: Tensor) -> Tensor:
        inputs = (rest.to(position.dtype), lame.to(position.dtype))
        return elastic._reference(position, *inputs, tets.elements, tets.node_order, tets.node_offsets)

    return forces


def energy(position: Tensor, rest: Tensor, lame: Tensor, tets: TetrahedronSet) -> Tensor:
    x, X = (y[tets.elements] for y in (position, rest))
    d, D = (y[:, 1:] - y[:, :1] for y in (x, X))  # edges as rows
    F = (torch.linalg.inv(D) @ d).mT
    G = (F.mT @ F - torch.eye(3, dtype=F.dtype)) / 2
    trace = G.diagonal(dim1=1, dim2=2).sum(1)
    return (torch.linalg.det(D).abs() / 6 * (lame[:, 0] / 2 * trace**2 + lame[:, 1] * (G**2).sum((1, 2)))).sum()


# ---- values ----


@pytest.mark.parametrize("cells", [(1, 1, 1), (1, 1, 2), (2, 3, 3), (5, 6, 7), (8, 8, 8)])
@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 1e3), (1e-3, 1.0)])
def test_accuracy_of_forces_and_gradient(cells, scale, shift):
    position, rest, lame, tets = case(*cells, scale=scale, shift=shift)
    assert_accurate(lambda x: elastic_forces(x, rest, lame, tets), composition(rest, lame, tets), [position])


@pytest.mark.parametrize("num", [1, 2, 3, 4, 7, 8, 9, 15, 16, 17, 31, 33, 2047, 2048, 2049])
def test_accuracy_around_every_block(num):
    position, rest, lame, tets = case(7, 7, 7)
    tets = TetrahedronSet.from_elements(tets.elements[:num], tets.num_nodes)
    assert_accurate(
        lambda x: elastic_forces(x, rest, lame[:num], tets), composition(rest, lame[:num], tets), [position]
    )


def test_accuracy_of_slivers():
    """Elements pressed flat to a thousandth of their width."""
    position, rest, lame, tets = case(3, 4, 5)
    flat = torch.tensor([1.0, 1.0, 1e-3])
    position, rest = rest * flat + 0.05 * (position - rest) * flat, rest * flat
    assert_accurate(lambda x: elastic_forces(x, rest, lame, tets), composition(rest, lame, tets), [position])


def test_uniaxial_stretch_of_a_unit_tetrahedron_by_hand():
    """F = diag(2, 1, 1), so G = diag(3/2, 0, 0), S = lambda 3/2 I + 2 mu G = diag(9, 6, 6), and f_j = -F S e_j / 6."""
    tets, lame = TetrahedronSet.from_elements(torch.tensor([[0, 1, 2, 3]]), 4), torch.tensor([[4.0, 1.0]])
    force = elastic_forces(UNIT * torch.tensor([2.0, 1.0, 1.0]), UNIT, lame, tets)
    expected = torch.tensor([[3.0, 1.0, 1.0], [-3.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    torch.testing.assert_close(force, expected, rtol=1e-6, atol=1e-6)
    turned = TetrahedronSet.from_elements(torch.tensor([[0, 2, 1, 3]]), 4)  # of negative volume
    torch.testing.assert_close(elastic_forces(UNIT * torch.tensor([2.0, 1.0, 1.0]), UNIT, lame, turned), expected)


def test_a_node_of_a_million_elements():
    """One chain of sums would be off by 1e-4: the forces are equal, and each addition is rounded the same way."""
    num = 1_000_000
    one, many = (TetrahedronSet.from_elements(torch.arange(4).expand(n, 4).clone(), 4) for n in (1, num))
    stretched = UNIT * torch.tensor([2.3, 1.7, 1.1])
    force, forces = (elastic_forces(stretched, UNIT, torch.ones(len(x), 2), x) for x in (one, many))
    torch.testing.assert_close(forces.double(), num * force.double(), rtol=1e-5, atol=0)


def test_a_cube_pulled_uniaxially_pulls_back_with_the_stress_on_its_faces():
    rest, elements = box(4, 4, 4)
    tets, lame = TetrahedronSet.from_elements(elements, len(rest)), torch.tensor([[1.0, 0.5]]).expand(len(elements), 2)
    force = elastic_forces(rest * torch.tensor([1.5, 1.0, 1.0]), rest, lame, tets)
    inside = ((rest > 0) & (rest < 4)).all(1)
    assert force[inside].abs().max() < 1e-5
    stress = 1.5 * (1.0 + 2 * 0.5) * (1.5**2 - 1) / 2  # first Piola-Kirchhoff, F S
    assert force[rest[:, 0] == 4, 0].sum().item() == pytest.approx(-stress * 16, rel=1e-5)
    assert force[rest[:, 0] == 0, 0].sum().item() == pytest.approx(stress * 16, rel=1e-5)


def test_a_rigid_motion_costs_nothing_and_rest_is_exactly_zero():
    _, rest, lame, tets = case(3, 3, 3)
    assert torch.equal(elastic_forces(rest, rest, lame, tets), torch.zeros_like(rest))
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))
    assert elastic_forces(rest @ q.T + 1, rest, lame, tets).abs().max() < 1e-5


def test_forces_and_moments_add_up_to_zero():
    position, rest, lame, tets = case(4, 5, 6)
    force = elastic_forces(position, rest, lame, tets).double()
    size = force.abs().sum()
    assert force.sum(0).abs().max() < 1e-6 * size
    assert torch.linalg.cross(position.double(), force).sum(0).abs().max() < 1e-5 * size


# ---- gradients ----


def test_forces_are_the_slope_of_the_energy_and_the_gradient_is_its_curvature():
    inputs = case(2, 3, 3)
    position, rest, lame = (x.double() for x in inputs[:3])
    position.requires_grad_()
    direction = torch.randn(position.shape, generator=torch.Generator().manual_seed(2))
    (slope,) = torch.autograd.grad(energy(position, rest, lame, inputs[3]), position, create_graph=True)
    (curvature,) = torch.autograd.grad(-slope, position, direction.double())
    exact = elastic_forces(position, rest, lame, inputs[3])
    torch.testing.assert_close(exact, -slope, rtol=1e-10, atol=1e-10)
    x = inputs[0].clone().requires_grad_()
    force = elastic_forces(x, *inputs[1:])
    (gradient,) = torch.autograd.grad(force, x, direction)
    torch.testing.assert_close(force.double(), -slope, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradient.double(), curvature, rtol=1e-4, atol=1e-4)


def test_gradients_in_float64():
    position, rest, lame, tets = case(1, 1, 2)
    rest, lame = rest.double(), lame.double()
    assert torch.autograd.gradcheck(
        lambda x: elastic_forces(x, rest, lame, tets), position.double().requires_grad_(), check_batched_grad=False
    )


@pytest.mark.parametrize("name, at", [("rest_position", 1), ("lame", 2)])
def test_other_gradients_are_refused(name, at):
    inputs = [*case(1, 1, 1)]
    inputs[at] = inputs[at].clone().requires_grad_()
    with pytest.raises(ValueError, match=f"elastic_forces: {name} requires a gradient"):
        elastic_forces(*inputs)
    with torch.no_grad():
        assert not elastic_forces(*inputs).requires_grad


# ---- extremes ----


@pytest.mark.parametrize("nodes", [0, 1, 5])
def test_without_elements(nodes):
    tets = TetrahedronSet.from_elements(NONE, nodes)
    x = torch.full((nodes, 3), float("nan"), requires_grad=True)
    force = elastic_forces(x, x.detach(), torch.empty(0, 2), tets)
    (gradient,) = torch.autograd.grad(force, x, torch.ones(nodes, 3))
    assert torch.equal(force, torch.zeros(nodes, 3)) and torch.equal(gradient, torch.zeros(nodes, 3))


def flattened(rest: Tensor, lame: Tensor) -> tuple[Tensor, Tensor]:
    return rest * torch.tensor([1.0, 0.0, 1.0]), lame


NOTHING = {
    "rigid": lambda rest, lame: (rest, lame * 0),
    "flat": flattened,
    "in a slanted plane": lambda rest, lame: (rest[:, [0, 0, 1]] * torch.tensor([1.0, -2.0, 1.0]), lame),
    "a point": lambda rest, lame: (rest * 0 + 3, lame),
    "not finite at rest": lambda rest, lame: (rest * float("nan"), lame),
    "subnormal": lambda rest, lame: (rest * 1e-44, lame),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("what", NOTHING)
def test_elements_without_volume_or_stiffness_contribute_exactly_nothing(what, dtype):
    position, rest, lame, tets = case(2, 2, 2)
    rest, lame = NOTHING[what](rest, lame)
    if what == "subnormal":
        rest = rest * (1 if dtype == torch.float32 else 1e-270)
    for value in (1.0, float("nan"), float("inf"), 1e30):
        x = torch.full_like(position, value).to(dtype).requires_grad_()
        force = elastic_forces(x, rest.to(dtype), lame.to(dtype), tets)
        (gradient,) = torch.autograd.grad(force, x, torch.full_like(force, value))
        assert torch.equal(force, torch.zeros_like(force)) and torch.equal(gradient, torch.zeros_like(force)), value


def test_an_element_with_two_equal_nodes_contributes_nothing():
    for corners in itertools.product(range(4), repeat=4):
        if len(set(corners)) < 4:
            tets = TetrahedronSet.from_elements(torch.tensor([corners]), 4)
            rest = torch.randn(4, 3, generator=torch.Generator().manual_seed(sum(corners)))
            for x in (rest, rest.double()):
                force = elastic_forces(3 * x, x, torch.ones(1, 2, dtype=x.dtype), tets)
                assert torch.equal(force, torch.zeros_like(x)), corners


def test_a_rigid_element_hides_nothing_of_its_neighbours():
    """Positions that are not finite reach the nodes of the elements that hold them, and no others."""
    position, rest, lame, tets = case(3, 3, 3)
    lame[::2] = 0
    expected = elastic_forces(position, rest, lame, tets)
    position[17] = float("nan")
    force = elastic_forces(position, rest, lame, tets)
    soft = tets.elements[(lame != 0).any(1)]
    reached = torch.zeros(len(rest), dtype=torch.bool)
    reached[soft[(soft == 17).any(1)].flatten()] = True
    assert torch.equal(force.isnan().all(1), reached) and torch.equal(force[~reached], expected[~reached])


@pytest.mark.parametrize("value", [0.0, 1.0, -7.5])
def test_coincident_guesses_give_no_force(value):
    position, rest, lame, tets = case(2, 2, 3)
    force = elastic_forces(torch.full_like(position, value), rest, lame, tets)
    assert torch.equal(force, torch.zeros_like(force))


@pytest.mark.parametrize("factor", [1e8, 1e12, 1e13, 1e30, 3e38])
def test_far_guesses_are_as_large_as_they_are(factor):
    """Beyond the range of float32 forces may be infinite or NaN, but not finite."""
    position, rest, lame, tets = case(2, 2, 2)
    x = position / position.abs().max() * factor
    exact = elastic_forces(x.double(), rest.double(), lame.double(), tets)
    force = elastic_forces(x, rest, lame, tets)
    inside = exact.abs() < 1e38
    largest = exact[inside].abs().max() if inside.any() else 1
    far = exact.abs() > 4e38
    assert not force[far].isfinite().any()
    if not far.any():
        assert (force - exact).abs().max() < 1e-5 * largest


# ---- sets of tetrahedra ----


def test_corners_are_sorted_by_node():
    tets = TetrahedronSet.from_elements(torch.tensor([[3, 1, 0, 4], [1, 4, 3, 5]]), 7)
    assert tets.node_order.tolist() == [2, 1, 4, 0, 6, 3, 5, 7]
    assert tets.node_offsets.tolist() == [0, 1, 3, 3, 5, 7, 8, 8]
    assert (len(tets), tets.num_nodes) == (2, 7)


def test_sets_as_one_equal_the_set_of_the_joined_mesh():
    parts = [
        case(1, 2, 3)[3],
        TetrahedronSet.from_elements(NONE, 0),
        TetrahedronSet.from_elements(NONE, 3),
        case(2, 1, 1)[3],
    ]
    starts = torch.tensor([0, *(p.num_nodes for p in parts)]).cumsum(0)
    elements = torch.cat([p.elements + start for p, start in zip(parts, starts[:-1], strict=True)])
    joined, both = TetrahedronSet.from_elements(elements, int(starts[-1])), TetrahedronSet.concatenate(parts)
    assert all(torch.equal(getattr(joined, x), getattr(both, x)) for x in ("elements", "node_order", "node_offsets"))
    assert TetrahedronSet.concatenate(parts[:1]) is parts[0]


def test_wrong_elements_are_named():
    with pytest.raises(ValueError, match=r"TetrahedronSet: elements\[1, 2\] = 9 is not an index below 9"):
        TetrahedronSet.from_elements(torch.tensor([[0, 1, 2, 3], [4, 5, 9, 7]]), 9)
    with pytest.raises(ValueError, match=r"elements\[0, 0\] = -1 is not an index"):
        TetrahedronSet.from_elements(torch.tensor([[-1, 1, 2, 3]]), 9)
    with pytest.raises(ValueError, match=r"elements must have shape \[E, 4\]"):
        TetrahedronSet.from_elements(torch.zeros(2, 8, dtype=torch.int64), 9)
    with pytest.raises(TypeError, match="elements must be int64"):
        TetrahedronSet.from_elements(torch.zeros(2, 4, dtype=torch.int32), 9)


# ---- as every op ----


def test_bitwise_equal_for_threads():
    position, rest, lame, tets = case(12, 12, 12)

    def results() -> list[Tensor]:
        x = position.clone().requires_grad_()
        force = elastic_forces(x, rest, lame, tets)
        return [force, *torch.autograd.grad(force, x, rest)]

    assert_same_for_threads(results)


def test_scene_alone_equals_scene_in_batch():
    scenes = [case(*cells, seed=i) for i, cells in enumerate([(1, 1, 1), (3, 2, 4), (1, 2, 1)])]
    tets = TetrahedronSet.concatenate([s[3] for s in scenes])
    batch = elastic_forces(*(torch.cat(x) for x in list(zip(*scenes, strict=True))[:3]), tets)
    assert torch.equal(batch, torch.cat([elastic_forces(*s) for s in scenes]))


CODE = """
import sys
sys.path.insert(0, "tests/ops"); sys.path.insert(0, "tests")
from test_elastic_forces import assert_accurate, case, composition, elastic_forces
position, rest, lame, tets = case(5, 5, 5)
assert_accurate(lambda x: elastic_forces(x, rest, lame, tets), composition(rest, lame, tets), [position])
print("accurate")
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == "accurate"


def test_opcheck():
    position, rest, lame, tets = case(1, 1, 2)
    arrays = (rest, lame, tets.elements, tets.node_order, tets.node_offsets)
    torch.library.opcheck(elastic._forces.overload, (position.requires_grad_(), *arrays))
    torch.library.opcheck(elastic._forces_backward.overload, (torch.randn(position.shape), position.detach(), *arrays))


def test_unusual_layouts_and_unchanged_inputs():
    position, rest, lame, tets = case(2, 2, 2)
    expected = elastic_forces(position, rest, lame, tets)
    wide = torch.randn(len(position), 6)
    wide[:, ::2] = position
    for x in (wide[:, ::2], position.t().contiguous().t(), misaligned_read_only(position)):
        before = x.clone()
        assert torch.equal(elastic_forces(x, rest, lame, tets), expected) and torch.equal(x, before)
    read_only = misaligned_read_only(rest), misaligned_read_only(lame)
    assert torch.equal(elastic_forces(position, *read_only, tets), expected)
    one = lame[:1].expand(len(tets), 2)
    assert torch.equal(elastic_forces(position, rest, one, tets), elastic_forces(position, rest, one.clone(), tets))


CHANGES = [
    (lambda x, X, m, e, o, f: (x[:, :2], X, m, e, o, f), r"position must have shape \[N, 3\]"),
    (lambda x, X, m, e, o, f: (x, X[:-1], m, e, o, f), "rest_position must have shape"),
    (lambda x, X, m, e, o, f: (x, X, m[:, :1], e, o, f), r"lame must have shape \[E, 2\]"),
    (lambda x, X, m, e, o, f: (x, X, m, e[:-1], o, f), "elements must have shape"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o[:-1], f), "node_order must have shape"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o, f[1:]), "node_offsets must have shape"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o, f.flip(0)), "node_offsets must start with 0"),
    (lambda x, X, m, e, o, f: (x, X, m, e - 1, o, f), "elements.*-1 is not an index below 27"),
    (lambda x, X, m, e, o, f: (x, X, m, e + 1, o, f), "elements.*27 is not an index below 27"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o.flip(0), f), "node_order"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o * 0, f), "node_order"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o + 192, f), "node_order"),
    (lambda x, X, m, e, o, f: (x, X, m, e, o - 10, f), "node_order"),
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("change, message", CHANGES)
def test_errors_name_op_argument_and_value(change, message, dtype):
    position, rest, lame, tets = case(2, 2, 2)
    floats = (x.to(dtype) for x in (position, rest, lame))
    arrays = change(*floats, tets.elements, tets.node_order, tets.node_offsets)
    with pytest.raises((ValueError, TypeError), match=message) as error:
        elastic._forces(*arrays)
    assert "elastic_forces" in str(error.value)
    with pytest.raises((ValueError, TypeError), match="elastic_forces_backward"):
        elastic._forces_backward(torch.zeros_like(arrays[0]), *arrays)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_cotangent_of_another_shape_is_refused(dtype):
    position, rest, lame, tets = case(1, 1, 1)
    floats = [x.to(dtype) for x in (position[:-1], position, rest, lame)]
    with pytest.raises(ValueError, match="elastic_forces_backward: dforce must have"):
        elastic._forces_backward(*floats, tets.elements, tets.node_order, tets.node_offsets)
