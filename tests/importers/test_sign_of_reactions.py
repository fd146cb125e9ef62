"""Reactions with the other sign are told by the work of the prescribed nodes; reactions of the solver are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ast_sim
from ast_sim.named_field import REACTION
from ast_sim.plausibility.motion import in_trajectory

CLIPS = Path(__file__).parents[2] / "examples" / "clip" / "test_scenes.h5"
WHAT = "reactions that take out work"


def told(trajectory, dynamic=False):
    return [one for one in in_trajectory(trajectory, dynamic) if one.what == WHAT]


def with_reactions(trajectory, values):
    field = replace(trajectory.fields[REACTION], values=values.astype(np.float32))
    return replace(trajectory, fields={REACTION: field})


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A plate that a tool presses in and lets go, as the bundled solver has it."""
    file = tmp_path_factory.mktemp("pressed") / "plate.h5"
    ast_sim.generate("deforming_plate", file, train=1, valid=0, test=0, nodes=100, frames=21)
    with ast_sim.Dataset(file) as dataset:
        return dataset.load("train", 0, (REACTION,))


def test_forces_on_the_tool_are_told_in_any_choice_of_frames(pressed):
    values, deepest = pressed.fields[REACTION].values, int(np.argmax(np.abs(pressed.position[:, :, 2].min(axis=1))))
    for frames in (list(range(21)), list(range(0, 21, 4)), [deepest], list(range(deepest + 1)), [3, deepest, 20]):
        part = pressed.select(frames)
        assert not told(part)
        (finding,) = told(with_reactions(part, -values[frames]))
        assert finding.count == 1 and not finding.may_be_meant
        assert "are these the forces on the tool? The forces on the body have the other sign" in finding.meaning


def test_work_that_is_roughly_right_is_not_told(pressed):
    """The plate gives back twice what was put in: between few frames, work is known only roughly."""
    values, deepest = pressed.fields[REACTION].values, int(np.argmax(np.abs(pressed.position[:, :, 2].min(axis=1))))
    late = (np.arange(21) > deepest)[:, None, None]
    assert not told(with_reactions(pressed, np.where(late, 4 * values, values)))
    assert told(with_reactions(pressed, np.where(late, 9 * values, values)))


def test_the_work_is_named(pressed):
    """By hand, in the deepest frame alone: half of its force along the way from rest."""
    frame = int(np.argmax(np.abs(pressed.position[:, :, 2].min(axis=1))))
    part = pressed.select([frame])
    force = part.fields[REACTION].values[0].astype(float)
    work = (force * (part.position[0] - part.scene.rest_position)).sum() / 2
    (finding,) = told(with_reactions(part, -part.fields[REACTION].values))
    assert f"up to frame 0 the prescribed nodes do a work of {-work:.3g} (newton" in finding.meaning


@pytest.fixture(scope="module")
def clips():
    with ast_sim.Dataset(CLIPS) as dataset:
        return [dataset.load("test", index, (REACTION,)) for index in range(dataset.count("test"))]


def test_reactions_of_friction_and_yielding_are_right(clips):
    """The shipped clips turn, yield and spring back; turned round, each is told."""
    assert len(clips) == 10
    for clip in clips:
        assert not told(clip)
        assert told(with_reactions(clip, -clip.fields[REACTION].values))


def test_forces_that_do_no_work_say_nothing(clips):
    """Forces of held nodes alone, none, rounding at the ram, and forces at corners, which are not the whole force."""
    clip, turned = clips[0], -clips[0].fields[REACTION].values
    stands = (clip.position == clip.position[0]).all(axis=(0, 2))[:, None]
    assert turned[:, stands[:, 0]].any() and turned[:, ~stands[:, 0]].any()
    assert not told(with_reactions(clip, np.where(stands, turned, 0)))
    assert not told(with_reactions(clip, 0 * turned))
    assert not told(with_reactions(clip, np.where(stands, turned, 1e-4 * turned)))
    wrong = with_reactions(clip, turned)
    assert told(wrong)
    assert not told(replace(wrong, attributes={**wrong.attributes, "corners_only": 1}))
    assert not told(wrong, dynamic=True)  # what moves at first may push the tool
    assert not told(replace(wrong, fields={}))
