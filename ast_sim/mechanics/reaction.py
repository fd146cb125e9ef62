"""The force that moves a body, from positions alone: of the solver, or predicted by a model.

At equilibrium, the derivative f_i of the elastic energy by the position of a node is zero at free nodes that nothing
touches; at a held node it is the force that holds the node, at a touched node the contact force on it. So the force on
the moved nodes is the sum of w_i f_i for every field w that is 1 where these act on the deforming bodies, and 0 at all
other nodes that are held or touched. Where a body touches itself, its two sides push each other: w is the same on both.
On predicted positions, f_i is not zero elsewhere. A smooth w then averages the stress over all of the body, where the
forces at the moved nodes alone would show the errors of one layer of elements.

What contact brings straight into held nodes strains nothing. Where a face is touched that has held and free corners, it
follows from the free ones (`contact_forces`). Where all that touch each other are held, positions do not show it.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from ast_sim.element_topology import linear_elements, node_normals
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.mechanics.linearised.contact_forces import ContactForces
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError

OPPOSITE = 0.5  # cosine between opposite normals, at most; at an edge, a normal is the mean of its faces
EXPLAINED = 0.4  # held nodes get their share where contact leaves less than this of the elastic forces on free nodes
SMOOTH = 1e-3  # residual to which the smooth field is computed; every field is exact at equilibrium


class Reaction:
    """The force on the moved nodes of a scene of tetrahedra.

    Made once for a scene, because the shape functions do not change.

    Args:
        driven: the moved nodes.
        law: of all elements; rigid ones ignore it.
        contact: between the bodies. None: it is not known, and what goes straight into held nodes is left out.

    Attributes:
        unseen: whether in some positions contact went straight into held nodes and no free node shows how hard. These
            forces are missing.
        rough: whether in some positions another body is near held nodes, and not all pairs that touch are known,
            because ipctk is not installed.
    """

    def __init__(self, scene: Scene, driven: Driven, law: NeoHookean, contact: ContactForces | None = None) -> None:
        import igl  # takes 0.2 s

        self.scene = scene
        self.driven = driven
        self._contact = contact
        self.unseen = self.rough = False
        self._rest = scene.rest_position.astype(np.float64)
        soft = np.flatnonzero(~scene.rigid_elements)
        self._elasticity = deforming_body(scene, soft, law)
        linear = linear_elements(self._elasticity.elements)
        self._laplacian = -igl.cotmatrix(self._rest, linear).tocsr()
        surface = scene.surface()
        owner = scene.body[surface[:, 0]]  # a node of no element may be a body without a surface
        self._surfaces = {int(n): surface[owner == n] for n in np.unique(owner)}
        self._reach = _longest_edge(self._rest, surface)
        self._deforming = np.zeros(scene.num_nodes, bool)
        self._deforming[scene.elements[soft]] = True

    def of(self, position: np.ndarray) -> np.ndarray:
        """The force [3] that moves the moved nodes, in pascal times the square of the unit of length.

        Args:
            position: [N,3].
        """
        return self.shares(position).sum(axis=0)

    def torque(self, position: np.ndarray) -> float:
        """The torque of that force around the axis of the moved nodes, in pascal times the cube of the unit of length,
        positive in the sense of their turn; 0 if they do not turn."""
        axis = self.driven.axis
        return 0.0 if axis is None else axis.torque(position, self.shares(position))

    def shares(self, position: np.ndarray) -> np.ndarray:
        """[N,3] w_i f_i, the share of each node in that force, and what contact brings straight into held nodes."""
        position = position.astype(np.float64)
        nearest = self._nearest_body(position)
        source, sink = self._ends(nearest)
        forces, _ = self._elasticity.gradient(self._elasticity.evaluate(position))
        shares = np.zeros_like(position)
        if source.any():
            shares = self._field(source, sink, self._folds(position))[:, None] * forces
        if self._contact is None or not (nearest[self.scene.prescribed & self._deforming] >= 0).any():
            return shares
        return shares + self._straight(self._contact, position, forces)

    def _straight(self, contact: ContactForces, position: np.ndarray, forces: np.ndarray) -> np.ndarray:
        """[N,3] the forces of contact between the driven body and held nodes, where elastic `forces` [N,3] show them; 0
        elsewhere, and on positions that are no equilibrium."""
        self.rough |= contact.barrier_pairs is None
        pairs = contact.pairs(position)
        of_body = self.scene.body == self.driven.body
        pushes_others = self.driven.body in self.scene.rigid_bodies
        held = self.scene.prescribed & self._deforming & ~of_body if pushes_others else self.driven.nodes
        straight = _of(pairs.normal, held) & _of(pairs.normal, of_body)
        self.unseen |= bool((straight & (abs(pairs.normal[:, contact.free]).sum(axis=1) == 0)).any())
        none = np.zeros_like(forces)
        if not straight.any():
            return none
        try:
            pushes = contact.forces(pairs, forces)
        except SimulationError:
            self.unseen = True
            return none
        elastic = forces.ravel()[contact.free]
        left = elastic - pushes.sum(axis=0)[contact.free]
        if np.linalg.norm(left) > EXPLAINED * np.linalg.norm(elastic):
            return none
        pushed = pushes[straight].sum(axis=0).reshape(-1, 3)
        return np.where(held[:, None], pushed if pushes_others else -pushed, none)

    def _ends(self, nearest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[N] bool twice: the deforming nodes on which the moved nodes act, and all others that are held or touched."""
        scene = self.scene
        driven = self.driven
        held = scene.prescribed & self._deforming
        touched = (nearest == driven.body) & ~held
        source = touched if driven.body in scene.rigid_bodies else held & driven.nodes
        return source, (held | (nearest >= 0)) & ~source

    def _nearest_body(self, position: np.ndarray) -> np.ndarray:
        """[N] the number of the nearest other body within reach of a deforming surface node; -1 for all other nodes."""
        import igl

        nearest_body = np.full(len(position), -1)
        nearest = self._reach**2
        farthest = self._reach.max()
        for body, faces in self._surfaces.items():
            used, local = np.unique(faces, return_inverse=True)
            local = local.reshape(-1, 3)
            low, high = position[used].min(axis=0) - farthest, position[used].max(axis=0) + farthest
            for other, theirs in self._surfaces.items():
                nodes = np.unique(theirs)
                nodes = nodes[self._deforming[nodes] & ((position[nodes] > low) & (position[nodes] < high)).all(axis=1)]
                if other == body or not len(nodes):
                    continue
                square = np.asarray(igl.point_mesh_squared_distance(position[nodes], position[used], local)[0])
                closer = square < nearest[nodes]
                nearest_body[nodes[closer]] = body
                nearest[nodes[closer]] = square[closer]
        return nearest_body

    def _folds(self, position: np.ndarray) -> np.ndarray:
        """[2, P] pairs of nodes of a deforming body whose surfaces look at each other across a gap within reach, and
        have come nearer: there the body may touch itself."""
        from scipy.spatial import KDTree

        outward = node_normals(position, np.concatenate(list(self._surfaces.values())))
        pairs = [np.zeros((0, 2), int)]
        for faces in self._surfaces.values():
            nodes = np.unique(faces)
            nodes = nodes[self._deforming[nodes]]
            if len(nodes):
                pairs.append(
                    nodes[KDTree(position[nodes]).query_pairs(self._reach[nodes].mean(), output_type="ndarray")]
                )
        first, second = np.concatenate(pairs).T
        between, before = position[second] - position[first], self._rest[second] - self._rest[first]
        facing = np.einsum("pi,pi->p", outward[first] - outward[second], between) > 0
        opposite = np.einsum("pi,pi->p", outward[first], outward[second]) < OPPOSITE
        nearer = np.linalg.norm(between, axis=1) < np.linalg.norm(before, axis=1)
        return np.stack([first, second])[:, facing & opposite & nearer]

    def _field(self, source: np.ndarray, sink: np.ndarray, folds: np.ndarray) -> np.ndarray:
        """[N] w: about harmonic between 1 at the sources and 0 at the sinks, and the same on both sides of folds."""
        count = len(source)
        free = self._deforming & ~source & ~sink
        inside = folds[:, free[folds].all(axis=0)]
        links = coo_array((np.ones(len(inside[0])), inside), shape=(count, count))
        groups, group = connected_components(links, directed=False)
        # A fold that a source or a sink touches is part of it, unless both do.
        both = np.concatenate([folds, folds[::-1]], axis=1)
        by_source, by_sink = (
            np.bincount(group[both[0, ends[both[1]]]], minlength=groups) > 0 for ends in (source, sink)
        )
        field = (source | (free & (by_source & ~by_sink)[group])).astype(float)
        inner = np.flatnonzero(free & (by_source == by_sink)[group])
        if len(inner):
            place = np.unique(group[inner], return_inverse=True)[1]
            spread = coo_array((np.ones(len(inner)), (np.arange(len(inner)), place))).tocsr()
            rows = spread.T @ self._laplacian[inner]
            field[inner] = spread @ cg(rows[:, inner] @ spread, -rows @ field, rtol=SMOOTH, maxiter=500)[0]
        return field


def _of(directions: scipy.sparse.csr_array, nodes: np.ndarray) -> np.ndarray:
    """[P] bool: which of the directions [P, 3 N] move one of the nodes, [N] bool."""
    return abs(directions) @ np.repeat(nodes, 3).astype(float) > 0


def _longest_edge(rest: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """[N] the longest of the edges around each node of a surface [F,3]; 0 at nodes inside."""
    ends = surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    longest = np.zeros(len(rest))
    np.maximum.at(longest, ends.ravel(), np.repeat(np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1), 2))
    return longest
