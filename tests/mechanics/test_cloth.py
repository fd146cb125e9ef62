"""The cloth potential: derivatives by central differences, closed forms of membrane and bending, invariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ast_sim.mechanics.elements.cloth import Cloth, ClothMaterial, bending_matrix
from ast_sim.mechanics.linear_algebra.sparsity import entry_dofs
from ast_sim.simulate.families.sphere_simple import sheet
from ast_sim.support.errors import SimulationError

STRETCH, POISSON, BENDING = 100.0, 0.3, 1e-2


def cloth(compression: float = 1.0, bending: float = BENDING, nodes: int = 30) -> tuple[Cloth, np.ndarray]:
    flat, triangles = sheet((1.0, 0.9), nodes, np.random.default_rng(0))
    rest = np.column_stack([flat, np.zeros(len(flat))])
    return Cloth(rest, triangles, ClothMaterial(STRETCH, POISSON, bending, 0.2, compression)), rest


def deformed(rest: np.ndarray) -> np.ndarray:
    """Taut, wrinkled and slack triangles."""
    return rest @ np.diag([1.03, 0.98, 1]) + np.random.default_rng(1).uniform(-0.02, 0.02, rest.shape)


def dense(sheet_: Cloth, position: np.ndarray, project: bool = False) -> np.ndarray:
    values, (rows, columns) = sheet_.hessian(sheet_.evaluate(position), project), entry_dofs(sheet_.entries())
    matrix = np.zeros((position.size, position.size))
    np.add.at(matrix, (rows, columns), values)
    off = rows != columns
    np.add.at(matrix, (columns[off], rows[off]), values[off])
    return matrix


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()


@pytest.mark.parametrize("compression", [1.0, 0.1, 0.0])
def test_derivatives_match_central_differences(compression):
    sheet_, rest = cloth(compression)
    position, step = deformed(rest), 1e-6
    gradient = sheet_.gradient(sheet_.evaluate(position))[0].ravel()
    matrix = dense(sheet_, position)
    slope, stiffness = np.empty(rest.size), np.empty((rest.size, rest.size))
    for dof in range(rest.size):
        shift = np.zeros(rest.size)
        shift[dof] = step
        up, down = (sheet_.evaluate(position + sign * shift.reshape(-1, 3)) for sign in (1, -1))
        slope[dof] = (up.energy - down.energy) / (2 * step)
        stiffness[dof] = (sheet_.gradient(up)[0] - sheet_.gradient(down)[0]).ravel() / (2 * step)
    np.testing.assert_allclose(slope, gradient, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(stiffness, matrix, atol=1e-6 * np.abs(matrix).max())


@pytest.mark.parametrize("compression", [1.0, 0.1])
def test_the_projected_hessian_is_positive_semi_definite_and_the_exact_one_where_that_is(compression):
    sheet_, rest = cloth(compression)
    crumpled, taut = deformed(rest), rest @ np.diag([1.1, 1.1, 1])
    scale = np.abs(dense(sheet_, crumpled)).max()
    assert np.linalg.eigvalsh(dense(sheet_, crumpled)).min() < -1e-3 * scale
    assert np.linalg.eigvalsh(dense(sheet_, crumpled, project=True)).min() > -1e-12 * scale
    np.testing.assert_allclose(dense(sheet_, taut, project=True), dense(sheet_, taut), atol=1e-12 * scale)


def test_without_stiffness_in_compression_the_hessian_is_positive_semi_definite_everywhere():
    sheet_, rest = cloth(compression=0.0)
    matrix = dense(sheet_, deformed(rest))
    assert np.linalg.eigvalsh(matrix).min() > -1e-12 * np.abs(matrix).max()


def test_rigid_motions_cost_nothing_and_turn_the_forces():
    sheet_, rest = cloth()
    turn = rotation((1, 2, 3), 2.0)
    moved = sheet_.evaluate(rest @ turn.T + [3, -1, 2])
    assert abs(moved.energy) < 1e-14 * sheet_.unit_energy
    assert np.abs(sheet_.gradient(moved)[0]).max() < 1e-12 * sheet_.unit_force
    position = deformed(rest)
    here, there = sheet_.evaluate(position), sheet_.evaluate(position @ turn.T + [3, -1, 2])
    assert there.energy == pytest.approx(here.energy, rel=1e-12)
    np.testing.assert_allclose(
        sheet_.gradient(there)[0], sheet_.gradient(here)[0] @ turn.T, atol=1e-11 * sheet_.unit_force
    )


def test_bending_costs_nothing_in_flat_sheets_however_stretched():
    sheet_, rest = cloth()
    matrix = bending_matrix(rest, sheet_.triangles)
    turned = rest @ np.array([[1.3, 0.2, 0], [-0.1, 0.7, 0], [0, 0, 1]]) @ rotation((1, 1, 0), 1.0).T
    assert np.abs(matrix @ turned).max() < 1e-12 * abs(matrix).max()


@pytest.mark.parametrize("angle", np.linspace(0, np.pi / 2, 4))
def test_a_cylinder_has_the_bending_energy_of_a_plate_whatever_its_direction(angle):
    # D / (2 R^2) per area; what is missing at the two edges that bend and what jitter adds is within 5 %.
    sheet_, rest = cloth(bending=1.0, nodes=2000)
    radius, along, across = (
        2.0,
        np.array([np.cos(angle), np.sin(angle), 0]),
        np.array([-np.sin(angle), np.cos(angle), 0]),
    )
    s, t = rest @ along, rest @ across
    rolled = np.column_stack([radius * np.sin(s / radius), t, radius * np.cos(s / radius)])
    energy = 0.5 * float(np.vdot(rolled, bending_matrix(rest, sheet_.triangles) @ rolled))
    assert energy == pytest.approx(0.9 / (2 * radius**2), rel=0.05)


def stressed(stretches: tuple[float, float], compression: float) -> tuple[float, float, float]:
    """Energy density and principal stresses of a sheet under an affine map."""
    sheet_, rest = cloth(compression, bending=0.0)
    state = sheet_.evaluate(rest @ np.diag([*stretches, 1]))
    stress = state.membrane.stress
    principal = np.linalg.eigvalsh(np.array([[stress[0], stress[2]], [stress[2], stress[1]]]).transpose(2, 0, 1))
    np.testing.assert_allclose(principal, principal[:1].repeat(len(principal), axis=0), atol=1e-9)
    return state.energy / 0.9, principal[0, 1], principal[0, 0]


def test_the_membrane_follows_its_closed_forms():
    e1, e2 = (1.1**2 - 1) / 2, (1.05**2 - 1) / 2
    large, small = (STRETCH / (1 - POISSON**2) * (a + POISSON * b) for a, b in ((e1, e2), (e2, e1)))
    taut = pytest.approx((0.5 * (large * e1 + small * e2), large, small), rel=1e-9)
    assert stressed((1.1, 1.05), 1.0) == taut and stressed((1.1, 1.05), 0.0) == taut
    # Wrinkled: a tension field carries uniaxial stress, however far the sheet is gathered across it.
    uniaxial = pytest.approx((STRETCH * e1**2 / 2, STRETCH * e1, 0), rel=1e-9, abs=1e-9)
    assert stressed((1.1, 0.8), 0.0) == uniaxial and stressed((1.1, 0.6), 0.0) == uniaxial
    assert stressed((0.9, 0.8), 0.0) == pytest.approx((0, 0, 0), abs=1e-9)
    # In between, shares of both.
    mixed, plain, relaxed = (stressed((1.1, 0.8), share) for share in (0.25, 1.0, 0.0))
    assert mixed[0] == pytest.approx(0.25 * plain[0] + 0.75 * relaxed[0], rel=1e-12)
    assert mixed[2] == pytest.approx(0.25 * plain[2], rel=1e-9)


def test_nodes_share_the_mass_of_their_triangles():
    sheet_, _ = cloth()
    assert sheet_.mass().sum() == pytest.approx(0.2 * 0.9, rel=1e-12)
    assert (sheet_.mass() > 0).all()


def test_the_jacobian_is_the_ratio_of_areas():
    sheet_, rest = cloth()
    np.testing.assert_allclose(sheet_.jacobian(rest @ np.diag([1.2, 0.5, 1])), 0.6, rtol=1e-12)


def test_what_is_no_sheet_or_no_material_is_refused():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0]], float)
    material = ClothMaterial(STRETCH, POISSON, BENDING, 0.2)
    with pytest.raises(SimulationError, match="triangle 1 has the rest area 0"):
        Cloth(corners, np.array([[0, 1, 2], [0, 1, 4]]), material)
    with pytest.raises(SimulationError, match="edge 0-1 belongs to 3 triangles"):
        Cloth(corners[:4], np.array([[0, 1, 2], [0, 1, 3], [1, 0, 2]]), material)
    for bad, name in (
        (dict(stretch=0.0), "stretch"),
        (dict(density=np.nan), "density"),
        (dict(bending=-1.0), "bending"),
    ):
        with pytest.raises(SimulationError, match=name):
            ClothMaterial(**{"stretch": 1.0, "poisson": 0.3, "bending": 0.0, "density": 1.0, **bad})
    with pytest.raises(SimulationError, match="Poisson"):
        ClothMaterial(1.0, 1.0, 0.0, 1.0)
    with pytest.raises(SimulationError, match="compression"):
        ClothMaterial(1.0, 0.3, 0.0, 1.0, 1.5)
