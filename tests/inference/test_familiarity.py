"""Is a scene like the calibration scenes: distances, p-values, and what a run says of strange plates."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import toy

import ast_sim
from ast_sim.inference.promises.familiarity import RIDGE, Familiarity
from ast_sim.models import Latent

TURNED_OVER = np.float32([[1, 0, 0], [0, -1, 0], [0, 0, -1]])


def an_answer(latents):
    """An answer of frames 1, 2, ... with these latent means; the prescribed nodes move farthest in the last but one."""
    scene = toy.plate(0).scene
    travel = np.float32([0.01 * (1 + frame) for frame in range(len(latents))])
    travel[-2:] = travel[-2:][::-1]
    position = scene.rest_position + travel[:, None, None] * np.float32([0, 0, 1])
    frames = tuple(range(1, 1 + len(latents)))
    return ast_sim.Answer(
        "scene", scene, position, None, 1, [], frames=frames, latents=dict(zip(frames, latents, strict=True))
    )


def test_the_distance_is_mahalanobis_with_a_ridge():
    rng = np.random.default_rng(0)
    scenes = [rng.normal(size=(3, 4)) @ rng.normal(size=(4, 4)) + 5 for _ in range(25)]
    known = Familiarity.of(scenes)

    def distance(x, frames):
        z = (frames - frames.mean(0)) / frames.std(0)
        own = (x - frames.mean(0)) / frames.std(0)
        inverse = np.linalg.inv(np.cov(z.T) + RIDGE * np.eye(4))
        return np.sqrt(own @ inverse @ own)

    scores = [
        max(distance(x, np.concatenate([other for j, other in enumerate(scenes) if j != i])) for x in scene)
        for i, scene in enumerate(scenes)
    ]
    assert known.scores == pytest.approx(scores, rel=1e-4)
    for size in (0.5, 1.0, 2.0, 8.0):
        x = known.center + size * rng.normal(size=4) * np.concatenate(scenes).std(0)
        expected = (1 + sum(score >= distance(x, np.concatenate(scenes)) for score in scores)) / 26
        far = np.full(4, 1e9)  # not the frame in which the prescribed nodes are farthest
        assert known.p_value(an_answer([far, x, far])) == pytest.approx(expected)
    assert known.p_value(an_answer([far])) == pytest.approx(1 / 26)
    assert Familiarity.from_json(known.to_json()) == known


def test_few_ordinary_scenes_are_called_unusual():
    """A share of at most 0.05 is, with fewer scenes than components too, and with a constant component."""
    rng = np.random.default_rng(1)

    def draw(count):
        values = rng.normal(size=(count, 1, 30)) * np.linspace(0.1, 3, 30)
        values[..., 7] = 2.0
        return values

    known = [Familiarity.of(draw(25)) for _ in range(30)]
    p_values = np.array([one.p_value(an_answer([x[0]])) for one in known for x in draw(30)])
    unusual = np.mean(p_values <= 0.05)
    assert 0.01 < unusual <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 900)


def test_a_note_tells_how_many_scenes_are_more_usual():
    known = Familiarity((0.0,), ((1.0,),), tuple(range(1, 40)))
    assert known.p_value(an_answer([np.array([37.5])])) == pytest.approx(3 / 40)
    assert not known.notes(3 / 40)
    (note,) = known.notes(known.p_value(an_answer([np.array([38.5])])))
    assert note.startswith("the network finds the scene more unusual than 38 of 39 calibration scenes (p = 0.05)")
    assert "more unusual than 39 of 39" in known.notes(1 / 40)[0]


def test_the_mean_of_a_scene_does_not_depend_on_the_others():
    import torch

    values = torch.randn(9, 5)
    means = Latent(values, torch.tensor([0, 2, 9])).means()
    assert torch.equal(means[1], Latent(values[2:], torch.tensor([0, 7])).means()[0])
    assert means[0].tolist() == pytest.approx(values[:2].double().mean(0).tolist())


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plates")
    scenes = {"train": 0, "valid": 0, "test": 6}
    path = ast_sim.generate(
        "deforming_plate", folder / "plates.h5", **scenes, nodes=400, frames=41, keep=(24,), seed=5
    ).path
    with ast_sim.Dataset(path) as data:
        return [data["test"][index] for index in range(6)]


def strange(truth, kind):
    """A plate unlike all in training, with all its sizes within their ranges."""
    scene, motion = truth.scene, truth.position
    if kind == "pressed from below":
        return replace(scene, rest_position=scene.rest_position @ TURNED_OVER.T), motion @ TURNED_OVER.T
    held = scene.node_type == ast_sim.NodeType.HANDLE
    let_go = (
        held if kind == "held by nothing" else held & (scene.rest_position[:, 0] > scene.rest_position[held, 0].mean())
    )
    return replace(scene, node_type=np.where(let_go, ast_sim.NodeType.NORMAL, scene.node_type).astype(np.uint8)), motion


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_shipped_run_knows_its_plates(plates):
    run = ast_sim.example_run("plates")
    answers = [run.predict(truth, frames=[-1]) for truth in plates]
    assert sum(not answer.notes and answer.band() is not None for answer in answers) >= 5
    assert all(0 < answer.p_value <= 1 for answer in answers)


@pytest.mark.parametrize(
    "kind, fewest", [("pressed from below", 5), ("held by nothing", 6), ("held at one end", 6)]
)  # docs/results/coverage.md: 38, 40 and 40 of 40
def test_the_shipped_run_tells_a_strange_plate(plates, kind, fewest):
    run = ast_sim.example_run("plates")
    told = 0
    for truth in plates:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            answer = run.predict(*strange(truth, kind), frames=[-1], effort=ast_sim.Effort(), throw=False)
        unusual = [one for one in map(str, (each.message for each in caught)) if "finds the scene more unusual" in one]
        assert len(unusual) == (answer.p_value <= 0.05)
        assert not unusual or "of 97 calibration scenes" in unusual[0]
        if answer.notes:
            told += 1
            assert answer.band() is None and answer.expected_error is None
    assert told >= fewest
    with pytest.warns(UserWarning, match="neither a band nor an error is promised"):
        answer = run.predict(*strange(plates[0], kind), frames=[-1], error=0.1, throw=False)
    assert "promise" not in answer.source and "effort" in answer.source
