"""How near the surface of another body is, one step ahead: what tells a model the moment of first contact.

Prescribed nodes are taken where they will be in the next frame, free ones where they are. A positive gap is the
distance to the nearest point of another body's surface, a negative one the depth inside it.

Legend: N nodes, F surface triangles, P points.
"""

from __future__ import annotations

import numpy as np
import torch
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
            found, outward = signed_gap(ahead[of_others], ahead, of_body, radius)
            nearer = np.abs(found) < np.abs(gap[of_others])
            gap[of_others[nearer]], normal[of_others[nearer]] = found[nearer], outward[nearer]
    weight = 1 - np.abs(gap) / radius
    fine = np.clip(gap / (FINE * radius), -1, 1)
    columns = [normal * weight[:, None], (gap / radius)[:, None], fine[:, None]]
    return torch.from_numpy(np.concatenate(columns, axis=1).astype(np.float32))


def signed_gap(
    points: np.ndarray, position: np.ndarray, triangles: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances [P] of points [P, 3] from the surface of triangles [F, 3] between nodes [N, 3], seen
    counter-clockwise from outside, and its outward unit normals [P, 3] at the nearest points; `radius` and 0 where it
    is farther away."""
    import igl  # 0.2 s, which only models with this input pay

    gap, normal = np.full(len(points), radius), np.zeros((len(points), 3))
    used, triangles = np.unique(triangles, return_inverse=True)
    distance, _, nearest, outward = igl.signed_distance(
        points, position[used], triangles.reshape(-1, 3), igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL, -radius, radius
    )
    near = np.abs(distance) < radius  # not where it is NaN: farther away
    gap[near] = distance[near]
    away = np.sign(distance[near])[:, None] * (points - nearest)[near]
    touching = np.abs(distance[near]) <= 1e-12 * radius
    normal[near] = _unit(np.where(touching[:, None], outward[near], away))
    return gap, normal


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)
