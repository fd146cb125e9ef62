"""Faces and edges of elements, as local numbers of their nodes, by the number of nodes: 3, 4 or 10.

A second-order tetrahedron has ten nodes: four corners, then the middles of its edges in VTK's order.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ast_sim.support.read_only_arrays import kept

# What meshio calls an element, by the number of its nodes.
CELL_KINDS = {3: "triangle", 4: "tetra", 10: "tetra10"}

# An attribute of a simulation, and an entry of `DatasetInfo.generator`: elements of a higher order keep their corners.
CORNERS_ONLY = "corners_only"

# The faces of a tetrahedron with positive volume; their normals point outward.
LOCAL_FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))

_BLOCK = 4096  # elements whose corners stay in the second cache: larger arrays would be new memory in every call

# The corners between which the nodes 4, 5, ... of a second-order tetrahedron lie.
MIDDLES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


# Where the nodes of an element stand after its corners 2 and 3 have changed places.
_TURNED = (0, 1, 3, 2, 4, 8, 7, 6, 5, 9)

# A tetrahedron (triangle) is flat if its volume (area) is below this share of its longest edge to the power of 3 (2).
_FLAT = 1e-6


def _middle(a: int, b: int) -> int:
    """The local number of the node between two corners."""
    return 4 + MIDDLES.index((min(a, b), max(a, b)))


def _cut_face(a: int, b: int, c: int) -> tuple[tuple[int, int, int], ...]:
    """The four triangles of a face of a second-order tetrahedron: one at each corner, and the one between."""
    ab, bc, ca = _middle(a, b), _middle(b, c), _middle(c, a)
    return (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)


# The triangles of each face of a tetrahedron.
FACE_TRIANGLES = {4: tuple((face,) for face in LOCAL_FACES), 10: tuple(_cut_face(*face) for face in LOCAL_FACES)}

# The edges of an element. In a second-order tetrahedron they join the corners with the middles beside them, and the
# middles of each face.
LOCAL_EDGES = {
    3: ((0, 1), (0, 2), (1, 2)),
    4: ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)),
    10: tuple(
        sorted(
            {(corner, 4 + number) for number, edge in enumerate(MIDDLES) for corner in edge}
            | {pair for *_, (a, b, c) in FACE_TRIANGLES[10] for pair in combinations(sorted((a, b, c)), 2)}
        )
    ),
}

# A second-order tetrahedron as eight linear ones: one at each corner, and four around the diagonal of the octahedron
# between them, which joins the middles of the edges 01 and 23.
_AT_CORNERS = ((0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3))
_EIGHTH = (*_AT_CORNERS, (4, 9, 6, 7), (4, 9, 5, 6), (4, 9, 8, 5), (4, 9, 7, 8))


def slopes_at(weights: np.ndarray) -> np.ndarray:
    """[n, 10, 3] the derivatives of the shape functions by the coordinates of corners 1, 2 and 3."""
    by_corner = np.zeros((len(weights), 10, 4))
    by_corner[:, range(4), range(4)] = 4 * weights - 1
    for node, (a, b) in enumerate(MIDDLES, 4):
        by_corner[:, node, a] = 4 * weights[:, b]
        by_corner[:, node, b] = 4 * weights[:, a]
    return by_corner[:, :, 1:] - by_corner[:, :, :1]


# The points of a second-order tetrahedron at which forces are integrated, by Gauss's rule of degree 2: barycentric
# coordinates [point, corner]; each point has a quarter of the volume.
_FAR, _NEAR = (5 - 5**0.5) / 20, (5 + 3 * 5**0.5) / 20
POINTS = np.full((4, 4), _FAR) + (_NEAR - _FAR) * np.eye(4)
SLOPES = slopes_at(POINTS)  # [point, node, 3]


def linear_elements(elements: np.ndarray) -> np.ndarray:
    """The elements [E,3] or [E,4] as they are; second-order ones [E,10] cut into [8 E,4], element by element."""
    return elements[:, np.array(_EIGHTH)].reshape(-1, 4) if elements.shape[1] == 10 else elements


def distinct(numbers: np.ndarray) -> np.ndarray:
    """The whole numbers [n], ascending and each once: by a sort, which is faster than the hashes of `np.unique`."""
    ascending = np.sort(numbers)
    kept = np.ones(len(ascending), bool)
    kept[1:] = ascending[1:] != ascending[:-1]
    return ascending[kept]


def unique_edges(elements: np.ndarray, num_nodes: int) -> np.ndarray:
    """[M, 2] int32: each edge of the elements [E, k] once, its smaller node first, in ascending order."""
    pairs = np.array(LOCAL_EDGES[elements.shape[1]]).T
    one, other = (elements[:, ends].ravel().astype(np.int64) for ends in pairs)
    keys = distinct(np.minimum(one, other) * num_nodes + np.maximum(one, other))
    return kept(np.stack(np.divmod(keys, num_nodes), axis=1).astype(np.int32))


def shortest_edge(points: np.ndarray, elements: np.ndarray) -> float:
    """The length of the shortest edge between two corners; 0 without elements."""
    corners = points[elements[:, :4]].astype(np.float64)
    lengths = [np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in LOCAL_EDGES[corners.shape[1]]]
    return float(np.min(lengths)) if len(elements) else 0.0


def triangle_sides(triangles: np.ndarray) -> np.ndarray:
    """[3 F, 2]: the three edges of each triangle, one triangle after the other, with the smaller node first."""
    return np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each side of the triangles [F, 3] is one of two of them."""
    return bool((np.unique(triangle_sides(triangles), axis=0, return_counts=True)[1] == 2).all())


def vector_areas(corners: np.ndarray) -> np.ndarray:
    """[F, 3]: the normals of triangles with these corners [F, 3, 3], as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


def unit_normals(corners: np.ndarray) -> np.ndarray:
    """[F, 3] of length one, for triangles with these corners [F, 3, 3]; 0 for a triangle without an area."""
    return _of_length_one(vector_areas(corners))


def node_areas(position: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[N, 3]: a third of the vector areas of the faces [F, 3] around each node, at positions [N, 3]."""
    areas = np.zeros_like(position)
    np.add.at(areas, faces, vector_areas(position[faces])[:, None] / 3)
    return areas


def node_normals(position: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[N, 3]: the unit normals of a surface [F, 3] at its nodes; 0 at other ones."""
    return _of_length_one(node_areas(position, faces))


def _of_length_one(vectors: np.ndarray) -> np.ndarray:
    """Vectors [n, 3] divided by their lengths; 0 stays 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(vectors.dtype).tiny)


def equal_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of rows [n, k] that are equal, as pairs: each such row but the last with the next one like it."""
    order = np.lexsort(rows.T)
    same = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
    return order[:-1][same], order[1:][same]


def signed_volumes(points: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[E] float64: the volumes between the corners of tetrahedra [E, 4] or [E, 10], negative if they are inside out."""
    coordinates = np.ascontiguousarray(points.T, np.float64)
    volumes = np.empty(len(elements))
    for first in range(0, len(elements), _BLOCK):
        nodes = np.ascontiguousarray(elements[first : first + _BLOCK, :4].T)
        x, y, z = (np.take(axis, nodes) for axis in coordinates)
        ax, bx, cx = x[1:] - x[0]
        ay, by, cy = y[1:] - y[0]
        az, bz, cz = z[1:] - z[0]
        six = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        volumes[first : first + _BLOCK] = six / 6
    return volumes


def turned_over(elements: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """The tetrahedra [E, 4] or [E, 10], with the ones that `wrong` [E] bool names turned over; also middles alone of
    some, [E, 6]."""
    width = elements.shape[1]
    order = np.array(_TURNED[4:]) - 4 if width == 6 else np.array(_TURNED[:width])
    return np.where(wrong[:, None], elements[:, order], elements)


def folded_elements(elements: np.ndarray, negative: np.ndarray) -> np.ndarray:
    """The tetrahedra [E, 4] or [E, 10] that lie on others: at faces of more than two elements, and at faces whose two
    elements lie on the same side.

    Args:
        negative: [E] whether the volume between the corners is below 0.
    """
    faces = elements[:, np.array(LOCAL_FACES)].reshape(-1, 3).astype(np.int64)
    # A face runs one way round or the other, seen from its lowest node; two elements beside each other see it both
    # ways.
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    one_way = (turned[:, 1] < turned[:, 2]) ^ np.repeat(negative, 4)
    keys = np.sort(faces, axis=1)
    order = np.lexsort(keys.T)
    start = np.append(True, (keys[order[1:]] != keys[order[:-1]]).any(axis=1))
    group = np.cumsum(start) - 1
    count, sides = np.bincount(group), np.bincount(group, one_way[order])
    wrong = (count > 2) | ((count == 2) & (sides != 1))
    return np.unique(order[wrong[group]] // 4)


def flat_elements(points: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[E] bool: the tetrahedra without a volume between their corners, or the triangles without an area."""
    coordinates = np.ascontiguousarray(points.T, np.float64)
    corners = np.ascontiguousarray(elements[:, :4].T)
    power = len(corners) - 1
    if power == 3:
        size = np.abs(signed_volumes(points, elements))
    else:
        x, y, z = (np.take(axis, corners[1:]) - np.take(axis, corners[0]) for axis in coordinates)
        across = np.stack([a[0] * b[1] - a[1] * b[0] for a, b in ((x, y), (y, z), (z, x))])
        size = np.linalg.norm(across, axis=0) / 2
    flat = size <= _FLAT * np.linalg.norm(np.ptp(coordinates, axis=1)) ** power  # no edge is longer
    rows = np.flatnonzero(flat)
    ends = coordinates[:, corners[:, rows][np.array(LOCAL_EDGES[len(corners)]).T]]  # [3, 2, edges, rows]
    longest = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=0).max(axis=0)
    flat[rows] = size[rows] <= _FLAT * longest**power
    return flat


def point_volumes(points: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[1, E] the volumes of tetrahedra [E, 4], or [4, E] the shares of the points in second-order ones [E, 10], in
    float64; negative where an element is inside out."""
    if elements.shape[1] == 4:
        return signed_volumes(points, elements)[None]
    places = points.astype(np.float64)[elements]  # [E, 10, 3]
    return np.stack([np.linalg.det(np.einsum("eai,ak->eik", places, slopes)) / 24 for slopes in SLOPES])


def surface_triangles(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """[F, 3] int32: the triangles of the surface of the elements [E, k], as `Scene.surface` describes them."""
    if elements.shape[1] == 3:
        return elements
    return triangles_of_faces(elements, _outer_faces(elements, len(position)), signed_volumes(position, elements))


def _outer_faces(elements: np.ndarray, num_nodes: int) -> np.ndarray:
    """[F]: the numbers 4 e + face of the faces whose corners no other face has, ascending."""
    faces = elements.astype(np.int64)[:, np.array(LOCAL_FACES)].reshape(-1, 3)  # [4 E, 3], of corners
    one, two, three = np.ascontiguousarray(faces.T)
    low = np.minimum(np.minimum(one, two), three)
    high = np.maximum(np.maximum(one, two), three)
    upper = (one + two + three - low - high) * num_nodes + high
    # A face of two elements stands beside its like. Numbers of few bits have the fastest stable order.
    order = np.argsort(upper)
    order = order[np.argsort(low[order].astype(np.min_scalar_type(num_nodes)), kind="stable")]
    low, upper = low[order], upper[order]
    like_next = (low[1:] == low[:-1]) & (upper[1:] == upper[:-1])
    alone = np.ones(len(faces), bool)
    alone[order[1:][like_next]] = alone[order[:-1][like_next]] = False
    return np.flatnonzero(alone)


def triangles_of_faces(elements: np.ndarray, outer: np.ndarray, volumes: np.ndarray) -> np.ndarray:
    """[F, 3] int32: the triangles of faces by number, 4 e + face; seen from outside they run counter-clockwise. The
    signed volumes [E] tell which elements are inside out."""
    owner = elements[outer // 4]
    turned = volumes[outer // 4] < 0
    local = np.array(FACE_TRIANGLES[elements.shape[1]])[outer % 4]  # [F, 1 or 4, 3]
    triangles = owner[np.arange(len(owner))[:, None, None], local]
    return kept(np.where(turned[:, None, None], triangles[:, :, ::-1], triangles).reshape(-1, 3).astype(np.int32))
