"""The deepest frame: relative errors, stress, times, and the solver's variants for the same frame."""

import itertools
import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
import toy

from ast_sim import Dataset, generate
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.figures import VariantFigures
from ast_sim.inference.answering import answers
from ast_sim.inference.effort import Effort, EffortErrors, cheapest_good, mean_errors
from ast_sim.inference.evaluation.deepest_frames import deepest_frames, errors_by_effort, lines
from ast_sim.inference.predicting import jump, jumping_scene
from ast_sim.inference.predicting.jump import answer_steps
from ast_sim.inference.predicting.question import Question, law_of
from ast_sim.mechanics.linearised.linearised_contact import STILL, NewtonSteps
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import find_preset
from ast_sim.models.simulator import Prediction, Simulator
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.errors import ConfigError, SimulationError
from ast_sim.support.progress import Patience
from ast_sim.training.data_lengths import measure


class Share(Simulator):
    """Goes a share of the way that is missing to the truth of one scene; the stress is a share of the true one."""

    def __init__(self, config, truth, frame, share):
        super().__init__(config)
        self.truth, self.stress, self.share = torch.tensor(truth.position[frame]), truth.stress[frame], share

    def forward(self, batch):
        return Prediction(
            self.share * (self.truth - batch.position), {"stress": torch.tensor(self.share * self.stress)}
        )


@pytest.fixture
def one(tmp_path):
    """A dataset whose test split is one toy plate."""
    with Dataset(toy.write(tmp_path / "toy.h5", counts=(1, 0, 1))) as dataset:
        yield dataset


def test_errors_are_shares_of_the_displacement(one):
    truth = one.load("test", 0)
    frame = deepest_frame(truth)
    assert 0 < frame < 6
    model = Share(replace(toy.config(toy.info()), jumps=True), truth, frame, 0.75)
    scene, *_ = deepest_frames(model, one, "test", Effort(2)).scenes
    free = ~truth.scene.prescribed
    size = np.sqrt(np.mean(np.square((truth.position[frame] - truth.position[0])[free].astype(float))))
    assert (scene.name, scene.frame, scene.displacement) == ("test/000000", frame, pytest.approx(size))
    assert scene.after_calls == pytest.approx([0.25, 0.25**2, 0.25**3], rel=1e-4) and scene.after_newton_steps == ()
    assert scene.relative_error == pytest.approx(0.25**3, rel=1e-4) and scene.seconds > 0
    there = truth.stress[frame][truth.scene.deforming("node")].astype(float)
    assert scene.stress_share == pytest.approx(0.25 * np.sqrt(np.mean(there**2)) / there.std(), rel=1e-5)
    assert scene.largest_stress == pytest.approx(0.25, rel=1e-5)


def test_a_failure_and_a_dataset_without_a_solver_are_told(one):
    truth = one.load("test", 0)
    model = Share(replace(toy.config(toy.info()), jumps=True), truth, 3, float("nan"))
    found = deepest_frames(model, one, "test", Effort(1), solver_scenes=1)
    assert found.relative_error is None and lines(found) == ["the deepest frame: every prediction failed"]
    model.share = 0.5
    found = deepest_frames(model, one, "test", Effort(1), solver_scenes=1)
    assert found.solver is None and "the solver was not run:" in lines(found)[-1]
    json.dumps(asdict(found), allow_nan=False)


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A dataset with one plate that the solver has pressed."""
    path = tmp_path_factory.mktemp("pressed") / "d.h5"
    generate("deforming_plate", path, train=1, valid=0, test=1, nodes=100, frames=5, workers=1)
    with Dataset(path) as dataset:
        yield dataset


def pressing(dataset, share):
    """A model that goes a share of the way to the solver's frame, with the settings that its data gives."""
    truth, scales = dataset.load("test", 0), measure(dataset)
    facts = DataFacts.of(dataset.info, (), scales.spacing, recorded=scales.recorded)
    settings = replace(find_preset("ast", "tiny").model, jumps=True).resolve(facts)
    return truth, Share(settings, truth, deepest_frame(truth), share)


def collapse(self, position, from_afar=False, stuck=None):
    raise SimulationError("collapsed")


def test_newton_steps_lead_from_the_answer_to_equilibrium(pressed, monkeypatch):
    truth, model = pressing(pressed, 0.7)
    frame = deepest_frame(truth)
    assert (
        (model.config.data.young, model.config.data.poisson)
        == (1e6, 0.4)
        == tuple(truth.attributes[key] for key in ("young", "poisson"))
    )
    monkeypatch.setattr(jumping_scene, "STILL", 0.0)
    found = deepest_frames(model, pressed, "test", Effort(1, 3)).scenes[0]
    calls, steps = found.after_calls, found.after_newton_steps
    assert calls == pytest.approx([0.3, 0.09], rel=1e-3) and len(steps) == 3
    assert steps[0] < 0.4 * calls[1] and steps[-1] < 0.015 and found.relative_error == steps[-1]
    assert found.stress_share < 0.05 and found.largest_stress < 0.05
    (answer,) = answers(model, [Question.of(truth, "plate", [frame])], Effort(1, 3))
    held = truth.scene.prescribed
    assert np.array_equal(answer.position[0][held], truth.position[frame][held])
    measured = errors_by_effort(model, truth, [Effort(0, 3), Effort(1, 3)])
    assert [one.effort for one in measured] == [Effort(c, k) for c in (0, 1) for k in range(4)]
    assert [one.not_converged for one in measured] == [0, 1, 1, 0] * 2
    assert [one.steps for one in measured] == [0, 1, 2, 3] * 2
    assert measured[7].stress_error == pytest.approx(found.stress_share)
    assert measured[5].stress_error > 1.1 * measured[7].stress_error
    assert [one.error for one in measured[4:]] == [calls[1], *steps] and measured[0].error == calls[0]
    monkeypatch.setattr(NewtonSteps, "step", collapse)
    fallen = errors_by_effort(model, truth, [Effort(0, 3), Effort(1, 3)])
    assert [one.error for one in fallen] == [calls[0], None, None, None, calls[1], None, None, None]
    assert [EffortErrors.from_json(json.loads(json.dumps(asdict(one)))) for one in fallen] == fallen


def test_newton_steps_that_do_not_end_begin_again_after_more_corrections(pressed, monkeypatch):
    truth, model = pressing(pressed, 0.4)
    frame = deepest_frame(truth)
    question, free = [Question.of(truth, "plate", [frame])], ~truth.scene.prescribed
    (first,) = answer_steps(model, question, Effort(1, 10))
    assert first.steps == [10] and first.last_step[0] > STILL  # with 0.36 of the way missing
    (again,) = answer_steps(model, question, Effort(3, 10))  # with 0.13 missing
    (answer,) = answers(model, question, Effort(1, 10))
    assert answer.converged and np.array_equal(answer.position[0], again.after_newton_steps[-1][0])
    assert np.array_equal(answer.stress[0], again.stress_after_newton_steps[-1][0]) and answer.seconds > 0
    size = np.linalg.norm((truth.position[frame] - truth.position[0])[free])
    assert np.linalg.norm((answer.position[0] - truth.position[frame])[free]) < 0.02 * size
    (nine,) = answers(model, question, Effort(1, 9))
    assert nine.converged is False  # who asks for fewer steps gets no second start
    step, made = NewtonSteps.step, []

    def fail_later(self, position, from_afar=False, stuck=None):
        made.append(1)
        return step(self, position, from_afar, stuck) if len(made) <= 10 else collapse(self, position)

    monkeypatch.setattr(NewtonSteps, "step", fail_later)
    (kept,) = answers(model, question, Effort(1, 10))
    assert len(made) == 11 and kept.failure is None and kept.converged is False
    assert np.array_equal(kept.position[0], first.after_newton_steps[-1][0])


def test_friction_knows_the_frame_before_if_that_is_wanted_too(pressed, monkeypatch):
    truth, model = pressing(pressed, 0.9)
    step, stuck_at = NewtonSteps.step, {}

    def watched(self, position, from_afar=False, stuck=None):
        stuck_at.setdefault(len(stuck_at) if from_afar else len(stuck_at) - 1, stuck)
        return step(self, position, from_afar, stuck)

    monkeypatch.setattr(NewtonSteps, "step", watched)
    monkeypatch.setattr(jump, "BATCH_NODES", 1)  # the model takes one frame at a time
    last = truth.num_frames - 1
    (whole,) = answers(model, [Question.of(truth, "plate", None)], Effort(1, 2))
    assert len(stuck_at) == last and all(np.array_equal(stuck_at[k], whole.position[k]) for k in range(last))
    for frames, known in (([last], [False]), ([1], [False]), ([0, 1, 3], [True, False])):
        stuck_at.clear()
        answers(model, [Question.of(truth, "plate", frames)], Effort(1, 2))
        assert [stuck is not None for stuck in stuck_at.values()] == known
    # Frames in different domains are predicted apart, but in which domain does not matter to friction.
    numbers = itertools.cycle(range(2))
    monkeypatch.setattr(model, "domain", lambda position: next(numbers))
    stuck_at.clear()
    answers(model, [Question.of(truth, "plate", None)], Effort(1, 2))
    assert len(stuck_at) == last and all(stuck is not None for stuck in stuck_at.values())


def test_newton_steps_need_a_material(one, pressed):
    truth, model = pressing(pressed, 0.7)
    question = [Question.of(truth, "plate", [-1])]
    model.config = replace(model.config, data=replace(model.config.data, young=0.0))
    with pytest.raises(
        ConfigError, match="newton_steps is 1, but the law of the material is not known: it has no columns"
    ):
        answers(model, question, Effort(0, 1))
    model.config = replace(model.config, jumps=False)
    with pytest.raises(ConfigError, match="corrections is 2; it needs a run that jumps"):
        answers(model, question, Effort(2))
    with pytest.raises(ConfigError, match="newton_steps is -1; it must be at least 0"):
        Effort(0, -1)
    with pytest.raises(ConfigError, match="corrections is 1.5; it must be a whole number"):
        Effort(corrections=1.5)
    assert not any(measure(one).recorded.values())


def test_newton_steps_end_when_one_is_small(pressed, monkeypatch):
    truth, model = pressing(pressed, 0.6)
    question = [Question.of(truth, "plate", [deepest_frame(truth)])]
    monkeypatch.setattr(jumping_scene, "STILL", 0.0)
    (all_steps,) = answer_steps(model, question, Effort(1, 6))
    newton = law_of(model.config).newton_steps(truth.scene)
    positions = [all_steps.after_calls[-1], *all_steps.after_newton_steps]
    sizes = [newton.size(*(one[0].astype(float) for one in pair)) for pair in itertools.pairwise(positions)]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > STILL > sizes[-1]
    assert all_steps.steps == [6] and all_steps.last_step[0] == pytest.approx(sizes[-1], abs=1e-5)
    monkeypatch.undo()
    needed = next(k for k, size in enumerate(sizes, 1) if size <= STILL)
    (ended,) = answer_steps(model, question, Effort(1, 6))
    assert ended.steps == [needed] and ended.last_step[0] == pytest.approx(sizes[needed - 1], rel=1e-3)
    assert np.array_equal(ended.after_calls, all_steps.after_calls)
    assert np.array_equal(ended.after_newton_steps[:needed], all_steps.after_newton_steps[:needed])
    last = ended.after_newton_steps[needed - 1]
    assert len(ended.after_newton_steps) == 6 and all(
        np.array_equal(one, last) for one in ended.after_newton_steps[needed:]
    )
    assert np.array_equal(ended.stress_after_newton_steps[:needed], all_steps.stress_after_newton_steps[:needed])
    assert len(ended.stress_after_newton_steps) == 6
    (answer,) = answers(model, question, Effort(1, 6))
    assert answer.converged and answer.last_steps == (ended.last_step[0],)
    assert np.array_equal(answer.position[0], last[0]) and np.array_equal(
        answer.stress[0], ended.stress_after_newton_steps[-1][0]
    )
    assert answer.trajectory.attributes["last_newton_steps"] == list(answer.last_steps)
    (short,) = answers(model, question, Effort(1, 1))
    assert short.converged is False and short.last_steps == (pytest.approx(sizes[0], rel=1e-3),)
    assert answers(model, question, Effort(1))[0].converged is None
    found = deepest_frames(model, pressed, "test", Effort(1, 1))
    assert found.not_converged == 1 and "in 1 of 1 scene the Newton steps have not converged" in "\n".join(lines(found))
    assert deepest_frames(model, pressed, "test", Effort(1, 6)).not_converged == 0


def test_a_quiet_prediction_says_nothing_of_newton_steps_that_take_long(pressed, monkeypatch, capfd):
    truth, model = pressing(pressed, 0.7)
    question = [Question.of(truth, "plate", [deepest_frame(truth)])]
    monkeypatch.setattr(Patience, "QUIET", 0.0)
    answers(model, question, Effort(0, 2), progress=False)
    assert capfd.readouterr() == ("", "")
    answers(model, question, Effort(0, 2), progress=True)
    assert f"plate frame {deepest_frame(truth)}: Newton step 2 of at most 2\n" in capfd.readouterr().err


def measured(errors, stresses, steps, not_converged):
    """What `cheapest_good` takes, from tables by corrections and Newton steps."""
    return [
        EffortErrors(
            Effort(c, k), error, None if stresses is None else stresses[c][k], steps[c][k], not_converged[c][k]
        )
        for c, row in enumerate(errors)
        for k, error in enumerate(row)
    ]


def test_the_default_effort_is_the_cheapest_that_is_good():
    errors = np.array([[0.2, 0.1, 0.05, 0.03], [0.1, 0.05, 0.018, 0.01], [0.08, 0.04, 0.012, 0.009]])
    steps = np.array([[0, 1, 2, 3], [0, 1, 1.9, 2.8], [0, 1, 1.7, 1.7]])
    ended = np.zeros((3, 4))
    assert cheapest_good(measured(errors, None, steps, ended)) == Effort(2, 3)  # 3.7 together; 3.8 after one
    steps[1, 3] = 2.6
    assert cheapest_good(measured(errors, None, steps, ended)) == Effort(1, 3)
    ended[1, 3] = 0.1  # in one scene of ten the steps have not converged
    assert cheapest_good(measured(errors, None, steps, ended)) == Effort(2, 3)
    ended[2, 3] = 0.1
    assert cheapest_good(measured(errors, None, steps, ended)) == Effort(1, 3)
    assert cheapest_good(measured(errors / 4.5, None, steps, ended)) == Effort(2)  # good without Newton steps
    assert cheapest_good(measured(10 * errors, None, steps, ended)) == Effort(2, 3)  # the only one nearly the best
    failed = [[*row] for row in errors[:2]] + [[None] * 4]
    assert cheapest_good(measured(failed, None, steps, ended)) == Effort(1, 3)
    assert cheapest_good(measured([[None] * 4] * 3, None, steps, ended)) == Effort()
    assert cheapest_good(measured(errors[:2, :1], None, steps, ended)) == Effort(1)


def test_stress_decides_the_default_effort_too():
    errors, steps = [[0.015, 0.002], [0.012, 0.001]], [[0.0, 2.5], [0.0, 2.0]]
    stress, ended = np.array([[0.8, 0.3], [0.6, 0.05]]), np.zeros((2, 2))
    assert cheapest_good(measured(errors, stress, steps, ended)) == Effort(1, 1)
    assert cheapest_good(measured(errors, 10 * stress, steps, ended)) == Effort(1, 1)  # none is good: the best
    stress = [[0.05, 9.0], [9.0, 9.0]]
    assert cheapest_good(measured(errors, stress, steps, ended)) == Effort()
    errors[0][0] = 0.1
    assert cheapest_good(measured(errors, stress, steps, ended)) == Effort(1)  # never both


def test_means_over_scenes_lack_what_one_scene_lacks():
    one = measured([[0.2, 0.1]], [[0.5, 0.3]], [[0, 2]], [[0, 0]])
    other = measured([[0.4, None]], [[None, None]], [[0, 1]], [[0, 1]])
    assert mean_errors([one, other]) == [
        EffortErrors(Effort(0, 0), pytest.approx(0.3), None, 0, 0),
        EffortErrors(Effort(0, 1), None, None, 1.5, 0.5),
    ]


def test_beside_the_solver(tmp_path):
    """A model that gives the truth: only variants as accurate as it count, so the own stop test is the cheapest."""
    made = generate("deforming_plate", tmp_path / "d.h5", train=1, valid=0, test=1, nodes=100, frames=5, workers=1)
    with Dataset(made.path) as dataset:
        truth = dataset.load("test", 0)
        frame = deepest_frame(truth)
        config = replace(toy.config(dataset.info), jumps=True)
        config = replace(config, data=replace(config.data, stress="node"))
        found = deepest_frames(Share(config, truth, frame, 0.99), dataset, "test", Effort(), solver_scenes=1)
    solver = found.scenes[0].solver
    assert found.relative_error == pytest.approx(0.01, rel=1e-3)
    assert solver.variants["own stop test"].relative_error < 1e-3
    assert solver.cheapest_seconds <= solver.seconds
    assert solver.variants[solver.cheapest].relative_error <= 0.01
    assert found.solver.ratio == pytest.approx(solver.seconds / found.scenes[0].seconds)
    assert any("the solver for this frame" in line for line in lines(found))
    assert not any("coarser mesh" in line for line in lines(found))
    halves = {name: figures for name, figures in solver.variants.items() if "1/2 nodes" in name}
    assert len(halves) == 14
    unmeshed = {name: VariantFigures(failure="could not be meshed: too thin") for name in halves}
    scene = replace(found.scenes[0], solver=replace(solver, variants={**solver.variants, **unmeshed}))
    assert lines(replace(found, scenes=(scene,)))[-1] == (
        "  in 1 of 1 scene the solver has no coarser mesh to begin on, also not for nested iteration: could not be"
        " meshed: too thin"
    )
    json.dumps(asdict(found), allow_nan=False)


def test_scenes_that_do_not_move_are_no_failures(one, tmp_path):
    """ "Every prediction failed" stood below a table with "failed: 0"; still scenes beside others were not told."""
    truth = one.load("test", 0)
    still = replace(truth, position=np.repeat(truth.position[:1], len(truth.position), axis=0))
    for moving, told in (
        (0, ["the deepest frame: nothing moves in 2 of 2 scenes, so there is no relative error"]),
        (1, ["  without 2 of 3 scenes, in which nothing moves"]),
    ):
        path = tmp_path / f"{moving}.h5"
        with DatasetWriter(path, toy.info()) as writer:
            for trajectory in (*[truth] * moving, still, still):
                writer.add("test", trajectory)
        model = Share(replace(toy.config(toy.info()), jumps=True), truth, deepest_frame(truth), 0.75)
        with Dataset(path) as dataset:
            found = lines(deepest_frames(model, dataset, "test", Effort()))
        assert set(told) <= set(found) and not any("failed" in line for line in found)
