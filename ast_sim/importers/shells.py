"""Shells of triangles or quadrilaterals beside tetrahedra: the usual mesh of a rigid tool.

A scene has elements of one kind, so a shell becomes a thin layer of tetrahedra: each of its nodes gets a second node
behind it, half a mesh width along the normal, on the side that looks away from the tetrahedra. The shell itself is the
front of the layer, so contact takes place where it took place in the file. Where the shell closes a thin wall, the
layer is a third of the wall; where tetrahedra lie behind an open shell, all of it takes 1/200 of the way to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ast_sim.element_topology import LOCAL_FACES, is_closed, unit_normals
from ast_sim.number_arrays import connected_parts

# The thickness of the layer, in mean edge lengths.
_THICKNESS = 0.5

# The share of a wall, and of the distance to tetrahedra behind a shell, that the layer takes where it would take more
# than half of the wall or reach the tetrahedra.
_OF_WALL, _OF_ROOM = 1 / 3, 1 / 200

# Where the normal of a node leads out through another triangle at it, the layer has this share of the usual thickness.
_LEAST = 0.01

# Nodes are behind a shell if the way to them leads backwards by at least this share of it.
_BEHIND = 0.5

# The front of an open shell is the side that looks at the tetrahedra, in this share of the triangles, the nearest ones.
_NEAREST = 0.1

# The edges of a rigid shell keep their lengths up to this share of the mean edge length.
_RIGID = 0.05

# The triangles that a cell is split into, by the number of its corners.
_TRIANGLES = {3: ((0, 1, 2),), 4: ((0, 1, 2), (0, 2, 3))}


@dataclass(frozen=True, eq=False)
class Shells:
    """The shells of a mesh of n points.

    Attributes:
        triangles: [S, 3] int64, oriented alike within a shell: the normals point to the front.
        nodes: [k] int64, the nodes of the shells in ascending order; the node behind `nodes[i]` has the number n + i.
        thickness: [k] float64, how far behind.
        cells: [S] int64, the cell that each triangle is made of, counted over all cells of the shells.
    """

    triangles: np.ndarray
    nodes: np.ndarray
    thickness: np.ndarray
    cells: np.ndarray

    def behind(self, points: np.ndarray) -> np.ndarray:
        """[k, 3]: the points behind the nodes of the shells, for points [n, 3] of any frame."""
        return points[self.nodes] - self.thickness[:, None] * _normals(points, self.triangles)[self.nodes]

    def tetrahedra(self, points: np.ndarray) -> np.ndarray:
        """[3 S, 4] int64: three for each triangle, of positive volume, for all points [n + k, 3]. Neighbours fit,
        because each side of a wedge is cut from its lower node in front to its higher node behind."""
        a, b, c = np.sort(self.triangles, axis=1).T
        back = np.zeros(len(points), np.int64)
        back[self.nodes] = np.arange(len(points) - len(self.nodes), len(points))
        wedge = [(a, b, c, back[c]), (a, b, back[b], back[c]), (a, back[a], back[b], back[c])]
        elements = np.stack([np.stack(corners, axis=1) for corners in wedge], axis=1).reshape(-1, 4)
        negative = np.linalg.det(points[elements[:, 1:]] - points[elements[:, :1]]) < 0
        elements[negative] = elements[negative][:, [0, 1, 3, 2]]
        return elements

    def bent(self, rest: np.ndarray, position: np.ndarray) -> tuple[int, float] | None:
        """The first node of a shell that is not rigid in `position` [n, 3], and the change of an edge there."""
        pairs = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]], self.triangles[:, [2, 0]]])
        at_rest, now = (np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1) for at in (rest, position))
        change = np.abs(now - at_rest)
        row = int(np.argmax(change))
        return (int(pairs[row, 0]), float(change[row])) if change[row] > _RIGID * at_rest.mean() else None

    def renumbered(self, used: np.ndarray) -> Shells:
        """The same shells in a mesh that keeps the points `used` only, in ascending order."""
        return replace(self, triangles=np.searchsorted(used, self.triangles), nodes=np.searchsorted(used, self.nodes))


def find_shells(points: np.ndarray, tetrahedra: np.ndarray, cells: list[np.ndarray]) -> Shells | None:
    """The shells among the `cells`, blocks of [c, 3] or [c, 4] corners: all cells that touch no tetrahedron, not even
    through other cells. None if there are none."""
    import igl  # takes 0.2 s
    from scipy.spatial import KDTree

    number = np.cumsum([0, *(len(block) for block in cells)])
    split = [
        (block[:, corners], start + np.arange(len(block)))
        for block, start in zip(cells, number, strict=False)
        for corners in _TRIANGLES[block.shape[1]]
    ]
    triangles, cell = (np.concatenate(one) for one in zip(*split, strict=True))
    part = connected_parts(triangles, len(points))
    free = ~np.isin(part[triangles[:, 0]], part[tetrahedra])
    if not free.any():
        return None
    order = np.flatnonzero(free)[np.argsort(cell[free], kind="stable")]
    oriented, _ = igl.bfs_orient(triangles[order])
    part_of = part[triangles[order, 0]]
    cell = cell[order]
    triangles = np.asarray(oriented, np.int64)
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    centre = (a + b + c) / 3
    normal = np.cross(b - a, c - a)
    distance, nearest = KDTree(points[np.unique(tetrahedra)]).query(centre)
    to_body = points[np.unique(tetrahedra)[nearest]] - centre
    thickness = np.zeros(len(points))
    for one in np.unique(part_of):
        rows = np.flatnonzero(part_of == one)
        near = rows[distance[rows] <= np.quantile(distance[rows], _NEAREST)]
        looks = _looks_out(points, triangles[rows], tetrahedra) or (normal[near] * to_body[near]).sum()
        if looks < 0:
            triangles[rows] = triangles[rows][:, ::-1]
        thickness[triangles[rows]] = _THICKNESS * np.linalg.norm(b[rows] - a[rows], axis=1).mean()
    nodes = np.unique(triangles)
    return Shells(triangles, nodes, _fitting(points, triangles, tetrahedra, thickness[nodes], nodes), cell)


def _looks_out(points: np.ndarray, triangles: np.ndarray, tetrahedra: np.ndarray) -> int:
    """1 if the normals of a closed shell point to the side where all tetrahedra are, -1 if they point away; 0 if
    tetrahedra are on both sides, or the shell is open."""
    import igl

    if not is_closed(triangles):
        return 0
    _, first = np.unique(connected_parts(tetrahedra, len(points))[tetrahedra[:, 0]], return_index=True)
    used, corners = np.unique(triangles, return_inverse=True)
    one_of_each = np.ascontiguousarray(points[tetrahedra[first, 0]])
    faces = np.ascontiguousarray(corners.reshape(-1, 3), np.int64)
    inside = np.abs(igl.winding_number(np.ascontiguousarray(points[used]), faces, one_of_each)) > 0.5
    a, b, c = np.moveaxis(points[triangles] - points[triangles[0, 0]], 1, 0)
    outwards = 1 if np.einsum("ij,ij->", a, np.cross(b, c)) > 0 else -1
    if inside.any() != inside.all():
        return 0
    return -outwards if inside.all() else outwards


def _fitting(
    points: np.ndarray, triangles: np.ndarray, tetrahedra: np.ndarray, thickness: np.ndarray, nodes: np.ndarray
) -> np.ndarray:
    """[k]: the thickness behind the `nodes` [k]; less where the shells' own walls or tetrahedra are near behind."""
    inwards = -_normals(points, triangles)[nodes]
    thickness = np.where(_sticks_out(points, triangles, inwards, nodes), _LEAST * thickness, thickness)
    start = points[nodes] + 1e-3 * thickness[:, None] * inwards  # behind the triangles that meet at the node
    wall = _distance_along(points, triangles, start, inwards)
    faces = tetrahedra[:, np.array(LOCAL_FACES)].reshape(-1, 3)
    room = _distance_along(points, faces, start, inwards)
    fitting = np.where(2 * thickness > wall, _OF_WALL * wall, thickness)
    part = connected_parts(triangles, len(points))
    for one in np.unique(part[nodes]):
        own = part[nodes] == one
        rows = triangles[part[triangles[:, 0]] == one]
        if not is_closed(rows):  # a node beside the tetrahedra meets none, but the layer between two nodes may
            room[own] = min(room[own].min(), _room_behind(points, rows, tetrahedra))
    return np.where(room < wall, np.minimum(fitting, _OF_ROOM * room), fitting)


def _room_behind(points: np.ndarray, triangles: np.ndarray, tetrahedra: np.ndarray) -> float:
    """The distance from the triangles to the nearest node of tetrahedra that is behind them; inf if there is none."""
    import igl

    used, corners = np.unique(triangles, return_inverse=True)
    faces = np.ascontiguousarray(corners.reshape(-1, 3), np.int64)
    others = np.ascontiguousarray(points[np.unique(tetrahedra)])
    squared, nearest, at = igl.point_mesh_squared_distance(others, np.ascontiguousarray(points[used]), faces)
    distance = np.sqrt(squared)
    height = np.einsum("ni,ni->n", others - at, unit_normals(points[triangles])[np.asarray(nearest)])
    return float(distance[height < -_BEHIND * distance].min(initial=np.inf))


def _sticks_out(points: np.ndarray, triangles: np.ndarray, inwards: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """[k] bool: the nodes whose direction inwards leads out of the shell through a triangle at the node."""
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    corner = np.searchsorted(nodes, triangles)
    outwards = np.einsum("tki,ti->tk", inwards[corner], np.cross(b - a, c - a)) > 0
    return np.bincount(corner[outwards], minlength=len(nodes)) > 0


def _distance_along(points: np.ndarray, triangles: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """[n]: the distance from each start [n, 3] along its unit direction to the first triangle; inf if it meets none.

    A ray may pass between two triangles that share an edge, so three go each way, nearly parallel.
    """
    import igl

    used, corners = np.unique(triangles, return_inverse=True)
    vertices, faces = np.ascontiguousarray(points[used]), np.ascontiguousarray(corners.reshape(-1, 3), np.int64)
    tree = igl.AABB()
    tree.init(vertices, faces)
    nearest = np.full(len(start), np.inf)
    for aside in ((0.0, 0.0, 0.0), (1e-3, 2e-3, -3e-3), (-2e-3, 1e-3, 1e-3)):
        hit, distance, _ = tree.intersect_ray_first(vertices, faces, start, direction + aside)
        nearest = np.minimum(nearest, np.where(np.asarray(hit) >= 0, distance, np.inf))
    return nearest


def _normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """[n, 3]: unit normals at the points, each the mean over the triangles at the point, weighted with their angles.
    Weighted with their areas, a long triangle could turn it away from the others."""
    normals = np.zeros_like(points)
    for corner in range(3):
        a, b, c = (points[triangles[:, (corner + i) % 3]] for i in range(3))
        normal = np.cross(b - a, c - a)
        twice_area = np.linalg.norm(normal, axis=1)
        angle = np.arctan2(twice_area, np.einsum("ti,ti->t", b - a, c - a))
        np.add.at(
            normals, triangles[:, corner], (angle / np.maximum(twice_area, np.finfo(float).tiny))[:, None] * normal
        )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
