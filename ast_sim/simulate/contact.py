"""Contact by the incremental potential method (IPC): everything that touches ipctk.

A barrier potential keeps surfaces apart: it acts below the distance `dhat` and grows to infinity as the distance falls
to zero; continuous collision detection (CCD) shortens each step before surfaces meet (Li et al. 2020, with the area
weighting and the improved max approximation of Li et al. 2023). ipctk changes its interface from one minor version to
the next, hence the pinned version and this module alone.
"""

from __future__ import annotations

import numpy as np

from ast_sim.errors import MissingExtra, SimulationError, require

IPCTK_VERSION = "1.5"
# Candidate pairs stay valid while no vertex has moved further than this share of dhat from where they were collected.
SKIN = 1.0


def load_ipctk():
    """Import ipctk, single-threaded.

    Raises:
        MissingExtra: absent, or of another minor version than the one this module is written for.
    """
    (ipctk,) = require("simulate", "ipctk")
    if not ipctk.__version__.startswith(IPCTK_VERSION + "."):
        raise MissingExtra(
            f"ipctk {IPCTK_VERSION}.x is needed here but {ipctk.__version__} is installed:"
            ' pip install "ast_sim[simulate]"'
        )
    ipctk.set_num_threads(1)
    return ipctk


def self_test() -> None:
    """Check on two tetrahedra that ipctk means what this module takes it to mean.

    Raises:
        MissingExtra: as `load_ipctk`.
        SimulationError: a gap or a gradient of the barrier that is not what it should be.
    """
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, 1]])
    position = np.concatenate([tetrahedron, [0.05, 0.1, 1.05] + tetrahedron @ np.diag([1, 1, 0.5])])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    contact = Contact(position, np.concatenate([faces, faces + 4]), np.repeat([0, 1], 4), dhat=0.1, stiffness=3.0)

    def state(shift: np.ndarray) -> ContactState:
        contact.collision_free_fraction(position, position + shift)
        return contact.at(position + shift)

    direction = 1e-6 * np.sin(np.arange(24)).reshape(8, 3)
    difference = (state(direction).energy() - state(-direction).energy()) / 2
    derivative = float(np.vdot(state(0 * direction).gradient(), direction))
    if not (derivative != 0 and abs(difference - derivative) <= 1e-5 * abs(derivative)):
        raise SimulationError(f"ipctk's barrier gradient is {derivative:.9g}, its differences say {difference:.9g}")
    if abs(contact.gap(position) - 0.05) > 1e-9:
        raise SimulationError(f"ipctk gives the distance {contact.gap(position):.9g} for 0.05")


class Contact:
    """Frictionless contact between bodies whose surfaces are triangles.

    Pairs of the same body are left out: a body that touches itself is not held apart, but `intersects` finds it.

    Args:
        rest: rest positions [N,3] in metres.
        faces: surface triangles [F,3], normals pointing out.
        body: body of each node [N].
        dhat: distance in metres below which surfaces repel each other.
        stiffness: barrier stiffness in pascal, about Young's modulus.
    """

    def __init__(self, rest: np.ndarray, faces: np.ndarray, body: np.ndarray, dhat: float, stiffness: float) -> None:
        self._ipctk = ipctk = load_ipctk()
        self.dhat, self.stiffness = dhat, stiffness
        self.num_nodes = len(rest)
        self.nodes, local_faces = np.unique(faces, return_inverse=True)
        local_faces = np.asfortranarray(local_faces.reshape(-1, 3), dtype=np.int32)
        vertices, edges = self._vertices(rest), ipctk.edges(local_faces)
        self._mesh = ipctk.CollisionMesh(vertices, edges, local_faces)
        self._mesh.can_collide = ipctk.VertexPatchesCanCollide(body[self.nodes].astype(np.int32))
        self._whole_mesh = ipctk.CollisionMesh(vertices, edges, local_faces)
        self._potential = ipctk.BarrierPotential(dhat, True)
        self._broad_phase, self._ccd = ipctk.LBVH(), ipctk.AdditiveCCD()
        self._candidates = ipctk.Candidates()
        self._reference = np.full_like(vertices, np.inf)
        self._dofs = (3 * self.nodes[:, None] + np.arange(3)).ravel()

    def _vertices(self, position: np.ndarray) -> np.ndarray:
        return np.asfortranarray(position[self.nodes])

    def _is_near_reference(self, vertices: np.ndarray) -> bool:
        difference = vertices - self._reference
        return np.einsum("ij,ij->i", difference, difference).max() <= (SKIN * self.dhat) ** 2

    def _collect(self, start: np.ndarray, end: np.ndarray) -> None:
        """Make the candidate pairs hold all that can come closer than dhat on the straight way from start to end.

        Pairs are collected along the way, enlarged by a skin around its end: later steps inside that skin need no new
        search. Both boxes of a pair are inflated, so half the distance is enough.
        """
        if self._is_near_reference(start) and self._is_near_reference(end):
            return
        self._candidates.build(self._mesh, start, end, (0.5 + SKIN) * self.dhat, self._broad_phase)
        self._reference = end

    def collision_free_fraction(self, start: np.ndarray, end: np.ndarray) -> float:
        """Largest share in [0,1] of the step between positions [N,3] that stays free of contact (with a margin)."""
        start, end = self._vertices(start), self._vertices(end)
        self._collect(start, end)
        return self._candidates.compute_collision_free_stepsize(self._mesh, start, end, 0.0, self._ccd)

    def at(self, position: np.ndarray) -> ContactState:
        """Pairs closer than dhat at positions [N,3] on the step last given to `collision_free_fraction`."""
        vertices = self._vertices(position)
        collisions = self._new_collisions()
        collisions.build(self._candidates, self._mesh, vertices, self.dhat)
        return ContactState(self, collisions, vertices)

    def _new_collisions(self):
        collisions = self._ipctk.NormalCollisions()
        collisions.use_area_weighting = True
        collisions.collision_set_type = self._ipctk.NormalCollisions.IMPROVED_MAX_APPROX
        return collisions

    def intersects(self, position: np.ndarray) -> bool:
        """Whether any two surface triangles intersect, of the same body or not."""
        return self._ipctk.has_intersections(self._whole_mesh, self._vertices(position), self._broad_phase)

    def gap(self, position: np.ndarray) -> float:
        """Distance between the closest two bodies, in metres; infinite for a single body."""
        vertices = self._vertices(position)
        radius, extent = self.dhat, np.linalg.norm(np.ptp(vertices, axis=0))
        collisions = self._new_collisions()
        while collisions.empty() and radius < 8 * extent:
            collisions.build(self._mesh, vertices, radius, 0.0, self._broad_phase)
            radius *= 4
        return float(np.sqrt(collisions.compute_minimum_distance(self._mesh, vertices)))  # ipctk gives its square


class ContactState:
    """The pairs in contact at one position and the derivatives of their barrier potential."""

    def __init__(self, contact: Contact, collisions, vertices: np.ndarray) -> None:
        self._contact, self._collisions, self._vertices = contact, collisions, vertices

    @property
    def is_empty(self) -> bool:
        """Whether no pair is closer than dhat."""
        return self._collisions.empty()

    def energy(self) -> float:
        """Barrier energy in joule."""
        contact = self._contact
        return contact.stiffness * contact._potential(self._collisions, contact._mesh, self._vertices)

    def gradient(self) -> np.ndarray:
        """Derivative of the energy by the positions [N,3], in newton: minus the contact force on each node."""
        contact = self._contact
        result = np.zeros((contact.num_nodes, 3))
        if not self.is_empty:
            local = contact._potential.gradient(self._collisions, contact._mesh, self._vertices)
            result[contact.nodes] = contact.stiffness * local.reshape(-1, 3)
        return result

    def hessian(self, project: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Second derivative of the energy: rows, columns (3 node + component) and values of its entries.

        Args:
            project: make each pair's block positive semi-definite.
        """
        contact = self._contact
        if self.is_empty:
            return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
        method = contact._ipctk.PSDProjectionMethod
        local = contact._potential.hessian(
            self._collisions, contact._mesh, self._vertices, method.CLAMP if project else method.NONE
        ).tocoo()
        return contact._dofs[local.row], contact._dofs[local.col], contact.stiffness * local.data
