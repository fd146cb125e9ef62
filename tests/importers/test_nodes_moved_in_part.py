"""Nodes that a job moves along some axes and leaves free along others: a scene has no such nodes, so it is told."""

import numpy as np
import pytest
import test_kinds_of_jobs
from data_samples import block
from test_jobs import solved
from test_kinds_of_jobs import (
    CUBE,
    CYLINDER,
    HEIGHT,
    NAMES,
    SHEET,
    TURNED,
    cube,
    listed,
    read,
    step,
    upper_cube,
    written,
)

from ast_sim import Dataset
from ast_sim.importers.convert import convert
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.solved_jobs.job import read_job
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError

X, Y, _ = CUBE.rest_position.T
TOP = HEIGHT == 2
AWAY = "this motion is taken from the results, and a question must give it"
FOR_ALL = "they count as prescribed in all"
SETS = [
    *listed("HALF", TOP & (X == 0)),
    *listed("REST", TOP & (X > 0)),
    *listed("LEFT", X == 0),
    *listed("FRONT", Y == 0),
]
NEW = ["*BOUNDARY, OP=NEW", "FLOOR, 1, 3"]
PRESS = ["*BOUNDARY", "TOP, 3, 3, -0.1"]


def told(notes, *words):
    return [note for note in notes if any(word in note for word in words)]


@pytest.mark.parametrize(
    ("steps", "model", "expected"),
    [
        ([PRESS], (), [f"9 nodes are moved, but free along x and y: {AWAY}"]),
        ([[*PRESS, "TOP, 2, 2, 0.05"]], (), [f"9 nodes are moved, but free along x: {AWAY}"]),
        ([[*PRESS, "TOP, 2"]], (), [f"9 nodes are moved, but free along x: {AWAY}"]),
        ([[*PRESS, "TOP, XSYMM"]], (), [f"9 nodes are moved, but free along y: {AWAY}"]),
        ([[*PRESS, "TOP, PINNED"]], (), []),
        ([[*PRESS, "TOP, ENCASTRE"]], (), []),
        ([["*BOUNDARY", "TOP, 1, 3, -0.1"]], (), []),
        (
            [["*BOUNDARY", "TOP, 3, 3, 0."]],
            (),
            ["9 nodes are held in some directions only (symmetry, sliding): they count as free"],
        ),
        (
            [["*BOUNDARY", "TOP, ZSYMM"]],
            (),
            ["9 nodes are held in some directions only (symmetry, sliding): they count as free"],
        ),
        ([["*BOUNDARY", "1, 1, 3", "27, 3, 3, -0.1"]], (), [f"1 node is moved, but free along x and y: {AWAY}"]),
        (
            [["*BOUNDARY", "HALF, 1, 1", "HALF, 3, 3, -0.1", "REST, 1, 2, 0.1"]],
            SETS,
            [f"3 nodes are moved, but free along y: {AWAY}", f"6 nodes are moved, but free along z: {AWAY}"],
        ),
        (
            [PRESS, [*NEW, "TOP, 2, 2, 0.1"]],
            (),
            [f"9 nodes are prescribed in some steps only: {FOR_ALL}", f"9 nodes are moved, but free along x: {AWAY}"],
        ),
        ([PRESS, [*NEW, "TOP, 1, 2"]], (), [f"9 nodes are prescribed in some steps only: {FOR_ALL}"]),
        ([["*BOUNDARY", "TOP, 3, 3"], PRESS], (), [f"9 nodes are moved, but free along x and y: {AWAY}"]),
        ([["*BOUNDARY, SUBMODEL, STEP=1", "TOP, 3, 3"]], (), [f"9 nodes are moved, but free along x and y: {AWAY}"]),
        ([PRESS], CYLINDER, [f"9 nodes are moved, but free along x and y of *TRANSFORM: {AWAY}"]),
        ([["*BOUNDARY", "998, 1, 3, -0.1", "999, 1, 3"]], TURNED, []),
        (
            [["*BOUNDARY", "998, 3, 3, -0.1", "999, 1, 3"]],
            TURNED,
            [f"the rigid body TOP is free along x, along y: {AWAY.split(',')[0]}"],
        ),
    ],
)
def test_axes_along_which_moved_nodes_are_free_are_told(tmp_path, steps, model, expected):
    job = read_job(written(tmp_path, cube(*(step(*lines) for lines in steps), model=model)))
    assert told(job.mesh.notes, "moved", "held in", "free", "some steps") == expected
    drives = not any("count as free" in note for note in expected)
    marked = job.node_type[np.isin(job.mesh.same_point, 1 + np.flatnonzero(TOP))]
    some = steps == [["*BOUNDARY", "1, 1, 3", "27, 3, 3, -0.1"]]
    assert (marked == NodeType.HANDLE).sum() == (1 if some else 9 * drives)


def test_a_quarter_of_a_block_between_planes_of_symmetry(tmp_path):
    """Pressed without friction. Nodes of the planes are free, but for the corner that all three hold; the top is given
    by the results, which a formula tells."""
    planes = ["*BOUNDARY", "LEFT, 1, 1", "FRONT, 2, 2", "FLOOR, 3, 3"]
    lines = [line for line in cube(step(*planes, *PRESS), model=SETS) if line != "FLOOR, 1, 3"]
    lines.remove("*BOUNDARY")
    result = read(solved(tmp_path, lines))
    corner = (X == 0) & (Y == 0) & (HEIGHT == 0)
    assert np.array_equal(result.scene.node_type == NodeType.HANDLE, TOP | corner)
    notes = result.attributes["notes"].split("; ")
    assert told(notes, "moved,", "held in") == [
        "13 nodes are held in some directions only (symmetry, sliding): they count as free",
        f"4 nodes are moved, but free along x and y: {AWAY}",
        f"2 nodes are moved, but free along x: {AWAY}",
        f"2 nodes are moved, but free along y: {AWAY}",
    ]
    way = result.position[-1] - result.scene.rest_position
    np.testing.assert_allclose(way[:, 2], -0.05 * HEIGHT, atol=1e-5)
    np.testing.assert_allclose(way[:, :2], 0.3 * 0.05 * np.stack([X, Y], axis=1), rtol=0.05, atol=1e-5)


@pytest.mark.parametrize(
    ("boundary", "note"),
    [
        (
            ["3, 5, 5, 0.2", "6, 5, 5, 0.2"],
            "2 nodes are turned (directions 4 to 6 of *BOUNDARY): turns of nodes are in no scene",
        ),
        (["3, 5, 5", "6, 5, 5"], "2 nodes are held in some directions only"),
        (["3, 3, 3, 0.1", "3, 5, 5, 0.2", "6, 3, 3, 0.1"], "2 nodes are moved, but free along x and y: "),
    ],
)
def test_nodes_of_shells_that_are_turned_are_told(tmp_path, boundary, note):
    job = read_job(written(tmp_path, [*SHEET[:-2], *boundary, "*END STEP"]))
    assert len(told(job.mesh.notes, "turned", "held in", "moved")) == 1 and told(job.mesh.notes, note)
    driven = "moved" in note
    assert (job.node_type == [3, 0, 3 * driven, 3, 0, 3 * driven]).all()


def test_middles_of_edges_that_a_scene_leaves_out_are_not_counted(tmp_path):
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    middles = [(0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
    places = [(x, y, z) for square in (corners, middles) for z in (0, 1) for x, y in square]
    places += [(x, y, 0.5) for x, y in corners]
    nodes = [f"{1 + row}, {x}, {y}, {z}" for row, (x, y, z) in enumerate(places)]
    top = [1 + row for row, place in enumerate(places) if place[2] == 1]
    lines = ["*NODE", *nodes, "*ELEMENT, TYPE=C3D20, ELSET=ALL", "1, " + ", ".join(map(str, range(1, 16))) + ","]
    lines += ["16, 17, 18, 19, 20", "*NSET, NSET=TOP", *map(str, top), *step(*PRESS)]
    notes = read_job(written(tmp_path, lines)).mesh.notes
    assert len(top) == 8 and told(notes, "moved") == [f"4 nodes are moved, but free along x and y: {AWAY}"]


@pytest.fixture
def flat(monkeypatch):
    """The block of one layer of elements, of which all nodes lie at the floor or at the top."""
    one = block(2, 2, 1)
    monkeypatch.setattr(test_kinds_of_jobs, "CUBE", one)
    monkeypatch.setattr(test_kinds_of_jobs, "HEIGHT", 2 * one.rest_position[:, 2])


SOFT = (
    "1 body has prescribed nodes only, some of them free along an axis: 18 nodes are handles there, not of a rigid tool"
)


@pytest.mark.parametrize(
    ("boundary", "kind", "expected"),
    [
        (["TOP, 3, 3, -0.1"], NodeType.HANDLE, [SOFT]),
        (["TOP, 2, 3, -0.1"], NodeType.HANDLE, [SOFT]),
        (["TOP, 1, 3, -0.1"], NodeType.OBSTACLE, []),
        (["FLOOR, 1, 3", "TOP, 1, 2", "TOP, 3, 3, -0.1"], NodeType.OBSTACLE, []),
    ],
)
@pytest.mark.usefixtures("flat")
def test_a_body_whose_nodes_are_all_prescribed_is_a_tool_only_if_they_are_along_all_axes(
    tmp_path, boundary, kind, expected
):
    job = read_job(written(tmp_path, cube(step("*BOUNDARY", *boundary))))
    assert (job.node_type == kind).all()
    notes = told(job.mesh.notes, "prescribed nodes only")
    assert [note.partition(" (as Field")[0] for note in notes] == expected


@pytest.mark.usefixtures("flat")
def test_a_job_without_a_free_node_is_refused(tmp_path):
    """Also if it has a stress: a training needs a free node."""
    deck, results = solved(tmp_path, cube(step(*PRESS)))
    options = {"names": NAMES, "deck": deck, "length_unit": "mm", "splits": {"train": 1}, "progress": False}
    with pytest.raises(DatasetError, match="all nodes are prescribed, so there is nothing to predict") as error:
        convert(results, tmp_path / "d.h5", **options)
    assert "not used" not in str(error.value)  # the displacement of the results is
    assert convert(results, tmp_path / "d.h5", **options, incomplete=True)["train"] == 1


def test_a_soft_body_that_is_wholly_given_beside_a_free_one(tmp_path):
    """Its x and y are in the dataset, and its stress."""
    both = ["LID, 3, 3, -0.1", "NODES_UP, 3, 3, -0.05", "101, 1, 2", "119, 2, 2"]
    model = [*upper_cube(0.5), "*NSET, NSET=NODES_UP", *(str(101 + node) for node in np.flatnonzero(HEIGHT < 2))]
    deck, results = solved(tmp_path, cube(step(*PRESS, *both), model=model))
    counts = convert(results, tmp_path / "d.h5", names=NAMES, deck=deck, length_unit="mm", splits={"train": 1})
    assert counts["train"] == 1
    with Dataset(tmp_path / "d.h5") as data:
        one = data.load("train", 0)
    assert np.array_equal(one.scene.node_type, [3 * (height != 1) for height in HEIGHT] + [3] * 27)
    notes = one.attributes["notes"]
    assert SOFT.replace("18", "27") in notes
    assert f"34 nodes are moved, but free along x and y: {AWAY}" in notes
    way = one.position[-1, 27:] - one.scene.rest_position[27:]
    assert way[:, 0].max() > 0.01 and one.stress[-1, 27:].max() > 1e6


def test_a_shell_as_a_tool_is_an_obstacle_whatever_moves_it(tmp_path):
    sheet = [f"{901 + row}, {x}, {y}, 2.5" for row, (x, y) in enumerate([(0, 0), (2, 0), (2, 2), (0, 2)])]
    model = ["*NODE, NSET=SHEET", *sheet, "*ELEMENT, TYPE=S4, ELSET=TOOL", "901, 901, 902, 903, 904"]
    job = read_job(written(tmp_path, cube(step("*BOUNDARY", "SHEET, 3, 3, -0.1"), model=model)))
    assert not told(job.mesh.notes, "prescribed nodes only")
    assert told(job.mesh.notes, "moved") == [f"4 nodes are moved, but free along x and y: {AWAY}"]


@pytest.mark.parametrize("kind", ["*AMPLITUDE, NAME=UP AND DOWN", "*Amplitude, Name=up and down, time=total time"])
def test_an_amplitude_is_in_the_results(tmp_path, kind):
    up = [kind, "0., 0., 0.5, 1., 1., 0.25"]
    move = ["*BOUNDARY, AMPLITUDE=UP AND DOWN", "TOP, 3, 3, -0.2"]
    job = solved(tmp_path, cube(step("*BOUNDARY", "TOP, 1, 2", *move, procedure="*STATIC, DIRECT"), model=up))
    result = read(job)
    assert result.times == (0, 0.5, 1)
    way = (result.position - result.scene.rest_position)[:, TOP, 2]
    np.testing.assert_allclose(way, np.outer([0, -0.2, -0.05], np.ones(9)), atol=1e-6)
    notes = result.attributes["notes"].split("; ")
    assert told(notes, "AMPLITUDE") == ["*AMPLITUDE is not computed: nodes move as in the results"]
    assert told(read_mesh(job[0]).notes, "ignored")[0].startswith("ignored keywords: AMPLITUDE, BOUNDARY, ")
