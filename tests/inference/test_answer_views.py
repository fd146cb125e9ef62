"""An answer frame by frame, as a picture and as a grid of PyVista."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest
import toy
from PIL import Image

from ast_sim.inference.answer import Answer
from ast_sim.support.errors import ConfigError, MissingExtra, RolloutError

TRUTH = toy.plate()
ROWS = [5, 2, 3]  # the order in which frames were asked for


def answer(stress: str = "node") -> Answer:
    at_elements = np.repeat(np.float32(1e5 * np.arange(7))[:, None, None], TRUTH.scene.num_elements, axis=1)
    values = {"node": TRUTH.stress, "element": at_elements, "none": None}[stress]
    return Answer(
        "toy",
        TRUTH.scene,
        TRUTH.position[ROWS],
        None if values is None else values[ROWS],
        1,
        [0.1] * 3,
        info=replace(toy.info(), time_step=0.5, stress_location=stress),
        stress_location=stress,
        frames=tuple(ROWS),
    )


def test_frames_one_by_one():
    found = answer()
    assert np.array_equal(found.displacement, TRUTH.position[ROWS] - TRUTH.scene.rest_position)
    assert [frame.number for frame in found] == ROWS
    for frame, row in zip(found, ROWS, strict=True):
        same = found.frame(row)
        assert np.array_equal(frame.position, TRUTH.position[row]) and np.array_equal(same.position, frame.position)
        assert np.array_equal(frame.displacement, TRUTH.position[row] - TRUTH.scene.rest_position)
        assert np.array_equal(frame.stress, TRUTH.stress[row, :, 0])
    assert answer("none").frame(2).stress is None
    with pytest.raises(RolloutError, match="toy: the answer has no frame 4; it has: 5, 2, 3"):
        found.frame(4)
    with pytest.raises(ConfigError, match="number is True; it must be a whole number"):
        found.frame(True)


def pixels(found: Answer, number: int | None = None) -> np.ndarray:
    file = io.BytesIO()
    found.plot(number).savefig(file, format="png", dpi=50)
    return np.asarray(Image.open(file).convert("RGB")).astype(int)


def test_a_picture_of_the_frame_of_largest_displacement():
    """The plate is deepest in frame 3 of 7."""
    found = answer()
    shown = pixels(found)
    assert 0.1 < (shown.min(axis=2) < 240).mean() < 0.8
    assert np.array_equal(shown, pixels(found, 3)) and not np.array_equal(shown, pixels(found, 5))
    (label,) = [axes.get_xlabel() for axes in found.plot().axes if axes.get_xlabel()]
    assert label == "von Mises stress (kPa), frame 3"
    (label,) = [axes.get_xlabel() for axes in answer("none").plot(2).axes if axes.get_xlabel()]
    assert label == "Displacement (mm), frame 2"
    with pytest.raises(RolloutError, match="has no frame 0"):
        found.plot(0)
    none = replace(found, position=found.position[:0], stress=None, frames=())
    with pytest.raises(RolloutError, match="the answer has no frame to draw"):
        none.plot()


@pytest.mark.parametrize("stress", ["node", "element", "none"])
def test_a_grid_of_pyvista(stress):
    found = answer(stress)
    grid = found.to_pyvista(2)
    assert np.array_equal(grid.points, TRUTH.position[2])
    assert np.array_equal(grid.cells.reshape(-1, 5)[:, 1:], TRUTH.scene.elements)
    assert np.array_equal(grid.point_data["displacement"], found.frame(2).displacement)
    assert np.array_equal(grid.point_data["node_type"], TRUTH.scene.node_type)
    data = {"node": grid.point_data, "element": grid.cell_data}.get(stress)
    assert (data is None and "von_mises" not in grid.array_names) or np.array_equal(
        data["von_mises"], found.frame(2).stress
    )
    assert np.array_equal(found.to_pyvista().points, TRUTH.position[5])


def test_a_missing_pyvista_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(MissingExtra, match=r'pyvista is needed here .*: pip install "ast_sim\[pyvista\]"'):
        answer().to_pyvista()
