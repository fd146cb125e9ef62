"""The solver at one frame, beside which a model is judged: real solves of tiny scenes in real worker processes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.simulate.jobs.fastest_solver import (
    FINER,
    VARIANTS,
    Outcome,
    SolverVariant,
    cheapest,
    deepest_frame,
    solver_outcomes,
)
from ast_sim.simulate.jobs.fastest_solver_worker import VariantSolver
from ast_sim.simulate.jobs.generate import generate
from ast_sim.simulate.jobs.recipe import recipe_of
from ast_sim.simulate.jobs.samples import Recipe, draw_sample
from ast_sim.simulate.shapes.mesh_check import BadMesh
from ast_sim.support.errors import ConfigError, DatasetError, SimulationError

OWN, LOOSER = SolverVariant("own stop test"), SolverVariant("10x looser", tolerance=10)
SETTINGS = {"seed": 5, "nodes": 150, "frames": 9, "workers": 1, "progress": False}


def test_pages_state_the_number_of_variants():
    docs = Path(__file__).parents[3] / "docs"
    for page in ("how-to/choose-effort.md", "reference/solver.md"):
        counts = re.findall(r"(\d+) (?:variants|settings of the solver)", (docs / page).read_text(encoding="utf-8"))
        assert counts == [str(len(VARIANTS))], page


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    return generate(
        "deforming_plate", tmp_path_factory.mktemp("solver") / "a.h5", train=2, valid=0, test=0, **SETTINGS
    ).path


@pytest.fixture
def no_torch(tmp_path, monkeypatch):
    """A process that imports torch fails."""
    folder = tmp_path / "no_torch"
    folder.mkdir()
    (folder / "torch.py").write_text("raise AssertionError('torch was imported')")
    monkeypatch.setenv("PYTHONPATH", str(folder))


def changed(plates, path, generator=None, **changes):
    """The dataset with other facts about itself."""
    with Dataset(plates) as data:
        info = replace(data.info, generator=data.info.generator if generator is None else generator, **changes)
        with DatasetWriter(path, info) as writer:
            for trajectory in data["train"]:
                writer.add("train", trajectory)
    return path


def test_other_meshes_of_second_order_plates_are_of_second_order_too(tmp_path):
    settings = {**SETTINGS, "nodes": 600, "order": 2, "keep": (5,)}
    ten = generate("deforming_plate", tmp_path / "ten.h5", train=1, valid=0, test=0, **settings).path
    half, nested = SolverVariant("half", nodes=0.5), SolverVariant("nested", nodes=0.5, linearised=6, newton=2)
    (scene,) = solver_outcomes(ten, "train", [0], variants=(OWN, half, nested, FINER), starts=(1,), progress=False)
    own, coarse, kept, finer = scene.outcomes
    with Dataset(ten) as data:
        assert data.element_size == 10 and own.nodes == data.scene("train", 0).num_nodes == 497
    assert coarse.nodes == kept.nodes == 278 and finer.nodes == 3155
    assert max(own.errors.values()) < 1e-4
    assert 0.02 < coarse.relative_error < 0.15 and 0.1 < coarse.reaction_error < 0.5
    assert kept.relative_error < 0.02 and kept.reaction_error < 0.03  # by quadratic shape functions, on a coarse mesh
    assert 0.02 < finer.relative_error < 0.08 and 0.1 < finer.reaction_error < 0.3  # 500 nodes are few


def test_every_way_is_solved_and_compared_with_the_dataset(plates, no_torch, capsys):
    told = []
    found = list(solver_outcomes(plates, "train", [0, 1], repeats=2, progress=lambda *values: told.append(values)))
    assert [values[:2] for values in told] == [(1, 2), (2, 2)] and capsys.readouterr().err == ""
    assert [(scene.split, scene.index) for scene in found] == [("train", 0), ("train", 1)]
    with Dataset(plates) as data:
        for scene in found:
            truth = data.load("train", scene.index)
            frame, free = truth.position[scene.frame].astype(float), ~truth.scene.prescribed
            assert scene.frame == deepest_frame(truth) and scene.draw_seconds > 0 and scene.processor
            moved = frame - truth.position[0]
            assert scene.displacement == pytest.approx(np.sqrt((moved[free] ** 2).sum(axis=1).mean()), rel=1e-6)
            assert [outcome.variant for outcome in scene.outcomes] == list(VARIANTS)
            for outcome in scene.outcomes:
                assert outcome.converged and outcome.position.dtype == np.float64
                # Prescribed nodes are exact, up to the float32 of the dataset.
                np.testing.assert_allclose(outcome.position[~free], frame[~free], atol=1e-7)
                error = np.sqrt(((outcome.position - frame)[free] ** 2).sum(axis=1).mean())
                assert outcome.error == pytest.approx(error) and outcome.relative_error == error / scene.displacement
                assert 0 < outcome.seconds < 30 and outcome.setup_seconds > 0 and outcome.newton_iterations > 0
                if outcome.variant.linearised:
                    steps = outcome.variant.linearised
                    assert (outcome.start, outcome.load_steps) == (steps, steps)
                    counted = steps + 1 + outcome.variant.newton
                    assert (outcome.newton_iterations > counted) == outcome.variant.finished
                    assert outcome.newton_iterations >= counted
                    assert outcome.variant.nodes < 1 or outcome.relative_error < 0.03
                if outcome.variant.newton:
                    assert outcome.relative_error < {1: 0.03, 2: 0.005, 3: 0.005}[outcome.variant.newton]
                if outcome.variant.linearised:
                    continue
                assert outcome.load_steps >= {1: 1, 2: 2, 4: 3, 0: scene.frame}[outcome.start]
                assert (outcome.nodes < truth.scene.num_nodes) == (outcome.variant.nodes < 1)


def test_the_own_stop_test_gives_the_frame_of_the_dataset(plates):
    """Without friction there is one equilibrium here. Both solves leave forces of at most 1e-4 of the mean force of an
    element, so their positions differ by about that share of the displacement; looser tests by as much more.
    """
    for scene in solver_outcomes(plates, "train", [0, 1], lambda _: 5, variants=VARIANTS[:3], progress=False):
        assert scene.frame == 5
        for outcome, most in zip(scene.outcomes, (1e-4, 1e-3, 1e-2), strict=True):
            assert outcome.relative_error <= 3 * most, outcome.variant


def test_frame_by_frame_every_frame_is_a_load_step(plates):
    (scene,) = solver_outcomes(plates, "train", [0], [5], variants=[OWN], starts=[0], progress=False)
    (outcome,) = scene.outcomes
    assert outcome.start == 0 and outcome.load_steps >= 5 and outcome.relative_error <= 3e-4


def test_coarser_meshes_and_a_longer_range_of_contact_differ_but_resemble_it(plates):
    (scene,) = solver_outcomes(plates, "train", [0], variants=VARIANTS[3:7], starts=[1], progress=False)
    doubled, fourfold, half, quarter = (outcome.relative_error for outcome in scene.outcomes)
    assert 1e-3 < doubled < fourfold < 0.3
    assert 1e-3 < half < quarter < 0.6


def test_nested_iteration_counts_the_coarse_solution_and_corrects_it(plates):
    """Without friction there is one equilibrium at the clearance with which contact is linearised. Newton's method ends
    there, from a coarser mesh and from load steps on the mesh itself."""
    coarse = SolverVariant("coarse", nodes=0.5, linearised=6)
    variants = [coarse, *(SolverVariant(f"{n} after", nodes=0.5, linearised=6, newton=n) for n in (1, 2, 6))]
    variants.append(SolverVariant("straight", linearised=6, newton=6))
    (scene,) = solver_outcomes(plates, "train", [0], variants=variants, progress=False)
    before, one, two, six, straight = scene.outcomes
    assert before.nodes == one.nodes == six.nodes < straight.nodes
    for after in (one, two, six):
        assert after.seconds > before.seconds and after.setup_seconds > before.setup_seconds
        assert after.newton_iterations == before.newton_iterations + after.variant.newton
    assert before.relative_error > 5 * one.relative_error > 10 * two.relative_error
    np.testing.assert_allclose(six.position, straight.position, rtol=0, atol=1e-5 * scene.displacement)


def test_the_solver_finishes_what_began_nearly_right(plates):
    """It ends where it ends from rest, in fewer iterations there; from overlaps it does not begin."""
    coarse = SolverVariant("coarse", nodes=0.5, linearised=6, newton=1)
    straight = SolverVariant("straight", linearised=6)
    finished = [replace(variant, finished=True) for variant in (coarse, straight)]
    overlapping = SolverVariant("overlapping", nodes=0.5, linearised=6, finished=True)
    variants = [OWN, coarse, straight, *finished, overlapping]
    (scene,) = solver_outcomes(plates, "train", [0], variants=variants, progress=False)
    own, *begun, from_coarse, from_straight, refused = scene.outcomes
    for start, end in zip(begun, (from_coarse, from_straight), strict=True):
        assert end.relative_error < 1e-4 < start.relative_error
        assert start.newton_iterations < end.newton_iterations < start.newton_iterations + own.newton_iterations
        assert end.whole_seconds > start.whole_seconds
    assert "surfaces intersect" in refused.failure


def test_what_fails_is_said_and_not_raised(plates):
    (scene,) = solver_outcomes(plates, "train", [0], [5], variants=[OWN, LOOSER], most_iterations=2, progress=False)
    for outcome in scene.outcomes:
        assert outcome.failure == "more than 2 Newton iterations" and outcome.position is None and outcome.seconds > 0
    assert cheapest(scene.outcomes, 1.0) is None

    def refuse(share):
        shares.append(share)
        raise BadMesh(f"no mesh with {share:g} of the nodes")

    shares, drawn = [], draw_sample(Recipe("deforming_plate", 5, 150, 9), "train", 0)
    effort = {"starts": [1], "repeats": 1, "most_iterations": 9}
    solver = VariantSolver(
        replace(drawn, remesh=refuse), (2, 5), drawn.case.prescribed_position[5], SolverSettings(), effort
    )
    outcomes = [solver.outcome(variant) for variant in VARIANTS[5:]]
    assert outcomes[0].failure == "could not be meshed: no mesh with 0.5 of the nodes"
    assert outcomes[3].failure == "could not be meshed: no mesh with 0.25 of the nodes"
    for outcome in outcomes:
        assert outcome.converged == (outcome.variant.nodes == 1), outcome.variant
    assert not outcomes[0].converged and outcomes[0].relative_error == outcomes[0].seconds == np.inf
    assert shares[:2] == [0.5, 0.475] and len(shares) == 10  # each share is meshed once, with sizes near it


def test_the_cheapest_is_the_fastest_that_is_as_accurate():
    fast, slow = (Outcome(OWN, seconds=s, relative_error=e) for s, e in ((1.0, 0.05), (2.0, 0.01)))
    failed = Outcome(LOOSER, "no equilibrium", seconds=0.1)
    assert cheapest([failed, slow, fast], 0.05) is fast
    assert cheapest([failed, slow, fast], 0.04) is slow
    assert cheapest([failed, slow, fast], 0.001) is None
    assert cheapest([replace(fast, setup_seconds=1.5), slow], 0.05) is slow  # what is set up for the mesh counts


def test_kept_frames_are_frames_of_the_whole_motion(plates, tmp_path):
    kept = generate("deforming_plate", tmp_path / "b.h5", train=1, valid=0, test=0, keep=(3, 6), **SETTINGS).path
    (scene,) = solver_outcomes(kept, "train", [0], [2], variants=[OWN], starts=[1], progress=False)
    (whole,) = solver_outcomes(plates, "train", [0], [6], variants=[OWN], starts=[1], progress=False)
    assert scene.outcomes[0].relative_error <= 3e-4
    np.testing.assert_array_equal(scene.outcomes[0].position, whole.outcomes[0].position)


def test_only_datasets_of_the_bundled_solver_are_solved_again(plates, tmp_path):
    with Dataset(plates) as data:
        generator = data.info.generator
        assert recipe_of("a.h5", data.info).nodes == 150
    cases = {
        "converted": {"generator": {"program": "another"}},
        "calculix": {"generator": {**generator, "solver": "calculix"}},
        "cloth": {"family": "sphere_simple", "integration": "dynamic"},
    }
    for name, changes in cases.items():
        path = changed(plates, tmp_path / f"{name}.h5", **changes)
        with pytest.raises(ConfigError, match="was not generated by the bundled solver"):
            solver_outcomes(path, "train", [0])
    broken = changed(plates, tmp_path / "broken.h5", {**generator, "nodes": "many"})
    with pytest.raises(ConfigError, match="its settings cannot be read"):
        solver_outcomes(broken, "train", [0])
    other = changed(plates, tmp_path / "other.h5", {**generator, "seed": 6})
    with pytest.raises(SimulationError, match="train/000000: drawing the scene again gives another one"):
        list(solver_outcomes(other, "train", [0], progress=False))
    with pytest.raises(ConfigError, match="was made without parts of your own or a specification: leave .* out"):
        solver_outcomes(plates, "train", [0], made_from=tmp_path)


def test_frames_and_trajectories_that_are_not_there(plates):
    for frames in ([0], [9], lambda _: 9):
        with pytest.raises(ConfigError, match="train/000000 has no frame [09]: 1 to 8"):
            solver_outcomes(plates, "train", [0], frames)
    with pytest.raises(ConfigError, match="1 frame is too few"):
        solver_outcomes(plates, "train", [0, 1], [3])
    with pytest.raises(DatasetError, match="no sample 2 in train"):
        solver_outcomes(plates, "train", [2])
    with pytest.raises(ConfigError, match="must be at least 0"):
        solver_outcomes(plates, "train", [0], starts=[-1])


def test_a_process_that_ends_before_its_time_is_named(plates, monkeypatch):
    monkeypatch.setattr("ast_sim.simulate.jobs.fastest_solver.SOLVER_MODULE", "ast_sim.no_such_module")
    with pytest.raises(SimulationError, match="train/000000: its worker process"):
        list(solver_outcomes(plates, "train", [0], progress=False))
