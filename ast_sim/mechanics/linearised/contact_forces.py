"""The forces of contact, from positions alone.

At equilibrium the elastic forces f on the free nodes are the forces of contact, C^T l with l >= 0, where a row of C is
the direction of the force of a near pair. On positions that are nearly right the l >= 0 are taken that leave least,
min |f - C^T l|. With friction a pair of a node and a face has four directions, the corners of a pyramid inside
Coulomb's cone. Where nothing overlaps, pairs of edges push, too; ipctk finds them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from scipy.optimize import nnls

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings, load_ipctk
from ast_sim.mechanics.linearised.near_pairs import NearSurfaces
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError


class ContactForces:
    """The forces of contact of a scene; made once, because its surfaces do not change.

    Args:
        contact_range: the distance below which surfaces push each other, in the unit of length.
        friction: Coulomb's coefficient.
        edges: whether pairs of edges push, too. Without them residuals are larger, and ipctk is not needed.

    Attributes:
        free: [F] the degrees of freedom of the free nodes of deforming bodies.

    Raises:
        MissingExtra: ipctk is not installed, and is needed.
    """

    def __init__(self, scene: Scene, contact_range: float, friction: float, edges: bool = False) -> None:
        self._range, self._friction = contact_range, friction
        self._near = NearSurfaces(scene, np.arange(3 * scene.num_nodes))
        self._edges = _NearEdges(scene, contact_range) if edges else None
        of_soft = np.isin(np.arange(scene.num_nodes), scene.elements[~scene.rigid_elements])
        self.free = np.flatnonzero(np.repeat(of_soft & ~scene.prescribed, 3))

    def directions(self, position: np.ndarray) -> scipy.sparse.csr_array:
        """[P, 3 N] C: the directions in which pairs within the range of contact may push the nodes at positions
        [N, 3]."""
        pairs = self._near.pairs(position)
        touching = np.flatnonzero(pairs.gap <= self._range)
        normal = pairs.directions[touching]
        count = len(pairs.gap)
        parts = [normal]
        if self._friction:
            tangents = [self._friction * pairs.directions[touching + axis * count] for axis in (1, 2)]
            parts = [normal + sign * tangent for tangent in tangents for sign in (1, -1)]
        if self._edges and not (pairs.gap < 0).any():  # a distance knows no sides: it says nothing of overlaps
            parts.append(self._edges.directions(position))
        return scipy.sparse.csr_array(scipy.sparse.vstack(parts))

    def sizes(self, directions: scipy.sparse.csr_array, forces: np.ndarray) -> np.ndarray:
        """[P] l: how hard the pairs push, so that they explain the elastic forces [N, 3] on the free nodes best.

        Args:
            directions: [P, 3 N].

        Raises:
            SimulationError: they were not found.
        """
        on_free = directions[:, self.free]
        touched = np.unique(on_free.nonzero()[1])
        count = len(directions.indptr) - 1
        if not len(touched):
            return np.zeros(count)
        try:
            columns = on_free[:, touched].toarray().T
            return nnls(columns, forces.ravel()[self.free][touched], maxiter=30 * count)[0]
        except RuntimeError as error:
            raise SimulationError(f"the forces of contact were not found: {error}") from error


class _NearEdges:
    """The pairs that ipctk finds within the range of contact: of edges, and once more of nodes and faces."""

    def __init__(self, scene: Scene, contact_range: float) -> None:
        rest = scene.rest_position.astype(np.float64)
        surface = scene.surface()
        settings = ContactSettings(contact_range, 1.0)
        self._contact = Contact(rest, surface, scene.body, settings, ~scene.deforming_nodes)
        local = np.unique(surface, return_inverse=True)[1].reshape(-1, 3).astype(np.int32)
        self._edges_and_faces = load_ipctk().edges(local), local

    def directions(self, position: np.ndarray) -> scipy.sparse.csr_array:
        """[P, 3 N]: of each pair of nodes, edges or faces within the range of contact the derivative of its distance by
        the positions, with a length of 1."""
        contact = self._contact
        contact.restart()
        contact.collision_free_fraction(position, position)
        state = contact.at(position)
        rows = [np.zeros(0, int)]
        columns = [np.zeros(0, int)]
        values = [np.zeros(0)]
        for row in range(len(state.collisions)):
            # No name keeps the pair: ipctk's pairs must not outlive their collection.
            nodes, gradient = self._of_pair(state.collisions[row], state.vertices)
            columns.append((3 * nodes[:, None] + np.arange(3)).ravel())
            rows.append(np.full(gradient.size, row))
            values.append(gradient / np.linalg.norm(gradient))
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return scipy.sparse.csr_array(entries, shape=(len(state.collisions), 3 * contact.num_nodes))

    def _of_pair(self, pair: Any, vertices: Any) -> tuple[np.ndarray, np.ndarray]:
        """The nodes [n] of a pair of ipctk, and the derivative [3 n] of its squared distance by their positions."""
        nodes = self._contact.nodes[[vertex for vertex in pair.vertex_ids(*self._edges_and_faces) if vertex >= 0]]
        return nodes, np.array(pair.compute_distance_gradient(pair.dof(vertices, *self._edges_and_faces)))
