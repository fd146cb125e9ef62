"""The distance of nodes from the surfaces of other bodies.

A positive gap is the distance to the nearest point of another body's surface. A negative gap is the depth inside it.

Legend: N nodes, F surface triangles, P points.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ast_sim.ops.library import is_differentiated
from ast_sim.support.nearest_surface import nearest_surface

FINE = 0.1  # the second channel of the gap saturates at this share of the radius
WIDTH = 5


def proximity(
    position: Tensor, offsets: Tensor, body: Tensor, surface: Tensor, surface_offsets: Tensor, radius: float
) -> Tensor:
    """[N, 5] float32: where the surface of the nearest other body is.

    The columns are the outward normal at the nearest point of that surface, times 1 - |gap| / radius; gap / radius; and
    gap / (FINE radius), clipped to [-1, 1]. A node with no other body within `radius` has 0, 0, 0, 1, 1.

    Args:
        position: [N, 3] float64.
        offsets, surface_offsets: [B + 1] int64, where each scene's nodes and triangles start and end.
        body: [N] int64, the body of each node.
        surface: [F, 3] int64, boundary triangles, counter-clockwise seen from outside.
        radius: in the unit of position.

    Raises:
        ValueError: a derivative or a transform of torch.func is asked for.
    """
    if any(map(is_differentiated, (position, offsets, body, surface, surface_offsets))):
        raise ValueError("proximity: it has no derivatives: detach the position, and call it outside of torch.func")
    ahead, body, surface = position.numpy(), body.numpy(), surface.numpy()
    gap = np.full(len(ahead), radius)
    normal = np.zeros((len(ahead), 3))
    nodes, faces = offsets.tolist(), surface_offsets.tolist()
    for scene in range(len(nodes) - 1):
        mine = slice(nodes[scene], nodes[scene + 1])
        triangles = surface[faces[scene] : faces[scene + 1]]
        for other in np.unique(body[mine]):
            of_others = nodes[scene] + np.flatnonzero(body[mine] != other)
            of_body = triangles[body[triangles[:, 0]] == other]
            gaps, outward = signed_gap(ahead[of_others], ahead, of_body, radius)
            nearer = np.abs(gaps) < np.abs(gap[of_others])
            gap[of_others[nearer]], normal[of_others[nearer]] = gaps[nearer], outward[nearer]
    weight = 1 - np.abs(gap) / radius
    fine = np.clip(gap / (FINE * radius), -1, 1)
    columns = [normal * weight[:, None], (gap / radius)[:, None], fine[:, None]]
    return torch.from_numpy(np.concatenate(columns, axis=1).astype(np.float32))


def signed_gap(
    points: np.ndarray, position: np.ndarray, triangles: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances of points from a surface, and its outward unit normals at the nearest points.

    Args:
        points: [P, 3].
        position: [N, 3], the nodes of the surface.
        triangles: [F, 3], counter-clockwise seen from outside.
        radius: points farther away get the distance `radius` and the normal 0.

    Returns:
        [P] and [P, 3].
    """
    gap = np.full(len(points), radius)
    normal = np.zeros((len(points), 3))
    nearest = nearest_surface(points, position, triangles, radius, radius)
    gap[nearest.rows], normal[nearest.rows] = nearest.gap, nearest.normal
    return gap, normal
