"""Places select the nodes that they say."""

import meshio
import numpy as np
import pytest
from data_samples import block
from meshes import plate_and_punch
from simulate.own_assembly.assemblies import SPEC, case_of, write_assembly

from ast_sim.importers.places import parse_places
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.scene import NodeType
from ast_sim.support.errors import ConfigError, DatasetError

GRID = np.stack(np.meshgrid(*[np.arange(5.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
X, Y, Z = GRID.T


def selected(text: str) -> np.ndarray:
    marks = {"odd": (X % 2 == 1), "end": (X == 4)}
    places = [place.inside(GRID, marks.__getitem__, marks.__getitem__) for place in parse_places(text)]
    return np.any(places, axis=0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("all", X >= 0),
        ("xmin", X == 0),
        ("zmax", Z == 4),
        ("x>3", X > 3),
        ("x >= 3", X >= 3),
        ("y=2", Y == 2),
        ("y<-1e-3,y<=0", Y == 0),
        ("1<x<3", X == 2),
        ("1 <= x < 3", (X == 1) | (X == 2)),
        ("1<x<3 and y=2 and z<=1", (X == 2) & (Y == 2) & (Z <= 1)),
        ("xmin and ymin,z>3", ((X == 0) & (Y == 0)) | (Z > 3)),
        ("field=odd and z>3", (X % 2 == 1) & (Z > 3)),
        ("group=end", X == 4),
    ],
)
def test_a_place_holds_these_nodes(text, expected):
    assert np.array_equal(selected(text), expected)


@pytest.mark.parametrize("text", ["", "top", "w>3", "x>", "x>nan", "x>1e999", "3<x", "x<3<y", "3<x>2", "x>1 or y>1"])
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError):
        parse_places(text)


def test_a_box_and_a_group_of_a_mesh_file(tmp_path):
    mesh = plate_and_punch()
    left = np.flatnonzero(mesh.points[:, 0] == -0.2)
    meshio.Mesh(mesh.points, mesh.cells, point_sets={"left": left}).write(tmp_path / "a.inp")
    inside = (np.abs(mesh.points[:, 0]) < 0.06) & (mesh.points[:, 2] == 0)
    for clamp, expected in (("0:group=left", left), ("0:-0.06<x<0.06 and zmin", np.flatnonzero(inside))):
        scene = read_scene(tmp_path / "a.inp", obstacles=[1], clamps=[clamp]).scene
        assert np.array_equal(np.flatnonzero(scene.node_type == NodeType.HANDLE), expected)
    with pytest.raises(DatasetError, match="there is no group of nodes 'right'; there are: left"):
        read_scene(tmp_path / "a.inp", obstacles=[1], clamps=["0:group=right"])
    with pytest.raises(ConfigError, match="no node of body 0 lies in 'x>9 and zmin'"):
        read_scene(tmp_path / "a.inp", obstacles=[1], clamps=["0:x>9 and zmin"])


def test_an_end_is_flat_to_a_hundredth_of_the_shortest_edge(tmp_path):
    """Coordinates that were written with few digits. The noise differs from node to node, so one node alone is the
    lowest; nodes that stand in by more are not at the end."""
    mesh = plate_and_punch()
    lowest = np.flatnonzero(mesh.points[:, 0] == mesh.points[:, 0].min())
    ends = mesh.points[mesh.cells[0].data]
    shortest = np.linalg.norm(ends - np.roll(ends, 1, axis=1), axis=2).min()
    for share, at_end in ((0.005, len(lowest)), (0.05, 1)):
        noisy = mesh.points.copy()
        noisy[lowest, 0] += share * shortest * (np.arange(len(lowest)) > 0)
        meshio.Mesh(noisy, mesh.cells).write(tmp_path / "a.vtu")
        scene = read_scene(tmp_path / "a.vtu", obstacles=[1], clamps=["0:xmin"]).scene
        held = np.flatnonzero(scene.node_type == NodeType.HANDLE)
        assert np.array_equal(held, lowest[:at_end])


BOTH = "bottom and fixed"


@pytest.mark.parametrize(
    ("text", "known", "expected"),
    [
        (f"group={BOTH}", [BOTH], [[BOTH]]),
        (f'group="{BOTH}"', [], [[BOTH]]),
        (f"group={BOTH}", ["bottom", BOTH, "fixed"], [[BOTH]]),
        (f"group={BOTH} and zmin", [BOTH], [[BOTH, "min"]]),
        (f"zmin and group={BOTH},xmax", [BOTH], [["min", BOTH], ["max"]]),
        (f'group="{BOTH}" and zmin,field="a, b"', [], [[BOTH, "min"], ["a, b"]]),
        ("group=left, right and zmin", ["left, right"], [["left, right", "min"]]),
        ("field=a and b,group=a and b", ["a and b"], [["a and b"], ["a and b"]]),
        ("group=bottom and zmin", ["bottom", BOTH], [["bottom", "min"]]),
        ("group=sand,group=bandage", [], [["sand"], ["bandage"]]),
    ],
)
def test_a_name_may_hold_the_word_and_or_a_comma(text, known, expected):
    places = parse_places(text, known)
    assert [[rule.name or rule.kind for rule in place.rules] for place in places] == expected
    assert ",".join(place.text for place in places) == text


@pytest.mark.parametrize("text", [f"group={BOTH}", "group=left, right", f'group="{BOTH}', f"group={BOTH} x"])
def test_a_name_with_and_or_a_comma_that_is_not_known_needs_quotes(text):
    with pytest.raises(ValueError):
        parse_places(text, ["bottom", "left"])


PAD = block(2, 2, 1)
FLOOR = PAD.rest_position[:, 2] == 0
NAMES = ["$PhysicalNames", "2", f'2 2 "{BOTH}"', '3 1 "all, parts"', "$EndPhysicalNames"]


def msh(form):
    """The pad as a file of Gmsh, whose floor is a named group."""
    faces = PAD.surface()
    faces = 1 + faces[FLOOR[faces].all(axis=1)]
    cells = 1 + PAD.elements
    places = [" ".join(f"{x:g}" for x in point) for point in PAD.rest_position]
    if form == "2.2":
        nodes = [f"{1 + row} {place}" for row, place in enumerate(places)]
        rows = [("2 2 2 2", face) for face in faces] + [("4 2 1 1", cell) for cell in cells]
        elements = [f"{1 + n} {kind} " + " ".join(map(str, row)) for n, (kind, row) in enumerate(rows)]
        sections = {"Nodes": [str(len(nodes)), *nodes], "Elements": [str(len(rows)), *elements]}
    else:
        rows = [f"{1 + n} " + " ".join(map(str, row)) for n, row in enumerate([*faces, *cells])]
        sizes = [f"2 {len(rows)} 1 {len(rows)}", f"2 1 2 {len(faces)}", f"3 1 4 {len(cells)}"]
        elements = [*sizes[:2], *rows[: len(faces)], sizes[2], *rows[len(faces) :]]
        nodes = [f"1 {len(places)} 1 {len(places)}", f"3 1 0 {len(places)}", *map(str, range(1, 1 + len(places)))]
        sections = {
            "Entities": ["0 0 1 1", "1 0 0 0 2 2 0 1 2 0", "1 0 0 0 2 2 1 1 1 0"],
            "Nodes": [*nodes, *places],
            "Elements": elements,
        }
    lines = [line for name, inner in sections.items() for line in (f"${name}", *inner, f"$End{name}")]
    return "\n".join(["$MeshFormat", f"{form} 0 8", "$EndMeshFormat", *NAMES, *lines, ""])


@pytest.mark.parametrize("form", ["2.2", "4.1"])
@pytest.mark.parametrize("written", [BOTH, f'"{BOTH}"'])
def test_a_group_of_gmsh_whose_name_holds_and_is_a_clamp(tmp_path, form, written):
    (tmp_path / "a.msh").write_text(msh(form))
    read = read_scene(tmp_path / "a.msh", clamps=[f"0:group={written}"])
    assert np.array_equal(read.scene.node_type == NodeType.HANDLE, FLOOR)
    some = read_scene(tmp_path / "a.msh", clamps=[f"0:group={written} and xmin,zmax"]).scene
    at_left = PAD.rest_position[:, 0] == 0
    assert np.array_equal(some.node_type == NodeType.HANDLE, (FLOOR & at_left) | ~FLOOR)
    every = read_scene(tmp_path / "a.msh", clamps=[f"0:group=all, parts and group={written}"]).scene
    assert np.array_equal(every.node_type == NodeType.HANDLE, FLOOR)


@pytest.mark.parametrize(("place", "told"), [(f'group=\\"{BOTH}\\"', None), (f"group={BOTH}", 'group="A and B"')])
def test_a_specification_names_such_a_group_in_quotes(tmp_path, place, told):
    path = write_assembly(tmp_path, SPEC.replace('"block.vtu"', '"a.msh"').replace("zmin", place))
    (tmp_path / "a.msh").write_text(msh("2.2"))
    if told:
        with pytest.raises(ConfigError, match=f"cannot be read at 'fixed'; .*{told}"):
            case_of(path)
    else:
        scene = case_of(path).scene
        assert np.array_equal(scene.rest_position[scene.node_type == NodeType.HANDLE, 2], np.zeros(FLOOR.sum()))
