"""Newton steps with linearised contact, beside the bundled solver, which resolves contact by barriers."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import box
from scipy.optimize import nnls
from simulate.own_assembly.assemblies import write_assembly, write_box
from solids import blocks, pressed, scene_of

from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linear_algebra import compliance
from ast_sim.mechanics.linearised import linearised_contact
from ast_sim.mechanics.linearised.linearised_contact import STILL, NewtonSteps
from ast_sim.mechanics.solid_frames import quasi_static, solve_frame
from ast_sim.scene import NodeType
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes import mesh
from ast_sim.support import nearest_surface
from ast_sim.support.errors import SimulationError

DHAT = 1e-3  # of `pressed`
RUBBER = NeoHookean(1e6, 0.4)


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference))))


@pytest.fixture(scope="module")
def squeezed():
    """Two blocks that are pressed together by 8 mm: the case, the solver's positions, and how far free nodes went."""
    case = pressed(*blocks(), depth=0.01)
    frame = len(case.prescribed_position) - 1
    found = solve_frame(case, frame)
    assert found.failure == ""
    free = ~case.scene.prescribed
    return case, found.position, free, rms((found.position - case.prescribed_position[0])[free])


@pytest.fixture(scope="module")
def fine_tool(tmp_path_factory):
    """A block under a punch of much smaller edges: the case and the solver's positions."""
    spec = write_assembly(tmp_path_factory.mktemp("fine"))
    write_box(spec.parent / "block.vtu", (0, 0, 0), (10, 10, 5), (6, 6, 3))
    write_box(spec.parent / "punch.vtu", (3.2, 3.1, 5.2), (6.7, 6.8, 8), (16, 16, 8))
    read = read_spec(spec)
    case = assembly.scene_of(read, completed(read.parameters, {"travel": 1.4}), None, read.frames).case
    return case, assembly.solve(case).position[-1].astype(float)


@pytest.fixture(params=[True, False])
def way(request, monkeypatch):
    """The compliance of contact by condensation or by columns, whatever the number of pairs."""
    monkeypatch.setattr(compliance, "condensation_pays", lambda *_: request.param)


def nearly(truth: np.ndarray, free: np.ndarray, size: float) -> np.ndarray:
    """Positions that are off by smooth waves of this size at the free nodes."""
    waves = np.sin(40 * truth @ np.array([[1.0, 0.4, 0.2], [0.3, 1, 0.5], [0.6, 0.1, 1]]) + [0, 1, 2])
    return truth + np.where(free[:, None], size / rms(waves[free]) * waves, 0)


def test_steps_lead_to_the_solution_of_the_solver(squeezed, way):
    """One step leaves a sixth of the error. What stays is contact: the solver's gap is not the same everywhere."""
    case, truth, free, size = squeezed
    start, left = nearly(truth, free, 0.1 * size), {}
    for clearance in (0.0, 0.92):  # the solver's gaps are 0.90 to 0.95 of the range of contact
        solver = NewtonSteps(case.scene, case.material, clearance * DHAT)
        position = start
        for _ in range(3):
            position = solver.step(position)
            left.setdefault(clearance, []).append(rms((position - truth)[free]) / size)
        assert solver.surfaces.pairs(position).gap.min() == pytest.approx(clearance * DHAT, abs=1e-5)
    assert np.array_equal(position[~free], truth[~free])
    assert left[0.92][0] < 0.017 and left[0.92][-1] < 0.016 and left[0.0][-1] > 0.05


def test_the_stress_is_the_solvers(squeezed):
    case, truth, *_ = squeezed
    stored = quasi_static(case).stress[-1]
    stress = NewtonSteps(case.scene, case.material, 0.8 * DHAT).von_mises(truth, "element")
    assert stress.shape == stored.shape and rms(stress - stored) < 2e-3 * stored.max()


@pytest.mark.parametrize("location", ["node", "element"])
def test_steps_of_second_order_tetrahedra_lead_to_the_solution_of_the_solver(location):
    """With the same surfaces, each face cut in four; nearly incompressible, so part of the law acts on the mean."""
    coarse = (
        mesh.second_order(*mesh.block(size, cells)) for size, cells in (((0.1, 0.1, 0.06), 2), ((0.07, 0.07, 0.06), 2))
    )
    case = replace(pressed(*coarse, depth=0.01, frames=1), stress_location=location)
    case = replace(case, material=NeoHookean(case.material.young, np.full(case.scene.num_elements, 0.49)))
    stored = quasi_static(case)
    truth, free = stored.position[-1].astype(float), ~case.scene.prescribed
    solver = NewtonSteps(case.scene, case.material, 0.92 * DHAT)
    size, position = (
        rms((truth - case.prescribed_position[0])[free]),
        nearly(truth, free, 0.1 * rms((truth - case.prescribed_position[0])[free])),
    )
    for _ in range(3):
        position = solver.step(position)
    assert rms((position - truth)[free]) < 0.02 * size
    stress = solver.von_mises(truth, location)
    assert stress.shape == stored.stress[-1].shape and rms(stress - stored.stress[-1]) < 2e-3 * stored.stress.max()
    assert stored.attributes["status"] == "complete" and stored.attributes["work_balance"] < 0.2


def test_without_contact_a_body_comes_to_rest():
    """A bar is bent by a fifth of its length; the forces on its free nodes vanish to rounding."""
    nodes, elements = box((10, 2, 2), (0.5, 0.1, 0.1))
    ends = np.isclose(abs(nodes[:, 0]), 0.25)
    scene = scene_of(nodes, elements, np.zeros(len(nodes)), np.where(ends, NodeType.HANDLE, NodeType.NORMAL))
    position = scene.rest_position.astype(float)
    position[np.isclose(position[:, 0], 0.25), 2] += 0.1
    solver = NewtonSteps(scene, RUBBER, 0.0)
    for _ in range(10):
        position = solver.step(position)
    elasticity = Elasticity(scene.rest_position.astype(float), elements, RUBBER)
    forces, _ = elasticity.gradient(elasticity.evaluate(position))
    assert abs(forces[~ends]).max() < 1e-9 * abs(forces).max()
    assert np.array_equal(solver.step(position)[ends], position[ends])


def test_a_step_turns_no_element_over_and_has_the_size_of_the_whole_one(squeezed, monkeypatch):
    """The whole way of the free nodes, towards their centre and beyond, would turn elements over."""
    case, truth, free, _ = squeezed
    solver = NewtonSteps(case.scene, case.material, 0.8 * DHAT)
    way = -1.5 * (truth - truth[free].mean(axis=0))[free]
    monkeypatch.setattr(solver, "_constrained", lambda *_: way.ravel())
    moved = solver.step(truth)
    deforming = Elasticity(case.scene.rest_position.astype(float), case.scene.elements.astype(int), case.material)
    made = abs(moved - truth)[free].max() / abs(way).max()
    double = truth.copy()
    double[free] += 2 * made * way
    assert made <= 0.5 and deforming.evaluate(moved).J.min() > 0 >= deforming.evaluate(double).J.min()
    share = rms(way) / rms((moved - case.scene.rest_position)[free])
    assert solver.size(truth, moved) == pytest.approx(max(abs(way).max() / solver.surfaces.length, share))


def test_steps_end_where_nothing_is_displaced(squeezed):
    """Before bodies touch, a frame is the rest shape: what is left of a guess after a step is all rounding."""
    case, _, free, size = squeezed
    rest = case.scene.rest_position.astype(np.float64)
    solver, position, sizes = NewtonSteps(case.scene, case.material, 0.0), nearly(rest, free, 0.01 * size), []
    for _ in range(3):
        before, position = position, solver.step(position)
        sizes.append(solver.size(before, position))
    assert sizes[0] > STILL and max(sizes[1:]) < 0.1 * STILL and rms((position - rest)[free]) < 1e-6 * size


def test_a_body_deep_inside_another_is_no_pair(squeezed):
    case, truth, *_ = squeezed
    solver = NewtonSteps(case.scene, case.material, 0.0)
    touching = len(solver.surfaces.pairs(truth).gap)
    apart = truth + np.where(case.scene.body == 1, 1.0, 0)[:, None]
    assert touching > 10 and len(solver.surfaces.pairs(apart).gap) == 0


def test_a_body_that_nothing_holds_is_refused():
    nodes, elements = box((2, 2, 2), (0.1, 0.1, 0.1))
    scene = scene_of(nodes, elements, np.zeros(len(nodes)), np.full(len(nodes), NodeType.NORMAL))
    solver = NewtonSteps(scene, RUBBER, 0.0)
    with pytest.raises(SimulationError, match="stiffness is singular"):
        solver.step(scene.rest_position.astype(float))


@pytest.mark.parametrize("size", [1e6, 1e30])
def test_positions_that_lead_nowhere_are_refused(squeezed, way, size):
    """A model that was trained badly answers with any numbers; the start of a step may be one of its answers."""
    case, truth, free, _ = squeezed
    position = truth + size * np.where(free[:, None], np.random.default_rng(0).standard_normal(truth.shape), 0)
    solver = NewtonSteps(case.scene, case.material, 0.0)
    with pytest.raises(SimulationError, match="too far from equilibrium"):
        for _ in range(4):
            position = solver.step(position, from_afar=True)


def test_forces_found_in_rounds_are_the_same_as_of_all_pairs_at_once(squeezed, monkeypatch):
    case, truth, free, size = squeezed
    start, found = nearly(truth, free, 0.1 * size), []
    for few in (2, 1000):
        monkeypatch.setattr(linearised_contact, "FEW", few)
        for friction in (0.0, 0.3):
            found.append(NewtonSteps(case.scene, case.material, 0.8 * DHAT, friction).step(start))
    assert rms(found[0] - found[2]) < 1e-6 * size and rms(found[1] - found[3]) < 1e-6 * size
    assert rms(found[0] - found[1]) > 1e-4 * size  # friction is felt


def test_forces_by_condensation_are_those_by_columns(squeezed, monkeypatch):
    case, truth, free, size = squeezed
    start, ends = nearly(truth, free, 0.1 * size), []
    for condensed in (True, False):
        monkeypatch.setattr(compliance, "condensation_pays", lambda *_, condensed=condensed: condensed)
        for friction in (0.0, 0.3):
            ends.append(NewtonSteps(case.scene, case.material, 0.8 * DHAT, friction).step(start))
    assert rms(ends[0] - ends[2]) < 1e-9 * size and rms(ends[1] - ends[3]) < 1e-8 * size


def test_forces_of_contact_are_those_of_least_squares():
    """Of random bodies, some with more pairs than degrees of freedom, as under a fine tool; and of one whose pairs take
    turns for ever if all that are wrong turn at once."""
    random, problems = np.random.default_rng(0), []
    for count in (1, 2, 5, 20, 20, 40):
        columns = random.normal(size=(count, max(1, 3 * count // 4)))
        problems.append((columns @ columns.T + 1e-6 * np.eye(count), random.normal(size=count) - 1))
    for count, freedoms in ((60, 6), (200, 9)):
        columns = random.normal(size=(count, freedoms))
        problems.append((columns @ columns.T, columns @ random.normal(size=freedoms)))
    circular = np.array(
        [
            [31, 8, -10, 1, 17, -4],
            [8, 30, -19, 4, 26, 24],
            [-10, -19, 18, 8, -18, -11],
            [1, 4, 8, 33, 0, 8],
            [17, 26, -18, 0, 37, 14],
            [-4, 24, -11, 8, 14, 26],
        ]
    )
    for give, offset in [*problems, (circular, np.array([-3, 3, -3, 3, 1, 2]))]:
        forces = linearised_contact._pressed(give, offset)
        give = give + linearised_contact.YIELDING * give.diagonal().mean() * np.eye(len(give))
        lower = np.linalg.cholesky(give)
        others = nnls(lower.T, -np.linalg.solve(lower, offset), maxiter=1000)[0]
        np.testing.assert_allclose(forces, others, atol=1e-6 * others.max())
        gap = give @ forces + offset
        assert forces.min() >= 0 and gap.min() >= -1e-8 and abs(gap[forces > 0]).max() < 1e-8


@pytest.mark.parametrize("share", [0.9, 0.7, 0.0])
def test_a_fine_tool_on_a_coarse_part(fine_tool, share):
    """Far more pairs than degrees of freedom touch, and what is near or still is a matter of the part's mesh. Steps
    from 10 % short, 30 % short and rest end within a few percent: the edges of the tool are sharp."""
    case, truth = fine_tool
    rest, free = case.scene.rest_position.astype(float), ~case.scene.prescribed
    solver = NewtonSteps(case.scene, case.material, 0.8 * case.contact.dhat)
    position = np.where(free[:, None], rest + share * (truth - rest), truth)
    for step in range(8):
        before, position = position, solver.step(position, from_afar=step == 0)
        if solver.size(before, position) <= STILL:
            break
    else:
        pytest.fail("the steps do not end")
    assert rms((position - truth)[free]) < 0.06 * rms((truth - rest)[free])


def test_a_step_can_be_watched_and_stopped(squeezed, way):
    """As by Ctrl-C: what the step knows so far is told, and the next step is not disturbed."""
    case, truth, free, size = squeezed
    start, told = nearly(truth, free, 0.1 * size), []
    solver = NewtonSteps(case.scene, case.material, 0.8 * DHAT, 0.3)
    solver.watch = told.append
    whole = solver.step(start)
    assert told[0] == 0 and told == sorted(told) and len(told) > 1

    def stop(forces: int) -> None:
        if forces:
            raise KeyboardInterrupt

    solver.watch = stop
    with pytest.raises(KeyboardInterrupt):
        solver.step(start)
    solver.watch = told.append
    assert np.array_equal(solver.step(start), whole)


def test_what_slides_feels_friction_against_its_way(way):
    """A block is pressed down, then pushed aside until it slides; the steps start from nearly what the solver finds. If
    it stuck where each step begins, any force would hold it; in truth the whole friction acts against its way."""
    case = pressed(*blocks(), depth=0.01, shift=0.03, friction=0.2)
    truth = quasi_static(case).position.astype(float)
    found, free, upper = truth[-1], ~case.scene.prescribed, case.scene.body == 1
    solver = NewtonSteps(case.scene, case.material, 0.92 * DHAT, 0.2)

    def pulled(position: np.ndarray) -> float:
        """The force along the way, of the force that presses."""
        forces = solver.elasticity.gradient(solver.elasticity.evaluate(position))[0][upper & ~free].sum(axis=0)
        return forces[0] / -forces[2]

    left, pull = {}, {}
    for known in ("here", "frame before", "nothing"):
        position = nearly(found, free, 0.1 * rms((found - truth[0])[free]))
        for _ in range(4):
            position = solver.step(position, stuck={"here": position, "frame before": truth[-2]}.get(known))
        left[known], pull[known] = rms((position - found)[free]), pulled(position) / pulled(found)
    assert pull["frame before"] == pytest.approx(1, abs=0.01) and pull["nothing"] == pytest.approx(1, abs=0.01)
    assert pull["here"] < 0.9
    assert max(left["frame before"], left["nothing"]) < 0.55 * left["here"]


def test_what_is_not_looked_at_is_not_near(squeezed, monkeypatch):
    """Only what comes near the box around the other body is compared; the pairs are the same as of whole surfaces."""
    case, truth, *_ = squeezed
    solver = NewtonSteps(case.scene, case.material, 0.0)
    pairs = solver.surfaces.pairs(truth)
    points, others = truth.T, truth[case.scene.body == 1].T
    kept = nearest_surface.beside(points, points, others, others, 0.0)
    assert 0 < kept.sum() < len(truth)
    monkeypatch.setattr(nearest_surface, "beside", lambda low, *_: np.ones(low.shape[1], bool))
    whole = solver.surfaces.pairs(truth)
    assert np.array_equal(pairs.gap, whole.gap) and abs(pairs.directions - whole.directions).max() < 1e-12
