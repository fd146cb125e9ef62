"""Motions of an assembly between its frames, by the real solver: turns, paths that come back, left-out frames."""

import warnings

import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, write_assembly, write_box

from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.simulate.jobs.generate import generate

TURNED = """
unit = "mm"
frames = {frames}
[parts.bar]
file = "bar.vtu"
young = 1e6
poisson = 0.3
fixed = "zmin"
move = {{ where = "zmax", rotation = {degrees}, point = [0, 0, 0] }}
[parts.punch]
file = "punch.vtu"
rigid = true
offset = [20, 0, 0]
"""
BACK = SPEC.replace("[0, 0, '-travel']", "[[0, 0, '-travel'], [0.3, 0, '-travel'], [0.3, 0, 0]]").replace(
    "frames = 3", "friction = 0.5\nframes = FRAMES"
)


def solved(folder, spec, **options):
    """The trajectory of the first scene of a specification."""
    path, out = write_assembly(folder, spec), folder / f"{len(list(folder.iterdir()))}.h5"
    write_box(folder / "bar.vtu", (-5, -5, 0), (5, 5, 40), (2, 2, 6))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        generate("assembly", out, spec=path, train=1, valid=0, test=0, workers=1, progress=False, **options)
    with Dataset(out) as data:
        return data.load("train", 0)


@pytest.mark.parametrize("degrees", [-180, 270, 360])
def test_a_turn_between_two_frames_is_the_turn_that_was_asked_for(degrees, tmp_path):
    """Elastic energy grows about with the square of the angle. The shortest way to the same positions has a ninth of it
    at 270 degrees, and none at 360."""
    quarter = solved(tmp_path, TURNED.format(frames=4, degrees=90)).attributes["elastic_energy"][-1]
    turned = solved(tmp_path, TURNED.format(frames=2, degrees=degrees))
    assert turned.attributes["status"] == "complete"
    assert turned.attributes["elastic_energy"][-1] == pytest.approx(quarter * (degrees / 90) ** 2, rel=0.2)
    in_steps = solved(tmp_path, TURNED.format(frames=1 + abs(degrees) // 30, degrees=degrees))
    np.testing.assert_array_equal(turned.position[-1], in_steps.position[-1])
    torque = in_steps.attributes["torque"][-1]
    assert turned.attributes["torque"][-1] == pytest.approx(torque, rel=1e-6) and torque > 0


def test_a_path_that_comes_back_between_frames_is_followed(tmp_path):
    """Down, sideways with friction, up again, in one frame: what is left of it is what steps there would leave."""
    at_once = solved(tmp_path, BACK.replace("FRAMES", "2"))
    assert at_once.attributes["dissipation"][-1] > 1e-5 * at_once.attributes["elastic_energy"][-1] > 0
    assert "parts.punch.move turns at" in at_once.attributes["notes"]
    kept = solved(tmp_path, BACK.replace("FRAMES", "9"), keep=[8])
    np.testing.assert_allclose(kept.position, at_once.position, rtol=0, atol=1e-6)
    with_note = solved(tmp_path, BACK.replace("FRAMES", "4"), keep=[2]).attributes["notes"]
    assert with_note.startswith("parts.punch.move turns at")
    assert "notes" not in solved(tmp_path, BACK.replace("FRAMES", "4"), keep=[1]).attributes


def test_frames_that_are_left_out_are_passed_at_the_peak(tmp_path):
    """The press of a plate and its release: without the frames between, the plate would not be touched at all."""
    out = [tmp_path / "all.h5", tmp_path / "kept.h5"]
    for path, keep in zip(out, (None, [7]), strict=True):
        generate("deforming_plate", path, train=1, valid=0, test=0, nodes=120, frames=8, keep=keep, workers=1)
    data = [Dataset(path) for path in out]
    every, kept = (one.load("train", 0) for one in data)
    [one.close() for one in data]
    assert kept.num_frames == 2 and kept.attributes["work"][-1] > 0.5 * max(every.attributes["work"])
    assert "nodes turn back in frame" in kept.attributes["notes"]


def test_a_turn_that_frames_hide_is_told_before_hours_go_into_it(tmp_path, capsys):
    path = write_assembly(tmp_path, TURNED.format(frames=2, degrees=200))
    write_box(tmp_path / "bar.vtu", (-5, -5, 0), (5, 5, 40), (2, 2, 6))
    assert (
        main(["generate", "assembly", str(path), "--out", str(tmp_path / "a.h5"), "--count", "1", "--workers=1"]) == 0
    )
    assert "warning: parts.bar.move turns 200 degrees from one frame to the next" in capsys.readouterr().err
