"""What a report is told of a run: its model, and how the checkpoint was chosen."""

from dataclasses import replace

import numpy as np
import pytest
import toy

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.trained_run import Run
from ast_sim.runs.sealed_line import seal
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import DatasetError
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training

SETTINGS = ["train.steps=2", "model.hidden=16", "model.blocks=2", "train.validate_every=1"]


@pytest.mark.parametrize(
    ("validated", "choice"),
    [(0, "the last, none was validated"), (1, "the best of the validations by rollout")],
)
def test_how_the_checkpoint_was_chosen_is_said(tmp_path, validated, choice):
    data = toy.write(tmp_path / "toy.h5", (2, validated, 1))
    start_training(tmp_path / "run", configure(data, "tiny", SETTINGS, model="mgn"))
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
