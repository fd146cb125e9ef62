"""Questions about an assembly: a run that learned from one predicts it for other values, alone and in sweeps."""

import csv
import warnings
from functools import partial

import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, write_assembly, write_box

import ast_sim
from ast_sim.cli import main
from ast_sim.support.errors import ConfigError


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A specification and a run of a few steps; what it predicts is poor, but it is a prediction."""
    folder = tmp_path_factory.mktemp("assembly")
    spec = write_assembly(folder)
    data = folder / "study.h5"
    ast_sim.generate("assembly", data, spec=spec, train=4, valid=1, test=1, workers=1, progress=False)
    return spec, ast_sim.train(data, folder / "run", steps=20, validate_every=20, checkpoint_every=20)


def test_a_specification_with_values_is_a_scene(trained):
    spec, run = trained
    answer = run.predict(spec=spec, parameters={"travel": 1.2, "young": {"block": 1.5e6}})
    scene = answer.scene
    assert answer.frames == (0, 1, 2) and answer.position.shape == (3, scene.num_nodes, 3) and answer.failure is None
    assert np.unique(scene.material[:, 0]).tolist() == [0, 1.5e6]
    punch = scene.body == 1
    for frame in (0, 1, 2):
        expected = scene.rest_position[punch] - np.float32([0, 0, 0.6 * frame])
        np.testing.assert_allclose(answer.position[frame, punch], expected, atol=1e-6)
    assert answer.source["parameter travel"] == 1.2 and answer.info.length_unit == "mm"
    deepest = run.predict(spec=spec, parameters={"travel": 1.2, "young": {"block": 1.5e6}}, frames=[-1])
    assert np.array_equal(deepest.position[0], answer.position[2])


def test_figures_of_an_answer(trained, tmp_path):
    spec, run = trained
    answer = run.predict(spec=spec, parameters={"travel": 1.2})
    forces, figures = answer.reaction(), answer.figures()
    assert forces.shape == (3, 3) and np.abs(forces[0]).max() < 1e-9
    stress, deforming = answer.stress[2, :, 0], answer.scene.deforming_nodes
    worst = int(np.argmax(np.where(deforming, stress, -1)))
    assert figures[2]["travel_of_nodes"] == pytest.approx(1.2, abs=1e-5)
    assert figures[2]["reaction"] == pytest.approx(np.linalg.norm(forces[2]))
    assert figures[2]["largest_stress"] == stress[worst]
    assert [figures[2][f"stress_at_{axis}"] for axis in "xyz"] == pytest.approx(answer.position[2, worst].tolist())
    answer.save(tmp_path / "answer.csv")
    rows = list(csv.DictReader((tmp_path / "answer.csv").open()))
    assert [row["frame"] for row in rows] == ["0", "1", "2"]
    assert float(rows[2]["reaction_z"]) == pytest.approx(forces[2, 2])


def test_the_true_frames_have_the_forces_of_the_solver(trained):
    """What `reaction` makes of the solver's own positions, in newton, is what the solver recorded."""
    from dataclasses import replace

    _, run = trained
    with run.open() as data:
        for index in range(3):
            truth = data["train"][index]
            answer = replace(run.predict(truth), position=truth.position)
            found = np.linalg.norm(answer.reaction(), axis=1)
            np.testing.assert_allclose(found, truth.attributes["reaction"], rtol=1e-3, atol=1e-6)


def test_a_sweep_is_many_predictions(trained, tmp_path):
    spec, run = trained
    found = run.sweep(spec, {"travel": [0.6, 0.9, 1.2], "young": {"block": [1.2e6, 1.8e6]}})
    assert len(found.rows) == 6 and found.varied == ("travel", "block.young") and found.seconds > 0
    for row in found.rows[1::3]:
        values = {"travel": row["travel"], "young": {"block": row["block.young"]}}
        alone = run.predict(spec=spec, parameters=values).figures()[-1]
        for key in ("reaction", "largest_stress", "stress_at_z", "travel_of_nodes"):
            assert row[key] == pytest.approx(alone[key], rel=1e-3), key
    found.save(tmp_path / "sweep.csv")
    rows = list(csv.DictReader((tmp_path / "sweep.csv").open()))
    assert [float(row["reaction"]) for row in rows] == [row["reaction"] for row in found.rows]
    for quantity in ("reaction", "largest_stress"):
        found.picture(tmp_path / "out" / f"{quantity}.png", quantity)
        assert (tmp_path / "out" / f"{quantity}.png").stat().st_size > 10_000
    with pytest.raises(ConfigError, match="no row has 'heat'"):
        found.picture(tmp_path / "heat.png", "heat")
    table = [{"travel": 0.6, "block.young": 1.2e6}, {"travel": 1.2, "block.young": 1.8e6}]
    listed = run.sweep(spec, table=table).rows
    for row, same in zip(listed, (found.rows[0], found.rows[5]), strict=True):
        assert row["reaction"] == pytest.approx(same["reaction"], rel=1e-3)


BETWEEN = '[[contact]]\nparts = ["block", "punch"]\nfriction = 0.4\n\n[parameters]'


def test_a_sweep_tells_elements_that_are_turned_over(trained, monkeypatch):
    spec, run = trained
    monkeypatch.setattr(
        "ast_sim.inference.sweep.impossible", lambda answer: ["7 are"] if answer.name == "row 1" else []
    )
    with pytest.warns(UserWarning, match="elements are turned over in 1 of 2 rows; the first: row 1: 7 are"):
        swept = run.sweep(spec, {"travel": [0.8, 1.0]})
    assert [row.get("notes") for row in swept.rows] == [None, "7 are"]


@pytest.mark.parametrize("rubs", ["friction = 0.4\n\n[parameters]", "friction = [0.3, 0.5]\n\n[parameters]", BETWEEN])
def test_with_friction_a_sweep_knows_the_frame_before(tmp_path, rubs):
    spec = write_assembly(tmp_path, SPEC.replace("[parameters]", rubs))
    ast_sim.generate("assembly", tmp_path / "study.h5", spec=spec, train=2, valid=1, test=1, workers=1, progress=False)
    run = ast_sim.train(tmp_path / "study.h5", tmp_path / "run", steps=5)
    effort = ast_sim.Effort(newton_steps=3)
    (row,) = run.sweep(spec, {"travel": 1.5}, effort=effort).rows
    alone, after_another = (
        run.predict(spec=spec, parameters={"travel": 1.5}, effort=effort, frames=frames).figures()[-1]["reaction"]
        for frames in ([-1], [-2, -1])
    )
    assert row["reaction"] == pytest.approx(after_another, rel=1e-6)
    assert alone != pytest.approx(after_another, rel=1e-5)
    wanted, predict_scenes = [], run.predict_scenes
    run.predict_scenes = lambda scenes, **given: wanted.append(given["frames"]) or predict_scenes(scenes, **given)
    run.sweep(spec, {"travel": 1.5}, effort=ast_sim.Effort())
    run.sweep(spec, {"travel": 1.5}, effort=effort)
    assert wanted == [[-1], [-2, -1]]  # without Newton steps, the frame before changes nothing


def test_rows_outside_the_training_are_told_once(trained):
    spec, run = trained
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        swept = run.sweep(spec, {"travel": [1.0, 2.4, 2.6]})
    assert ["in training" in row.get("notes", "") for row in swept.rows] == [False, True, True]
    assert swept.rows[2]["notes"].startswith("travel is 2.6; in training 0.5 to 1.5")  # in the table, too
    (note,) = [str(one.message) for one in caught if "training scenes" in str(one.message)]
    assert note == (
        "2 of 3 rows lie outside the training scenes; the first: row 1: travel is 2.4; in training 0.5 to 1.5"
    )


CHANGED = {
    "friction": (("frames = 3", "frames = 3\nfriction = 0.8"), "friction is 0.8; in training 0"),
    "hold": (("'zmin'", "'zmin,xmin'"), "parts.block.fixed is 'zmin,xmin'; in training it was 'zmin'"),
    "motion": (("0, 0, '-travel'", "0, 0, '-travel / 2'"), "parts.punch.move is {'translation': [0, 0, '-travel / 2']}"
               "; in training it was {'translation': [0, 0, '-travel']}"),
    "self contact": (("poisson", "self_contact = true\npoisson"), "parts.block.self_contact is True; in training it was"
                     " left out"),
    "pair": (("[parts.block]", "[[contact]]\nparts = ['block', 'punch']\nfriction = 0.5\n[parts.block]"),
             "contact is [{'parts': ['block', 'punch'], 'friction': 0.5}]; in training it was left out"),
    "range": (("[0.5, 1.5]", "[0.5, 4.5]"), "travel is 2.5; in training 0.5 to 1.5"),
    "file": (("", ""), "the run was trained on another file of part punch: punch.vtu, whose content was not this one"),
    "name": (("parts.punch", "parts.ram"), "the run was trained without the part ram"),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGED)
def test_what_differs_from_the_specification_of_the_training_is_told(change, trained, tmp_path):
    (old, new), line = CHANGED[change]
    text = SPEC.replace('"zmin"', "'zmin'")
    path = write_assembly(tmp_path, text.replace(old, new))
    if change == "file":
        write_box(tmp_path / "punch.vtu", (3, 3, 5.2), (7, 7, 8), (3, 2, 2))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        answer = trained[1].predict(spec=path, frames=[-1])
    assert f"scene: {line}" in [str(one.message) for one in told]
    assert line in answer.notes and answer.expected_error is None


def test_a_specification_within_the_ranges_of_the_training_has_no_notes(trained, tmp_path):
    """Other comments, another place, one value instead of a range tell nothing."""
    spec, run = trained
    path = write_assembly(tmp_path, "# a copy\n" + SPEC.replace("[0.5, 1.5]", "1.2").replace("[1e6, 2e6]", "1.4e6"))
    assert run.predict(spec=path, frames=[-1]).notes == run.predict(spec=spec, frames=[-1]).notes == ()


def test_the_command_and_a_sweep_tell_what_differs(trained, tmp_path, capsys):
    run = trained[1]
    path = write_assembly(tmp_path, SPEC.replace("frames = 3", "frames = 3\nfriction = 0.8"))
    out = str(tmp_path / "y.csv")
    assert main(["predict", str(run.path), str(path), "--set", "travel=1", "--frames=-1", "--out", out]) == 0
    assert "friction is 0.8; in training 0" in capsys.readouterr().err
    with pytest.warns(UserWarning, match="2 of 2 rows lie outside the training scenes; the first: row 0: friction is"):
        run.sweep(path, {"travel": [0.6, 1.0]})


def test_a_run_that_knows_no_specification_says_so(trained):
    spec, run = trained
    blind = ast_sim.Run(run.path)
    blind.folder.origin.pop("specification")
    assert any("not trained on a specification" in note for note in blind.predict(spec=spec, frames=[-1]).notes)


def test_wrong_questions(trained, tmp_path):
    spec, run = trained
    scene = run.predict(spec=spec).scene
    metres = tmp_path / "metres"
    metres.mkdir()
    for call, line in (
        (
            lambda: run.predict(spec=spec, parameters={"travl": 1}),
            "there is no parameter 'travl'; did you mean 'travel'",
        ),
        (
            lambda: run.predict(scene, {1: (0, 0, -1)}, parameters={}),
            "give a scene, or a specification with its parameters and nodes",
        ),
        (lambda: run.predict(scene, spec=spec), "leave scene, motion and stress out"),
        (lambda: run.predict(), "give a scene, or a specification"),
        (lambda: run.sweep(spec, {"travel": 2}, table=[{"travel": 1}]), "a table has the values of all parameters"),
        *(
            (partial(call, parameters=values), f"parameters is {told}; it must be values by name, such as")
            for call in (partial(run.predict, spec=spec), partial(run.sweep, spec), partial(run.sweep, spec, table=[1]))
            for values, told in (
                (["travel"], "of the type list"),
                ("travel=1", "'travel=1'"),
                (("travel", 1), "of the type tuple"),
                ({"travel"}, "of the type set"),
                ([], "of the type list"),
                ("", "''"),
                (0, "0"),
            )
        ),
        *(
            (partial(run.sweep, spec, table=table), f"row {row} of table is {told}; it must be values by name")
            for table, row, told in (([1], 0, "1"), (({"travel": 1}, "travel=1"), 1, "'travel=1'"), ([None], 0, "None"))
        ),
        (lambda: run.predict(spec=spec, num_frames=0), "num_frames is 0; it must be at least 2"),
        (lambda: run.predict(spec=spec, num_frames=1), "num_frames is 1; it must be at least 2"),
        (lambda: run.predict(spec=spec, num_frames=3.0), "num_frames is 3.0; it must be a whole number"),
        (lambda: run.predict(spec=spec, nodes=-5), "nodes is -5; it must be at least 1"),
        (lambda: run.sweep(spec, {"travel": 2}, nodes="5"), "nodes is '5'; it must be a whole number"),
        (lambda: run.sweep(spec, table=[]), "a sweep needs at least one row of values"),
        (
            lambda: run.predict(spec=write_assembly(metres, SPEC.replace('"mm"', '"m"'))),
            "SPEC.toml has lengths in m, but the run was trained in mm",
        ),
    ):
        with pytest.raises(ConfigError, match=line):
            call()


def test_the_command_line(trained, tmp_path, capsys):
    spec, run = trained
    out = tmp_path / "answer.csv"
    words = ["predict", str(run.path), str(spec)]
    assert main([*words, "--set", "travel=1.2", "--frames=-1", "--out", str(out)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[-1].startswith("frame 2: travel_of_nodes 1.2 mm, reaction ") and "largest_stress" in told[-1]
    (row,) = csv.DictReader(out.open())
    expected = run.predict(spec=spec, parameters={"travel": 1.2}, frames=[-1]).figures()[0]
    assert float(row["reaction"]) == pytest.approx(expected["reaction"], rel=1e-3)
    assert main(["sweep", str(run.path), str(spec), "--set", "travel=0.6:1.2:3", "--out", str(tmp_path / "s.csv")]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith(f"{tmp_path / 's.csv'}: 3 rows, ") and told[-1] == f"picture: {tmp_path / 's.png'}"
    rows = list(csv.DictReader((tmp_path / "s.csv").open()))
    assert len(rows) == 3 and (tmp_path / "s.png").exists()
    large = sum(float(row.get("last_newton_step") or 0) > 0.05 for row in rows)
    assert told[1:-1] == [f"not converged: {large} of 3 rows, where last_newton_step is too large"] * bool(large)
    for wrong, line in (
        ([*words, "--set", "travel=1,2", "--out", str(tmp_path / "b.csv")], "ast-sim sweep predicts them all"),
        ([*words, "--clamp", "0:zmin", "--out", str(tmp_path / "b.csv")], "--clamp has no meaning for"),
        ([*words, "--move", "1=0,0,-1", "--out", str(tmp_path / "b.csv")], "says what moves: change its parameters"),
        (["sweep", *words[1:], "--set", "travel=1", "--out", str(tmp_path / "b.txt")], "must end in .csv"),
        (["sweep", *words[1:], "--set", "travel=1", "--out", str(tmp_path / "s.csv")], "exists: name another output"),
    ):
        assert main(wrong) == 2
        (told_line,) = capsys.readouterr().err.strip().splitlines()
        assert line in told_line
