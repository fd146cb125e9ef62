"""Calls that nobody means well: each works right, or is one line before any long work, and leaves nothing half-made."""

import copy
import os
import pickle
import re
import resource
import shutil
import signal
import warnings
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
import toy
from meshes import plate_and_punch

import ast_sim
from ast_sim import Effort, Scene
from ast_sim.inference.trade import Trade
from ast_sim.support.argument_checks import at_home, require_line
from ast_sim.support.disk import output_file
from ast_sim.support.errors import AstSimError, CheckpointError, ConfigError, DatasetError

PRESS = {1: (0, 0, -0.01)}
SMALL = {"hidden": 16, "d_token": 16, "heads": 1, "head_dim": 16, "L_SA": 1, "L_cell": 3}


def refused(call, text: str) -> None:
    """The call ends with an error of ours, in one line that holds the text."""
    with pytest.raises(AstSimError, match=re.escape(text)) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("hostile") / "toy.h5", (3, 2, 2))


@pytest.fixture(scope="module")
def trained(data):
    folder = data.parent / "run"
    ast_sim.train(data, folder, steps=2, batch_size=4, model_settings=SMALL, progress=False)
    return folder


@pytest.fixture(scope="module")
def plates():
    return ast_sim.example_run("plates")


@pytest.fixture(scope="module")
def scene():
    mesh = plate_and_punch((0.48, 0.32, 0.03), (11, 8, 2), 0.008)
    return ast_sim.read_scene(mesh, obstacles=[1], clamps=["0:xmin,xmax"]).scene


@pytest.mark.parametrize(
    ("changes", "text"),
    [  # the 3 training scenes have 18 frames to learn
        ({"batch_size": 49}, "train.batch_size is 49, but an epoch has 18 samples"),
        ({"batch_size": 10**9}, "take at most 48"),
        ({"statistics_pairs": 401}, "train.statistics_pairs is 401, but an epoch has 18 samples"),
        ({"accumulate": 5, "batch_size": 4}, "train.accumulate is 5, but an epoch has 18 samples"),
        ({"mirror": ("x", "y", "x")}, "train.mirror is x, y, x; name each axis once"),
        ({"mirror": ("x",) * 1000}, "name each axis once"),
        ({"shift": 0.31}, "train.shift is 0.31, but a training scene is 0.3 from the boundary of the domain"),
        ({"shift": 1e308}, "take less than that"),
        ({"processes": 3, "batch_size": 4}, "train.batch_size = 4 cannot be cut for 3 processes"),
        ({"processes": 10**6, "batch_size": 10**6}, "train.processes is 1000000; it must be at most"),
        ({"progress": 5}, "progress is 5; it must be True, False or a function"),
        ({"progress": lambda done: None}, "progress is of the type function; it must be"),
    ],
)
def test_a_training_that_cannot_end_well_does_not_begin(data, tmp_path, changes, text):
    refused(lambda: ast_sim.train(data, tmp_path / "run", **{"steps": 1, "progress": False, **changes}), text)
    assert not os.listdir(tmp_path)


def test_the_limits_of_a_training_are_allowed(data, tmp_path):
    limits = {"batch_size": 6, "accumulate": 3, "statistics_pairs": 400, "shift": 0.29, "mirror": ("x", "y", "z")}
    run = ast_sim.train(data, tmp_path / "run", steps=1, model_settings=SMALL, progress=False, **limits)
    assert (run.settings.train.batch_size, run.settings.train.accumulate) == (6, 3)


def test_the_effort_of_a_run_is_checked_where_it_is_set(trained, tmp_path):
    run = ast_sim.Run(trained)
    before = run.effort
    for effort in (5, None, "exact", Effort):
        refused(lambda effort=effort: setattr(run, "effort", effort), "it must be an Effort, such as")
    refused(lambda: setattr(run, "effort", Effort.exact()), "this run can give no exact answer")
    assert run.effort == before
    run.effort = Effort(2)
    run.save(tmp_path / "run.ast")
    others = (copy.copy(run), pickle.loads(pickle.dumps(run)), ast_sim.Run(tmp_path / "run.ast"))
    assert all(other.effort == Effort(2) for other in others) and ast_sim.Run(trained).effort == before


def test_a_name_is_one_line(plates, scene):
    for name in ("a\nb", "a\r", "\x85", "", "a\u2028b"):
        refused(lambda name=name: plates.predict(scene, PRESS, name=name), "it must be one line of text")
        refused(lambda name=name: ast_sim.box((0, 0, 0), (1, 1, 1), (1, 1, 1), name=name), "must be one line of text")
    refused(lambda: require_line("title", 5), "title is 5; it must be a text")
    answer = plates.predict(scene, PRESS, num_frames=2, effort=Effort(), name="a $\\frac$ of \udc80")
    assert "$\\frac$ of \\udc80" in [text.get_text() for text in answer.plot().texts][0]
    assert "<img" in answer._repr_html_()


def test_numbers_of_frames(plates, scene):
    answer = plates.predict(scene, PRESS, num_frames=3, effort=Effort(), frames=np.array(2))
    assert answer.frames == (2,) and answer.frame(np.uint8(2)).number == 2
    for number in (2.0, np.float32(2), "2", None, [2], np.array(2), True):
        refused(lambda number=number: answer.frame(number), "it must be a whole number")
    refused(lambda: plates.predict(scene, PRESS, frames=np.array(2.0)), "frames must be whole numbers")


def test_a_time_limit_of_any_size(plates, scene):
    kind = {"num_frames": 2, "frames": -1}
    limits = (1e300, float("inf"), 10**400, np.float32(1e30), Fraction(10**400), Fraction(10**6, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy, where a number is too large for its type
        chosen = {plates.predict(scene, PRESS, ms=ms, **kind).source["effort"] for ms in limits}
    assert len(chosen) == 1
    far = {1: (0, 0, -0.03)}  # as far as in training at least: of less nothing is promised
    taken = [plates.predict(scene, far, error=error, **kind).source for error in (0.05, Fraction(1, 20))]
    assert taken[0]["promise"] == taken[1]["promise"] and "5 % of the displacement" in taken[0]["promise"]
    with pytest.raises(ConfigError, match="the error of the displacement is 1000.*; it must lie") as error:
        plates.predict(scene, PRESS, error=10**400)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda run: ast_sim.trade(run, scenes=None), "scenes is None"),
        (lambda run: run.evaluate(solver_scenes=None), "solver_scenes is None"),
        (lambda run: ast_sim.generate("deforming_plate", "never.h5", train=None), "train is None"),
        (lambda run: ast_sim.generate("deforming_plate", "never.h5", calibration=None), "calibration is None"),
        (lambda run: ast_sim.generate("deforming_plate", "never.h5", keep=[None]), "keep[0] is None"),
        (lambda run: ast_sim.box((0, 0, 0), (1, 1, 1), (1, 1, 1), obstacles=[None]), "body is None"),
    ],
)
def test_a_number_that_cannot_be_none(trained, call, text):
    refused(lambda: call(ast_sim.Run(trained)), f"{text}; it must be a whole number")


def test_a_simulation_that_is_refused_leaves_nothing(tmp_path):
    out = tmp_path / "a.h5"
    for changes, text in (
        ({"progress": 5}, "progress is 5"),
        ({"keep": {1: 2}}, "keep is of the type dict; it must be a list of whole numbers"),
        ({"workers": 10**6}, "workers is 1000000; it must be at most"),
    ):
        refused(lambda changes=changes: ast_sim.generate("deforming_plate", out, train=1, **changes), text)
    assert not os.listdir(tmp_path)


def test_places_where_no_file_can_be_made_are_told_before_the_work(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling.h5").symlink_to(tmp_path / "no folder" / "x.h5")
    (tmp_path / "loop.h5").symlink_to(tmp_path / "loop.h5")
    before = sorted(os.listdir(tmp_path))
    for place in (tmp_path / "file" / "x.h5", tmp_path / "dangling.h5", tmp_path / "loop.h5", Path("/proc/x.h5")):
        refused(lambda place=place: output_file(place), "choose another place")
        refused(lambda place=place: ast_sim.generate("deforming_plate", place, train=1), "choose another place")
    assert sorted(os.listdir(tmp_path)) == before
    (tmp_path / "link.h5").symlink_to(tmp_path / "target.h5")
    assert output_file(tmp_path / "link.h5") == tmp_path / "target.h5"
    assert output_file(tmp_path / "new" / "folder" / "x.h5") == tmp_path / "new" / "folder" / "x.h5"


def test_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert at_home(Path("~/a")) == tmp_path / "a" and at_home(Path("a/~")) == Path("a/~")
    assert at_home(Path("~tmp.h5")) == Path("~tmp.h5")
    toy.write("~/toy.h5")
    with ast_sim.Dataset("~/toy.h5") as dataset:
        assert dataset.path == tmp_path / "toy.h5"


def test_figures_do_not_take_the_place_of_a_dataset(data, trained):
    content = data.read_bytes()
    evaluation = ast_sim.Run(trained).evaluate(solver_scenes=0, progress=False)
    for save in (Trade({}).save, evaluation.save):
        for name in (data, data.with_suffix(".txt"), data.with_suffix("")):
            refused(lambda save=save, name=name: save(name), "the name of a file of figures must end in .json")
    assert data.read_bytes() == content


def test_what_was_opened_by_a_relative_name_is_found_from_another_folder(data, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(data.parent)
    run, dataset = ast_sim.Run("run"), ast_sim.Dataset("toy.h5")
    monkeypatch.chdir(tmp_path)
    with pickle.loads(pickle.dumps(dataset)) as other:
        assert other.count("train") == 3
    assert run.open(dataset).fingerprint() == dataset.fingerprint()
    assert run.evaluate(dataset, solver_scenes=0, progress=False).figures.origin["data"] == str(data)
    ast_sim.train(dataset, "again", steps=1, batch_size=4, model_settings=SMALL, progress=False)
    run.save("run.ast")
    run.folder.keep_calibration({"by": "hand"})
    assert ast_sim.Run(trained).folder.chosen.answers["calibration"] == {"by": "hand"}
    assert sorted(os.listdir(tmp_path)) == ["again", "run.ast"]


def test_a_calibration_that_cannot_be_kept_does_not_begin(data, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(ast_sim.Run, "predict", lambda *_, **__: pytest.fail("it has begun"))
    run = ast_sim.Run(trained)
    refused(lambda: ast_sim.calibrate(run, data, "test"), "needs at least 19 calibration scenes, and there are 2: make")
    shutil.copytree(trained, tmp_path / "run")
    run = ast_sim.Run(tmp_path / "run")
    (tmp_path / "run").rename(tmp_path / "moved")
    with pytest.raises(CheckpointError, match="is gone since it was opened: open the run where it is now"):
        ast_sim.calibrate(run, data, "test")


def test_runs_beside_that_a_generator_gives(trained):
    run = ast_sim.Run(trained)
    for beside in ([run], (one for one in [run])):
        refused(lambda beside=beside: ast_sim.trade(run, beside=beside, solver_seconds=1), "two runs are called run")


def test_seconds_of_a_solver_that_no_solver_takes(trained):
    for seconds in (1e308, 1.1e9, 10**400, float("inf")):
        call = lambda seconds=seconds: ast_sim.trade(ast_sim.Run(trained), solver_seconds=seconds)  # noqa: E731
        refused(call, "they must be a number above 0, at most 1e+09")


def test_a_wrong_origin_of_the_data_is_told_before_the_work(data, trained, monkeypatch):
    run = ast_sim.Run(trained)
    for call in (run.evaluate, lambda **made: ast_sim.trade(run, **made)):
        refused(lambda call=call: call(made_from="nowhere", progress=False), "was not generated by the bundled solver")


@pytest.mark.parametrize("suffix", [".vtkhdf", ".pvd", ".csv", ".h5"])
def test_a_full_disk_leaves_no_file(plates, scene, tmp_path, suffix):
    answer = plates.predict(scene, PRESS, num_frames=3, effort=Effort())
    handler, limit = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        for size in (0, 100, 2000) if suffix != ".csv" else (0, 100):
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
            refused(lambda: answer.save(tmp_path / f"a{suffix}"), "cannot be written")
            assert not os.listdir(tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    answer.save(tmp_path / f"a{suffix}")
    assert (tmp_path / f"a{suffix}").stat().st_size > 100


def test_bodies_have_any_numbers_and_nodes_need_no_element(plates, scene):
    """The answer is the one to bodies 0 and 1; a node of no element is a body that touches nothing."""
    plain = plates.predict(scene, PRESS, num_frames=2)
    names = np.array([7, 10**9], np.int32)
    renamed = plates.predict(replace(scene, body=names[scene.body]), {10**9: PRESS[1]}, num_frames=2)
    assert np.array_equal(renamed.position, plain.position) and np.array_equal(renamed.reaction(), plain.reaction())
    handle = np.array([ast_sim.NodeType.HANDLE], np.uint8)
    loose = Scene.of(
        np.concatenate([scene.rest_position, [[0, 0.1, 0.1]]]),
        scene.elements,
        node_type=np.concatenate([scene.node_type, handle]),
        body=np.append(scene.body, 2),
    )
    answer = plates.predict(loose, PRESS, num_frames=2, effort=Effort(newton_steps=1))
    assert np.isfinite(answer.reaction()).all() and answer.reaction()[1, 2] < 0


def test_bodies_that_would_not_be_what_was_asked_for():
    plate = ((1, 1, 0.1), (8, 8, 1))
    for hole in ((9, 9, 0.1), (0, 0, 0.01), (0.6, 0, 0.05)):
        refused(
            lambda hole=hole: ast_sim.plate(*plate, [(0.2, 0, 0.1), hole]), "no cell of the plate has its centre in"
        )
    assert ast_sim.plate(*plate, [(0, 0, 0.1)]).num_elements == 6 * 60
    assert ast_sim.box((0, 0, 0), (1, 1, 1), (n for n in (1, 2, 3))).num_elements == 36
    for cells in ((10**7, 10**7, 1), (10**400, 1, 1), (3000, 3000, 3000)):
        refused(lambda cells=cells: ast_sim.box((0, 0, 0), (1, 1, 1), cells), "are too many for one scene")


def test_a_device_is_no_dataset():
    for place in ("/dev/null", "/dev/zero"):
        with pytest.raises(DatasetError, match=f"{place} is no regular file: name the file of a dataset"):
            ast_sim.Dataset(place)


def test_what_was_measured_does_not_hold_for_other_weights(plates, scene, tmp_path):
    run = ast_sim.example_run("plates")
    kept = {name: values.clone() for name, values in run.model.state_dict().items()}
    usual = run.predict(scene, PRESS, num_frames=3, effort=Effort())
    assert usual.band() is not None and usual.expected_error is not None
    run.model.double().float()  # the same weights, also for torch's count of changes
    run.model.load_state_dict(kept)
    for same in (run, copy.deepcopy(run), pickle.loads(pickle.dumps(run))):
        assert same.predict(scene, PRESS, num_frames=3, effort=Effort()).expected_error == usual.expected_error
    before, again = pickle.loads(pickle.dumps(run)), pickle.loads(pickle.dumps(run))
    with torch.no_grad():
        for weights in run.model.parameters():
            weights.mul_(1.01)
    with pytest.warns(UserWarning, match="have changed since it was opened: no errors and no bands are known"):
        answer = run.predict(scene, PRESS, num_frames=3, effort=Effort())
    assert (answer.band(), answer.expected_error, answer.p_value) == (None, None, None)
    with pytest.raises(ConfigError, match="promises no error before it is calibrated"):
        run.predict(scene, PRESS, error=0.1)
    next(iter(again.model.parameters())).data[0] += 1  # which torch does not count
    for number, changed in enumerate((run, again)):
        file = tmp_path / f"{number}.ast"
        changed.save(file)
        saved = ast_sim.Run(file)
        assert saved.calibration is None and saved.expected_error(Effort()) is None and saved.effort == before.effort
    before.save(tmp_path / "before.ast")
    assert ast_sim.Run(tmp_path / "before.ast").calibration == plates.calibration


def test_other_weights_are_not_calibrated_beside_the_trained_ones(data, trained):
    run = ast_sim.Run(trained)
    next(iter(run.model.parameters())).data[0] += 1
    with pytest.raises(ConfigError, match="the weights of .*run have changed since it was opened: save it"):
        ast_sim.calibrate(run, data, "test")


def test_another_dataset_in_the_place_of_the_training_data_is_told(tmp_path, recwarn):
    data = toy.write(tmp_path / "toy.h5")
    run = ast_sim.train(data, tmp_path / "run", steps=1, batch_size=4, model_settings=SMALL, progress=False)
    run.evaluate(solver_scenes=0, progress=False)
    assert not [one for one in recwarn if "other scenes" in str(one.message)]
    toy.write(data, (4, 2, 2))
    with pytest.warns(UserWarning, match="toy.h5 holds other scenes than when .*run was trained on it"):
        run.evaluate(solver_scenes=0, progress=False)
