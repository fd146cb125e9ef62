"""What a person hands over by mistake: each gets one line that names the argument, none is taken for something else."""

import math
import os
import re
import warnings
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
import torch
import toy
from meshes import plate_and_punch

import ast_sim
from ast_sim import Effort, Material, Motion, Scene
from ast_sim.support.argument_checks import file_name, in_short, require_bool, several
from ast_sim.support.errors import AstSimError, ConfigError, DatasetError

PRESS = {1: (0, 0, -0.01)}
POINTS, CELLS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]
NO_NAME = "must be the name of a file or a folder"


class Place:
    """A path of a class of one's own."""

    def __init__(self, name) -> None:
        self.name = name

    def __fspath__(self):
        return self.name


def refused(call, text: str) -> None:
    """The call ends with an error of ours, in one line that holds the text."""
    with pytest.raises(AstSimError, match=re.escape(text)) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def run():
    return ast_sim.example_run("plates")


@pytest.fixture(scope="module")
def scene():
    mesh = plate_and_punch((0.48, 0.32, 0.03), (11, 8, 2), 0.008)
    return ast_sim.read_scene(mesh, obstacles=[1], clamps=["0:xmin,xmax"]).scene


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("odd") / "toy.h5")


@pytest.fixture(scope="module")
def answer(run, scene):
    return run.predict(scene, PRESS, num_frames=3, effort=Effort())


def test_the_checks_by_hand(tmp_path):
    assert file_name("a", "x") == file_name(Path("a"), "x") == file_name("\udcff", "x").with_name("a") == Path("a")
    for wrong in (b"a", Place(b"a"), Place(5), "\ud800", "", "a\0", 5, None):
        refused(lambda wrong=wrong: file_name(wrong, "x"), NO_NAME)
    assert several("x", (n for n in (1, 2)), "numbers") == several("x", np.array([1, 2]), "numbers") == [1, 2]
    assert in_short("a" * 99) == f"'{'a' * 49}..." and in_short(np.zeros((9, 9))) == "of the type ndarray"
    assert in_short(10**400) == f"1{'0' * 49}..." and in_short(Scene) == "the class Scene"
    require_bool(a=True, b=False)
    refused(lambda: require_bool(throw="no"), "throw is 'no'; it must be True or False")
    refused(lambda: require_bool(throw=1), "throw is 1; it must be True or False")
    for value in (5, None, "", b"a", "a\0b", ["a"]):
        refused(lambda value=value: file_name(value, "out"), f"out is {in_short(value)}; it {NO_NAME}")


def test_tensors_of_torch_are_read_or_refused(run, scene):
    points = torch.from_numpy(np.array(scene.rest_position))
    for kind in (points, points.double()):
        made = Scene.of(kind, scene.elements, node_type=scene.node_type, body=scene.body)
        np.testing.assert_array_equal(made.rest_position, scene.rest_position)
    for kind in (points.bfloat16(), points.clone().requires_grad_(), points.to("meta"), points.to_sparse()):
        refused(
            lambda kind=kind: Scene.of(kind, scene.elements), "scene: points is no array of NumPy: hand over .detach"
        )
        refused(
            lambda kind=kind: run.predict(scene, kind[None]), "the motion: position is no array of NumPy: hand over"
        )


def test_truth_values_are_no_numbers(run, scene):
    kinds = {"node_type": scene.prescribed, "body": scene.prescribed}  # True is no NodeType, though it equals OBSTACLE
    for name, kind in kinds.items():
        refused(
            lambda name=name, kind=kind: Scene.of(scene.rest_position, scene.elements, **{name: kind}),
            f"scene: {name} must be whole numbers, not bool",
        )
    refused(lambda: run.predict(scene, {1: (False, False, True)}), "translation of a motion must be three numbers or")
    refused(lambda: ast_sim.RigidMotion(rotation=True), "rotation of a motion must be one finite number")
    moved = torch.tensor((0, 0, -0.01), requires_grad=True)
    refused(lambda: ast_sim.RigidMotion(moved), "translation of a motion must be three numbers or")


@pytest.mark.parametrize("kind", ["a mesh", "plates.h5", 5, [], np.zeros((3, 3)), Scene, {}])
def test_what_is_no_scene(run, kind):
    refused(lambda: run.predict(kind, PRESS), f"scene is {in_short(kind)}; it must be a Scene, a Trajectory or what")


@pytest.mark.parametrize(
    ("motion", "text"),
    [
        ([(1, (0, 0, -0.01))], "the motion: position must be an array"),
        ("down", "the motion: position must be numbers"),
        ({True: (0, 0, -0.01)}, "body is True; it must be a whole number"),
        ({1.0: (0, 0, -0.01)}, "body is 1.0; it must be a whole number"),
        ({"1": (0, 0, -0.01)}, "body is '1'; it must be a whole number"),
    ],
)
def test_what_is_no_motion(run, scene, motion, text):
    refused(lambda: run.predict(scene, motion), text)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"effort": 3}, "effort is 3; it must be an Effort"),
        ({"effort": "exact"}, "effort is 'exact'"),
        ({"effort": Effort}, "effort is the class Effort"),
        ({"stress": "a"}, "stress must be numbers"),
        ({"stress": [[1, 2], [3]]}, "stress must be an array"),
        ({"throw": "no"}, "throw is 'no'; it must be True or False"),
        ({"name": 5}, "name is 5; it must be a text"),
        ({"frames": np.ma.masked_array([1, 2], [True, False])}, "or a slice, not of the type MaskedArray"),
        ({"frames": {1: 2}}, "frames must be whole numbers, one such number, or a slice, not of the type dict"),
        ({"progress": lambda: None}, "it must be True, False or a function of (done, total, text)"),
    ],
)
def test_arguments_of_a_prediction(run, scene, changes, text):
    refused(lambda: run.predict(scene, PRESS, **changes), text)


def test_a_stress_that_is_not_finite_is_refused(run, scene):
    stress = np.zeros((1, scene.num_nodes, 1))
    stress[0, 7] = math.nan
    refused(lambda: run.predict(scene, PRESS, stress=stress), "stress in frame 0 at node 7 is not finite")


def test_arguments_of_several_predictions(run, scene):
    pairs = "it must be a list of pairs of a scene and a motion"
    for scenes in (None, 5, "ab", np.array(5), {"a": (scene, PRESS)}):
        refused(lambda scenes=scenes: run.predict_scenes(scenes), f"scenes is {in_short(scenes)}; {pairs}")
    for scenes in ([scene], [(scene,)]):
        refused(lambda scenes=scenes: run.predict_scenes(scenes), "it must be a pair of a scene and a motion")
    refused(lambda: run.predict_scenes([(scene, PRESS)], names=["a", "b"]), "there are 2 names for 1 scene")
    refused(lambda: run.predict_scenes([(scene, PRESS)], names="a"), "names is 'a'; it must be a list")
    for motions in (None, PRESS):
        text = f"motions is {in_short(motions)}; it must be a list of motions"
        refused(lambda motions=motions: run.predict_motions(scene, motions, num_frames=3), text)
    (answer,) = run.predict_scenes([(scene, PRESS)], names=(n for n in ["a"]), frames=-1, effort=Effort())
    assert answer.name == "a"
    both = run.predict_motions(scene, [PRESS] * 2, num_frames=3, frames=(n for n in [2]), effort=Effort())
    assert [answer.frames for answer in both] == [(2,), (2,)]


def test_files_that_have_no_name(run, scene, data, answer, tmp_path):
    calls = {
        "path": [
            ast_sim.Run,
            ast_sim.Dataset,
            run.save,
            answer.save,
            answer.save_forces,
            ast_sim.new_model,
        ],
        "spec": [lambda x: run.predict(spec=x), run.sweep, lambda x: ast_sim.worth(x, tmp_path / "w", 5)],
        "out": [lambda x: ast_sim.train(data, x), lambda x: ast_sim.generate("deforming_plate", x, train=1)],
        "parts": [lambda x: ast_sim.generate("abcd", tmp_path / "p.h5", train=1, parts=x)],
        "data": [run.open, run.evaluate, lambda x: ast_sim.train(x, tmp_path / "r")],
        "source": [lambda x: ast_sim.convert(x, tmp_path / "c.h5")],
        "from_run": [lambda x: ast_sim.train(data, tmp_path / "r", from_run=x)],
        "config": [lambda x: ast_sim.train(data, tmp_path / "r", config=x)],
    }
    for name, takers in calls.items():
        for take in takers:
            for value in (5, ""):
                refused(lambda take=take, value=value: take(value), f"{name} is {value!r}; it {NO_NAME}")
    refused(lambda: ast_sim.read_scene(5), "source is 5; it must be the name of a file or a mesh of meshio")
    refused(lambda: ast_sim.convert(tmp_path / "none", tmp_path / "c.h5"), "there is no such file or folder")
    refused(
        lambda: ast_sim.convert(data, tmp_path / "c.h5", shares=1), "there is no option shares; did you mean 'names'?"
    )
    refused(
        lambda: ast_sim.convert(data, tmp_path / "c.h5", split=1), "there is no option split; did you mean 'splits'?"
    )
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Effort(newton_steps=None), "newton_steps is None; it must be a whole number"),
        (
            lambda: Effort(newton_steps=1, solved=True, solved_beyond="far"),
            "solved_beyond is 'far'; it must be a number",
        ),
        (
            lambda: Effort(newton_steps=1, solved=True, solved_beyond=-0.1),
            "solved_beyond is -0.1; it must be at least 0",
        ),
        (
            lambda: Effort(newton_steps=1, solved=True, solved_beyond=math.nan),
            "solved_beyond is nan; it must be at most",
        ),
        (lambda: Effort(newton_steps=1, solved_beyond=0.1), "solved_beyond says which frames are solved"),
        (lambda: Effort(solved=True, solved_beyond=0.1), "solved_beyond says which frames are solved"),
        (lambda: Effort(solved="yes"), "solved is 'yes'; it must be True or False"),
        (lambda: Material("young"), "columns is 'young'; it must be a list of names"),
        (lambda: Material(("young", "young")), "two columns of the material have one name"),
        (lambda: Material((), {"poisson": math.nan}), "poisson of a material is nan; it must be a number"),
        (lambda: Material((), {"poisson": "0.3"}), "poisson of a material is '0.3'; it must be a number"),
        (lambda: Scene.of(POINTS, CELLS, obstacles=0), "obstacles is 0; it must be a list of the numbers of bodies"),
        (lambda: Scene.of(POINTS, CELLS, obstacles=[0.0]), "body is 0.0; it must be a whole number"),
        (lambda: Scene.of(POINTS, CELLS, obstacles="0"), "obstacles is '0'; it must be a list"),
        (lambda: Scene.of(np.ma.masked_equal(POINTS, 1), CELLS), "points has masked numbers"),
        (lambda: Scene.of(POINTS, CELLS, handles=2), "handles is 2; it must be a list of nodes"),
        (lambda: Scene.join(Scene.of(POINTS, CELLS), 5), "a scene to join is 5; it must be a Scene"),
        (lambda: Scene.from_meshio(5), "the mesh is 5; it must be a mesh of meshio"),
        (lambda: Motion.of_bodies(None, PRESS, 3), "scene is None; it must be a Scene"),
        (lambda: Motion.of_bodies(Scene.of(POINTS, CELLS), None, 3), "motions is None; it must be the motion of each"),
        (lambda: Motion.of_bodies(Scene.of(POINTS, CELLS), PRESS, 2.5), "frames is 2.5; it must be a whole number"),
        (lambda: ast_sim.box((0, 0, 0), (1, 1, 1), 2), "cells is 2; it must be a list of three numbers"),
        (lambda: ast_sim.box((0, 0, 0), (1, 1, 1), (2, 2)), "the box has [2, 2] cells; must be three whole numbers"),
        (lambda: ast_sim.box((0, 0, 0), (1, 1), (2, 2, 2)), "the box: high must be three finite numbers, not [1, 1]"),
        (lambda: ast_sim.ball((0, 0, math.inf), 1, 4), "the ball: center must be three finite numbers"),
        (lambda: ast_sim.box("a", "b", (2, 2, 2)), "the box: low must be numbers"),
        (lambda: ast_sim.box((0, 0, 0), (1, 1, 1), (True, True, True)), "cells; must be three whole numbers"),
        (lambda: ast_sim.ball((0, 0, 0), 1, 4.0), "the ball has [4.0] cells; must be an even whole number"),
        (lambda: ast_sim.ball((0, 0, 0), "1", 4), "the ball: its sizes must be numbers"),
        (lambda: ast_sim.plate((1, 1, 0.1), (4, 4, 1), [(0, 0, -0.1)]), "holes of the plate must be triples"),
        (lambda: ast_sim.plate((1, 1, 0.1), (4, 4, 1), [(0, 0)]), "holes of the plate must be triples"),
        (lambda: ast_sim.plate((1, 1, 0.1), (4, 4, 1), [(0, 0, math.nan)]), "holes of the plate must be triples"),
        (lambda: ast_sim.FieldNames(displacement=""), "FieldNames: displacement is ''; it must be a name"),
        (lambda: ast_sim.FieldNames(obstacle=5), "FieldNames: obstacle is 5; it must be a name"),
        (lambda: ast_sim.FieldNames(fields=[5]), "FieldNames: fields is [5]; it must be a name"),
        (lambda: ast_sim.FieldNames(material="young"), "material is 'young'; it must be a list of names"),
        (lambda: ast_sim.FieldNames(newton=math.nan), "FieldNames: newton is nan"),
        (lambda: ast_sim.FieldNames(newton="1"), "FieldNames: newton is '1'; it must be a number"),
        (lambda: Motion(None).check(Scene.of(POINTS, CELLS)), "position of a motion is None; it must be an array"),
        (lambda: ast_sim.TensorBoard(__file__), "cannot be made (File exists)"),
        (lambda: ast_sim.example_run(5), "there is no example run 5"),
    ],
)
def test_objects_that_cannot_be(make, text):
    refused(make, text)


def test_whole_numbers_of_numpy_become_plain_ones():
    assert (
        repr(Effort(np.int64(2), np.int32(1)))
        == "Effort(corrections=2, newton_steps=1, solved=False, solved_beyond=0.0, precision='float32')"
    )


def test_marks_of_a_mesh(scene):
    mesh = scene.to_meshio()
    for arguments, text in (
        ({"obstacles": 1}, "obstacles is 1; it must be a list"),
        ({"obstacles": [True]}, "body is True; it must be a whole number"),
        ({"clamps": "0:xmin"}, "clamps is '0:xmin'; it must be a list of texts"),
        ({"clamps": [0]}, "a clamp is 0; it must be a text"),
        ({"materials": "steel"}, "materials must be numbers"),
        ({"corners": "yes"}, "corners is 'yes'; it must be True or False"),
    ):
        refused(lambda arguments=arguments: ast_sim.read_scene(mesh, **arguments), text)
    assert isinstance(mesh, meshio.Mesh)


def test_a_dataset_of_what_it_cannot_hold(tmp_path):
    truth, info = toy.plate(), toy.info()

    def write(trajectory=truth, facts=info):
        with ast_sim.DatasetWriter(tmp_path / "w.h5", facts) as writer:
            writer.add("train", trajectory)

    for trajectory, text in (
        (truth.scene, "trajectory is of the type Scene; it must be a Trajectory"),
        (None, "trajectory is None; it must be a Trajectory"),
        (replace(truth, scene=5), "its scene is 5; it must be a Scene"),
        (replace(truth, fields=None), "its fields is None; it must be fields by name"),
        (replace(truth, frames=map(float, range(7))), "frames must be whole numbers and ascend"),
        (replace(truth, position=truth.position.tolist()), "position must be an array of float32"),
        (replace(truth, times=(0, 1, 2, 3, 4, 5, "a")), "times must be finite and ascend"),
        (replace(truth, fields={"PEEQ": truth.stress}), "the field PEEQ is of the type ndarray"),
        (replace(truth, attributes={5: 1}), "the name of an attribute is 5; it must be a text"),
        (replace(truth, attributes=None), "the attributes is None; it must be values by name"),
    ):
        refused(lambda trajectory=trajectory: write(trajectory), text)
    for changes, text in (
        ({"family": ""}, "family is ''; must be a text"),
        ({"family": 5}, "family is 5; must be a text"),
        ({"generator": "me"}, "generator is 'me'; must be facts by name"),
        ({"contact_radius": "a"}, "contact_radius must be numbers"),
        ({"domain_center": 5}, "domain_center must be three finite numbers, not 5"),
        ({"time_step": (1, 2)}, "time_step must be one finite number"),
        ({"domain_half_width": math.inf}, "domain_half_width must be one finite number, not inf"),
    ):
        refused(lambda changes=changes: write(facts=replace(info, **changes)), text)
    refused(lambda: write(facts=None), "info is None; it must be a DatasetInfo")
    writer = ast_sim.DatasetWriter(tmp_path / "w.h5", info)
    with writer:
        writer.add("train", truth)
    refused(lambda: writer.add("train", truth), "add in the block of `with DatasetWriter(...)`")
    (tmp_path / "w.h5").unlink()
    assert not list(tmp_path.iterdir())


def test_frames_and_scenes_by_number(data):
    with ast_sim.Dataset(data) as dataset:
        truth = dataset["test"][0]
        with pytest.raises(IndexError, match="^test has 2 scenes: there is no 5$"):
            dataset["test"][5]
    assert truth.select(number for number in (2, 0)).numbers == (0, 2)
    for frames in (list(range(7)), np.arange(7), iter(range(7))):
        assert replace(truth, frames=frames).numbers == tuple(range(7))
    refused(replace(truth, stress_location="nodes").check, "stress_location is 'nodes'; it must be 'node' or 'element'")
    with ast_sim.Dataset(data) as dataset:
        for index in ("0", 0.5, None):
            text = f"index is {index!r}; it must be a whole number"
            refused(lambda index=index: dataset.load("test", index), text)
        refused(lambda: dataset.load("test", 0, "PEEQ"), "fields is 'PEEQ'; it must be a list of names")
        with pytest.raises(TypeError, match="'slice' object cannot be interpreted as an integer"):
            dataset.torch("test")[0:2]
    refused(lambda: ast_sim.FramePairs(data, "test"), "it must be an open ast_sim.Dataset")
    refused(lambda: truth.select(1), "frames is 1; it must be a list of whole numbers")
    refused(lambda: truth.select([1.0]), "frames is 1.0; it must be a whole number")
    refused(lambda: truth.select([]), "frames is empty: name at least one")


def test_questions_to_an_answer(answer, scene, tmp_path):
    refused(lambda: answer.band("force"), "a band of 'force' is not known; known are displacement, reaction, stress")
    refused(lambda: answer.errors(scene), "truth is of the type Scene; it must be a Trajectory")
    refused(lambda: answer.save(tmp_path / "a.csv", 5), "truth is 5; it must be a Trajectory")
    for origin in (5, (0, 0), (math.nan, 0, 0)):
        refused(lambda origin=origin: answer.figures(origin), "origin must be three finite numbers")


def test_errors_beside_a_truth_of_another_motion_are_not_written(answer, tmp_path):
    """ParaView would show how far two motions are apart, as if it were the error of the answer."""
    moved = replace(answer.trajectory, position=answer.trajectory.position.copy())
    answer.save(tmp_path / "a.vtkhdf", moved)
    moved.position[-1, answer.scene.prescribed] += 0.001
    refused(lambda: answer.save(tmp_path / "b.vtkhdf", moved), "compare with a simulation of the same motion")
    assert not (tmp_path / "b.vtkhdf").exists()


def test_arguments_of_long_work(data, run, answer, tmp_path, tmp_path_factory):
    series = tmp_path_factory.mktemp("series") / "a.pvd"
    answer.save(series)

    def train(**settings):
        return lambda: ast_sim.train(data, tmp_path / "run", steps=1, progress=False, **settings)

    def convert(**options):
        return lambda: ast_sim.convert(series, tmp_path / "c.h5", progress=False, **options)

    def generate(**settings):
        return lambda: ast_sim.generate("deforming_plate", tmp_path / "g.h5", progress=False, **settings)

    for call, text in (
        (train(resume="no"), "resume is 'no'; it must be True or False"),
        (train(callback=5), "callback is 5; it must be a function of (step, figures)"),
        (train(callback=ast_sim.TensorBoard), "callback is the class TensorBoard; it must be a function of"),
        (train(state=["PEEQ"], model_settings={"state": ["U"]}), "model_settings has the state, too: give it once"),
        (train(preset=""), "there is no preset of ast ''"),
        (train(model=""), "there is no model ''"),
        (lambda: ast_sim.train(data, data, steps=1, progress=False), "cannot be made (File exists)"),
        (lambda: ast_sim.train(tmp_path, tmp_path / "r", steps=1, progress=False), "is a folder: name the file"),
        (train(state=5), "state is 5; it must be a list of names"),
        (train(state="PEEQ"), "state is 'PEEQ'; it must be a list of names"),
        (train(model_settings=5), "model_settings is 5; it must be values by name"),
        (train(model=5), "there is no model 5"),
        (train(preset=5), "there is no preset of ast 5"),
        (convert(names=5), "names is 5; it must be ast_sim.FieldNames(...)"),
        (convert(splits=5), "splits is 5; it must be shares or names of simulations by split"),
        (convert(splits={"train": math.nan}), "must be at least 0 and add up to 1"),
        (convert(splits={"train": "one"}), "train is 'one'; it must be a list of names"),
        (lambda: ast_sim.plan(data, tmp_path / "p", None), "minutes is None; it must be a number"),
        (lambda: ast_sim.worth("a.toml", tmp_path / "p", None), "minutes is None; it must be a number"),
        (lambda: run.sweep("a.toml", [1]), "parameters is of the type list; it must be values by name"),
        (generate(patient="no"), "patient is 'no'; it must be True or False"),
        (generate(seed=None), "seed is None; must be from 0 to"),
        (generate(workers=1.5), "workers is 1.5; it must be a whole number"),
        (generate(workers=True), "workers is True; it must be a whole number"),
        (lambda: ast_sim.calibrate("run"), "a run is 'run'; it must be a Run"),
        (lambda: ast_sim.trade(5), "a run is 5; it must be a Run"),
        (lambda: ast_sim.trade(run, beside=run), "beside is of the type Run; it must be a list of runs"),
        (
            lambda: run.evaluate(data, solver_scenes=0, made_from="spec.toml"),
            "made_from is for the solver: give solver_scenes",
        ),
        (lambda: run.evaluate(data, command=5), "command is 5; it must be a text"),
        (lambda: ast_sim.trade(run, command=5), "command is 5; it must be a text"),
        (lambda: ast_sim.trade(run, solver_seconds=1, made_from="spec.toml"), "made_from is for our solver"),
        (lambda: run.expected_error(None), "effort is None; it must be an Effort"),
    ):
        refused(call, text)
    assert not os.listdir(tmp_path)


def test_classes_of_the_errors(run, scene):
    """`except ValueError` catches both."""
    with pytest.raises(ConfigError):
        run.predict(scene, PRESS, effort=3)
    with pytest.raises(DatasetError):
        run.predict(scene, "down")


def test_a_warning_names_the_line_of_the_caller(run, scene):
    turned = ast_sim.RigidMotion([(0, 0, -0.045), (0, 0, 0)])  # between two frames
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run.predict(scene, {1: turned}, num_frames=6, frames=[-1], progress=False)
        run.predict_motions(scene, [{1: turned}], num_frames=6, frames=[-1], progress=False)
        ast_sim.Motion.of_bodies(scene, {1: turned}, 6)
    assert len([one for one in told if "which no frame shows" in str(one.message)]) == 3
    assert {one.filename for one in told} == {__file__}
