"""Results of LS-DYNA as it writes them: the geometry in d3plot, the states in d3plot01, with the numbers of users."""

import numpy as np
import pytest

from ast_sim.importers.formats.vtk_files import vtk_frames
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

TIMES = (0.0, 0.5, 1.0)
NAMES = FieldNames(displacement="Deflection", stress="Stress", handle="0:zmin")
COLUMN = np.array([(x, y, z) for z in range(5) for y in range(2) for x in range(2)], float)  # of four cubes
CUBES = np.array([[0, 1, 3, 2, 4, 5, 7, 6]]) + 4 * np.arange(4)[:, None]


def write(
    folder, points, solids, parts, positions, stress, shells=((), ()), width=4, order="<", users=True, rigid=False
):
    """States of 8-node solids, whose positions and xx stress are given, and of rigid 4-node shells."""
    whole, real = np.dtype(f"{order}i{width}"), np.dtype(f"{order}f{width}")
    quads, quad_parts = (np.array(one, int) for one in shells)
    control = np.zeros(64, whole)
    numbers = {11: 1, 15: 4, 16: len(points), 17: 6, 18: 6, 20: 1, 23: len(solids), 24: max(parts), 27: 7, 36: 3}
    numbers |= {31: len(quads), 32: 1 if len(quads) else 0, 33: 33, 39: 10 + len(points) + len(solids) + len(quads)}
    for place, number in {**numbers, **dict.fromkeys(range(43, 47), 1000)}.items():
        control[place] = number if users or place != 39 else 0
    control.view(real)[14] = 960
    tables = [np.column_stack([solids + 1, parts]), np.column_stack([quads.reshape(-1, 4) + 1, quad_parts])]
    ends = np.cumsum([len(points), len(points), len(solids), 0, 0])
    head = [*ends.tolist(), len(points), len(solids), 0, len(quads), 0]
    given = [*head, *(1000 + 7 * np.arange(len(points))), *range(1, 1 + len(solids) + len(quads))] if users else []
    end = np.array([-999999], real).tobytes()
    control[15] = 5 if rigid else 4
    control[51] = 2 if rigid else 0
    materials = np.array([0, 2, 24, 24] if rigid else [], whole)
    content = [
        control,
        materials,
        points.astype(real),
        *(table.astype(whole) for table in tables),
        np.array(given, whole),
    ]
    (folder / "d3plot").write_bytes(b"".join(one.tobytes() for one in content) + end)
    states = b""
    for time, moved, xx in zip(TIMES, positions, stress, strict=True):
        values = np.zeros((len(solids), 7))
        values[:, 0] = xx
        state = [[time], np.zeros(6), moved.ravel(), values.ravel(), np.zeros(33 * len(quads))]
        states += np.concatenate(state).astype(real).tobytes()
    (folder / "d3plot01").write_bytes(states + end)
    return folder / "d3plot"


def pressed(points):
    return [points * (1, 1, 1 - 0.1 * frame) for frame in range(3)]


def stresses(count):
    return [np.full(count, 1e6 * frame) for frame in range(3)]


FORMS = [
    (4, "<", True, False),
    (4, "<", False, False),
    (8, "<", True, False),
    (4, ">", True, False),
    (4, "<", True, True),
]


@pytest.mark.parametrize(("width", "order", "users", "rigid"), FORMS)
def test_parts_that_share_nodes_are_one_body(tmp_path, width, order, users, rigid):
    """Of two materials; VTK gives each part nodes of its own, and garbage for the numbers of users."""
    path = write(
        tmp_path,
        COLUMN,
        CUBES,
        [1, 1, 2, 2],
        pressed(COLUMN),
        stresses(4),
        width=width,
        order=order,
        users=users,
        rigid=rigid,
    )
    read = read_series(path, NAMES)
    assert read.times == TIMES and read.scene.num_nodes == len(COLUMN)
    assert np.unique(read.scene.body).tolist() == [0]
    np.testing.assert_allclose(np.sort(read.position[2, :, 2]), np.sort(0.8 * COLUMN[:, 2]), rtol=1e-6)
    np.testing.assert_allclose(read.stress[:, :, 0].max(axis=1), (0, 1e6, 2e6), rtol=1e-6)
    assert "8 points at 4 places are joined: the file gives them one number" in read.attributes["notes"]
    assert not any("ser" in name for name in next(vtk_frames(path)).point_fields)


@pytest.mark.parametrize(("width", "order", "users", "rigid"), FORMS)
@pytest.mark.parametrize("gap", [0.0, 0.1])
def test_bodies_that_touch_at_rest_stay_two(tmp_path, gap, width, order, users, rigid):
    """Whether they part or stay together."""
    points = np.concatenate([COLUMN[:12], COLUMN[8:]])
    cubes = np.where(np.arange(4)[:, None] < 2, CUBES, CUBES + 4)
    upper = np.arange(24) >= 12
    moved = [points * (1, 1, 1 - 0.1 * frame) + upper[:, None] * (0, 0, gap * frame) for frame in range(3)]
    path = write(
        tmp_path, points, cubes, [1, 1, 2, 2], moved, stresses(4), width=width, order=order, users=users, rigid=rigid
    )
    read = read_series(path, NAMES)
    assert read.scene.num_nodes == 24 and np.unique(read.scene.body).tolist() == [0, 1]
    np.testing.assert_allclose(read.position[2, :, 2], moved[2][:, 2], rtol=1e-6)


def test_a_tool_of_shells_is_an_obstacle(tmp_path):
    tool = np.array([(x, y, 4.5) for y in range(3) for x in range(3)], float) - (0.5, 0.5, 0)
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]]) + len(COLUMN)
    points = np.concatenate([COLUMN, tool])
    down = [np.concatenate([one, tool - (0, 0, 0.4 * frame)]) for frame, one in enumerate(pressed(COLUMN))]
    path = write(tmp_path, points, CUBES, [1, 1, 1, 1], down, stresses(4), shells=(quads, [2] * 4))
    read = read_series(path, NAMES)
    front = read.scene.rest_position[:, 2] == 4.5
    assert front.sum() == 9 and (read.scene.node_type[front] == NodeType.OBSTACLE).all()
    np.testing.assert_allclose(read.position[:, front, 2], [[4.5] * 9, [4.1] * 9, [3.7] * 9], rtol=1e-6)


def in_two_files(path):
    """The last of three states in a file of its own."""
    words = np.fromfile(path.parent / "d3plot01", "<f4")
    end = words[-1:]
    size = (len(words) - 1) // 3
    np.concatenate([words[: 2 * size], end, np.zeros(50)]).astype("<f4").tofile(path.parent / "d3plot01")
    np.concatenate([words[2 * size : -1], end]).astype("<f4").tofile(path.parent / "d3plot02")


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (lambda path: None, None),
        (lambda path: (path.parent / "d3plot02").rename(path.parent / "d3plot03"), "d3plot02 is missing, but d3plot03"),
        (lambda path: (path.parent / "d3plot01").unlink(), "d3plot01 is missing, but d3plot02 is there"),
        (lambda path: (path.parent / "d3plotaa").touch(), "goes on in d3plotaa with another mesh"),
        (
            lambda path: shorten(path.parent / "d3plot02"),
            "d3plot02: is cut off: it does not end as the files",
        ),
        (lambda path: shorten(path.parent / "d3plot01"), "d3plot01: is cut off"),
    ],
    ids=["whole", "one missing", "the first missing", "adaptive", "cut off", "the first cut off"],
)
def test_states_that_are_missing_or_cut_off_are_refused(tmp_path, damage, cause):
    """VTK stops at the first missing file, and takes zeros for the rest of a state that is cut off."""
    path = write(tmp_path, COLUMN, CUBES, [1, 1, 1, 1], pressed(COLUMN), stresses(4))
    in_two_files(path)
    damage(path)
    if cause is None:
        assert read_series(path, NAMES).times == TIMES
        return
    with pytest.raises(DatasetError, match=cause):
        read_series(path, NAMES)


def shorten(file):
    file.write_bytes(file.read_bytes()[:-240])


@pytest.mark.parametrize("dead", [None, 0, 3])
@pytest.mark.parametrize("when", [1, 2])
def test_elements_that_are_deleted_are_refused(tmp_path, dead, when):
    """A table at the end of each state has 0 for them; a maximum of -10,003 layers says that it is there."""
    path = write(tmp_path, COLUMN, CUBES, [1, 1, 1, 1], pressed(COLUMN), stresses(4))
    control = np.fromfile(path, "<i4")
    control[36] = -10003
    control.tofile(path)
    states = np.fromfile(tmp_path / "d3plot01", "<f4")
    alive = np.ones((3, 4), "<f4")
    alive[when:, dead if dead is not None else []] = 0
    states = np.column_stack([states[:-1].reshape(3, -1), alive]).ravel()
    np.append(states, states.dtype.type(-999999)).tofile(tmp_path / "d3plot01")
    if dead is None:
        assert read_series(path, NAMES).scene.num_elements == 24
        return
    with pytest.raises(DatasetError, match=f"d3plot: 1 element is deleted at the time {TIMES[when]:g}, but all"):
        read_series(path, NAMES)
