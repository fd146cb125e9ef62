"""Is an answer physics? On a frame of the solver, and on frames that are wrong in a known way."""

from dataclasses import replace

import numpy as np
import pytest
from solids import blocks, pressed

from ast_sim.material import Material
from ast_sim.mechanics.physics_check import Law, check_physics
from ast_sim.mechanics.quasi_static import solve_frame


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
    turned, depth, volume, residual, imbalance = values(scene, position[None], [1], law)
    assert (turned, depth, volume) == (0, 0, 0)
    assert residual < 30 and imbalance < 1e-4


def test_the_worst_frame_is_named(squeezed):
    """A free node inside a block is moved by 1 mm: nothing else holds it there."""
    scene, position, law = squeezed
    inside = np.setdiff1d(np.flatnonzero(~scene.prescribed), scene.surface())[0]
    moved = position.copy()
    moved[inside, 0] += 1e-3
    found = check_physics(scene, np.stack([position, moved]), [3, 7], law, "m")
    residual = values(scene, moved[None], [7], law)[3]
    assert residual > 1e4 and found.residual.value == residual
    assert found.residual.frame == 7 and found.imbalance.frame == 7
    assert f"{residual:.3g}" in str(found).splitlines()[4] and "  7  " in str(found).splitlines()[4]


def test_elements_that_are_turned_over_are_counted(squeezed):
    scene, position, law = squeezed
    mirrored = scene.rest_position * np.float32([-1, 1, 1])
    turned, _, _, residual, imbalance = values(scene, mirrored[None], [1], law)
    assert turned == scene.num_elements and residual == imbalance == np.inf


def test_bodies_that_overlap_share_a_volume(squeezed):
    """The upper block has a base of 140 mm x 140 mm; it comes down by 2 mm of gap and 3 mm more: 58.8 cm^3."""
    scene, _, law = squeezed
    down = scene.rest_position - np.float32([0, 0, 5e-3]) * (scene.body == 1)[:, None].astype(np.float32)
    _, depth, volume, _, _ = values(scene, down[None], [1], law)
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
