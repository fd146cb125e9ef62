"""STL files as programs write them, and what is mended: every way to write a cube gives the same cube."""

import numpy as np
import pytest

from ast_sim.importers.formats.stl_file import BadSurface, read_stl
from ast_sim.simulate.shapes.cad.surface_mend import solids_of, stl_surface, whole_surface
from ast_sim.simulate.shapes.mesh_check import BadMesh, boundary, check_surface
from ast_sim.simulate.shapes.parts import rectilinear


def cube(low=0.0, high=10.0, cells=2):
    """The corners [F,3,3] of the triangles of a cube."""
    position, elements = rectilinear([np.linspace(low, high, cells + 1)] * 3)
    return position[boundary(elements)]


def facet(corners) -> str:
    vertices = "".join(f"      vertex {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in corners)
    return f"  facet normal 0 0 0\n    outer loop\n{vertices}    endloop\n  endfacet\n"


def text(*solids, names=("thing", "other")) -> str:
    blocks = zip(solids, names, strict=False)
    return "".join(f"solid {name}\n{''.join(map(facet, corners))}endsolid {name}\n" for corners, name in blocks)


def binary(corners, header=b"", count=None, colour=0) -> bytes:
    rows = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
    rows["corners"], rows["colour"] = corners, colour
    number = len(corners) if count is None else count
    return header.ljust(80, b" ")[:80] + number.to_bytes(4, "little") + rows.tobytes()


def volume(surface) -> float:
    a, b, c = np.moveaxis(surface.position[surface.triangles], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


CUBES = {
    "text": text(cube()),
    "capitals": text(cube()).upper(),
    "mixed case": text(cube()).title(),
    "tabs and CRLF": text(cube()).replace("  ", "\t").replace("\n", "\r\n"),
    "carriage returns": text(cube()).replace("\n", "\r"),
    "no indentation": "\n".join(line.strip() for line in text(cube()).splitlines()),
    "a mark of the bytes' order": b"\xef\xbb\xbf" + text(cube()).encode(),
    "empty lines": "\n\n" + text(cube()).replace("\n", "\n\n"),
    "no name": text(cube(), names=[""]),
    "a name of many words": text(cube(), names=["solid facet 3 vertex (mm)"]),
    "exponents": text(cube()).replace("vertex 10 ", "vertex 1.0E+01 ").replace("vertex 5 ", "vertex +5.000000e+000 "),
    "binary": binary(cube()),
    "binary that begins with solid": binary(cube(), b"solid thing\0\0 made by a program"),
    "binary with colours": binary(cube(), b"COLOR=\xff\x00\x00\xff", colour=0x7FFF),
    "two solids that share a face": text(cube()[:20], cube()[20:]),
}


@pytest.mark.parametrize("name", CUBES)
def test_every_way_to_write_a_cube_gives_the_cube(name, tmp_path):
    data = CUBES[name]
    (tmp_path / "cube.stl").write_bytes(data if isinstance(data, bytes) else data.encode())
    surface = stl_surface(tmp_path / "cube.stl")
    assert (len(surface.position), len(surface.triangles), surface.notes) == (26, 48, ())
    assert surface.is_closed and volume(surface) == pytest.approx(1000)


BROKEN = {
    "not there": (None, "cannot be read: No such file"),
    "empty": (b"", "has 0 bytes: neither a text that begins with 'solid' nor a binary STL file"),
    "no triangle": (text([]).encode(), "holds no triangles"),
    "binary without a triangle": (binary(cube()[:0]), "holds no triangles"),
    "text cut off": (text(cube()).encode()[:-300], "is cut off after .* facets"),
    "text cut off behind a facet": (text(cube()).encode()[:-16], "is cut off after 48 facets: .*'endsolid' is missing"),
    "binary cut off": (binary(cube())[:-60], "is cut off: it says 48 triangles, but holds 46"),
    "binary with a wrong count": (binary(cube(), count=40), "says 40 triangles, but has 2,400 bytes of them"),
    "four corners": (text(cube()).replace("endloop", "vertex 0 0 0\n endloop", 1).encode(), "but 145 vertices"),
    "decimal commas": (text(cube(high=10.5)).replace(".5", ",5").encode(), "a vertex has no three numbers"),
    "no number": (text(cube()).replace("vertex 10 ", "vertex nan ", 1).encode(), "corner of triangle .* not finite"),
    "points only": (text(np.zeros((3, 3, 3))).encode(), "all its triangles are without an area"),
    "an HTML page": (b"<!DOCTYPE html>" + b" " * 200, "is cut off: it says"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_told(kind, tmp_path):
    data, words = BROKEN[kind]
    if data is not None:
        (tmp_path / "cube.stl").write_bytes(data)
    with pytest.raises(BadSurface, match=words):
        stl_surface(tmp_path / "cube.stl")


def test_triangles_of_no_area_are_left_out():
    """Two corners at one place, three at one place, and a corner in the middle of a side of its neighbour."""
    corners = cube()
    a, b, _ = corners[0]
    points = np.array([[a, a, b], [b, b, b]])
    surface = whole_surface(np.concatenate([points[:1], corners, points[1:]]))
    assert (len(surface.position), len(surface.triangles)) == (26, 48) and surface.is_closed
    assert surface.notes == ("2 triangles of no area left out",)


@pytest.mark.parametrize("off", [0.0, 1e-9])
def test_a_needle_along_a_side_leaves_no_gap(off):
    """A side is cut in two on one of its two faces only; the needle a, m, b closes the gap between them."""
    corners = cube(cells=1)
    row = next(i for i, one in enumerate(corners) if (one[:, 2] == 10).all())
    a, b, c = corners[row]
    middle = (a + b) / 2 + [0, 0, off]
    cut = [np.stack(one) for one in ((a, middle, c), (middle, b, c), (a, b, middle))]
    surface = whole_surface(np.concatenate([np.delete(corners, row, axis=0), cut]))
    assert (len(surface.position), len(surface.triangles)) == (9, 14) and surface.is_closed
    assert volume(surface) == pytest.approx(1000) and surface.notes == ("1 triangle of no area left out",)


def test_triangles_that_stand_twice():
    corners = cube()
    surface = whole_surface(np.concatenate([corners, corners[:1], corners[3:4]]))
    assert len(surface.triangles) == 48 and surface.is_closed
    assert surface.notes == ("2 triangles that stand twice left out",)


def test_a_fin_without_a_thickness_goes():
    """A triangle and the same one turned over bound nothing."""
    fin = np.array([[[5.0, 5, 10], [6, 5, 10], [5, 5, 12]]])
    surface = whole_surface(np.concatenate([cube(), fin, fin[:, ::-1]]))
    assert len(surface.triangles) == 48 and surface.is_closed and len(surface.position) == 26


@pytest.mark.parametrize(("crack", "closed"), [(1e-8, True), (1e-5, True), (1e-3, True), (0.1, False)])
def test_cracks_of_the_size_of_rounding_are_closed(crack, closed):
    corners = cube()
    corners[:20] += crack * np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3, 3))
    surface = whole_surface(corners)
    assert surface.is_closed == closed
    assert (len(surface.position) == 26) == closed
    assert any("cracks of up to" in note for note in surface.notes) == (closed and crack > 1e-7)


def test_cavities_belong_to_the_solid_around_them():
    """A hollow cube, a cube within the hollow, and one beside it: three solids."""
    hollow = np.concatenate([cube(), cube(2, 8)[:, ::-1]])
    surface = whole_surface(np.concatenate([hollow, cube(4, 6), cube(20, 30)]))
    assert surface.is_closed
    solids = solids_of(surface)
    assert [volume(surface.only(solids == i)) for i in range(3)] == pytest.approx([1000 - 216, 8, 1000])
    check_surface(surface.only(solids == 0).position, surface.only(solids == 0).triangles, "hollow")


def test_one_solid_of_several_is_chosen_by_number_or_name(tmp_path):
    path = tmp_path / "two.stl"
    path.write_text(text(cube(), cube(20, 24), names=("Plate", "Pin A")))
    assert volume(stl_surface(path, 1)) == pytest.approx(1000)
    for chosen in (2, "Pin A", "pin a"):
        assert volume(stl_surface(path, chosen)) == pytest.approx(64)
    assert volume(stl_surface(path, whole=True)) == pytest.approx(1064)
    told = "it holds 2 solids: 1 of 10 x 10 x 10 around .5, 5, 5.; 2 of 4 x 4 x 4 around .22, 22, 22.; .* solid = 1"
    with pytest.raises(BadSurface, match=told):
        stl_surface(path)
    with pytest.raises(BadSurface, match="it has no solid 3; it holds 2"):
        stl_surface(path, 3)
    with pytest.raises(BadSurface, match="it has no solid 'pin'; it holds 'Plate', 'Pin A'"):
        stl_surface(path, "pin")


def test_corners_at_one_place_become_one_node():
    corners = cube()
    loose = corners + 1e-8 * np.sin(np.arange(corners.size)).reshape(corners.shape)
    surface = whole_surface(loose)
    assert len(surface.position) == 26
    check_surface(surface.position, surface.triangles, "cube")


def test_solids_that_touch_are_told_apart_from_one():
    """Two cubes with an edge in common: four triangles meet there, which bounds no solid."""
    with pytest.raises(BadMesh, match="does not bound a solid: 2 edges with more than two triangles"):
        surface = whole_surface(np.concatenate([cube(), cube() + [10, 10, 0]]))
        check_surface(surface.position, surface.triangles, "cubes")


def test_the_number_of_a_triangle_is_kept(tmp_path):
    (tmp_path / "cube.stl").write_text(text(cube()[:5], cube()[5:]))
    file = read_stl(tmp_path / "cube.stl")
    assert file.solid.tolist() == [0] * 5 + [1] * 43 and file.names == ("thing", "other")
