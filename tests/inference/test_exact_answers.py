"""Exact answers: where the solver ends, from the answer of a model or along the load path."""

from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.cli import main
from ast_sim.inference.effort import choices
from ast_sim.inference.evaluation.deepest_frames import deepest_frames
from ast_sim.material import Material
from ast_sim.mechanics.equilibria import Equilibria
from ast_sim.mechanics.linearised.linearised_contact import NewtonSteps
from ast_sim.mechanics.physics_check import Law
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.errors import ConfigError, SimulationError

FROM_MODEL = "solved to the stop test of the solver, from the answer of the model"
ALONG_LOAD_PATH = "solved to the stop test of the solver, along the load path, frame by frame"


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    """Plates of the solver, in a file."""
    path = tmp_path_factory.mktemp("plates") / "plates.h5"
    ast_sim.generate("deforming_plate", path, train=0, valid=0, test=4, nodes=400, frames=41, keep=(14, 24), seed=77)
    return path


def loaded(path):
    with ast_sim.Dataset(path) as data:
        return [data["test"][index] for index in range(data.count("test"))]


def equilibria_of(scene, law, targets):
    return Equilibria.of(scene, law, targets, law.newton_steps(scene))


def test_an_exact_answer_ends_where_the_solver_ended(plates):
    """One of these plates has two equilibria: the load path leads to the one of the dataset."""
    run = ast_sim.example_run("plates")
    others = []
    for truth in loaded(plates):
        answer = run.predict(truth, effort=ast_sim.Effort.exact())
        assert answer.converged and answer.source["solved"] == FROM_MODEL == answer.how_far[0]
        assert answer.expected_error is None  # no validation has measured it
        rounding = replace(answer, position=truth.position).check().residual.value  # of float32
        assert answer.check().residual.value < 2 * rounding
        if answer.errors(truth)["displacement"] > 1e-5:
            others.append(truth)
            continue
        assert answer.errors(truth)["stress"] < 1e-4
        force = np.linalg.norm(answer.reaction(), axis=1)[1:]
        assert force == pytest.approx(truth.attributes["reaction"][1:], rel=1e-3)
    assert len(others) == 1
    position, along_load_path = equilibria_of(others[0].scene, answer.law, others[0].position).solve(2, None)
    assert along_load_path and np.abs(position - others[0].position[2]).max() < 1e-6


def test_a_pair_of_parts_that_snaps_ends_where_the_solver_ended(tmp_path):
    """With 60 iterations a step, which is enough elsewhere, the last frame of this pair is given up after 500."""
    path = tmp_path / "pairs.h5"
    ast_sim.generate("abcd", path, train=0, valid=5, test=0, nodes=400, keep=(10, 15, 20), seed=11, progress=False)
    with ast_sim.Dataset(path) as data:
        truth = data["valid"][4]
    law = Law(Material(("young", "poisson"), {"friction": truth.attributes["friction"]}), truth.attributes["dhat"])
    position, _ = equilibria_of(truth.scene, law, truth.position).solve(3, None)
    displacement = np.linalg.norm(truth.position[3] - truth.scene.rest_position)
    assert np.linalg.norm(position - truth.position[3]) < 1e-3 * displacement


def test_only_frames_that_newton_steps_move_far_are_solved(plates):
    run = ast_sim.example_run("plates")
    truth = loaded(plates)[0]
    steps = ast_sim.Effort(newton_steps=10)
    stepped, exact = (run.predict(truth, effort=one) for one in (steps, replace(steps, solved=True)))
    first = run.predict(truth, effort=ast_sim.Effort())
    free = truth.scene.deforming_nodes & ~truth.scene.prescribed
    moves = [
        np.linalg.norm((stepped.position[frame] - first.position[frame])[free])
        / np.linalg.norm(stepped.displacement[frame][free])
        for frame in (1, 2)
    ]
    far = int(np.argmax(moves)) + 1
    between = replace(steps, solved=True, solved_beyond=float(np.mean(moves)))
    answer = run.predict(truth, effort=between)
    for frame in (1, 2):
        wanted = exact if frame == far else stepped
        np.testing.assert_array_equal(answer.position[frame], wanted.position[frame])
    assert answer.source["solved"] == f"1 of 2 frames {FROM_MODEL}"
    none = run.predict(truth, effort=replace(between, solved_beyond=1.0))
    np.testing.assert_array_equal(none.position, stepped.position)
    assert "solved" not in none.source
    assert between.text.endswith(f"then the solver where they move a frame by more than {100 * np.mean(moves):g} %")


def test_a_frame_whose_newton_steps_fail_is_solved(plates, monkeypatch):
    run = ast_sim.example_run("plates")
    truth = loaded(plates)[0]

    def fail(*arguments, **options):
        raise SimulationError("the stiffness is singular")

    monkeypatch.setattr(NewtonSteps, "step", fail)
    effort = ast_sim.Effort(newton_steps=1, solved=True, solved_beyond=0.5)
    answer = run.predict(truth, frames=[1], effort=effort)
    assert answer.source["solved"] == ALONG_LOAD_PATH and answer.errors(truth)["displacement"] < 1e-5
    with run.open(plates) as data:
        (scene,) = deepest_frames(run.model, data, "test", effort, most_scenes=1).scenes
    assert scene.relative_error < 1e-5 < scene.after_calls[0] and scene.after_newton_steps == ()


def test_scenes_that_the_solver_ends_are_evaluated_beside_others(plates):
    run = ast_sim.example_run("plates")
    one_step = ast_sim.Effort(newton_steps=1)
    moves = []
    for truth in loaded(plates):
        frame = [deepest_frame(truth)]
        called, stepped = (run.predict(truth, frames=frame, effort=one) for one in (ast_sim.Effort(), one_step))
        free = truth.scene.deforming_nodes & ~truth.scene.prescribed
        move = np.linalg.norm((stepped.position - called.position)[0, free])
        moves.append(move / np.linalg.norm(stepped.displacement[0, free]))
    effort = replace(one_step, solved=True, solved_beyond=float(np.median(moves)))
    with run.open(plates) as data:
        some, none = (deepest_frames(run.model, data, "test", one) for one in (effort, one_step))
    ended = [scene.relative_error != scene.after_newton_steps[0] for scene in some.scenes]
    assert ended == [move > np.median(moves) for move in moves] and sum(ended) == 2
    assert (some.after_calls, some.after_newton_steps) == (none.after_calls, none.after_newton_steps)
    assert none.after_newton_steps[0] == pytest.approx(none.relative_error, rel=1e-12)


def test_a_poor_start_makes_the_solver_go_the_way_of_the_load(plates, monkeypatch):
    """The weights of nobody: bodies overlap after the Newton steps, or these fail."""
    run = ast_sim.example_run("plates")
    run.calibration = None
    truth = loaded(plates)[0]
    solved = []
    solve = Equilibria.solve
    monkeypatch.setattr(
        Equilibria, "solve", lambda self, frame, start: solved.append(frame) or solve(self, frame, None)
    )
    answer = run.predict(truth, frames=[2], effort=ast_sim.Effort.exact())
    assert solved == [2] and answer.source["solved"] == ALONG_LOAD_PATH
    assert answer.errors(truth)["displacement"] < 1e-5


def test_only_a_start_without_overlap_is_taken(plates):
    run = ast_sim.example_run("plates")
    truth = loaded(plates)[0]
    law = run.predict(truth, effort=ast_sim.Effort()).law
    there = truth.position.astype(float)
    equilibria = equilibria_of(truth.scene, law, there)
    position, along_load_path = equilibria.solve(2, there[2])
    assert not along_load_path and np.abs(position - there[2]).max() < 1e-6
    inside = np.where(truth.scene.prescribed[:, None], there[2], there[0])  # the plate at rest, the obstacle in it
    position, along_load_path = equilibria.solve(2, inside)
    assert along_load_path and np.abs(position - there[2]).max() < 1e-4
    assert equilibria_of(truth.scene, law, there).solve(1, None)[1]


def test_with_friction_the_solver_goes_the_way_of_the_load(plates):
    """It sticks where it touched first; the answer is the one of the solver frame by frame."""
    run = ast_sim.example_run("plates")
    truth = loaded(plates)[1]
    law = run.predict(truth, effort=ast_sim.Effort()).law
    rough = replace(law, material=replace(law.material, constants={**law.material.constants, "friction": 0.4}))
    equilibria = equilibria_of(truth.scene, rough, truth.position)
    position, along_load_path = equilibria.solve(2, truth.position[2].astype(float))
    again, _ = equilibria_of(truth.scene, rough, truth.position).solve(2, None)
    assert along_load_path and np.array_equal(position, again)
    smooth, _ = equilibria_of(truth.scene, law, truth.position).solve(2, None)
    assert np.abs(position - smooth).max() > 1e-5


def test_a_wanted_error_below_all_others_is_given_to_the_solver(plates):
    run = ast_sim.example_run("plates")
    truth = loaded(plates)[0]
    assert choices(run.settings.model, 0)[-1] == ast_sim.Effort.exact()
    answer = run.predict(truth, frames=[-1], error=0.001)
    assert answer.source["effort"] == "0 corrections, up to 1 Newton step, then the solver"
    assert answer.errors(truth)["displacement"] < 1e-3


def test_the_command_line_has_exact_answers(plates, tmp_path, capsys):
    ast_sim.example_run("plates").save(tmp_path / "run.ast")
    told = [
        "predict",
        str(tmp_path / "run.ast"),
        str(plates),
        "--index",
        "0",
        "--out",
        str(tmp_path / "a.h5"),
        "--exact",
    ]
    assert main(told) == 0
    assert FROM_MODEL in capsys.readouterr().out
    assert main([*told, "--newton-steps", "3", "--overwrite"]) != 0
    assert "an exact answer needs no numbers" in capsys.readouterr().err


def test_what_has_no_law_has_no_exact_answer(plates):
    run = ast_sim.example_run("plates")
    data = replace(run.settings.model.data, contact_range=0.0)
    run.model.config = replace(run.settings.model, data=data)
    with pytest.raises(ConfigError, match="can give no exact answer: the range of contact is not known"):
        run.predict(loaded(plates)[0], effort=ast_sim.Effort.exact())
