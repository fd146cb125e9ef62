"""What is said against a question or an answer whose numbers look as good as others."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.cli import main
from ast_sim.inference.answering import doubts
from ast_sim.support.errors import DatasetError, RolloutError

ROW = 97  # an element whose last corner can lie in the face of the others, so that no element before is flat


@pytest.fixture(scope="module")
def plate():
    """A plate and a punch, as the run that comes with the package knows them, and their motion."""
    scene = ast_sim.Scene.join(
        ast_sim.plate((0.48, 0.32, 0.03), cells=(8, 6, 2)),
        ast_sim.box((-0.05, -0.05, 0.023), (0.05, 0.05, 0.123), cells=(2, 2, 2)),
    )
    motion = np.repeat(scene.rest_position[None], 2, axis=0)
    motion[1, scene.node_type == ast_sim.NodeType.OBSTACLE] -= np.float32([0, 0, 0.03])
    return scene, motion


@pytest.fixture(scope="module")
def held(plate):
    """The same; the ends of the plate are held, and the punch is an obstacle."""
    scene, motion = plate
    types = np.where(np.abs(scene.rest_position[:, 0]) > 0.239, 3, scene.body).astype(np.uint8)
    motion = np.repeat(motion[:1], 2, axis=0)
    motion[1, scene.body == 1] -= np.float32([0, 0, 0.02])
    return replace(scene, node_type=types), motion


def told(scene, motion):
    """The warnings of a prediction by the run that comes with the package."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = ast_sim.example_run("plates").predict(scene, motion, effort=ast_sim.Effort())
    return answer, [str(one.message) for one in caught]


def test_elements_that_are_turned_over_are_told_with_their_number_and_frame(plate):
    scene, motion = plate
    answer, before = told(scene, motion)
    assert not any("turned over" in line for line in before)
    position = answer.position.copy()
    corner = scene.elements[np.flatnonzero(scene.deforming_elements)[0]]
    position[1, corner[3]] = 2 * position[1, corner[:3]].mean(axis=0) - position[1, corner[3]]
    bent = replace(answer, position=position)
    count = int(bent.check().turned_over.value)
    assert count > 0
    assert doubts(bent) == [f"{count} elements are turned over in frame 1, which no body can do (Answer.check)"]
    assert doubts(answer) == []


def test_elements_that_are_numbered_inside_out_are_not_turned_over(plate):
    """As `Answer.check` counts: what matters is the sign at rest."""
    scene, motion = plate
    numbered = replace(scene, elements=scene.elements[:, [0, 1, 3, 2]])
    answer, lines = told(numbered, motion)
    assert answer.check().turned_over.value == 0 and not any("turned over" in line for line in lines)


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_newton_steps_do_not_mind_how_elements_are_numbered(held, share):
    scene, motion = held
    turned = np.random.default_rng(0).random(scene.num_elements) < share
    numbered = replace(scene, elements=np.where(turned[:, None], scene.elements[:, [0, 1, 3, 2]], scene.elements))
    run, effort = ast_sim.example_run("plates"), ast_sim.Effort(newton_steps=2)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        one, other = (run.predict(each, motion, effort=effort) for each in (scene, numbered))
    assert np.array_equal(one.position, other.position) and np.array_equal(one.reaction(), other.reaction())
    assert other.check().residual.value == one.check().residual.value > 0
    assert not any("lie on each other" in str(line.message) for line in caught)


def test_a_mesh_that_folds_over_itself_is_told_and_has_no_newton_steps(held):
    scene, motion = held
    position = scene.rest_position.copy()
    corner = scene.elements[ROW]
    position[corner[3]] = 2 * position[corner[:3]].mean(axis=0) - position[corner[3]]
    folded = replace(scene, rest_position=position)
    count = len(folded.elements[folded.rest_volumes < 0])
    assert 0 < count < 20
    answer, lines = told(folded, motion)
    assert sum("the mesh folds over itself there, so it cannot be computed with" in line for line in lines) == 1
    assert answer.expected_error is None
    with pytest.raises(RolloutError, match="a Newton step failed: .* elements that lie on each other"):
        ast_sim.example_run("plates").predict(folded, motion, effort=ast_sim.Effort(newton_steps=1))


@pytest.mark.parametrize("body", ["deforming", "rigid"])
def test_elements_without_a_volume_are_refused_unless_they_are_rigid(held, body):
    scene, motion = held
    row = np.flatnonzero(scene.rigid_elements)[0] if body == "rigid" else ROW
    position = scene.rest_position.copy()
    position[scene.elements[row, 3]] = position[scene.elements[row, :3]].mean(axis=0)
    flat = replace(scene, rest_position=position)
    if body == "rigid":
        flat.require_predictable("scene")
        return
    nodes = re.escape(str(scene.elements[row].tolist()))
    text = f"scene: element {row} with the nodes {nodes} has no volume; \\d of {(~scene.rigid_elements).sum()} elements"
    with pytest.raises(DatasetError, match=text):
        told(flat, motion)


def test_bodies_that_overlap_at_rest_are_told_as_of_files(held):
    """Once each question; the same body twice is all overlap."""
    scene, motion = held
    inside = scene.rest_position - np.float32([0, 0, 0.033]) * (scene.body == 1)[:, None]
    overlapping = replace(scene, rest_position=inside)
    answer, lines = told(overlapping, motion - np.float32([0, 0, 0.033]) * (scene.body == 1)[:, None])
    told_of = [line for line in lines if "pairs of bodies that overlap" in line]
    assert len(told_of) == 1 and "body 1 lies 0.025 inside body 0 at the start" in told_of[0]
    assert answer.expected_error is None and not any("overlap" in line for line in told(scene, motion)[1])
    path = ast_sim.read_scene(overlapping.to_meshio())
    assert [f"scene: {line}" for line in path.warnings] == told_of
    twice = ast_sim.Scene.join(scene, scene)
    lines = told(twice, np.concatenate([motion, motion], axis=1))[1]
    assert any("body 2 stands where body 0 stands, wholly or in part, at the start; scenes" in line for line in lines)


def test_the_command_line_tells_an_overlap_once(held, tmp_path, capsys):
    """It describes the mesh before the prediction warns; what else looks wrong at rest stays in the description."""
    scene, _ = held
    inside = scene.rest_position - np.float32([0, 0, 0.033]) * (scene.body == 1)[:, None]
    mesh = replace(scene, rest_position=inside).to_meshio()
    mesh.points = np.concatenate([mesh.points, [[0.3, 0, 0], [0.31, 0, 0], [0.3, 0.01, 0], [0.3, 0, 0.01]]])
    mesh.cells[0].data = np.concatenate([mesh.cells[0].data, len(mesh.points) - 4 + np.arange(4)[None]])
    mesh.point_data = {"node_type": np.append(mesh.point_data["node_type"], np.full(4, 3))}
    mesh.cell_data = {}
    mesh.write(tmp_path / "mesh.vtu")
    move = ["--move", "1=0,0,-0.02", "--out", str(tmp_path / "a.h5")]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code = main(["predict", str(ast_sim.example_run("plates").path), str(tmp_path / "mesh.vtu"), *move])
    assert code == 0
    lines = "".join(capsys.readouterr()).splitlines()
    (told_of,) = [line for line in lines if "overlap" in line]
    assert "pairs of bodies that overlap: 1 (at" in told_of and "body 1 lies 0.025 inside body 0" in told_of
    assert sum("warning: bodies of one element: 1 (element " in line for line in lines) == 1


def test_overlaps_are_looked_for_once_in_a_scene(held, monkeypatch):
    scene, motion = held
    scene, looked = replace(scene), []
    monkeypatch.setattr("ast_sim.inference.predict_arguments.no_scene", lambda one: looked.append(one) or [])
    ast_sim.example_run("plates").predict_motions(scene, [motion, motion], effort=ast_sim.Effort())
    assert looked == [scene]


def test_points_that_rounding_puts_at_one_place_are_told():
    with pytest.warns(UserWarning, match="scene: rounding to float32 moves points by up to 0.001, and the shortest ed"):
        ast_sim.box((1e9, 0, 0), (1e9 + 1e-3, 1, 1), cells=(4, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ast_sim.box((1e3, 0, 0), (1e3 + 1, 1, 1), cells=(4, 1, 1))


def test_a_scene_so_flat_that_its_answer_turns_over_is_told(plate):
    """Its size and its edges are as in training; before, only Newton steps said that something is wrong."""
    scene, motion = plate
    flat = np.float32([1, 1, 1e-3])
    _, lines = told(replace(scene, rest_position=scene.rest_position * flat), motion * flat)
    assert any("elements are turned over in frame 1" in line for line in lines)


@pytest.mark.parametrize("axis", [0, 2])
def test_positions_that_single_precision_has_rounded_are_refused(plate, axis):
    """Along z, across the plate, elements have been rounded flat, too."""
    scene, motion = plate
    for distance, fits in ((1e3, True), (1e6, False)):
        shift = distance * np.eye(3, dtype=np.float32)[axis]
        moved = replace(scene, rest_position=scene.rest_position + shift)
        if fits:
            told(moved, motion + shift)
            continue
        with pytest.raises(
            DatasetError, match=r"lies 1e\+06 from the origin, where single precision keeps steps of 0.06"
        ):
            told(moved, motion + shift)


@pytest.mark.parametrize(("distance", "fits"), [(100.0, True), (1e4, False), (1e10, False), (1e30, False)])
def test_a_motion_to_places_that_single_precision_rounds_is_refused(held, distance, fits):
    """It was said of 1e10 that elements have no volume: the scene was moved by half of the way and rounded flat."""
    scene, motion = held
    far = motion.copy()
    far[-1, scene.body == 1, 2] -= np.float32(distance)
    if fits:
        assert any("prescribed nodes move up to 100 m" in line for line in told(scene, far)[1])
        return
    with pytest.raises(
        DatasetError, match=r"moves to places 1e\+\d\d from the origin, where .*: give a shorter motion"
    ):
        told(scene, far)


def test_free_nodes_of_no_element_are_told(plate):
    scene, motion = plate
    more = np.float32([[0.01 * k, 0, 0.01] for k in range(3)])
    wider = ast_sim.Scene(
        np.concatenate([scene.rest_position, more]),
        scene.elements,
        np.concatenate([scene.node_type, np.zeros(3, np.uint8)]),
        np.concatenate([scene.body, np.zeros(3, np.int32)]),
    )
    _, lines = told(wider, np.concatenate([motion, np.repeat(more[None], 2, axis=0)], axis=1))
    assert any("3 free nodes belong to no element: what is predicted for them means nothing" in line for line in lines)


def test_a_file_of_an_answer_holds_what_was_told(held, tmp_path):
    """Whoever reads the file has not seen the warnings."""
    scene, motion = held
    far = motion.copy()
    far[1, scene.body == 1] -= np.float32([0, 0, 0.2])
    answer, _ = told(scene, far)
    answer.save(tmp_path / "told.h5")
    replace(answer, notes=()).save(tmp_path / "usual.h5")
    kept = []
    for name in ("told", "usual"):
        with ast_sim.Dataset(tmp_path / f"{name}.h5") as data:
            kept.append(data["test"][0].attributes.get("notes"))
    assert kept == ["; ".join(answer.notes), None] and "move up to 0.22 m from their start" in kept[0]
