"""The force that moves a body, from positions alone: of the solver, or predicted by a model.

At equilibrium, the derivative f_i of the elastic energy by the position of a node is zero at free nodes that nothing
touches; at a held node it is the force that holds the node, at a touched node the contact force on it. So the force on
the moved nodes is the sum of w_i f_i for every field w that is 1 where these act on the deforming bodies, and 0 at all
other nodes that are held or touched. On predicted positions, f_i is not zero elsewhere. A smooth w then averages the
stress over all of the body, where the forces at the moved nodes alone would show the errors of one layer of elements.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import cg

from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.mechanics.elasticity import Elasticity
from ast_sim.simulate.mechanics.material import NeoHookean

REACH = 1.0  # a node counts as touched if another body is nearer than so many mean edge lengths
SMOOTH = 1e-3  # residual to which the smooth field is computed; every field is exact at equilibrium


class Reaction:
    """The force on the moved nodes of a scene of tetrahedra with Young's modulus and Poisson's ratio as its material.

    Made once for a scene, because the shape functions do not change.
    """

    def __init__(self, scene: Scene) -> None:
        import igl  # takes 0.2 s

        assert scene.material is not None
        self.scene, self._rest = scene, scene.rest_position.astype(np.float64)
        soft = np.flatnonzero(scene.deforming_nodes[scene.elements].any(axis=1))
        young, poisson = scene.material[soft, :2].astype(np.float64).T
        self._elasticity = Elasticity(self._rest, scene.elements[soft], NeoHookean(young, poisson))
        self._laplacian = -igl.cotmatrix(self._rest, scene.elements[soft].astype(np.int64)).tocsr()
        surface = scene.surface()
        self._surfaces = {int(n): surface[scene.body[surface[:, 0]] == n] for n in np.unique(scene.body)}
        a, b = surface[:, [0, 1]].T
        self._reach = REACH * float(np.linalg.norm(self._rest[a] - self._rest[b], axis=1).mean())
        self._deforming = np.zeros(scene.num_nodes, bool)
        self._deforming[scene.elements[soft]] = True

    def of(self, position: np.ndarray) -> np.ndarray:
        """The force [3] that moves the moved nodes, in pascal times the square of the unit of length.

        The moved nodes are the prescribed nodes, away from their places at rest, of the body that moves farthest.

        Args:
            position: [N,3].
        """
        position = position.astype(np.float64)
        source, sink = self._ends(position)
        if not source.any():
            return np.zeros(3)
        deformation = self._elasticity.evaluate(position)
        forces, _ = self._elasticity.gradient(deformation)
        return self._field(source, sink) @ forces

    def _ends(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[N] bool twice: the deforming nodes on which the moved nodes act, and all others that are held or touched."""
        scene, way = self.scene, np.linalg.norm(position - self._rest, axis=1)
        way[~scene.prescribed] = 0
        driven = int(scene.body[np.argmax(way)])
        nearest = self._nearest_body(position)
        held = scene.prescribed & self._deforming
        if scene.node_type[scene.body == driven][0] == NodeType.OBSTACLE:
            source = (nearest == driven) & ~held
        else:
            source = held & (scene.body == driven) & (way > 0)
        return source, (held | (nearest >= 0)) & ~source

    def _nearest_body(self, position: np.ndarray) -> np.ndarray:
        """[N] the number of the nearest other body within reach of a deforming surface node; -1 for all other nodes."""
        import igl

        found = np.full(len(position), -1)
        nearest = np.full(len(position), self._reach**2)
        for body, faces in self._surfaces.items():
            used, local = np.unique(faces, return_inverse=True)
            local = local.reshape(-1, 3)
            low, high = position[used].min(axis=0) - self._reach, position[used].max(axis=0) + self._reach
            for other, theirs in self._surfaces.items():
                nodes = np.unique(theirs)
                nodes = nodes[self._deforming[nodes] & ((position[nodes] > low) & (position[nodes] < high)).all(axis=1)]
                if other == body or not len(nodes):
                    continue
                square = igl.point_mesh_squared_distance(position[nodes], position[used], local)[0]
                closer = square < nearest[nodes]
                found[nodes[closer]], nearest[nodes[closer]] = body, square[closer]
        return found

    def _field(self, source: np.ndarray, sink: np.ndarray) -> np.ndarray:
        """[N] w: about harmonic between 1 at the sources and 0 at the sinks."""
        field = source.astype(float)
        inner = np.flatnonzero(self._deforming & ~source & ~sink)
        if len(inner):
            rows = self._laplacian[inner]
            field[inner] = cg(rows[:, inner], -rows[:, source].sum(axis=1), rtol=SMOOTH, maxiter=500)[0]
        return field
