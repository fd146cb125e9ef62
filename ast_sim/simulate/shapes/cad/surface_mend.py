"""Surfaces of triangles made whole: corners that lie at one place, triangles of no area, cracks; and their pieces.

Legend: N nodes, F triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ast_sim.element_topology import equal_rows, triangle_sides
from ast_sim.importers.formats.stl_file import BadSurface, StlFile, read_stl
from ast_sim.number_arrays import connected_parts
from ast_sim.support.errors import counted

SAME_PLACE = 1e-7  # distance of corners that are one, relative to the diagonal
CRACKS = (1e-6, 1e-5, 1e-4)  # the same where a surface is open otherwise
MOST_TOLD = 30  # solids that a message describes
NO_HEIGHT = 1e-6  # height of a triangle that has no area, relative to its longest side


@dataclass(frozen=True, eq=False)
class TriangleSurface:
    """A surface.

    Attributes:
        position: [N,3] float64.
        triangles: [F,3], which share their nodes.
        notes: what was mended, a sentence each.
    """

    position: np.ndarray
    triangles: np.ndarray
    notes: tuple[str, ...] = ()

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.ptp(self.position, axis=0)))

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """The edges [n,2], and how many triangles meet at each."""
        return np.unique(triangle_sides(self.triangles), axis=0, return_counts=True)

    @property
    def is_closed(self) -> bool:
        """Whether two triangles meet at every edge."""
        return bool((self.edges()[1] == 2).all())

    def only(self, rows: np.ndarray) -> TriangleSurface:
        """Some of its triangles, with their nodes."""
        used, triangles = np.unique(self.triangles[rows], return_inverse=True)
        return TriangleSurface(self.position[used], triangles.reshape(-1, 3), self.notes)


def stl_surface(path: Path, solid: str | int | None = None, whole: bool = False) -> TriangleSurface:
    """The surface of one solid of an STL file, mended.

    Args:
        solid: the name of the solid, or its number from 1; None: there must be one only.
        whole: take all that the file holds if `solid` is None.

    Raises:
        BadSurface: the file cannot be read, holds no such solid, or holds several and none is chosen.
    """
    file = read_stl(path)
    if isinstance(solid, str):
        return whole_surface(file.corners[_named(file, solid)])
    surface = whole_surface(file.corners)
    if not len(surface.triangles):
        raise BadSurface("all its triangles are without an area")
    if solid is None and whole:
        return surface
    number = solids_of(surface) if surface.is_closed else pieces_of(surface)
    count = int(number.max()) + 1
    if solid is None and count > 1 and surface.is_closed:
        boxes = [surface.only(number == one).position for one in range(count)]
        raise BadSurface(several_solids([("", box.min(axis=0), box.max(axis=0)) for box in boxes]))
    if solid is None:
        return surface
    if not 1 <= solid <= count:
        raise BadSurface(f"it has no solid {solid}; it holds {count}")
    return surface.only(number == solid - 1)


def _named(file: StlFile, name: str) -> np.ndarray:
    """[F] bool: the triangles of the solids with this name; case does not matter."""
    chosen = [i for i, one in enumerate(file.names) if one.lower() == name.lower()]
    if not chosen:
        raise BadSurface(f"it has no solid {name!r}; it holds {', '.join(map(repr, file.names))}")
    return np.isin(file.solid, chosen)


def several_solids(solids: list[tuple[str, np.ndarray, np.ndarray]]) -> str:
    """What a file with several solids is told: their names, where they are and how one is chosen."""
    shown = []
    for number, (name, low, high) in enumerate(solids[:MOST_TOLD], 1):
        middle = "(" + ", ".join(f"{x:.4g}" for x in (low + high) / 2) + ")"
        size = " x ".join(f"{x:.4g}" for x in high - low)
        shown.append(f"{number}{f' {name!r}' if name else ''} of {size} around {middle}")
    more = f", and {len(solids) - MOST_TOLD} more" if len(solids) > MOST_TOLD else ""
    named = next((f" or {name!r}" for name, _, _ in solids if name), "")
    return f"it holds {len(solids)} solids: {'; '.join(shown)}{more}; say which one the part is: solid = 1{named}"


def whole_surface(corners: np.ndarray) -> TriangleSurface:
    """The surface of triangles with these corners [F,3,3], mended."""
    surface = _joined(corners, SAME_PLACE)
    for tolerance in () if surface.is_closed else CRACKS:
        wider = _joined(corners, tolerance)
        if wider.is_closed:
            crack = f"cracks of up to {tolerance * surface.diagonal:.2g} in its surface are closed"
            return TriangleSurface(wider.position, wider.triangles, (*wider.notes, crack))
    return surface


def _joined(corners: np.ndarray, tolerance: float) -> TriangleSurface:
    """Corners closer than `tolerance` diagonals become one; triangles without an area go."""
    points, triangles = _exactly_joined(corners)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = KDTree(points).query_pairs(tolerance * diagonal, output_type="ndarray")
    place = connected_parts(pairs, len(points))
    position = points[np.unique(place, return_index=True)[1]]
    triangles = place[triangles]
    points_alone = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    whole, needles = _without_needles(position, triangles[~points_alone])
    kept = _without_folds(whole)
    gone, folds = int(points_alone.sum()) + needles, len(whole) - len(kept)
    notes = [f"{counted(gone, 'triangle')} of no area left out"] if gone else []
    notes += [f"{counted(folds, 'triangle that stands twice', 'triangles that stand twice')} left out"] if folds else []
    return TriangleSurface(position, kept, tuple(notes)).only(np.arange(len(kept)))


def _exactly_joined(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different corners [N,3], in the order of the file, and the triangles [F,3] over them."""
    points = np.ascontiguousarray(corners.reshape(-1, 3) + 0.0)  # -0 is 0
    _, first, label = np.unique(points.view([("", points.dtype)] * 3), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    return points[first[order]], rank[label.ravel()].reshape(-1, 3)


def _without_needles(position: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, int]:
    """The triangles without needles, whose corners lie on a line, and the number of needles.

    The needle a, b, c with b between a and c would leave a gap: its neighbour a, c, d has a side that its other
    neighbours cut at b. So the neighbour is cut there, too, into a, b, d and b, c, d.
    """
    gone = 0
    while True:
        sides = position[np.roll(triangles, -1, axis=1)] - position[np.roll(triangles, 1, axis=1)]
        lengths = np.linalg.norm(sides, axis=2)  # of the side opposite to each corner
        height = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / lengths.max(axis=1)
        needles = np.flatnonzero(height <= NO_HEIGHT * lengths.max(axis=1))
        if not len(needles):
            return triangles, gone
        row = int(needles[0])
        middle = int(lengths[row].argmax())
        a, b, c = np.roll(triangles[row], 1 - middle)
        beside = np.flatnonzero((triangles == a).any(axis=1) & (triangles == c).any(axis=1))
        beside = beside[beside != row]
        pieces = [triangles[other].copy() for other in beside for _ in range(2)]
        for number, piece in enumerate(pieces):
            piece[piece == (c, a)[number % 2]] = b
        pieces = [piece for piece in pieces if len(set(piece.tolist())) == 3]
        kept = np.delete(triangles, [row, *beside], axis=0)
        triangles = np.concatenate([kept, *(piece[None] for piece in pieces)])
        gone = gone + 1


def _without_folds(triangles: np.ndarray) -> np.ndarray:
    """Each triangle at most once: of two alike one stays, of two that look apart none."""
    same, which = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)
    if len(same) == len(triangles):
        return triangles
    which = which.ravel()
    start = triangles.argmin(axis=1)
    turned = np.take_along_axis(triangles, (start[:, None] + [1, 2]) % 3, axis=1)
    sense = np.where(turned[:, 0] < turned[:, 1], 1, -1)
    balance = np.bincount(which, sense)
    first = np.unique(which, return_index=True)[1]
    return triangles[np.sort(first[balance != 0])]


def pieces_of(surface: TriangleSurface) -> np.ndarray:
    """[F]: the piece that each triangle belongs to, from 0, in the order of their first triangles. Triangles that share
    an edge belong to one piece."""
    neighbours = np.stack(equal_rows(triangle_sides(surface.triangles)), axis=1) // 3
    return connected_parts(neighbours, len(surface.triangles))


def solids_of(surface: TriangleSurface) -> np.ndarray:
    """[F]: the solid that each triangle of a closed surface bounds, from 0: an outer piece and the cavities in it."""
    piece = pieces_of(surface)
    count = int(piece.max()) + 1
    parts = [surface.triangles[piece == one] for one in range(count)]
    inside = np.zeros((count, count), bool)  # piece i inside piece j
    for i in range(count):
        for j in range(count):
            inside[i, j] = i != j and _contains(surface.position, parts[j], surface.position[parts[i][0, 0]])
    depth = inside.sum(axis=1)
    solid = np.full(count, -1)
    outer = np.flatnonzero(depth % 2 == 0)
    solid[outer] = np.arange(len(outer))
    for cavity in np.flatnonzero(depth % 2 == 1):
        around = [j for j in np.flatnonzero(inside[cavity]) if depth[j] == depth[cavity] - 1]
        solid[cavity] = solid[around[0]]
    return solid[piece]


def _contains(position: np.ndarray, triangles: np.ndarray, point: np.ndarray) -> bool:
    """Whether a closed surface winds around a point: its solid angle there, over 4 pi (van Oosterom and Strackee)."""
    corners = position[triangles]
    if (point < corners.min(axis=(0, 1))).any() or (point > corners.max(axis=(0, 1))).any():
        return False
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(one, axis=1) for one in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
    angle = 2 * np.arctan2(above, la * lb * lc + ab * lc + bc * la + ca * lb)
    return abs(angle.sum()) > 2 * np.pi
