"""Points that move, where the first frame may not be at rest; frames whose parts lack a displacement; time steps."""

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.convert import convert
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
POINTS = CUBE.rest_position.astype(float)
FLOOR = FieldNames(handle="0:zmin")


def pressed(frame):
    return POINTS * (0, 0, -0.1 * frame)


def written(folder, frames, points=pressed, **fields):
    """A file for each of the frames, in this order of names; the points are moved."""
    for number, frame in enumerate(frames):
        at = {name: make(frame) for name, make in fields.items()}
        mesh = meshio.Mesh(POINTS + points(frame), [("tetra", CUBE.elements)], point_data=at)
        mesh.write(folder / f"f{number}.vtu")
    return folder


def along_axes(pattern):
    return {pattern.format(axis): (lambda frame, at=at: pressed(frame)[:, at]) for at, axis in enumerate("xyz")}


@pytest.mark.parametrize("fields", [{"U": pressed}, along_axes("U_{}"), along_axes("U{}")])
def test_a_first_frame_that_is_not_at_rest_is_told_by_a_field_nobody_named(tmp_path, fields):
    with pytest.raises(DatasetError, match="the points of the first frame are not at rest: .* the field 'U' has moved"):
        read_series(written(tmp_path, (1, 2, 3), **fields), FLOOR)
    named = read_series(tmp_path, FieldNames(handle="0:zmin", displacement="U"))
    np.testing.assert_allclose(named.scene.rest_position, POINTS, atol=1e-6)


@pytest.mark.parametrize(
    ("frames", "fields"),
    [
        ((0, 1, 2), {"U": pressed}),
        ((1, 2, 3), {"velocity": lambda frame: pressed(1)}),
        ((1, 2, 3), {"position": lambda frame: POINTS + pressed(frame)}),
        ((1, 2, 3), {"U": lambda frame: pressed(frame)[:, :2], "fix": lambda frame: POINTS[:, 2]}),
        ((1, 2, 4), {"U": lambda frame: np.where(POINTS > 0, np.nan, pressed(frame))}),
    ],
    ids=["at rest", "velocity", "position", "two columns", "no numbers"],
)
def test_a_first_frame_is_at_rest_if_no_field_denies_it(tmp_path, frames, fields):
    result = read_series(written(tmp_path, frames, **fields), FLOOR)
    np.testing.assert_allclose(result.scene.rest_position, POINTS + pressed(frames[0]), atol=1e-6)


def test_a_vector_that_does_not_change_denies_nothing_where_nothing_moves(tmp_path):
    still = written(tmp_path, (1, 1), normal=lambda frame: np.ones_like(POINTS))
    np.testing.assert_allclose(read_series(still, FLOOR).scene.rest_position, POINTS + pressed(1), atol=1e-6)


def collection(folder, times):
    entries = "".join(f'<DataSet timestep="{time}" file="f{number}.vtu"/>' for number, time in enumerate(times))
    path = folder / "all.pvd"
    path.write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    return path


def test_the_first_frame_is_the_first_in_time(tmp_path):
    written(tmp_path, (2, 0, 1), U=pressed)
    result = read_series(collection(tmp_path, (2, 0, 1)), FLOOR)
    np.testing.assert_allclose(result.scene.rest_position, POINTS, atol=1e-6)


@pytest.mark.parametrize(("always", "told"), [(True, "in all frames, the first at"), (False, "was the run stopped")])
def test_nodes_without_a_displacement_are_told_by_what_lacks_it(tmp_path, always, told):
    def half(frame):
        return np.where((POINTS[:, 2:] > 0) & (always or frame == 2), np.nan, pressed(frame))

    with pytest.raises(DatasetError, match=told):
        read_series(written(tmp_path, (0, 1, 2), lambda _: 0, displacement=half), FLOOR)


@pytest.mark.parametrize("named", [None, "displacement"])
def test_a_displacement_of_cells_is_told(tmp_path, named):
    for frame in range(2):
        cells = {"displacement": [pressed(frame)[CUBE.elements].mean(axis=1)]}
        mesh = meshio.Mesh(POINTS, [("tetra", CUBE.elements)], cell_data=cells)
        mesh.write(tmp_path / f"f{frame}.vtu")
    told = "'displacement' is a cell field"
    with pytest.raises(DatasetError, match=told):
        names = FieldNames(handle="0:zmin", displacement=named)
        convert(tmp_path, tmp_path / "a.h5", names=names, splits={"train": 1}, progress=False)


@pytest.mark.parametrize(
    ("times", "step", "told"),
    [((0, 0.1, 0.2), 0.1, False), ((0, 1, 2), 0.1, False), ((0, 0.1, 0.2), 0.0, False), ((0, 100, 200), 0.1, True)],
)
def test_a_time_step_that_the_files_deny_is_told(tmp_path, times, step, told, recwarn):
    written(tmp_path, (0, 1, 2))
    options = {"names": FLOOR, "splits": {"train": 1}, "progress": False, "integration": "dynamic", "time_step": step}
    convert(collection(tmp_path, times), tmp_path / "a.h5", **options)
    texts = [str(one.message) for one in recwarn if "100 s pass from frame to frame" in str(one.message)]
    assert [text.partition("says ")[2][:3] for text in texts] == (["0.1"] if told else [])
