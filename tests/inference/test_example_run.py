"""The run that comes with the package answers plates that it has never seen, nearly as the solver does."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.cli import main
from ast_sim.named_field import REACTION
from ast_sim.support.errors import ConfigError
from benchmarks.studies.clip import RESULTS
from benchmarks.studies.clip_outcome import LAST, SPEC, outcome, true_outcome
from benchmarks.studies.clip_variants import SCENES


def test_it_predicts_a_new_plate_by_one_call_and_better_with_newton_steps(tmp_path, capsys):
    data = tmp_path / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=0, valid=0, test=3, nodes=400, frames=41, keep=(24,), seed=123)
    run, errors = ast_sim.example_run("plates"), []
    with ast_sim.Dataset(data) as dataset:
        for truth in dataset["test"]:
            free = ~truth.scene.prescribed
            moved = np.sqrt(np.mean((truth.position[1] - truth.position[0])[free] ** 2))
            answers = [run.predict(truth, frames=[1], effort=ast_sim.Effort(0, steps)) for steps in (0, 10)]
            errors.append([np.sqrt(np.mean((a.position[0] - truth.position[1])[free] ** 2)) / moved for a in answers])
            assert replace(answers[1], position=truth.position[1:]).check().residual.value < 100
            steps = answers[1].check()
            assert answers[0].check().residual.value > 5 * steps.residual.value and steps.imbalance.value < 0.02
            assert np.linalg.norm(answers[1].reaction()) == pytest.approx(truth.attributes["reaction"][1], rel=0.02)
            held, pressed = answers[1].body_forces()
            assert (held.body, pressed.body) == (0, 1) and np.allclose(pressed.force, answers[1].reaction()[0])
            assert np.linalg.norm(held.force + pressed.force) < 0.05 * np.linalg.norm(held.force)
            # About one point, all torques from outside add up to nothing.
            centres = [answers[1].position[0, truth.scene.body == body].mean(axis=0) for body in (0, 1)]
            arm = (centres[1] - centres[0]).astype(float)
            rest = held.torque + pressed.torque + np.cross(arm, pressed.force)
            assert np.linalg.norm(rest) < 0.05 * np.linalg.norm(held.force) * np.linalg.norm(
                np.ptp(answers[1].position[0], axis=0)
            )
    network, with_newton = np.mean(errors, axis=0)
    assert network < 0.08 and with_newton < 0.03
    told = ["predict", str(tmp_path / "run.ast"), str(data), "--index", "2", "--out", str(tmp_path / "a.h5"), "--check"]
    run.save(tmp_path / "run.ast")
    assert main(told) == 0
    table = capsys.readouterr().out.splitlines()[-7:]
    assert [line.split("  ")[0] for line in table] == [
        "check", "elements turned over", "elements folded in", "deepest penetration", "penetrated volume",
        "force residual", "balance of reactions",
    ]  # fmt: skip


def test_without_friction_a_frame_is_the_same_alone_and_among_all(tmp_path):
    """So a calibration takes the errors of the deepest frame from the answer with all frames."""
    data = tmp_path / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=0, valid=0, test=1, nodes=400, frames=41, keep=(14, 24), seed=5)
    run = ast_sim.example_run("plates")
    with ast_sim.Dataset(data) as dataset:
        truth = dataset["test"][0]
    steps = ast_sim.Effort(newton_steps=10)
    for effort in (ast_sim.Effort(), steps, replace(steps, solved=True, solved_beyond=1e-3), ast_sim.Effort.exact()):
        among, alone = run.predict(truth, effort=effort), run.predict(truth, frames=-1, effort=effort)
        assert np.array_equal(among.position[-1], alone.position[0]) and among.errors(truth) == alone.errors(truth)


def test_a_clip_that_is_asked_for_by_its_parameters_has_the_set_and_the_force_of_calculix():
    """Test scenes of the study, which no training has seen; benchmarks/results/clip.json has what CalculiX found."""
    run = ast_sim.example_run("clip")
    assert run.scope.length_unit == "mm" and run.calibration.scenes == 40 and run.settings.model.history is not None
    for known in json.loads(RESULTS.read_text())["scenes"][:2]:
        names = ("length", "thickness", "place", "travel", "yield_stress")
        parameters = {name: known["parameters"][name] for name in names}
        parameters["file"] = {"clip": known["parameters"]["clip.file"]}
        answer = run.predict(spec=SPEC, parameters=parameters, nodes=3500)
        said = outcome(answer.scene, answer.position[0], answer.position[-1], answer.fields[REACTION].values)
        assert said == pytest.approx(tuple(known["true"].values()), rel=0.1)
        assert answer.fields["PEEQ"].values[-1].max() > 0.01 and answer.frames == tuple(range(LAST + 1))


def test_ten_scenes_of_the_repository_have_the_errors_of_the_page():
    """The medians of the page are known to 0.2 %: half of this is the margin, and rounding is far below it."""
    run = ast_sim.example_run("clip")
    known = {one["name"]: one for one in json.loads(RESULTS.read_text())["scenes"]}
    with ast_sim.Dataset(SPEC.with_name("test_scenes.h5")) as dataset:
        for name, truth in zip(SCENES, dataset["test"], strict=True):
            true = true_outcome(truth)
            assert true == pytest.approx(tuple(known[name]["true"].values()), rel=1e-6)
            answer = run.predict(truth)
            said = outcome(truth.scene, truth.position[0], answer.position[-1], answer.fields[REACTION].values)
            of_page = np.array(tuple(known[name]["run_two_frames"].values())) / true - 1
            np.testing.assert_allclose(np.array(said) / true - 1, of_page, atol=1e-3)
            assert np.all(np.abs(of_page) < (0.03, 0.05))  # set and force


def true_sets(rows):
    """The sets of clips with these parameters, by a plane through what CalculiX found in the 30 scenes of the study:
    its own deviations are 3 % of the mean set."""
    names = ("length", "thickness", "place", "travel", "yield_stress")
    scenes = json.loads(RESULTS.read_text())["scenes"]
    known, wanted = (
        np.array([[1, *(values[name] for name in names)] for values in listed])
        for listed in ([scene["parameters"] for scene in scenes], rows)
    )
    scale = known.max(axis=0)  # else the yield stress in pascal drowns the others
    return wanted / scale @ np.linalg.lstsq(known / scale, [scene["true"]["set"] for scene in scenes], rcond=None)[0]


def test_travels_that_end_at_one_place_leave_sets_as_far_apart_as_in_true_scenes():
    """In the last frame the ram is back, whatever its travel: what differs is where it turned. From one travel to the
    next the true sets grow by the factors 2.4 and 1.6."""
    sweep = ast_sim.example_run("clip").sweep(SPEC, {"travel": [1.2, 2.4, 3.6]}, nodes=3500)
    assert [row["travel_of_nodes"] for row in sweep.rows] == [0, 0, 0]
    sets = np.array([row["permanent_set"] for row in sweep.rows])
    true = true_sets(sweep.rows)
    growth, true_growth = (values[1:] / values[:-1] for values in (sets, true))
    assert np.all(growth > 0.9 * true_growth) and np.all(true_growth > 1.5)
    strains = [row["largest_PEEQ"] for row in sweep.rows]
    assert strains[1] > 1.2 * strains[0] and strains[2] > 1.2 * strains[1]


def test_it_says_where_it_comes_from_and_an_unknown_name_is_one_line():
    run = ast_sim.example_run("plates")
    assert (run.step, run.settings.train.corrections, run.settings.data) == (80_000, 0, "plates400.h5")
    assert run.effort == ast_sim.Effort(0, 10) and run.scope.family == "deforming_plate"
    with pytest.raises(ConfigError, match="there is no example run 'plate'; did you mean 'plates'"):
        ast_sim.example_run("plate")


def test_info_tells_a_calibration_in_words(capsys):
    """As numbers it is thousands: the errors of all scenes, and the covariance of what the network makes of them."""
    path = str(ast_sim.example_run("plates").path)
    assert main(["info", path]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 200 and max(map(len, lines)) < 150
    assert "    band of 95 %" in lines and "    largest error in 90 % of scenes" in lines
    assert any("up to 1 Newton step " in line and line.endswith(" 1.5 %") for line in lines)
    assert main(["info", path, "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["answers"]["calibration"]["familiarity"]["scores"]) == 97
