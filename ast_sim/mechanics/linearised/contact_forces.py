"""The forces of contact, from positions alone.

At equilibrium the elastic forces f on the free nodes are the forces of contact. Each near pair has a normal force p,
at least 0, along the derivative n of its distance and, with Coulomb's coefficient c, a tangential one of at most c p.
On positions that are nearly right the forces are taken that leave least of f. Coulomb's cone is spanned by the rays
n + c t, where t is any unit tangent. A few rays of each pair stand for all: n at first; then, `TURNS` times, the ones
that carry a force, and of each pair the one along what is left of f.

A pair that hardly moves free nodes could carry any force. So of all forces that leave no more of f than that, about the
smallest are taken: the sum of their squares counts, times the square of the share of f that is left (Tikhonov).

Where nothing overlaps, the pairs are the ones of the solver's barriers, which ipctk finds. A distance knows no sides:
of bodies that overlap, and where ipctk is not installed, the pairs of Newton steps are taken (`near_pairs`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_array, vstack

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings, load_ipctk
from ast_sim.mechanics.linearised.near_pairs import NearSurfaces, tangents_of
from ast_sim.scene import Scene
from ast_sim.support.errors import MissingExtra, SimulationError

TURNS = 3  # more of them change forces by less than friction is known to
TINY = 1e-300  # instead of zero in a denominator


@dataclass(frozen=True, eq=False)
class TouchingPairs:
    """Pairs within the range of contact.

    Attributes:
        normal: [P, 3 N], where each pair pushes the nodes: the derivative of its distance by the positions.
        first, second: [P, 3 N] each, the derivatives of its slip along two tangents.
    """

    normal: csr_array
    first: csr_array
    second: csr_array

    @property
    def count(self) -> int:
        """P, the number of pairs."""
        return len(self.normal.indptr) - 1

    def rays(self, along: np.ndarray) -> csr_array:
        """[P, 3 N]: of each pair the ray of Coulomb's cone along tangents [P, 2], as long as the coefficient."""
        return csr_array(self.normal + self.first.multiply(along[:, :1]) + self.second.multiply(along[:, 1:]))


class ContactForces:
    """The forces of contact of a scene; made once, because its surfaces do not change. What finds pairs is made where
    it is first needed: most scenes have no contact near held nodes.

    Args:
        contact_range: the distance below which surfaces push each other, in the unit of length.
        friction: Coulomb's coefficient.

    Attributes:
        free: [F] the degrees of freedom of the free nodes of deforming bodies.
    """

    def __init__(self, scene: Scene, contact_range: float, friction: float) -> None:
        self._scene = scene
        self._range = contact_range
        self._friction = friction
        of_soft = np.isin(np.arange(scene.num_nodes), scene.elements[~scene.rigid_elements])
        self.free = np.flatnonzero(np.repeat(of_soft & ~scene.prescribed, 3))

    @cached_property
    def barrier_pairs(self) -> _BarrierPairs | None:
        """The pairs of nodes and faces, and of edges; None: ipctk is not installed."""
        try:
            return _BarrierPairs(self._scene, self._range)
        except MissingExtra:
            return None

    @cached_property
    def _near(self) -> NearSurfaces:
        return NearSurfaces(self._scene, np.arange(3 * self._scene.num_nodes))

    def pairs(self, position: np.ndarray) -> TouchingPairs:
        """The pairs within the range of contact at positions [N, 3]."""
        if self.barrier_pairs and not self.barrier_pairs.overlap(position):
            return self.barrier_pairs.at(position)
        near = self._near.pairs(position)
        touching = np.flatnonzero(near.gap <= self._range)
        return TouchingPairs(*(near.directions[touching + axis * len(near.gap)] for axis in range(3)))

    def forces(self, pairs: TouchingPairs, elastic: np.ndarray) -> csr_array:
        """[P, 3 N]: the force of each pair on the nodes. Together they explain the `elastic` forces [N, 3] on the free
        nodes best.

        Raises:
            SimulationError: they were not found.
        """
        of_pair = all_pairs = np.arange(pairs.count)
        rays = pairs.normal
        sizes, left = self._explained(rays, elastic)
        for _ in range(TURNS if self._friction else 0):
            slip = np.stack([pairs.first @ left, pairs.second @ left], axis=1)
            slip *= self._friction / np.maximum(np.linalg.norm(slip, axis=1, keepdims=True), TINY)
            carry = np.flatnonzero(sizes)
            of_pair = np.concatenate([of_pair[carry], all_pairs])
            rays = csr_array(vstack([rays[carry], pairs.rays(slip)]))
            sizes, left = self._explained(rays, elastic)
        whole = np.linalg.norm(elastic.ravel()[self.free])
        sizes, _ = self._explained(rays, elastic, float(np.linalg.norm(left) / max(whole, TINY)))
        share = csr_array((sizes, (of_pair, np.arange(len(of_pair)))), shape=(pairs.count, len(of_pair)))
        return csr_array(share @ rays)

    def _explained(self, rays: csr_array, elastic: np.ndarray, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """How large the forces along rays [M, 3 N] are, [M], and what is left [3 N] of the elastic forces [N, 3] on the
        free nodes; 0 at others. Beside what is left, the forces themselves count, times `damping`."""
        left = np.zeros(elastic.size)
        left[self.free] = elastic.ravel()[self.free]
        touched = np.intersect1d(rays.indices, self.free)
        count = len(rays.indptr) - 1
        if not len(touched):
            return np.zeros(count), left
        columns = rays[:, touched].toarray().T
        damped = np.concatenate([columns, damping * np.eye(count)]) if damping else columns
        try:
            sizes, _ = nnls(damped, np.pad(left[touched], (0, len(damped) - len(touched))), maxiter=30 * count)
        except RuntimeError as error:
            raise SimulationError(f"the forces of contact were not found: {error}") from error
        left[touched] -= columns @ sizes
        return sizes, left


def free_of_themselves(scene: Scene, contact_range: float) -> tuple[int, ...]:
    """The bodies that can touch themselves: they deform, and no wall or slit of them is thinner at rest than the range
    of contact, where its barriers would act. ipctk must be installed."""
    deforming = np.unique(scene.body[scene.deforming_nodes]).tolist()
    return tuple(body for body in deforming if not presses_itself_at_rest(scene, body, contact_range))


def presses_itself_at_rest(scene: Scene, body: int, contact_range: float) -> bool:
    """Whether a wall, a slit or an element of a body is thinner at rest than the range of contact. ipctk must be
    installed."""
    rest = scene.rest_position.astype(np.float64)
    surface = scene.surface()
    of_body = surface[scene.body[surface[:, 0]] == body]
    contact = Contact(rest, of_body, scene.body, ContactSettings(contact_range, 1.0, self_contact=True))
    contact.collision_free_fraction(rest, rest)
    return not contact.at(rest).is_empty


class _BarrierPairs:
    """The pairs on which the solver's barriers act: nodes and faces, and edges."""

    def __init__(self, scene: Scene, contact_range: float) -> None:
        rest = scene.rest_position.astype(np.float64)
        surface = scene.surface()
        settings = ContactSettings(contact_range, 1.0, self_contact=free_of_themselves(scene, contact_range))
        self._contact = Contact(rest, surface, scene.body, settings, ~scene.deforming_nodes)
        local = np.unique(surface, return_inverse=True)[1].reshape(-1, 3).astype(np.int32)
        self._edges_and_faces = load_ipctk().edges(local), local

    def overlap(self, position: np.ndarray) -> bool:
        """Whether bodies overlap at positions [N, 3]."""
        return self._contact.intersects(position)

    def at(self, position: np.ndarray) -> TouchingPairs:
        """The pairs at positions [N, 3]. The barrier takes some off again, so that none counts twice: these pull."""
        contact = self._contact
        contact.restart()
        contact.collision_free_fraction(position, position)
        state = contact.at(position)
        # No name keeps a pair: ipctk's pairs must not outlive their collection.
        near = [self._of_pair(state.collisions[row], state.vertices) for row in range(len(state.collisions))]
        shape = len(near), 3 * contact.num_nodes
        if not near:
            return TouchingPairs(*(csr_array(shape) for _ in range(3)))
        nodes, pushes, shares, normals = zip(*near, strict=True)
        row = np.repeat(np.arange(len(near)), [len(one) for one in nodes])
        places = np.repeat(row, 3), (3 * np.concatenate(nodes)[:, None] + np.arange(3)).ravel()
        slips = [np.concatenate(shares)[:, None] * tangent[row] for tangent in tangents_of(np.array(normals))]
        return TouchingPairs(*(csr_array((one.ravel(), places), shape) for one in (np.concatenate(pushes), *slips)))

    def _of_pair(self, pair: Any, vertices: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of a pair of ipctk the nodes [n]; where it pushes them [n, 3] (the barrier of two edges depends on how
        parallel they are, too); the share [n] of each in the distance; the unit normal [3]. Shares of one side add up
        to 1, of the other to -1."""
        nodes = self._contact.nodes[[vertex for vertex in pair.vertex_ids(*self._edges_and_faces) if vertex >= 0]]
        place = pair.dof(vertices, *self._edges_and_faces)
        push = -np.array(self._contact.barrier.gradient(pair, place)).reshape(-1, 3)
        push *= 2 / np.maximum(np.linalg.norm(push, axis=1).sum(), TINY)
        gradient = np.array(pair.compute_distance_gradient(place)).reshape(-1, 3)
        lengths = np.linalg.norm(gradient, axis=1)
        normal = gradient[lengths.argmax()] / lengths.max()
        shares = gradient @ normal
        return nodes, push, shares * 2 / np.abs(shares).sum(), normal
