"""Scenes in which nothing can deform: one clear line at training and at prediction, and never a NaN."""

import dataclasses

import numpy as np
import pytest
import toy

from ast_sim.cli import main
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.trained_run import Run
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.errors import DatasetError
from ast_sim.training import start
from ast_sim.training.validation import validation_frames

SMALL = ["train.steps=2", "train.batch_size=2", "train.statistics_pairs=4", "train.rollout_pool=0", "model.hidden=16"]
MORE = {"ast": ["model.d_token=16", "model.L_SA=1"], "mgn": ["model.blocks=1"]}
NOTHING, POINT = "all nodes are obstacles or handles, so nothing deforms", "all nodes that deform lie at one point"


def plate(which: np.ndarray | None = None, node_type: NodeType | None = None, place: int | None = None) -> Trajectory:
    """A plate; the chosen nodes have this type, or lie where the node `place` lies."""
    truth = toy.plate(0)
    kinds, rest, position = truth.scene.node_type.copy(), truth.scene.rest_position.copy(), truth.position.copy()
    if node_type is not None:
        kinds[which] = node_type
    if place is not None:
        rest[which], position[:, which] = rest[place], position[:, [place]]
    scene = dataclasses.replace(truth.scene, node_type=kinds, rest_position=rest)
    return dataclasses.replace(truth, scene=scene, position=position)


@pytest.mark.parametrize("dynamic", [False, True])
def test_where_the_solver_gave_up_at_once_there_is_nothing_to_learn_or_measure(tmp_path, dynamic):
    start_only = toy.plate(1, dynamic=dynamic)
    start_only = dataclasses.replace(start_only, position=start_only.position[:1], stress=start_only.stress[:1])
    with DatasetWriter(tmp_path / "toy.h5", toy.info(dynamic=dynamic)) as writer:
        for split in ("train", "valid", "test"):
            for truth in (toy.plate(0, dynamic=dynamic), start_only, toy.plate(2, dynamic=dynamic)):
                writer.add(split, truth)
    settings = start.configure(tmp_path / "toy.h5", "tiny", ["train.steps=2"])
    start.start_training(tmp_path / "run", settings)
    run = Run(tmp_path / "run")
    figures = run.evaluate().figures
    assert [scene.name for scene in figures.scenes] == ["test/000000", "test/000002"]
    assert [scene.name for scene in figures.deepest.scenes] == ["test/000000", "test/000002"]
    assert run.scope.travel[0] > 0 and run.scope.increment[0] > 0
    with DatasetWriter(tmp_path / "still.h5", toy.info(dynamic=dynamic)) as writer:
        writer.add("test", start_only)
    with pytest.raises(DatasetError, match="the split test has no frame to predict"):
        run.evaluate(tmp_path / "still.h5")


ALL, DEFORMING = slice(None), toy.plate(0).scene.deforming_nodes
BAD = {
    "obstacles only": (plate(ALL, NodeType.OBSTACLE), NOTHING),
    "handles only": (plate(ALL, NodeType.HANDLE), NOTHING),
    "zero size": (plate(ALL, place=0), POINT),
    "a body of zero size": (plate(DEFORMING, place=0), POINT),
}


def write(path, truth: Trajectory):
    with DatasetWriter(path, toy.info()) as writer:
        for split in ("train", "train", "valid", "test"):
            writer.add(split, truth)
    return path


@pytest.fixture(scope="module", params=["ast", "mgn"])
def trained(request, tmp_path_factory):
    """The name of a model, and a run of it."""
    folder = tmp_path_factory.mktemp("trained")
    data = toy.write(folder / "toy.h5")
    start.start_training(folder / "run", start.configure(data, "tiny", SMALL + MORE[request.param], request.param))
    return request.param, folder / "run"


@pytest.mark.parametrize("kind", BAD)
def test_a_scene_in_which_nothing_can_deform_is_one_line(trained, tmp_path, kind, capsys):
    (model, run), (truth, message) = trained, BAD[kind]
    data = write(tmp_path / "bad.h5", truth)
    sets = [part for setting in SMALL + MORE[model] for part in ("--set", setting)]
    for command in (
        ["train", str(data), "--out", str(tmp_path / "new"), "--model", model, *sets],
        ["predict", str(run), str(data), "--index", "0", "--out", str(tmp_path / "answer.h5")],
        ["evaluate", str(run), str(data)],
    ):
        assert main(command) == 2
        # The scene moves as one of the training does, which is told, too.
        (error,) = [line for line in capsys.readouterr().err.splitlines() if "learned from" not in line]
        assert message in error and "/000000" in error
    with pytest.raises(DatasetError, match=message):
        Run(run).predict(truth.scene, truth.position)
    assert not (tmp_path / "new" / "config.toml").exists() and not (tmp_path / "answer.h5").exists()


def test_coincident_nodes_of_an_element_are_refused(trained, tmp_path):
    model, run = trained
    first, second = toy.plate(0).scene.elements[0, :2]
    truth = plate(np.array([second]), place=first)
    data = write(tmp_path / "twin.h5", truth)
    flat = r"element 0 with the nodes \[0, 8, 10, 11\] has no volume; 2 of 72 elements have none: repair the mesh"
    with pytest.raises(DatasetError, match=flat):
        start.start_training(tmp_path / "new", start.configure(data, "tiny", SMALL + MORE[model], model))
    with pytest.raises(DatasetError, match=flat):
        Run(run).predict(truth)


@pytest.mark.parametrize(
    ("count", "frames"), [(2, [1]), (3, [1, 2]), (4, [1, 2, 3]), (5, [1, 2, 3, 4]), (41, [10, 20, 30, 40])]
)
def test_a_validation_asks_for_no_given_frame(count, frames):
    """Scenes of two or three frames are too short for four different ones."""
    assert validation_frames(count).tolist() == frames
