"""The nodes on which the reaction of a scene acts: the prescribed nodes of one body that move farthest together.

A body may have several sets of prescribed nodes: one end is held, the other is moved or turned. The forces on all of
them add up to nearly nothing, so the reaction is the force on one set. It starts with the node that goes farthest, and
with all that edges of unchanged length between prescribed nodes join to it: so nodes on the axis of a turn belong to
it, which stand still. If the set moves like a rigid body, other such sets that follow the same motion belong to it,
such as a second face of the same clamp. In a clamp that changes its shape edges change their lengths; there, the nodes
count that edges between moving nodes join.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ast_sim.element_topology import LOCAL_EDGES
from ast_sim.scene import Scene
from ast_sim.support.notebook_table import one_line

RIGID = 1e-3  # nodes follow a motion if they are no farther off, as a share of the largest displacement
TURNED = 1e-4  # radian; below, a motion is a translation: positions in single precision know no better
FLAT = 1e-6  # points lie on a line if their second extent, as a share of the first, is below this


@dataclass(frozen=True, eq=False)
class Axis:
    """The axis around which nodes turn: a unit vector along it, and a point of it."""

    direction: np.ndarray
    point: np.ndarray

    def torque(self, position: np.ndarray, forces: np.ndarray) -> float:
        """The torque around the axis of forces [n,3] that act at positions [n,3], positive in the sense of the turn."""
        return float(self.direction @ np.cross(position - self.point, forces).sum(axis=0))


@dataclass(frozen=True, eq=False)
class Driven:
    """The driven nodes of a scene.

    Attributes:
        body: the number of their body.
        nodes: [N] bool.
        path: [S,n,3] float64, where the nodes are in each frame.
    """

    body: int
    nodes: np.ndarray
    path: np.ndarray

    def __repr__(self) -> str:
        travel = np.linalg.norm(self.path - self.path[:1], axis=2).max(initial=0.0)
        facts = {"body": self.body, "nodes": f"{int(self.nodes.sum()):,} of {len(self.nodes):,}"}
        return one_line("Driven", {**facts, "frames": len(self.path), "largest travel": f"{travel:.4g}"})

    @staticmethod
    def of(scene: Scene, prescribed_position: np.ndarray) -> Driven:
        """Of a scene with positions [S,N,3] of the prescribed nodes in each frame; other rows are not read."""
        given = prescribed_position[:, scene.prescribed]
        travel = np.zeros(scene.num_nodes, given.dtype)
        travel[scene.prescribed] = np.abs(given - given[0]).max(axis=(0, 2))
        farthest = int(np.argmax(travel))
        body = int(scene.body[farthest])
        own = scene.prescribed & (scene.body == body)
        moves = travel > RIGID * travel[farthest]
        if not scene.deforming_nodes[farthest] or not moves.any():
            nodes = own
        else:
            nodes = _moved_together(_edges_between(scene, own), own, moves, prescribed_position, farthest)
        return Driven(body, nodes, prescribed_position[:, nodes].astype(np.float64))

    @cached_property
    def axis(self) -> Axis | None:
        """Around which the nodes turn, at the frame in which they have turned farthest and at its place nearest to
        them, in the sense of their first turn. None if they do not turn, or not as a rigid body."""
        from scipy.spatial.transform import Rotation

        motions = RigidMotions.of(self.path)
        if not motions.fit.all():
            return None
        turns = Rotation.from_matrix(motions.rotation).as_rotvec()
        angles = np.linalg.norm(turns, axis=1)
        turned = np.flatnonzero(angles > TURNED)
        if not len(turned):
            return None
        largest = int(np.argmax(angles))
        direction = turns[largest] / angles[largest]
        sense = 1 if direction @ turns[turned[0]] > 0 else -1
        # A point p of the axis moves along it only: (I - R) p is the rest of the shift. `lstsq` takes the nearest p.
        rotation = motions.rotation[largest]
        near = self.path[0].mean(axis=0)
        shift = motions.shift[largest] + rotation @ near - near
        across = shift - direction * (direction @ shift)
        return Axis(sense * direction, near + np.linalg.lstsq(np.eye(3) - rotation, across, rcond=1e-8)[0])


@dataclass(frozen=True, eq=False)
class RigidMotions:
    """The rigid motions x R^T + shift that fit the motion of some points from frame 0 to each frame best (Kabsch 1976).

    Attributes:
        rotation, shift: R [S,3,3] and shift [S,3].
        fit: [S] bool, whether the points move like that. Points on a line that turn do not: any turn about the line
            would do.
    """

    rotation: np.ndarray
    shift: np.ndarray
    fit: np.ndarray

    @staticmethod
    def of(path: np.ndarray) -> RigidMotions:
        """Of points [S,n,3]."""
        center = path.mean(axis=1)
        offset = path - center[:, None]
        left, extents, right = np.linalg.svd(np.einsum("ni,snj->sij", offset[0], offset))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        shifted = np.abs(offset - offset[0]).max(axis=(1, 2)) <= TURNED * np.abs(offset[0]).max()
        rotation = np.where(shifted[:, None, None], np.eye(3), (left @ right).swapaxes(1, 2))
        shift = center - np.einsum("sij,j->si", rotation, center[0])
        off = np.einsum("sij,nj->sni", rotation, path[0]) + shift[:, None] - path
        allowed = RIGID * np.abs(path - path[0]).max(initial=0)
        solid = shifted | (extents[:, 1] > FLAT * extents[:, 0])
        return RigidMotions(rotation, shift, solid & (np.abs(off).max(axis=(1, 2)) <= allowed))


def _edges_between(scene: Scene, nodes: np.ndarray) -> np.ndarray:
    """[2,M] the edges of the elements both of whose ends are among the nodes [N] bool; some stand there twice."""
    elements = scene.elements[nodes[scene.elements].any(axis=1)].astype(np.int64)
    ends = elements[:, np.array(LOCAL_EDGES[elements.shape[1]])].reshape(-1, 2)
    return ends[nodes[ends].all(axis=1)].T


def _joined(edges: np.ndarray, nodes: np.ndarray, start: int) -> np.ndarray:
    """[N] bool: the nodes that edges between `nodes` [N] join to one of them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    inside = edges[:, nodes[edges].all(axis=0)]
    graph = coo_array((np.ones(inside.shape[1], np.int8), tuple(inside)), shape=(len(nodes), len(nodes)))
    part = connected_components(graph, directed=False)[1]
    return nodes & (part == part[start])


def _moved_together(
    edges: np.ndarray, own: np.ndarray, moves: np.ndarray, prescribed_position: np.ndarray, farthest: int
) -> np.ndarray:
    """[N] bool: the nodes of `own` that move with the farthest one."""
    most = RIGID * np.abs(prescribed_position[:, farthest] - prescribed_position[0, farthest]).max()
    length = np.linalg.norm(prescribed_position[:, edges[0]] - prescribed_position[:, edges[1]], axis=2)
    rigid = edges[:, np.abs(length - length[0]).max(axis=0) <= most]
    alike, nodes = _joined(rigid, own, farthest), _joined(edges, own & moves, farthest)
    if not alike[nodes].all():
        return nodes
    motions = RigidMotions.of(prescribed_position[:, alike].astype(np.float64))
    if not motions.fit.all():
        return alike
    off = (
        np.einsum("sij,nj->sni", motions.rotation, prescribed_position[0][own])
        + motions.shift[:, None]
        - prescribed_position[:, own]
    )
    follows = np.zeros_like(own)
    follows[own] = np.abs(off).max(axis=(0, 2)) <= most
    for start in np.flatnonzero(follows & moves & ~alike):
        piece = _joined(rigid, own, int(start))
        alike |= piece & follows[piece].all()
    return alike
