"""Implicit dynamics: free fall, momentum, energy, rest, symmetry, contact; halved steps, truncation, resumption."""

from dataclasses import replace

import numpy as np
import pytest

from ast_sim.mechanics import unfinished as checkpoint_module
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.dynamics import BackwardEuler, ClothCase, DynamicSettings, implicit_euler
from ast_sim.mechanics.elements.cloth import ClothMaterial
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.families.sphere_simple import icosphere
from ast_sim.support.errors import SimulationError

STEP = 0.01
MATERIAL = ClothMaterial(stretch=100.0, poisson=0.3, bending=1e-4, density=0.2, compression=0.1)
EXACT = DynamicSettings(acceleration_tolerance=1e-6)


def square(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A square of side 1 around the origin, of an even number of cells whose diagonals mirror each other in x and y."""
    line = np.linspace(-0.5, 0.5, cells + 1)
    position = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((cells + 1,) * 2)], axis=-1).reshape(-1, 3)
    i, j = (index.ravel() for index in np.meshgrid(*[np.arange(cells)] * 2, indexing="ij"))
    a, step = i * (cells + 1) + j, cells + 1
    b, c, d = a + step, a + step + 1, a + 1
    one = (i < cells // 2) == (j < cells // 2)
    first = np.where(one[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(one[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return position, np.concatenate([first, second])


def case(frames: int, cells: int = 4, held=None, ball: tuple[float, float] | None = None, **settings) -> ClothCase:
    """A square sheet, horizontal at first; `held` picks nodes, `ball` is the radius and centre height of a sphere."""
    position, triangles = square(cells)
    node_type = np.full(len(position), NodeType.NORMAL, np.uint8)
    if held is not None:
        node_type[held(position)] = NodeType.HANDLE
    body = np.zeros(len(position), np.int32)
    if ball is not None:
        sphere, sphere_triangles = icosphere(2)
        triangles = np.concatenate([triangles, sphere_triangles + len(position)])
        node_type = np.append(node_type, np.full(len(sphere), NodeType.OBSTACLE, np.uint8))
        body = np.append(body, np.ones(len(sphere), np.int32))
        position = np.concatenate([position, ball[0] * sphere + [0, 0, ball[1]]])
    scene = Scene(position.astype(np.float32), triangles.astype(np.int32), node_type, body)
    targets = np.repeat(scene.rest_position.astype(float)[None], frames, axis=0)
    contact = ContactSettings(0.02, 300.0, self_contact=True)
    return ClothCase(
        **{
            **dict(scene=scene, prescribed_position=targets, material=MATERIAL, contact=contact, time_step=STEP),
            **settings,
        }
    )


def thrown(frames: int) -> ClothCase:
    """A sheet without gravity whose nodes start with velocities that deform and turn it."""
    free = case(frames, gravity=(0.0, 0.0, 0.0))
    return replace(free, velocity=np.random.default_rng(0).normal(size=free.scene.rest_position.shape))


def corners(position: np.ndarray) -> np.ndarray:
    return (np.abs(position[:, 0]) == 0.5) & (position[:, 1] == 0.5)


def mirrored(position: np.ndarray, cloth_nodes: int) -> np.ndarray:
    """What the mirror in x makes of cloth positions [N,3] on the grid of `square`."""
    side = round(np.sqrt(cloth_nodes))
    return position[:cloth_nodes].reshape(side, side, 3)[::-1].reshape(-1, 3) * [-1, 1, 1]


def test_free_fall_follows_backward_euler():
    trajectory = implicit_euler(case(21))
    n = np.arange(21)
    fallen = trajectory.position[:, :, 2]
    np.testing.assert_allclose(fallen, np.repeat((-9.81 * STEP**2 * n * (n + 1) / 2)[:, None], 25, axis=1), atol=1e-6)
    assert np.abs(trajectory.position[:, :, :2] - trajectory.position[0, :, :2]).max() < 1e-6
    energy = trajectory.attributes["potential_energy"]
    assert energy[20] == pytest.approx(-0.2 * 9.81**2 * STEP**2 * 20 * 21 / 2, rel=1e-6)


def test_momentum_is_conserved_without_gravity():
    solver = BackwardEuler(thrown(2), EXACT)
    momentum = solver.mass @ solver.velocity
    for _ in range(10):
        solver.advance(solver.position)
        np.testing.assert_allclose(solver.mass @ solver.velocity, momentum, atol=1e-9)
    assert solver.elastic_energy() > 1e-3


def test_energy_never_grows_unless_driven():
    attributes = implicit_euler(thrown(30)).attributes
    names = ("elastic_energy", "contact_energy", "kinetic_energy", "potential_energy")
    total = np.sum([attributes[name] for name in names], axis=0)
    assert total[0] > 0.2
    assert np.diff(total).max() <= 1e-9 * total[0]
    assert total[-1] < 0.9 * total[0]


def test_cloth_at_rest_stays_at_rest():
    trajectory = implicit_euler(case(4, gravity=(0.0, 0.0, 0.0)))
    assert trajectory.attributes["newton_iterations"] == [0, 1, 1, 1]
    np.testing.assert_allclose(trajectory.position, trajectory.position[:1].repeat(4, axis=0), rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def hanging():
    return implicit_euler(case(40, cells=6, held=corners), EXACT)


def test_a_sheet_that_swings_from_two_corners_stays_symmetric_and_is_held(hanging):
    assert hanging.attributes["status"] == "complete"
    last = hanging.position[-1].astype(float)
    assert last[:, 2].min() < -0.5
    np.testing.assert_allclose(mirrored(last, 49), last, atol=1e-5)
    held = corners(hanging.position[0])
    assert held.sum() == 2 and (hanging.position[:, held] == hanging.position[0, held]).all()


def test_a_sheet_that_swings_loses_energy_alone_to_the_time_integration(hanging):
    names = ("elastic_energy", "contact_energy", "kinetic_energy", "potential_energy")
    total = np.sum([hanging.attributes[name] for name in names], axis=0)
    assert np.diff(total).max() <= 1e-6
    assert hanging.attributes["work"][-1] == 0


@pytest.fixture(scope="module")
def drape():
    return implicit_euler(case(45, cells=10, ball=(0.25, -0.28)))


def test_a_drape_stays_off_the_sphere_and_nearly_symmetric(drape):
    attributes = drape.attributes
    assert attributes["status"] == "complete", attributes.get("stopped_by")
    assert drape.num_frames == 45 and len(attributes["gap"]) == 45
    assert attributes["min_gap"] > 0 and attributes["min_gap"] == min(attributes["gap"]) < 0.02
    assert attributes["max_residual"] <= 1 and attributes["min_jacobian"] > 0
    last = drape.position[-1, :121].astype(float)
    assert np.linalg.norm(last - [0, 0, -0.28], axis=1).min() > 0.24  # facets lie inside the sphere of radius 0.25
    assert last[:, 2].min() < -0.2 and last[:, 2].max() > -0.05  # the rim has come down, the middle lies on top
    np.testing.assert_allclose(mirrored(last, 121), last, atol=5e-3)
    assert max(attributes["contact_area"]) > 0.01 and max(attributes["contact_energy"]) > 0


def test_the_sphere_stands_where_it_is_told_and_carries_the_cloth():
    moving = case(25, cells=8, ball=(0.2, -0.23), gravity=(0.0, 0.0, 0.0))
    sphere = moving.scene.body == 1
    lift = 1.0 * STEP * np.arange(25)
    moving.prescribed_position[:, sphere, 2] += lift[:, None]
    trajectory = implicit_euler(moving)
    attributes = trajectory.attributes
    assert attributes["status"] == "complete", attributes.get("stopped_by")
    np.testing.assert_array_equal(
        trajectory.position[:, sphere], moving.prescribed_position[:, sphere].astype(np.float32)
    )
    assert trajectory.position[-1, ~sphere, 2].max() > 0.2
    assert attributes["work"][-1] > 0 and max(attributes["reaction"]) > 0
    energy = sum(attributes[name][-1] for name in ("elastic_energy", "contact_energy", "kinetic_energy"))
    assert energy <= attributes["work"][-1]


def on_slope(slope: float, friction: float, frames: int) -> ClothCase:
    """A sheet on a plane, gravity leaning by the angle whose tangent is `slope`.

    It starts about where the barrier carries it.
    """
    angle = np.arctan(slope)
    flat = case(frames, gravity=tuple(9.81 * np.array([np.sin(angle), 0, -np.cos(angle)])))
    corners_ = np.array([[-2, -2, -0.0185], [4, -2, -0.0185], [4, 2, -0.0185], [-2, 2, -0.0185]], np.float32)
    scene, n = flat.scene, flat.scene.num_nodes
    scene = Scene(
        np.concatenate([scene.rest_position, corners_]),
        np.concatenate([scene.elements, np.array([[0, 1, 2], [0, 2, 3]], np.int32) + n]),
        np.append(scene.node_type, np.full(4, NodeType.OBSTACLE, np.uint8)),
        np.append(scene.body, np.ones(4, np.int32)),
    )
    targets = np.repeat(scene.rest_position.astype(float)[None], frames, axis=0)
    return replace(
        flat,
        scene=scene,
        prescribed_position=targets,
        contact=ContactSettings(0.02, 300.0, friction, self_contact=True),
    )


def test_a_sheet_slides_down_a_slope_with_what_friction_leaves_of_gravity():
    settings = DynamicSettings(acceleration_tolerance=1e-3)
    slope, friction, frames = 0.5, 0.3, 60
    trajectory = implicit_euler(on_slope(slope, friction, frames), settings)
    travel = trajectory.position[:, :25, 0].mean(axis=1) - trajectory.position[0, :25, 0].mean()
    speed = np.diff(travel) / STEP
    expected = 9.81 * (slope - friction) / np.hypot(1, slope)
    # While the sheet settles on the barrier that does not carry just its weight: the later half counts.
    assert (speed[-1] - speed[28]) / (30 * STEP) == pytest.approx(expected, rel=0.03)
    attributes = trajectory.attributes
    lost = friction * 0.2 * 9.81 / np.hypot(1, slope) * (travel[-1] - travel[30])
    assert attributes["dissipation"][-1] - attributes["dissipation"][30] == pytest.approx(lost, rel=0.05)


def test_a_sheet_sticks_on_a_slope_below_the_friction_angle():
    settings = DynamicSettings(acceleration_tolerance=1e-3)
    trajectory = implicit_euler(on_slope(0.25, 0.3, 40), settings)
    speed = np.diff(trajectory.position[:, :25, 0].mean(axis=1)) / STEP
    # Lagged friction is mobilised by slip u in a step as 2 y - y^2, y = u / (0.1 dhat): sticking is a slow creep at
    # which that is tan(slope) / friction. Without friction the speed would be 0.93 m/s by now.
    creep = 0.1 * 0.02 / STEP * (1 - np.sqrt(1 - 0.25 / 0.3))
    assert speed.max() < 1.1 * creep
    assert speed[-10:].mean() == pytest.approx(creep, rel=0.05)


def test_a_step_that_does_not_converge_is_halved(hanging):
    hasty = replace(EXACT, max_iterations=4)
    attributes = implicit_euler(case(25, cells=6, held=corners), hasty).attributes
    assert attributes["status"] == "complete" and sum(attributes["halvings"]) > 0
    assert attributes["max_residual"] <= 1


def test_frames_before_one_that_does_not_converge_are_kept():
    strict = replace(EXACT, max_iterations=3, max_halvings=0)
    trajectory = implicit_euler(case(25, cells=6, held=corners), strict)
    attributes = trajectory.attributes
    assert attributes["status"] == "truncated" and 1 <= trajectory.num_frames < 25
    assert attributes["stopped_by"].startswith(f"frame {trajectory.num_frames}: no equilibrium after 3 Newton")
    assert len(attributes["gap"]) == trajectory.num_frames


def test_a_scene_that_starts_with_surfaces_through_each_other_is_refused():
    with pytest.raises(SimulationError, match="surfaces intersect"):
        implicit_euler(case(3, ball=(0.2, 0.05)))


class Killed(Exception):
    pass


def test_a_resumed_solve_equals_an_undisturbed_one_bit_for_bit(tmp_path, monkeypatch, drape):
    monkeypatch.setattr(checkpoint_module, "SECONDS_BETWEEN_WRITES", 0.0)
    draped, path = case(45, cells=10, ball=(0.25, -0.28)), tmp_path / "sample.npz"

    def kill(frames, of, iterations):
        if frames == 33:
            raise Killed

    with pytest.raises(Killed):
        implicit_euler(draped, checkpoint=Checkpoint(path, kill))
    seen = []
    resumed = implicit_euler(draped, checkpoint=Checkpoint(path, lambda *progress: seen.append(progress)))
    assert seen[0][:2] == (33, 45)
    assert resumed.position.tobytes() == drape.position.tobytes()
    for name, value in drape.attributes.items():
        if name != "solve_seconds":
            assert resumed.attributes[name] == value, name
