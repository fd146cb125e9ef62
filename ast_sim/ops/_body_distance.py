"""The distance of nodes from the surfaces of other bodies.

A positive gap is the distance to the nearest point of another body's surface. A negative gap is the depth inside it.

Legend: B scenes, N nodes, F surface triangles, P points.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ast_sim.ops.library import Kernel, Op, is_differentiated
from ast_sim.ops.spec import Given, Sizes
from ast_sim.support.nearest_surface import nearest_surface

FINE = 0.1  # the second channel of the gap saturates at this share of the radius
WIDTH = 5


def _check_finite(name: str, sizes: Sizes, given: Given) -> None:
    radius = given["radius"]
    ahead = given["position"].double() + given["motion"].double()
    if not 0 < radius < float("inf"):
        raise ValueError(f"{name}: radius must be positive and finite, not {radius}")
    bad = (~ahead.isfinite().all(1)).nonzero()
    if len(bad):
        where = ", ".join(f"{x:.9g}" for x in ahead[int(bad[0])].tolist())
        raise ValueError(f"{name}: node {int(bad[0])} moves to ({where}), which is not finite")


def _reference(
    position: Tensor,
    motion: Tensor,
    offsets: Tensor,
    body: Tensor,
    surface: Tensor,
    surface_offsets: Tensor,
    radius: float,
) -> Tensor:
    ahead = (position.double() + motion.double()).cpu().numpy()
    bodies, triangles = body.cpu().numpy(), surface.cpu().numpy()
    gap = np.full(len(ahead), radius)
    normal = np.zeros((len(ahead), 3))
    nodes, faces = offsets.tolist(), surface_offsets.tolist()
    for scene in range(len(nodes) - 1):
        mine = slice(nodes[scene], nodes[scene + 1])
        of_scene = triangles[faces[scene] : faces[scene + 1]]
        owner = bodies[of_scene[:, 0]]
        for other in np.unique(owner):
            of_others = nodes[scene] + np.flatnonzero(bodies[mine] != other)
            gaps, outward = signed_gap(ahead[of_others], ahead, of_scene[owner == other], radius)
            nearer = np.abs(gaps) < np.abs(gap[of_others])
            gap[of_others[nearer]] = gaps[nearer]
            normal[of_others[nearer]] = outward[nearer]
    weight = 1 - np.abs(gap) / radius
    fine = np.clip(gap / (FINE * radius), -1, 1)
    columns = np.concatenate([normal * weight[:, None], (gap / radius)[:, None], fine[:, None]], axis=1)
    return torch.from_numpy(columns).to(position)


_proximity = Op(
    Kernel(
        "proximity",
        "position[N,3], motion[N,3], offsets[B+1] offsets(N), body[N] int64, surface[F,3] index(N),"
        f" surface_offsets[B+1] offsets(F), radius number -> out[N,{WIDTH}]",
        _check_finite,
    ),
    _reference,
)


def proximity(
    position: Tensor,
    motion: Tensor,
    offsets: Tensor,
    body: Tensor,
    surface: Tensor,
    surface_offsets: Tensor,
    radius: float,
) -> Tensor:
    """[N, 5]: where the surface of the nearest other body will be.

    The columns are the outward normal at the nearest point of that surface, times 1 - |gap| / radius; gap / radius; and
    gap / (FINE radius), clipped to [-1, 1]. A node with no other body within `radius` has 0, 0, 0, 1, 1. Distances are
    computed in float64; triangles without an area do not count.

    Args:
        position, motion: [N, 3]; each node will be at the sum of the two.
        offsets, surface_offsets: [B + 1] int64, where each scene's nodes and triangles start and end.
        body: [N] int64, the body of each node.
        surface: [F, 3] int64, boundary triangles, counter-clockwise seen from outside; each belongs to the body of its
            first node.
        radius: in the unit of position.

    Raises:
        ValueError: a derivative or a transform of torch.func is wanted, a position is not finite, or the radius is
            not positive and finite.
    """
    if any(map(is_differentiated, (position, motion, offsets, body, surface, surface_offsets))):
        raise ValueError("proximity: it has no derivatives: detach the position, and call it outside of torch.func")
    return _proximity(position, motion, offsets, body, surface, surface_offsets, radius)


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
    gap[nearest.rows] = nearest.gap
    normal[nearest.rows] = nearest.normal
    return gap, normal
