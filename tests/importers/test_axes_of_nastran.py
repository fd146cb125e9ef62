"""Points of decks of Nastran in coordinate systems: CORD2R, CORD2C, CORD2S, CORD1R, within each other, by GRDSET."""

import numpy as np
import pytest

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.support.errors import DatasetError

# A tetrahedron of volume 1/6, and a point of its own.
CORNERS = np.array([(1.0, 2, 3), (2, 2, 3), (1, 3, 3), (1, 2, 4)])
CELL = "CTETRA,1,1,1,2,3,4\n"


class Axes:
    """A coordinate system by the three points of its card, along the basic axes."""

    def __init__(self, letter, origin, on_z, in_xz):
        z = (on_z - origin) / np.linalg.norm(on_z - origin)
        x = (in_xz - origin) - ((in_xz - origin) @ z) * z
        x /= np.linalg.norm(x)
        self.letter, self.origin, self.matrix = letter, origin, np.array([x, np.cross(z, x), z])

    def inside(self, point):
        """The coordinates of a point in this system."""
        x, y, z = self.matrix @ (point - self.origin)
        if self.letter == "R":
            return x, y, z
        angle = np.degrees(np.arctan2(y, x))
        if self.letter == "C":
            return np.hypot(x, y), angle, z
        radius = np.sqrt(x * x + y * y + z * z)
        return radius, np.degrees(np.arccos(z / radius)), angle


def free(name, *fields):
    """A card between commas, eight fields a line."""
    lines = [fields[at : at + 8] for at in range(0, len(fields), 8)]
    return "\n".join(",".join([name if row == 0 else "", *map(str, line)]) for row, line in enumerate(lines)) + "\n"


def wide(name, *fields):
    """A card with fields of 16 characters, four a line."""
    texts = [f"{field:.9f}" if isinstance(field, float) else str(field) for field in fields]
    lines = [texts[at : at + 4] for at in range(0, len(texts), 4)]
    return "".join(
        f"{name + '*' if row == 0 else '*':8}{''.join(f'{x:>16}' for x in line)}\n" for row, line in enumerate(lines)
    )


def read(folder, *texts):
    (folder / "a.bdf").write_text("BEGIN BULK\n" + "".join(texts) + CELL + "ENDDATA\n")
    return read_mesh(folder / "a.bdf")


@pytest.mark.parametrize("written", [free, wide])
@pytest.mark.parametrize("letter", "RCS")
@pytest.mark.parametrize("outer", "RCS")
def test_points_in_systems_within_systems_are_where_they_are(tmp_path, letter, outer, written):
    random = np.random.default_rng(7)
    cards = [random.normal(size=(3, 3)) for _ in range(2)]
    one, two = (Axes(kind, *points) for kind, points in zip((outer, letter), cards, strict=True))
    three = Axes("R", *CORNERS[:3])
    text = written("CORD2" + letter, 2, 1, *(float(x) for point in cards[1] for x in one.inside(point)))
    text += written("CORD2" + outer, 1, "", *(float(x) for x in cards[0].ravel()))
    text += free("CORD1R", 9, 1, 2, 3, 3, 1, 2, 3)
    systems = [one, two, two, three]
    grids = [
        written("GRID", 1 + row, name, *map(float, system.inside(point)))
        for row, (point, system, name) in enumerate(zip(CORNERS, systems, (1, 2, 2, 3), strict=True))
    ]
    mesh = read(tmp_path, *grids, text)
    assert mesh.points == pytest.approx(CORNERS, abs=1e-6)
    default = [
        written("GRID", 1 + row, "" if row else 0, *map(float, point if row == 0 else two.inside(point)))
        for row, point in enumerate(CORNERS)
    ]
    assert read(tmp_path, text, *default, "GRDSET,,2\n").points == pytest.approx(CORNERS, abs=1e-6)


def test_numbers_as_nastran_writes_them(tmp_path):
    system = (
        "CORD2C         5       0      0.     0.0   +0.-3      0.      0.    1.D0+A\n+A         1.0+0      0.      0.\n"
    )
    grids = "GRID           1       5     2.0     90.     1.0\nGRID           2       52.000E+0     0.0   1.0-0\n"
    mesh = read(tmp_path, system, grids, "GRID,3,,0.,0.,0.\nGRID,4,0,,,1.\n")
    assert mesh.points == pytest.approx(np.array([(0, 2, 1), (2, 0, 1), (0, 0, 0), (0, 0, 1)]), abs=1e-12)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", r"line 2 stands in the coordinate system 5, which there is not, or of a kind that is not read"),
        ("CORD3G,5,,,1,2,3\n", "which there is not, or of a kind that is not read"),
        ("CORD2R,5,5,0.,0.,0.,0.,0.,1.,\n,1.,0.,0.\n", "stands in the coordinate system 5, which stands in itself"),
        ("CORD1R,5,1,2,3\n", "stands in the coordinate system 5, which stands in itself"),
        ("CORD1R,5,2,3,77\n", "has the GRID 77, which there is not"),
        ("CORD2R,5,0,0.,0.,0.,0.,0.,1.,\n,0.,0.,2.\n", "lie on a line"),
        ("CORD2R,5,0,0.,0.,0.,0.,0.,x,\n,0.,0.,2.\n", "'x' is no number"),
        ("CORD1R,5,2,3,4\nCORD1R,5,2,4,3\n", "there are two coordinate systems 5"),
    ],
)
def test_a_system_that_cannot_be_known_is_refused(tmp_path, text, told):
    with pytest.raises(DatasetError, match=told):
        read(tmp_path, "GRID,1,5,1.,0.,0.\nGRID,2,,0.,0.,0.\nGRID,3,,1.,0.,0.\nGRID,4,,0.,1.,0.\n", text)
    unused = read(
        tmp_path, "GRID,1,,1.,0.,1.\nGRID,2,,0.,0.,0.\nGRID,3,,1.,0.,0.\nGRID,4,,0.,1.,0.\n", "CORD3G,5,,,1,2,3\n"
    )
    assert unused.points[0].tolist() == [1, 0, 1]
