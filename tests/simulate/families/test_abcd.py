"""Pairs of parts: how they are put together and clamped, what is drawn, and one squeezed from end to end."""

import numpy as np
import pytest

from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.scene import NodeType
from ast_sim.simulate.families import abcd, abcd_xl
from ast_sim.simulate.shapes.cad.gmsh_process import MeshingFailed
from ast_sim.simulate.shapes.mesh_check import boundary
from ast_sim.simulate.shapes.pairing import LEAST_OVERLAP, Unsuitable, put_together, shadow_cells, turned
from ast_sim.simulate.shapes.part_source import StructuredParts, part_source
from ast_sim.simulate.shapes.parts import Part, rectilinear, volumes
from ast_sim.support.errors import SimulationError

SOURCE = StructuredParts()


def block(size, cells: int = 3) -> Part:
    return Part(*rectilinear([np.linspace(0, length, cells + 1) for length in size]), "block")


def cone() -> Part:
    """A block whose long ends run to an edge, so that they offer no face to clamp."""
    position, elements = rectilinear([np.linspace(0, 1, 9), np.linspace(-0.4, 0.4, 5), np.linspace(-0.4, 0.4, 5)])
    position[:, 1:] *= (1.01 - np.abs(2 * position[:, :1] - 1)) ** 0.5
    return Part(position, elements, "cone")


def check_pair(case) -> None:
    """What holds for every case, as an engineer would look at it."""
    scene, rest = case.scene, case.scene.rest_position.astype(float)
    scene.check()
    assert np.ptp(rest, axis=0).max() == pytest.approx(1.8, abs=0.01)
    assert np.abs(case.prescribed_position).max() < 1
    lower, clamped = scene.body == 0, scene.node_type == NodeType.HANDLE
    assert set(np.unique(scene.node_type)) == {NodeType.NORMAL, NodeType.HANDLE}
    height = {body: np.ptp(rest[scene.body == body, 2]) for body in (0, 1)}
    assert rest[clamped & lower, 2].max() <= rest[lower, 2].min() + 0.1 * height[0] + 1e-6
    assert rest[clamped & ~lower, 2].min() >= rest[~lower, 2].max() - 0.1 * height[1] - 1e-6
    assert min((clamped & lower).sum(), (clamped & ~lower).sum()) >= 3
    contact = Contact(rest, scene.surface(), scene.body, case.contact)
    assert 1.9 * case.contact.dhat <= contact.gap(rest) <= 2.1 * case.contact.dhat
    assert not contact.intersects(rest)
    assert Elasticity(rest, scene.elements, case.material).evaluate(rest).J.min() > 0.99
    travel = case.prescribed_position - case.prescribed_position[0]
    assert travel.shape == (21, scene.num_nodes, 3)
    moving = np.abs(travel).max(axis=(0, 2)) > 0
    assert np.array_equal(moving, clamped & ~lower)
    down = -travel[:, moving, 2]
    assert np.allclose(np.diff(down, axis=0), down[-1] / 20) and not travel[:, :, :2].any()
    free = case.attributes["free_height"]
    assert free == pytest.approx(np.ptp(rest[clamped, 2]) - 2 * case.contact.dhat, abs=1e-5)
    assert 0.1 * free < down[-1, 0] - 2 * case.contact.dhat < 0.25 * free
    assert case.attributes["overlap"] >= LEAST_OVERLAP
    young, poisson = scene.material.T
    body = scene.body[scene.elements[:, 0]]
    for which in (0, 1):
        assert len(np.unique(scene.material[body == which], axis=0)) == 1
        assert 5e5 <= young[body == which][0] <= 2e6 and 0.25 <= poisson[body == which][0] <= 0.4
    assert not np.array_equal(scene.material[body == 0][0], scene.material[body == 1][0])
    assert np.array_equal(np.broadcast_to(case.material.young, len(young)), young)


@pytest.mark.parametrize("nodes", [300, 1500])
def test_structured_pairs_are_sound(nodes):
    for seed in range(4):
        case = abcd.draw(np.random.default_rng(seed), nodes, SOURCE)
        check_pair(case)
        assert 0.6 * nodes <= case.scene.num_nodes <= 1.4 * nodes


def test_pairs_of_the_grammar_are_sound():
    source, names = part_source(), set()
    for seed in range(3):
        case = abcd.draw(np.random.default_rng(seed), 800, source)
        check_pair(case)
        assert case.scene.num_nodes == pytest.approx(800, rel=0.2)
        names |= set(case.attributes["parts"].split(", "))
    assert len(names) > 2


def test_the_same_seed_gives_the_same_case():
    first, second, other = (abcd.draw(np.random.default_rng(seed), 300, SOURCE) for seed in (3, 3, 4))
    assert np.array_equal(first.scene.rest_position, second.scene.rest_position)
    assert (
        np.array_equal(first.prescribed_position, second.prescribed_position) and first.attributes == second.attributes
    )
    assert first.attributes != other.attributes
    assert first.attributes["mesher"] == "structured"


def test_two_blocks_meet_face_to_face():
    pair = put_together(np.random.default_rng(0), block((1, 1, 1)), block((1, 1, 1), 4), gap=0.002)
    assert np.ptp(pair.position, axis=0)[2] == pytest.approx(1.8 + 0.002, abs=1e-3)
    lower = pair.body == 0
    assert pair.position[~lower, 2].min() - pair.position[lower, 2].max() == pytest.approx(0.002, rel=0.02)
    assert pair.clamped[lower].sum() == 16 and pair.clamped[~lower].sum() == 25
    assert pair.height == pytest.approx(1.8, abs=1e-3) and pair.scale == pytest.approx(0.9, abs=1e-3)


def test_a_part_is_turned_without_a_change_of_shape():
    part, seen = block((1, 0.9, 0.8)), set()
    for seed in range(30):
        position = turned(np.random.default_rng(seed), part.position)
        assert np.allclose(volumes(position, part.elements), volumes(part.position, part.elements))
        assert position[:, 2].min() == pytest.approx(0, abs=1e-12)
        assert np.allclose(position[:, :2].max(axis=0) + position[:, :2].min(axis=0), 0)
        seen.add(round(float(np.ptp(position[:, 2])), 3))
    assert seen == {1.0, 0.9, 0.8}
    slender = [turned(np.random.default_rng(seed), block((2, 0.7, 0.6)).position) for seed in range(20)]
    assert {round(float(np.ptp(position[:, 2])), 3) for position in slender} == {0.7, 0.6}


def test_shadows_have_their_area():
    part = block((1, 0.6, 0.3))
    cells = shadow_cells(part.position[:, :2], boundary(part.elements), 0.01)
    assert len(cells) * 0.01**2 == pytest.approx(0.6, rel=0.03)
    fine = block((1, 0.6, 0.3), 12)
    assert np.array_equal(cells, shadow_cells(fine.position[:, :2], boundary(fine.elements), 0.01))


def test_ends_without_a_face_are_not_clamped():
    with pytest.raises(Unsuitable, match="too pointed"):
        for seed in range(20):
            put_together(np.random.default_rng(seed), cone(), block((1, 1, 1)), gap=0.002)


def test_walls_thinner_than_the_range_of_contact_are_refused():
    class Sheets:
        mesher = "none"

        def draw(self, rng):
            fork = rectilinear(
                [np.array([0, 0.3, 1.0]), np.linspace(0, 1, 5), np.array([0, 0.3, 0.3004, 0.6])],
                np.array([[[True, True, True]] * 4, [[True, False, True]] * 4]),
            )
            return lambda nodes: (Part(*fork, "fork"), block((1, 1, 1)))

    with pytest.raises(SimulationError, match="a wall, slit or element is thinner than 0.001, the range of contact"):
        abcd.draw(np.random.default_rng(0), 300, Sheets())


def test_parts_that_cannot_be_squeezed_are_drawn_again_and_then_given_up(monkeypatch):
    class Flaky:
        calls, mesher = 0, "flaky"

        def draw(self, rng):
            self.calls += 1
            if self.calls < 4:
                raise MeshingFailed("gmsh crashed (SIGSEGV): no message")
            return SOURCE.draw(rng)

    source = Flaky()
    check_pair(abcd.draw(np.random.default_rng(0), 300, source))
    assert source.calls >= 4
    source.calls = -1000
    with pytest.raises(SimulationError, match=r"none of 30 draws .* gmsh crashed \(SIGSEGV\)"):
        abcd.draw(np.random.default_rng(0), 300, source)


def test_the_large_family_draws_the_same_at_another_size():
    assert abcd_xl.INFO.family == "abcd_xl" and abcd_xl.DEFAULT_NODES == 100_000
    small, large = (module.draw(np.random.default_rng(1), 300, SOURCE) for module in (abcd, abcd_xl))
    assert np.array_equal(small.scene.rest_position, large.scene.rest_position)
    case = abcd_xl.draw(np.random.default_rng(1), 10_000, SOURCE)
    assert case.scene.num_nodes == pytest.approx(10_000, rel=0.2)


@pytest.mark.parametrize(("source", "nodes"), [(SOURCE, 800), (None, 1600)], ids=["structured", "gmsh"])
def test_the_same_pair_on_coarser_meshes(source, nodes):
    """Volume, materials, place and motion stay; curved surfaces are met less well."""
    for seed in range(3):
        drawn = abcd.draw_geometry(np.random.default_rng(seed), nodes, source)
        case, coarse = drawn.case, drawn.remesh(0.4)
        check_pair(case)
        coarse.scene.check()
        assert 0.25 <= coarse.scene.num_nodes / case.scene.num_nodes <= 0.6
        for body in (0, 1):
            fine_body, coarse_body = (c.scene.rest_position[c.scene.body == body] for c in (case, coarse))
            np.testing.assert_allclose(np.ptp(coarse_body, axis=0), np.ptp(fine_body, axis=0), rtol=0.05)
            assert np.array_equal(*(np.unique(c.scene.material[c.scene.body[c.scene.elements[:, 0]] == body], axis=0)
                                    for c in (case, coarse)))  # fmt: skip
            sizes = [
                volumes(
                    c.scene.rest_position.astype(float), c.scene.elements[c.scene.body[c.scene.elements[:, 0]] == body]
                ).sum()
                for c in (case, coarse)
            ]
            assert sizes[1] == pytest.approx(sizes[0], rel=0.06)
        # The clamps end at the same heights, although the upper part may start a little higher.
        tops = [c.prescribed_position[-1, c.scene.prescribed & (c.scene.body == 1), 2].max() for c in (case, coarse)]
        assert tops[1] == pytest.approx(tops[0], abs=2e-3)
        contact = Contact(*(coarse.prescribed_position[0], coarse.scene.surface(), coarse.scene.body, coarse.contact))
        assert contact.gap(coarse.prescribed_position[0]) >= 1.9 * coarse.contact.dhat and not contact.intersects(
            coarse.prescribed_position[0]
        )


def test_parts_that_are_meshes_have_no_other_mesh():
    class Given:
        mesher = "none"

        def draw(self, rng):
            return lambda nodes, smallest_angle=5.0: (block((1, 1, 1)), block((1, 1, 1)))

    drawn = abcd.draw_geometry(np.random.default_rng(0), 300, Given())
    with pytest.raises(Unsuitable, match="no other mesh"):
        drawn.remesh(0.5)


def test_a_pair_is_squeezed():
    case = abcd.draw(np.random.default_rng(2), 250, SOURCE)
    trajectory = abcd.solve(case)
    trajectory.check("pair", abcd.INFO.stress_location)
    attributes, scene = trajectory.attributes, case.scene
    assert attributes["status"] == "complete" and trajectory.num_frames == 21
    assert attributes["parts"] == case.attributes["parts"]
    assert trajectory.stress.shape == (21, scene.num_elements, 1)
    assert trajectory.cauchy_stress.shape == (21, scene.num_elements, 6)
    xx, yy, zz, xy, yz, zx = trajectory.cauchy_stress[-1].T.astype(float)
    squares = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    von_mises = np.sqrt(0.5 * squares + 3 * (xy**2 + yz**2 + zx**2))
    assert np.allclose(von_mises, trajectory.stress[-1, :, 0], rtol=1e-4)
    handles = scene.prescribed
    assert np.allclose(trajectory.position[:, handles], case.prescribed_position[:, handles], atol=1e-6)
    assert attributes["min_gap"] > 0 and attributes["min_jacobian"] > 0 and attributes["max_residual"] <= 1
    assert np.abs(trajectory.position).max() < abcd.INFO.domain_half_width
    assert trajectory.stress[0].max() < 1e-6 and trajectory.stress[-1].max() > 1e4
    assert attributes["reaction"][-1] > attributes["reaction"][5] > 0
    assert max(attributes["imbalance"]) < 1e-3
