"""Solid parts as tetrahedral meshes, and structured parts, which need no mesh generator.

A structured part is a rectilinear grid with cells left out, or an extruded plane section: block, cylinder, plate with a
hole, finned plate. Legend: N nodes, E tetrahedra; lengths in units of about the size of a part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ast_sim.element_topology import LOCAL_FACES
from ast_sim.mechanics.elements.second_order import points_at_rest
from ast_sim.simulate.shapes.mesh import hexahedral_grid


@dataclass(frozen=True, eq=False)
class Part:
    """A solid body.

    Attributes:
        position: [N,3] float64.
        elements: [E,4] int64, tetrahedra of positive volume.
        name: what it is: a shape of the grammar, or the name of a file.
        notes: what a user should know of the file, a sentence each.
    """

    position: np.ndarray
    elements: np.ndarray
    name: str
    notes: tuple[str, ...] = ()


def volumes(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Signed volumes [E] between the corners of the tetrahedra [E,4] or [E,10] over positions [N,3]."""
    corners = position[elements[:, :4]]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def quarters(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Signed volumes [4,E] of the quarters around the points of integration of second-order tetrahedra [E,10]; the
    volumes [1,E] of the tetrahedra [E,4]."""
    return points_at_rest(position, elements)[0] if elements.shape[1] == 10 else volumes(position, elements)[None]


def oriented(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """The tetrahedra [E,4] or [E,10]; where the volume is negative, two corners are swapped, and so are the middles."""
    swapped = elements[:, [0, 2, 1, 3, 6, 5, 4, 7, 9, 8][: elements.shape[1]]]
    return np.where((volumes(position, elements) < 0)[:, None], swapped, elements)


def smallest_dihedral(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Smallest angle [E] between two faces of each tetrahedron, in degrees; 0 if a face has no area."""
    corners = position[elements]
    normals = []
    flat = np.zeros(len(elements), bool)
    for face in LOCAL_FACES:
        a, b, c = (corners[:, i] for i in face)
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        flat |= length[:, 0] == 0
        normals.append(normal / np.where(length == 0, 1, length))
    cosine = np.max([-np.einsum("ei,ei->e", m, n) for m, n in combinations(normals, 2)], axis=0)
    return np.where(flat, 0, np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def draw_structured(rng: np.random.Generator) -> Callable[[int], Part]:
    """Draw one of the structured shapes: a function that meshes it with about a given number of nodes.

    The largest extent of the part is 0.8 to 1.2.
    """
    name, draw_shape = list(_SHAPES.items())[rng.integers(len(_SHAPES))]
    build = draw_shape(rng)
    return lambda nodes: Part(*_of_size(build, nodes), name)


Build = Callable[[float], tuple[np.ndarray, np.ndarray]]  # size of the cells -> positions and elements of a part


def _of_size(build: Build, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The mesh whose number of nodes is nearest to the wanted one. Cells are whole, so the numbers come in steps."""
    spacing = nodes ** (-1 / 3)
    best = mesh = build(spacing)
    for _ in range(9):
        spacing *= (len(mesh[0]) / nodes) ** (1 / 3)
        mesh = build(spacing)
        if abs(len(mesh[0]) - nodes) < abs(len(best[0]) - nodes):
            best = mesh
    return best


def _block(rng: np.random.Generator) -> Build:
    size = rng.uniform([0.8, 0.5, 0.3], [1.2, 0.9, 0.7])

    def build(spacing: float) -> tuple[np.ndarray, np.ndarray]:
        return rectilinear([_split([0, length], spacing) for length in size])

    return build


def _cylinder(rng: np.random.Generator) -> Build:
    radius, height = rng.uniform([0.25, 0.5], [0.4, 1.1])

    def build(spacing: float) -> tuple[np.ndarray, np.ndarray]:
        return extruded(*_disc(radius, spacing), _split([0, height], spacing))

    return build


def _plate_with_hole(rng: np.random.Generator) -> Build:
    length, width, height = rng.uniform([0.8, 0.7, 0.2], [1.0, 0.9, 0.4])
    radius = rng.uniform(0.25, 0.33) * width

    def build(spacing: float) -> tuple[np.ndarray, np.ndarray]:
        return extruded(*_holed_rectangle(length, width, radius, spacing), _split([0, height], spacing))

    return build


def _finned_plate(rng: np.random.Generator) -> Build:
    fins = int(rng.integers(2, 5))
    thickness, gap, width, base, height = rng.uniform([0.12, 0.14, 0.5, 0.15, 0.2], [0.18, 0.2, 0.9, 0.25, 0.4])
    along = np.cumsum([0, *([thickness, gap] * fins)[:-1]])

    def build(spacing: float) -> tuple[np.ndarray, np.ndarray]:
        x, z = _split(along, spacing), _split([0, base, base + height], spacing)
        y = _split([0, width], spacing)
        in_fin = np.searchsorted(along, (x[1:] + x[:-1]) / 2) % 2 == 1
        keep = in_fin[:, None, None] | (z[1:] <= base + 1e-9)[None, None, :]
        return rectilinear([x, y, z], np.broadcast_to(keep, (len(x) - 1, len(y) - 1, len(z) - 1)))

    return build


_SHAPES = {
    "structured block": _block,
    "structured cylinder": _cylinder,
    "structured plate with hole": _plate_with_hole,
    "structured finned plate": _finned_plate,
}


def _split(ends: list[float] | np.ndarray, spacing: float) -> np.ndarray:
    """Grid lines at `ends` and between them, each interval cut evenly into cells of about `spacing`."""
    lines = [np.asarray(ends[:1], float)]
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        lines.append(np.linspace(start, end, max(1, round((end - start) / spacing)) + 1)[1:])
    return np.concatenate(lines)


def rectilinear(lines: list[np.ndarray], keep: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mesh of the cells between grid lines along x, y, z that `keep` selects: positions [N,3], tetrahedra [E,4]."""
    coordinates, elements = hexahedral_grid([len(line) - 1 for line in lines], keep)
    position = np.column_stack([line[index] for line, index in zip(lines, coordinates.T, strict=True)])
    return position, oriented(position, elements)


def extruded(points: np.ndarray, triangles: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plane triangulation, points [n,2] and triangles [m,3], extruded through `heights`.

    Each prism has a triangle a < b < c below and A B C above. It is cut into abcC, abBC and aABC. The diagonal of a
    side goes up from the side's smaller node, so that neighbours agree.

    Returns:
        Positions [N,3] and tetrahedra [E,4].
    """
    n = len(points)
    position = np.column_stack([np.tile(points, (len(heights), 1)), np.repeat(heights, n)])
    a, b, c = np.sort(triangles, axis=1).T
    prism = np.stack([[a, b, c, c + n], [a, b, b + n, c + n], [a, a + n, b + n, c + n]]).transpose(2, 0, 1)
    layers = n * np.arange(len(heights) - 1)
    elements = (layers[:, None, None, None] + prism).reshape(-1, 4)
    return position, oriented(position, elements)


def _disc(radius: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A square grid mapped onto a disc, x |x|_max / |x|_2. All diagonals point away from the centre.

    At the corners of the square the angle opens to 180 degrees. A diagonal across it would leave a flat triangle.
    """
    half = max(1, round(radius / spacing))
    line = np.arange(-half, half + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2) / half
    length = np.linalg.norm(grid, axis=1)
    length[length == 0] = 1
    points = radius * grid * (np.abs(grid).max(axis=1) / length)[:, None]
    i, j = np.meshgrid(np.arange(2 * half), np.arange(2 * half), indexing="ij")
    return points, _cut_quads(i, j, 2 * half + 1, rising=(i < half) == (j < half))


def _holed_rectangle(length: float, width: float, radius: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Rings from a round hole in the middle to the sides of a rectangle."""
    x, y = _split([-length / 2, length / 2], spacing), _split([-width / 2, width / 2], spacing)
    outer = np.concatenate(
        [
            np.column_stack([x[:-1], np.full(len(x) - 1, y[0])]),
            np.column_stack([np.full(len(y) - 1, x[-1]), y[:-1]]),
            np.column_stack([x[:0:-1], np.full(len(x) - 1, y[-1])]),
            np.column_stack([np.full(len(y) - 1, x[0]), y[:0:-1]]),
        ]
    )
    around = len(outer)
    # A quarter of the hole belongs to each side, evenly divided.
    sides = enumerate((x, y, x, y))
    angle = np.concatenate([np.pi / 2 * (i - 1.5 + np.arange(len(line) - 1) / (len(line) - 1)) for i, line in sides])
    inner = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    rings = max(1, round((min(length, width) / 2 - radius) / spacing)) + 1
    share = np.linspace(0, 1, rings)[:, None, None]
    points = ((1 - share) * inner + share * outer).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, c = points[i * around + j], points[(i + 1) * around + (j + 1) % around]
    b, d = points[(i + 1) * around + j], points[i * around + (j + 1) % around]
    shorter = np.linalg.norm(a - c, axis=2) <= np.linalg.norm(b - d, axis=2)
    return points, _cut_quads(i, j, around, rising=shorter, closed=True)


def _cut_quads(i: np.ndarray, j: np.ndarray, columns: int, rising: np.ndarray, closed: bool = False) -> np.ndarray:
    """Triangles [m,3] of the cells at rows i and columns j of a grid of nodes. A rising diagonal starts at (i, j)."""
    i = i.ravel()
    j = j.ravel()
    rising = rising.ravel()[:, None, None]
    following = (j + 1) % columns if closed else j + 1
    a, b = i * columns + j, (i + 1) * columns + j
    d, c = i * columns + following, (i + 1) * columns + following
    up = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)
    down = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    return np.where(rising, up, down).reshape(-1, 3)
