"""Unstructured plates: triangles between given curves, extruded through the thickness into tetrahedra.

Nodes lie at equal steps on the curves, so the rims are exact. A hexagonal lattice fills the inside and is smoothed:
each inner node moves to the mean of the centroids of its triangles, weighted by their areas, and then Delaunay's
criterion connects all nodes again. No mesh generator is needed. Lengths in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, KDTree

from ast_sim.element_topology import triangle_sides

SMOOTHING_ROUNDS = 25
# Inner nodes start at least this many spacings away from the curves.
CLEARANCE = 0.65


@dataclass(frozen=True)
class PlaneMesh:
    """Triangles between curves.

    Attributes:
        points: [P,2], ordered along x.
        triangles: [T,3], counter-clockwise.
        pieces: numbers of the nodes on each piece of the outline, both ends included.
    """

    points: np.ndarray
    triangles: np.ndarray
    pieces: list[np.ndarray]


def spacing_for(points: float, area: float, perimeter: float) -> float:
    """Length of the edges of a mesh with `points` nodes.

    By Euler's formula P = T/2 + B/2 + 1 - holes, with T equilateral triangles on the area and B edges on the curves.
    """
    a, b = area * 2 / np.sqrt(3), perimeter / 2  # P = a / h^2 + b / h
    return (b + np.sqrt(b * b + 4 * a * points)) / (2 * points)


def length(curve: np.ndarray) -> float:
    """Length of a polyline [K,2]."""
    return float(np.linalg.norm(np.diff(curve, axis=0), axis=1).sum())


def area(loop: np.ndarray) -> float:
    """Area enclosed by a polygon [K,2]; positive counter-clockwise."""
    x, y = loop.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


def resample(curve: np.ndarray, spacing: float, least: int = 1) -> np.ndarray:
    """Points [n,2] on a polyline at equal steps near `spacing`, at least `least` of them; the end is left out."""
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    n = max(least, round(arc[-1] / spacing))
    at = np.arange(n) * (arc[-1] / n)
    return np.stack([np.interp(at, arc, component) for component in curve.T], axis=1)


def inside(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Whether each point [P,2] lies inside closed curves: bool [P].

    A point is inside if an odd number of the edges, each from start to end [B,2], lie to its right.
    """
    x, y = points.T[:, :, None]
    x0, y0 = starts.T
    x1, y1 = ends.T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        right = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return (crosses & right).sum(axis=1) % 2 == 1


def triangulate(outline: list[np.ndarray], holes: list[np.ndarray], spacing: float) -> PlaneMesh | None:
    """Mesh the inside of an outline around its holes with triangles of about equal edges.

    Args:
        outline: polylines [K,2] that follow each other counter-clockwise and close. A node stands where two of them
            meet.
        holes: closed polylines [K,2].
        spacing: length of the edges. On a hole that would have fewer than ten edges, they are shorter.

    Returns:
        The mesh; None if curves come so close that a Delaunay triangulation lacks some of their edges.
    """
    loops = [[resample(piece, spacing) for piece in outline], *([resample(hole, spacing, 10)] for hole in holes)]
    rims = [np.concatenate(loop) for loop in loops]
    rim = np.concatenate(rims)
    first = np.cumsum([0, *map(len, rims)])[:-1]
    following = np.concatenate([start + np.roll(np.arange(len(r)), -1) for start, r in zip(first, rims, strict=True)])
    edges = np.stack([np.arange(len(rim)), following], axis=1)
    curves = [np.concatenate(outline), *holes]
    points = np.concatenate([rim, _lattice(rim, edges, np.concatenate(curves), spacing)])
    for _ in range(SMOOTHING_ROUNDS):
        points[len(rim) :] = _smoothed(points, _connect(points, rim, edges))[len(rim) :]
    triangles = _connect(points, rim, edges)
    if not _has_rim(triangles, edges) or len(np.unique(triangles)) < len(points):
        return None
    counts = np.cumsum([0, *map(len, loops[0])])
    pieces = [np.arange(a, b + 1) % len(rims[0]) for a, b in zip(counts, counts[1:], strict=False)]
    order = np.lexsort((points[:, 1], points[:, 0]))
    number = np.argsort(order)
    return PlaneMesh(points[order], number[triangles], [number[piece] for piece in pieces])


def _lattice(rim: np.ndarray, edges: np.ndarray, curves: np.ndarray, spacing: float) -> np.ndarray:
    """Nodes of a hexagonal lattice inside the edges and well away from the curves."""
    low, high = rim.min(axis=0), rim.max(axis=0)
    columns, rows = np.ceil((high - low) / (spacing, spacing * np.sqrt(3) / 2)).astype(int) + 1
    j, i = np.meshgrid(np.arange(rows), np.arange(columns))
    grid = np.stack([i + j % 2 / 2, j * np.sqrt(3) / 2], axis=2).reshape(-1, 2) * spacing
    grid += (low + high) / 2 - grid.mean(axis=0)
    distance, _ = KDTree(np.concatenate([rim, curves])).query(grid)
    return grid[(distance > CLEARANCE * spacing) & inside(grid, rim[edges[:, 0]], rim[edges[:, 1]])]


def _connect(points: np.ndarray, rim: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Delaunay triangles [T,3] inside the edges, counter-clockwise. Triangles of collinear points are left out."""
    triangles = Delaunay(points).simplices
    a, b, c = points[triangles].transpose(1, 2, 0)
    doubled = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    triangles[doubled < 0] = triangles[doubled < 0][:, ::-1]
    step = np.linalg.norm(rim[edges[:, 1]] - rim[edges[:, 0]], axis=1).min()
    kept = np.abs(doubled) > 1e-6 * step**2
    kept &= inside(points[triangles].mean(axis=1), rim[edges[:, 0]], rim[edges[:, 1]])
    return triangles[kept]


def _smoothed(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Mean of the centroids of the triangles around each point, weighted by their areas."""
    corners = points[triangles]
    side = corners[:, 1:] - corners[:, :1]
    weight = np.repeat(side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0], 3)
    total = np.bincount(triangles.ravel(), weight, len(points))
    mean = [
        np.bincount(triangles.ravel(), weight * np.repeat(centroid, 3), len(points))
        for centroid in corners.mean(axis=1).T
    ]
    return np.where(total[:, None] > 0, np.transpose(mean) / np.maximum(total, 1e-300)[:, None], points)


def _has_rim(triangles: np.ndarray, edges: np.ndarray) -> bool:
    """Whether the given edges are exactly the edges that belong to only one triangle."""
    outline, count = np.unique(triangle_sides(triangles), axis=0, return_counts=True)
    return np.array_equal(outline[count == 1], np.unique(np.sort(edges, axis=1), axis=0))


def smallest_angle(mesh: PlaneMesh) -> float:
    """Smallest angle of any triangle, in radian."""
    corners = mesh.points[mesh.triangles]
    to_next = np.roll(corners, -1, axis=1) - corners
    to_last = np.roll(corners, 1, axis=1) - corners
    cross = to_next[..., 0] * to_last[..., 1] - to_next[..., 1] * to_last[..., 0]
    return float(np.arctan2(cross, (to_next * to_last).sum(axis=2)).min())


def extrude(mesh: PlaneMesh, thickness: np.ndarray, layers: int) -> tuple[np.ndarray, np.ndarray]:
    """Plate around z = 0 over a plane mesh.

    A prism is cut into three tetrahedra. The diagonal of each side rises from the node with the smaller number, so both
    prisms at a side have the same diagonal.

    Args:
        mesh: mesh of the middle plane.
        thickness: thickness at each point [P].
        layers: number of layers of elements.

    Returns:
        Positions [(layers + 1) P, 3] and tetrahedra [E,4]. The positions over one point follow each other, bottom
        first.
    """
    height = (np.arange(layers + 1) / layers - 0.5) * thickness[:, None]
    flat = np.repeat(mesh.points[:, None], layers + 1, axis=1)
    position = np.concatenate([flat, height[..., None]], axis=2).reshape(-1, 3)
    a, b, c = (layers + 1) * np.sort(mesh.triangles, axis=1).T
    prism = [(a, b, c, c + 1), (a, b, b + 1, c + 1), (a, a + 1, b + 1, c + 1)]
    elements = np.concatenate([np.stack(corners, axis=1) + layer for layer in range(layers) for corners in prism])
    x = position[elements]
    inverted = np.linalg.det(x[:, 1:] - x[:, :1]) < 0
    elements[inverted] = elements[inverted][:, [1, 0, 2, 3]]
    return position, elements
