"""How near the surface of another body is, one step ahead: what tells a model the moment of first contact.

Prescribed nodes are taken where they will be in the next frame, free ones where they are. A positive gap is the
distance to the nearest point of another body's surface, a negative one the depth inside it.

Legend: N nodes, F surface triangles, P pairs of a node and a triangle.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ast_sim.data.batch import Batch

FINE = 0.1  # the second channel of the gap saturates at this share of the radius
WIDTH = 5


def proximity(batch: Batch, radius: float) -> Tensor:
    """[N, 5] float32: the outward normal at the nearest point of another body within `radius`,
    times 1 - |gap| / radius; gap / radius; gap / (FINE radius), at most 1 in magnitude.
    Nodes with no other body so near have 0, 0, 0, 1, 1."""
    ahead = (batch.position.double() + batch.boundary_motion.double()).numpy()
    gap, normal = np.full(len(ahead), radius), np.zeros((len(ahead), 3))
    graph = batch.graph
    nodes, faces = graph.node_offsets.tolist(), graph.surface_offsets.tolist()
    body, surface = graph.body.numpy(), graph.surface.numpy()
    for scene in range(graph.num_scenes):
        mine, triangles = slice(nodes[scene], nodes[scene + 1]), surface[faces[scene] : faces[scene + 1]]
        for other in np.unique(body[mine]):
            of_others = nodes[scene] + np.flatnonzero(body[mine] != other)
            of_body = triangles[body[triangles[:, 0]] == other]
            if not len(of_others) or not len(of_body):
                continue
            found, outward = signed_gap(ahead[of_others], ahead[of_body], radius)
            nearer = np.abs(found) < np.abs(gap[of_others])
            gap[of_others[nearer]], normal[of_others[nearer]] = found[nearer], outward[nearer]
    weight = 1 - np.abs(gap) / radius
    fine = np.clip(gap / (FINE * radius), -1, 1)
    columns = [normal * weight[:, None], (gap / radius)[:, None], fine[:, None]]
    return torch.from_numpy(np.concatenate(columns, axis=1).astype(np.float32))


def signed_gap(points: np.ndarray, corners: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances [N] of points [N, 3] from a closed surface with the triangles [F, 3, 3], counter-clockwise seen
    from outside, and the outward unit normals [N, 3] at the nearest points; `radius` and 0 where it is farther away."""
    gap, normal = np.full(len(points), radius), np.zeros((len(points), 3))
    point, triangle = _candidates(points, corners, radius)
    if not len(point):
        return gap, normal
    offset = points[point] - nearest_on_triangles(points[point], corners[triangle])
    distance = np.linalg.norm(offset, axis=1)
    least = np.full(len(points), np.inf)
    np.minimum.at(least, point, distance)
    tied = distance <= least[point] * (1 + 1e-9) + 1e-300
    # On an edge or at a corner several triangles are nearest: the sum of their normals tells outside from inside.
    outward = np.zeros_like(points)
    a, b, c = corners[triangle[tied]].transpose(1, 0, 2)
    np.add.at(outward, point[tied], _unit(np.cross(b - a, c - a)))
    away = np.zeros_like(points)
    away[point[tied]] = offset[tied]
    sign = np.where(np.einsum("ij,ij->i", away, outward) < 0, -1.0, 1.0)
    near = least < radius
    gap[near] = (sign * least)[near]
    direction = np.where(least[:, None] > 1e-12 * radius, sign[:, None] * away, outward)
    normal[near] = _unit(direction[near])
    return gap, normal


def _candidates(points: np.ndarray, corners: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (point [P], triangle [P]) among which is the nearest triangle of each point that has one within `radius`.

    No triangle is nearer than its centroid less the largest distance of a corner from its centroid.
    """
    centroids = corners.mean(axis=1)
    reach = float(np.linalg.norm(corners - centroids[:, None], axis=2).max())
    tree = KDTree(centroids)
    first, index = tree.query(points, distance_upper_bound=radius + reach)
    close = np.flatnonzero(np.isfinite(first))
    bound = np.linalg.norm(points[close] - nearest_on_triangles(points[close], corners[index[close]]), axis=1)
    lists = tree.query_ball_point(points[close], np.minimum(bound, radius) * (1 + 1e-9) + reach)
    counts = [len(found) for found in lists]
    return np.repeat(close, counts), np.fromiter((t for found in lists for t in found), np.int64, sum(counts))


def nearest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """[P, 3]: the nearest point of the triangle [P, 3, 3] to the point [P, 3] (Ericson, Real-Time Collision Detection,
    section 5.1.5): the projection onto the plane if it lies inside, else the nearest of the three edges' nearest."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    on_edges = np.stack([_nearest_on_segments(points, *ends) for ends in ((a, b), (b, c), (c, a))])
    nearest = np.take_along_axis(
        on_edges, np.argmin(np.linalg.norm(on_edges - points, axis=2), axis=0)[None, :, None], axis=0
    )[0]
    normal = np.cross(b - a, c - a)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", points - a, normal) / np.where(square > 0, square, 1)
    projected = points - height[:, None] * normal
    inside = square > 0
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("ij,ij->i", np.cross(end - start, projected - start), normal) >= 0
    return np.where(inside[:, None], projected, nearest)


def _nearest_on_segments(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = end - start
    square = np.einsum("ij,ij->i", way, way)
    share = np.einsum("ij,ij->i", points - start, way) / np.where(square > 0, square, 1)
    return start + np.clip(share, 0, 1)[:, None] * way


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
