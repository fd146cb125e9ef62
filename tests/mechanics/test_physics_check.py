"""Is an answer physics? On a frame of the solver, and on frames that are wrong in a known way."""

from dataclasses import replace

import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, case_of, write_assembly, write_box
from solids import blocks, pressed

from ast_sim.material import Material
from ast_sim.mechanics.physics_check import Law, check_physics
from ast_sim.mechanics.solid_frames import solve_frame
from ast_sim.simulate.families import assembly


@pytest.fixture(scope="module")
def squeezed():
    """Two blocks that are pressed together by 8 mm: the scene, the solver's positions and the law."""
    case = pressed(*blocks(), depth=0.01, frames=1)
    found = solve_frame(case, 1)
    assert found.failure == ""
    columns = np.broadcast_arrays(np.zeros(case.scene.num_elements), case.material.young, case.material.poisson)[1:]
    scene = replace(case.scene, material=np.stack(columns, axis=1).astype(np.float32))
    return scene, found.position.astype(np.float32), Law(Material(("young", "poisson"), {"friction": 0.0}), 1e-3)


def values(*arguments) -> list:
    return [row.value for row in check_physics(*arguments, "m").rows]


def test_a_frame_of_the_solver_is_physics(squeezed):
    scene, position, law = squeezed
    turned, folded, depth, volume, residual, imbalance = values(scene, position[None], [1], law)
    assert (turned, folded, depth, volume) == (0, 0, 0, 0)
    assert residual < 30 and imbalance < 1e-4


def test_the_worst_frame_is_named(squeezed):
    """A free node inside a block is moved by 1 mm: nothing else holds it there."""
    scene, position, law = squeezed
    inside = np.setdiff1d(np.flatnonzero(~scene.prescribed), scene.surface())[0]
    moved = position.copy()
    moved[inside, 0] += 1e-3
    found = check_physics(scene, np.stack([position, moved]), [3, 7], law, "m")
    residual = values(scene, moved[None], [7], law)[4]
    assert residual > 1e4 and found.residual.value == residual
    assert found.residual.frame == 7 and found.imbalance.frame == 7
    assert f"{residual:.3g}" in str(found).splitlines()[5] and "  7  " in str(found).splitlines()[5]


def test_elements_that_are_turned_over_are_counted(squeezed):
    scene, position, law = squeezed
    mirrored = scene.rest_position * np.float32([-1, 1, 1])
    turned, _, _, _, residual, imbalance = values(scene, mirrored[None], [1], law)
    assert turned == scene.num_elements and residual == imbalance == np.inf


def test_bodies_that_overlap_share_a_volume(squeezed):
    """The upper block has a base of 140 mm x 140 mm; it comes down by 2 mm of gap and 3 mm more: 58.8 cm^3."""
    scene, _, law = squeezed
    down = scene.rest_position - np.float32([0, 0, 5e-3]) * (scene.body == 1)[:, None].astype(np.float32)
    _, _, depth, volume, _, _ = values(scene, down[None], [1], law)
    assert depth == pytest.approx(3e-3, rel=1e-3)
    assert volume == pytest.approx(0.14**2 * 3e-3, rel=0.2)  # at its rim the lower block counts nodes whole


def test_what_is_not_known_is_said(squeezed):
    scene, position, law = squeezed
    found = check_physics(scene, position[None], [1], None, "m")
    assert found.residual.value is None and "law of the material is not known" in found.residual.sentence
    incompressible = replace(scene, material=np.full_like(scene.material, 0.5))
    wrong = check_physics(incompressible, position[None], [1], law, "m")
    assert wrong.imbalance.value is None and "Poisson" in wrong.imbalance.sentence
    assert check_physics(scene, position[:0, None], [], law, "m").depth.sentence == "no frame was predicted"


def test_friction_explains_forces_across_the_axes(tmp_path):
    """The punch slides along the diagonal. With four rays of Coulomb's cone 4 % of the reactions miss balance."""
    spec = SPEC.replace("frames = 3", "frames = 3\nfriction = 0.3")
    spec = spec.replace("[0, 0, '-travel']", "['0.6 * travel', '0.6 * travel', '-travel']")
    case = case_of(write_assembly(tmp_path, spec), travel=0.8)
    scene, truth = case.scene, assembly.solve(case)
    law = Law(Material(("young", "poisson"), {"friction": 0.3}), 0.05)
    *_, residual, imbalance = check_physics(scene, truth.position[1:], [1, 2], law, "mm").rows
    assert residual.value < 1.5e4 and "its own frames have up to some 100,000" in residual.sentence
    assert imbalance.value < 0.01
    smooth = replace(law, material=Material(("young", "poisson"), {"friction": 0.0}))
    without = check_physics(scene, truth.position[1:], [1, 2], smooth, "mm")
    assert without.residual.value > 5 * residual.value and "100,000" not in without.residual.sentence


def test_barriers_of_parallel_edges_and_pairs_that_pull(tmp_path):
    """The tool and a finer mesh of second-order elements have parallel edges. By the distances of pairs alone, 0.5 % of
    the forces are left."""
    spec = write_assembly(tmp_path, SPEC.replace("order = 1", "order = 2"))
    write_box(tmp_path / "block.vtu", (0, 0, 0), (8, 8, 4), (6, 6, 3))
    write_box(tmp_path / "punch.vtu", (0.7, 2.87, 4.2), (4.7, 6.87, 6.2), (1, 1, 1))
    case = case_of(spec, travel=0.8)
    scene, truth = case.scene, assembly.solve(case)
    law = Law(Material(("young", "poisson"), {"friction": 0.0}), 0.05)
    assert check_physics(scene, truth.position[1:], [1, 2], law, "mm").residual.value < 30
