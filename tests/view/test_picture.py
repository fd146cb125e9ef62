"""The still picture: both sides drawn, at the frame of largest displacement, without a display."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from view_scenes import plate, strip

from ast_sim.scene import Trajectory
from ast_sim.support.errors import AstSimError
from ast_sim.view import picture


def sides(path):
    """The pixels of the left and the right half, without titles and colour bar."""
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    height, width = image.shape[:2]
    part = image[height // 10 : 3 * height // 4]
    return part[:, : width // 2], part[:, width // 2 :]


def inked(image):
    return (image.min(axis=2) < 240).mean()


@pytest.mark.parametrize(
    ("truth", "prediction"),
    [
        (plate(9), plate(9, seed=1)),
        (plate(9, stress="element"), plate(9, stress="element", seed=1)),
        (plate(9), plate(9, stress="none", seed=1)),
        (strip(6), strip(6)),
    ],
)
def test_both_sides_are_drawn(tmp_path, monkeypatch, truth, prediction):
    monkeypatch.delenv("DISPLAY", raising=False)
    picture.write(tmp_path / "a.png", truth, prediction, "ast")
    left, right = sides(tmp_path / "a.png")
    for side in (left, right):
        assert 0.1 < inked(side) < 0.8
        assert len(np.unique(side.reshape(-1, 3), axis=0)) > 100
    assert [f.name for f in tmp_path.iterdir()] == ["a.png"]


def test_errors_are_seen_and_a_perfect_prediction_is_the_truth(tmp_path):
    truth = plate(9)
    for name, prediction in (("same", truth), ("other", plate(9, seed=1))):
        picture.write(tmp_path / f"{name}.png", truth, prediction, "ast")
    left, right = sides(tmp_path / "same.png")
    assert (np.abs(left - right).max(axis=2) > 60).mean() < 0.02
    left, right = sides(tmp_path / "other.png")
    assert (np.abs(left - right).max(axis=2) > 60).mean() > 0.05


def test_the_frame_has_the_largest_displacement(tmp_path, monkeypatch):
    frames, figure = [], picture._figure
    monkeypatch.setattr(picture, "_figure", lambda *given: frames.append(given[2]) or figure(*given))
    truth, prediction = plate(9), plate(9, seed=1)
    picture.write(tmp_path / "a.png", truth, prediction, "ast")
    short = Trajectory(truth.scene, prediction.position[:3], prediction.stress[:3])
    picture.write(tmp_path / "b.png", truth, short, "ast")
    assert frames == [4, 2]


def test_the_model_is_named():
    for model, title in (("hcmt", "Prediction (HCMT)"), ("my-net", "Prediction (my-net)")):
        assert title in [text.get_text() for text in picture._figure(plate(2), plate(2), 1, model, "m").texts]


def test_only_metres_and_pascal_take_a_prefix():
    def label(unit: str, stress: float | None = None) -> str:
        given = plate(9, stress="none" if stress is None else "node")
        values = None if stress is None else stress * given.stress / given.stress.max()
        given = Trajectory(given.scene, given.position, values)
        (bar,) = [axes for axes in picture._figure(given, given, 4, "ast", unit).axes if axes.get_xlabel()]
        return bar.get_xlabel()

    assert label("m") == "Displacement (mm), frame 4"
    for unit in ("mm", "um", "in"):
        assert label(unit) == f"Displacement ({unit}), frame 4"
    assert "(Pa)" in label("mm", 0.02) and "(kPa)" in label("mm", 2e4)


def test_nothing_is_left_where_it_cannot_be_written(tmp_path):
    with pytest.raises(AstSimError, match="cannot be written"):
        picture.write(tmp_path / "absent" / "a.png", strip(2), strip(2), "ast")
    lost = strip(2)
    lost.position[0] = np.nan
    with pytest.raises(AstSimError, match="no frame"):
        picture.write(tmp_path / "a.png", strip(2), lost, "ast")
    assert list(tmp_path.iterdir()) == []
