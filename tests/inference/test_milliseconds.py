"""What a wanted time chooses, with the run that comes with the package: times are measured once and kept."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import ast_sim
from ast_sim.inference.effort import Effort
from ast_sim.scene import Trajectory
from ast_sim.support.errors import AstSimError, ConfigError


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The file with the times, in a home of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ast_sim" / "milliseconds.json"


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A plate like the training plates, in its deepest frame."""
    data = tmp_path_factory.mktemp("plate") / "plate.h5"
    ast_sim.generate("deforming_plate", data, train=0, valid=0, test=1, nodes=400, frames=41, keep=(24,), seed=123)
    with ast_sim.Dataset(data) as dataset:
        return dataset["test"][0]


def times(cache, **changes):
    """The kept times by number of Newton steps; with changes, such as steps10=50.0, written back."""
    kept = json.loads(cache.read_text())
    ((one,),) = kept.values()
    for each in one["times"]:
        each["ms"] = changes.get(f"steps{each['effort']['newton_steps']}", each["ms"])
    cache.write_text(json.dumps(kept))
    return {each["effort"]["newton_steps"]: each["ms"] for each in one["times"]}


def test_the_most_accurate_effort_within_the_time_is_made(cache, truth):
    run = ast_sim.example_run("plates")
    efforts = {steps: Effort(0, steps) for steps in (0, 1, 2, 10)}

    def best(*steps: int) -> str:
        """The effort of these that had the smallest error in the validation scenes."""
        return min((efforts[number] for number in steps), key=run.expected_error).text

    slow = run.predict(truth, frames=[1], ms=1e6)
    assert slow.source["effort"] == best(*efforts)
    measured = times(cache)
    assert measured.keys() == {0, 1, 2, 10} and all(0 < ms < 1e6 for ms in measured.values())
    times(cache, steps0=10.0, steps1=20.0, steps2=30.0, steps10=40.0)
    chosen = {ms: run.predict(truth, frames=[1], ms=ms) for ms in (10, 25, 40)}
    assert [answer.source["effort"] for answer in chosen.values()] == [best(0), best(0, 1), best(*efforts)]
    assert best(0, 1) == Effort(0, 1).text
    told = "effort: 0 corrections, up to 1 Newton step, the most accurate within 25 ms: such a question took 20 ms on"
    assert chosen[25].how_far[0].startswith(told)
    assert np.array_equal(chosen[10].position, run.predict(truth, frames=[1], effort=Effort()).position)
    with pytest.raises(ConfigError, match="at most 9.9 ms on this machine: the fastest takes 10 ms .* 0 corrections"):
        run.predict(truth, frames=[1], ms=9.9)


def test_other_questions_are_timed_again_and_a_damaged_file_is_no_obstacle(cache, truth):
    run = ast_sim.example_run("plates")
    cache.parent.mkdir()
    cache.write_text("{")
    run.predict(truth, frames=[1], ms=1e6)
    times(cache, steps0=1e9, steps1=1e9, steps2=1e9, steps10=1e9)
    with pytest.raises(ConfigError, match="no effort takes at most"):
        run.predict(truth, frames=[1], ms=1e6)
    assert run.predict(truth, ms=1e6).frames == (0, 1)  # both frames: another question
    kept = json.loads(cache.read_text())
    ((where, _),) = kept.items()
    for of_another_version in ([1], {"frames": 1}, [{"nodes": 1, "frames": 1, "times": [{"effort": {"x": 1}}]}]):
        cache.write_text(json.dumps({where: of_another_version}))
        assert run.predict(truth, frames=[1], ms=1e6).converged
    cache.unlink()
    cache.parent.rmdir()
    cache.parent.write_text("no folder")
    assert run.predict(truth, frames=[1], ms=1e6).converged


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"ms": "50"}, "ms is '50'; it must be a number above 0"),
        ({"ms": float("nan")}, "ms is nan; it must be a number above 0"),
        ({"ms": 0}, "ms is 0; it must be a number above 0"),
        ({"error": "2%"}, "the error of the displacement is '2%'; it must be a number, as 0.02 for 2 %"),
        ({"error": {}}, "no error is given"),
        ({"num_frames": 3.0}, "num_frames is 3.0; it must be a whole number"),
        ({"num_frames": True}, "num_frames is True; it must be a whole number"),
    ],
)
def test_what_is_no_such_number_is_refused_by_name(cache, truth, options, text):
    with pytest.raises(ConfigError, match=re.escape(text)):
        ast_sim.example_run("plates").predict(truth.scene, {1: (0, 0, -0.02)}, **options)


def test_a_model_without_known_errors_cannot_choose(cache, truth, tmp_path):
    run = ast_sim.example_run("plates")
    run.measured = []
    with pytest.raises(ConfigError, match="ms chooses among efforts whose errors are known"):
        run.predict(truth, ms=50)


def test_the_errors_of_an_answer_beside_the_truth(truth):
    run = ast_sim.example_run("plates")
    answer = run.predict(truth, effort=Effort())
    errors = answer.errors(truth)
    true = replace(answer, position=truth.position, fields=truth.fields).reaction()[1]
    assert np.linalg.norm(true) == pytest.approx(truth.attributes["reaction"][1], rel=1e-4)
    assert errors["reaction"] == pytest.approx(np.linalg.norm(answer.reaction()[1] - true) / np.linalg.norm(true))
    body = truth.scene.deforming("node")
    largest = answer.stress[1, body].max() / truth.stress[1, body].max() - 1
    assert errors["stress"] == pytest.approx(abs(largest), rel=1e-5)
    free = ~truth.scene.prescribed
    wrong = np.linalg.norm((answer.position[1] - truth.position[1])[free])
    moved = np.linalg.norm((truth.position[1] - truth.position[0])[free])
    assert errors["displacement"] == pytest.approx(wrong / moved, rel=1e-4)


def test_an_answer_is_compared_with_the_frame_of_the_same_number(truth):
    """The frames of a truth may have gaps; what is no truth of this answer is refused by name."""
    run = ast_sim.example_run("plates")
    start, pressed = truth.scene.rest_position, truth.position[1]
    way = np.stack([start, (start + pressed) / 2, pressed])
    answer = run.predict(truth.scene, way, effort=Effort())
    last = Trajectory(truth.scene, truth.position, truth.stress, frames=(0, 2), stress_location="node")
    whole = Trajectory(truth.scene, way, stress_location="node")
    assert answer.errors(last)["displacement"] == answer.errors(whole)["displacement"] > 0
    cube = ast_sim.box((0, 0, 0), (1, 1, 1), (1, 1, 1))
    for wrong, text in (
        (replace(last, frames=(0, 5)), "the answer has 1 to 2, the truth has the frames 0, 5"),
        (whole.select([1, 2]), "there is no frame 0; there are the frames 1 to 2"),
        (replace(last, length_unit="mm"), "is in m, but the truth is in mm"),
        (replace(whole, position=way[[0, 1, 1]]), "the ones of the truth are up to 0.0164 apart in frame 2:"),
        (replace(whole, position=way[[0, 0, 2]]), "the ones of the truth are up to 0.0164 apart in frame 1:"),
        (Trajectory(cube, np.zeros((3, 8, 3), np.float32)), "but the truth has 8 and 6"),
    ):
        with pytest.raises(AstSimError, match=text):
            answer.errors(wrong)
    still = run.predict(truth.scene, way[[0, 0]], effort=Effort())
    for by in (0, 1e-9):
        moved = way[[0, 0]] + np.array([[[0.0]], [[by]]], np.float32)
        with pytest.raises(ConfigError, match=r"nothing is displaced in the truth, but for rounding, .* \(1\)"):
            still.errors(replace(whole, position=moved))


def test_errors_are_of_the_deepest_frame_that_both_have(truth):
    """The plate is pressed, then let go: the last frame would say nothing."""
    run = ast_sim.example_run("plates")
    start, pressed = truth.position
    way = np.stack([start, (start + pressed) / 2, pressed, start])
    field = truth.fields["reaction"]
    stored = replace(field, values=field.values[[0, 0, 1, 0]] * np.float32([1, 1, 1, 0])[:, None, None])
    stress = truth.stress[[0, 1, 1, 0]] * np.float32([1, 0.5, 1, 0])[:, None, None]
    whole = replace(truth, position=way, stress=stress, fields={"reaction": stored}, frames=None, times=None)
    answer = run.predict(truth.scene, way, effort=Effort())
    errors = answer.errors(whole)
    assert set(errors) == {"displacement", "reaction", "stress"} and max(errors.values()) < 0.2
    assert errors == pytest.approx(run.predict(truth.scene, way, frames=[2], effort=Effort()).errors(whole), rel=1e-4)
    half = run.predict(truth.scene, way, frames=[3, 1], effort=Effort()).errors(whole)
    assert half == pytest.approx(answer.errors(whole.select([0, 1, 3])), rel=1e-4)
    assert set(half) == {"displacement", "stress"}  # the true force is 0 there
    assert set(answer.errors(replace(whole, stress=0 * stress))) == {"displacement", "reaction"}
    faint = replace(whole, stress=stress * np.float32([1, 1, 1e-9, 1e9])[:, None, None] + np.float32(1e-4))
    assert set(answer.errors(faint)) == {"displacement", "reaction"}  # but for rounding
    with pytest.raises(ConfigError, match="Predict a frame in which something is displaced, too"):
        run.predict(truth.scene, way, frames=[3], effort=Effort()).errors(whole)
