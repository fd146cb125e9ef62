"""What a report is told of a run: its model, and how the checkpoint was chosen."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from vtk_series import read

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.evaluation import deepest_frames, evaluate
from ast_sim.inference.trained_run import Run
from ast_sim.runs.sealed_line import seal
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError, RolloutError
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training

SETTINGS = ["train.steps=2", "model.hidden=16", "model.blocks=2"]
VALIDATED = ["train.validate_every=1"]


@pytest.mark.parametrize(
    ("validated", "choice"),
    [(0, "the last, none was validated"), (1, "the best of the validations by rollout")],
)
def test_how_the_checkpoint_was_chosen_is_said(tmp_path, validated, choice):
    data = toy.write(tmp_path / "toy.h5", (2, validated, 1))
    start_training(tmp_path / "run", configure(data, "tiny", [*SETTINGS, *VALIDATED][: 3 + validated], model="mgn"))
    run = Run(tmp_path / "run")
    evaluation = run.evaluate()
    assert "no solver to compare with" in evaluation.figures.deepest.no_solver  # by default it is wanted
    shown = evaluation.shown()
    assert shown.model == "mgn" and shown.facts["Checkpoint"] == f"step {run.step}, {choice}"
    assert [scene.prediction.stress_location for scene in shown.scenes] == ["node"]
    if validated:
        lines = [seal({"step": step, "valid_rmse": None}) for step in (1, 2)]
        (run.path / "metrics.jsonl").write_text("".join(lines))
        assert evaluation.shown().facts["Checkpoint"].endswith("the last, every validation failed")


def test_an_evaluation_keeps_no_answers(tmp_path, monkeypatch):
    """Whatever the number of scenes, it keeps figures only; a page predicts the few scenes that it shows once more."""
    data = toy.write(tmp_path / "toy.h5", (2, 0, 3))
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
    run = Run(tmp_path / "run")
    made = []

    def followed(function):
        def predicted(*arguments, **options):
            answers = function(*arguments, **options)
            made.extend(weakref.ref(answer) for answer in answers)
            return answers

        return predicted

    monkeypatch.setattr(evaluate, "predictions", followed(evaluate.predictions))
    monkeypatch.setattr(deepest_frames, "answers", followed(deepest_frames.answers))
    evaluation = run.evaluate(solver_scenes=0)
    gc.collect()
    assert len(made) == 6 and [answer() for answer in made] == [None] * 6
    assert len(evaluation.figures.scenes) == 3


def test_times_of_a_question_are_the_ones_of_its_answer(tmp_path):
    data = toy.write(tmp_path / "toy.h5", (2, 0, 1))
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
    run = Run(tmp_path / "run")
    truth = replace(toy.plate(2), stress_location="node")
    timed = replace(truth, times=tuple(7.0 * number for number in range(7)))
    assert run.predict(truth).trajectory.times == tuple(map(float, range(7)))  # by the time step of the data, 1 s
    answer = run.predict(timed, frames=[4, 2])
    assert [frame.time for frame in answer] == [28.0, 14.0] and answer.frame(2).time == 14.0
    assert answer.trajectory.times == (14.0, 28.0)
    answer.save(tmp_path / "answer.vtkhdf", timed)
    assert read(tmp_path / "answer.vtkhdf")[0] == [14.0, 28.0]
    answer.save(tmp_path / "answer.h5")
    with Dataset(tmp_path / "answer.h5") as stored:
        assert (stored["test"][0].numbers, stored["test"][0].times) == ((2, 4), (14.0, 28.0))
    uneven = replace(truth, times=(0.0, 0.1, 0.4, 0.5, 2.0, 3.0, 9.0))
    assert run.predict(uneven).trajectory.times == uneven.times


def test_times_of_a_dynamic_question(tmp_path):
    data = toy.write(tmp_path / "toy.h5", (2, 0, 1), dynamic=True)
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
    truth = replace(toy.plate(2, dynamic=True), stress_location="node", times=tuple(0.25 * n for n in range(7)))
    answer = Run(tmp_path / "run").predict(truth, throw=False)
    assert len(answer.frames) > 2
    assert [frame.time for frame in answer] == [0.25 * number for number in answer.frames]


def test_an_answer_without_frames_is_not_saved(tmp_path, monkeypatch):
    data = toy.write(tmp_path / "toy.h5", (2, 1, 1))
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
    run = Run(tmp_path / "run")
    scene = toy.plate(0)  # one of the training, so nothing is unusual
    monkeypatch.setattr(type(run), "expected_error", lambda self, effort: 0.77)
    question = {"frames": [3], "throw": False}
    whole = run.predict(replace(scene, stress_location="node"), **question)
    assert whole.expected_error == 0.77 and whole.frames == (3,)
    advance = run.model.advance
    monkeypatch.setattr(run.model, "advance", lambda *given: (torch.nan * advance(*given)[0], advance(*given)[1]))
    failed = run.predict(replace(scene, stress_location="node"), **question)
    assert failed.frames == () and failed.expected_error is None
    assert "expected error: not known" in repr(failed) and "expected_error" not in failed.trajectory.attributes
    message = "scene: the answer has no frame to save: scene: the predicted position of node 0 in frame 3 is not fin"
    for name in ("x.h5", "x.csv", "x.pvd", "x.vtkhdf"):
        with pytest.raises(RolloutError, match=message) as error:
            failed.save(tmp_path / "new" / name)
        assert error.value.answer is failed
    with pytest.raises(RolloutError, match=message):
        failed.save_forces(tmp_path / "new" / "forces.csv")
    assert not (tmp_path / "new").exists()
    with pytest.raises(RolloutError, match="the answer has no frame to draw: scene: the predicted position"):
        failed.plot()


def test_data_in_another_unit_are_converted(tmp_path):
    """The same plate in millimetres has the same errors, in metres, as it has in metres."""
    data, plate = toy.write(tmp_path / "toy.h5"), toy.plate(0)
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
    run, found = Run(tmp_path / "run"), []
    for unit, scale in (("m", 1), ("mm", 1000)):
        info = toy.info()
        facts = {"domain_half_width": scale * info.domain_half_width, "contact_radius": scale * info.contact_radius}
        scene = replace(plate.scene, rest_position=(scale * plate.scene.rest_position).astype(np.float32))
        with DatasetWriter(tmp_path / f"{unit}.h5", replace(info, length_unit=unit, **facts)) as writer:
            writer.add("test", replace(plate, scene=scene, position=(scale * plate.position).astype(np.float32)))
        figures = run.evaluate(tmp_path / f"{unit}.h5").figures
        assert figures.length_unit == "m"
        found.append(figures.scenes[0].error("displacement"))
    assert found[1] == pytest.approx(found[0], rel=1e-4) and found[0] > 0
    with pytest.raises(DatasetError, match="length_unit 'parsec' is unknown: use one of m, cm, mm, um, in"):
        Dataset(tmp_path / "mm.h5", "parsec")


def test_planar_scenes_stay_in_their_plane(tmp_path):
    """A sheet of triangles that a handle pulls in its plane; an untrained model would lift its nodes."""
    points = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0), [0.0], indexing="ij"), -1).reshape(-1, 3)
    corners = np.array([(3 * i + j, 3 * i + j + 3, 3 * i + j + 4, 3 * i + j + 1) for i in range(3) for j in range(2)])
    triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]).astype(np.int32)
    types = np.where(points[:, 0] == 3, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    scene = Scene(points.astype(np.float32), triangles, types, np.zeros(12, np.int32))
    pulled = points[None] * (1 + 0.02 * np.arange(5)[:, None, None])
    info = replace(toy.info(stress=False), domain_half_width=6.0)
    with DatasetWriter(tmp_path / "sheet.h5", info) as writer:
        for split in ("train", "test"):
            writer.add(split, Trajectory(scene, pulled.astype(np.float32)))
    start_training(tmp_path / "run", configure(tmp_path / "sheet.h5", "tiny", SETTINGS, model="mgn"))
    run = Run(tmp_path / "run")
    assert run.settings.model.data.planar
    with run.open() as dataset:
        answer = run.predict(dataset["test"][0])
    assert not answer.position[:, :, 2].any()
    assert np.abs(answer.position[1:, types == NodeType.NORMAL, :2] - points[types == NodeType.NORMAL, :2]).max() > 1e-4
