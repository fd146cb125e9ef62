"""Contact by the incremental potential method (IPC), on top of ipctk.

A barrier potential keeps surfaces apart. It acts below the distance `dhat` and grows to infinity as the distance falls
to zero. Continuous collision detection (CCD) shortens each step before surfaces meet (Li et al. 2020, with the area
weighting and the improved max approximation of Li et al. 2023).
ipctk changes its interface from one minor version to the next. Its version is therefore pinned, and it is imported in
one place only (`load_ipctk`).
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import numpy as np

from ast_sim.scene import Scene
from ast_sim.support.errors import MissingExtra, SimulationError, require

IPCTK_VERSION = "1.5"
# Candidate pairs stay valid until a vertex has moved by this share of dhat since they were collected. A thick skin
# saves searches but adds pairs. A surface that may touch itself has many pairs nearby, so its skin is thin.
SKIN = 1.0
SELF_CONTACT_SKIN = 0.3
# ipctk counts squares of distances as zero below about 1e-16, so lengths are blown up by a power of two, which rounds
# nothing, until dhat is at least ZOOMED where it is below SMALL.
SMALL, ZOOMED = 1e-6, 1e-3
# Slip per load step, in units of dhat, from which Coulomb friction is fully mobilised; below it a contact sticks.
STICKING_SLIP = 0.1


@dataclass(frozen=True)
class ContactSettings:
    """How surfaces act on each other. The settings are the same in a whole dataset and are stored with it.

    Attributes:
        dhat: distance in metres below which surfaces repel each other.
        stiffness: barrier stiffness in pascal, about Young's modulus.
        friction: Coulomb's coefficient of friction. At 0 no term of friction is computed.
        self_contact: whether bodies are kept from passing through themselves, or the numbers of bodies that are. At
            rest, nodes of them that do not share an element must be further apart than dhat.
        pair_friction: other coefficients of friction between two bodies: (body, body, coefficient).

    Raises:
        SimulationError: a value is not allowed.
    """

    dhat: float
    stiffness: float
    friction: float = 0.0
    self_contact: bool | tuple[int, ...] = False
    pair_friction: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        least = min([self.friction, *(coefficient for _, _, coefficient in self.pair_friction)])
        if not (self.dhat > 0 and self.stiffness > 0 and least >= 0):
            raise SimulationError(
                "contact needs a distance dhat and a stiffness above 0 and a friction of at least 0:"
                f" got {self.dhat}, {self.stiffness}, {least}"
            )

    @property
    def has_friction(self) -> bool:
        """Whether a term of friction is computed."""
        return self.friction > 0 or any(coefficient > 0 for _, _, coefficient in self.pair_friction)

    def friction_between(self, first: int, second: int) -> float:
        """The coefficient of friction between two bodies."""
        pairs = (coefficient for a, b, coefficient in self.pair_friction if {a, b} == {first, second})
        return next(pairs, self.friction)

    def frictions(self, scene: Scene) -> list[float]:
        """The coefficients of friction that act in a scene, ascending, each once. Rigid bodies do not rub on others."""
        rigid = scene.rigid_bodies
        pairs = itertools.combinations(np.unique(scene.body).tolist(), 2)
        rubbing = [pair for pair in pairs if not rigid.issuperset(pair)]
        coefficients = {self.friction_between(*pair) for pair in rubbing}
        return sorted(coefficients | {self.friction} if self.self_contact or not coefficients else coefficients)


def load_ipctk():
    """Import ipctk, single-threaded.

    Raises:
        MissingExtra: ipctk is not installed, or this module is written for another minor version of it.
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
    """Check on two tetrahedra that ipctk does what this module expects.

    Raises:
        MissingExtra: as `load_ipctk`.
        SimulationError: a gap or a gradient of the barrier has a wrong value.
    """
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.3, 1]])
    position = np.concatenate([tetrahedron, [0.05, 0.1, 1.05] + tetrahedron @ np.diag([1, 1, 0.5])])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    contact = Contact(position, np.concatenate([faces, faces + 4]), np.repeat([0, 1], 4), ContactSettings(0.1, 3.0))

    def state(shift: np.ndarray) -> ContactState:
        contact.collision_free_fraction(position, position + shift)
        return contact.at(position + shift)

    direction = 1e-6 * np.sin(np.arange(24)).reshape(8, 3)
    difference = (state(direction).energy() - state(-direction).energy()) / 2
    derivative = float(np.vdot(state(0 * direction).gradient(), direction))
    if not (derivative != 0 and abs(difference - derivative) <= 1e-5 * abs(derivative)):
        raise SimulationError(f"ipctk's barrier gradient is {derivative:.9g}, finite differences give {difference:.9g}")
    if abs(contact.gap(position) - 0.05) > 1e-9:
        raise SimulationError(f"ipctk gives the distance {contact.gap(position):.9g} where 0.05 is right")


class Contact:
    """Contact between bodies whose surfaces are triangles. The settings say whether friction and self-contact act.

    Without self-contact, pairs of the same body are left out. Nothing then keeps a body from passing through itself,
    but `intersects` tells whether one does.

    Args:
        rest: rest positions [N,3] in metres.
        faces: surface triangles [F,3], normals pointing out.
        body: number of the body of each node [N].
        settings: distance, stiffness and friction.
        rigid: [N] bool, nodes of rigid bodies, which touch neither themselves nor each other, because their motion is
            given. None: no body is rigid.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        body: np.ndarray,
        settings: ContactSettings,
        rigid: np.ndarray | None = None,
    ) -> None:
        self._ipctk = ipctk = load_ipctk()
        self.settings = settings
        self._zoom = 1.0 if settings.dhat >= SMALL else 2.0 ** math.ceil(math.log2(ZOOMED / settings.dhat))
        self._dhat = self._zoom * settings.dhat  # in ipctk's lengths, as are all vertices and distances below
        self.num_nodes = len(rest)
        self.nodes, local_faces = np.unique(faces, return_inverse=True)
        local_faces = np.asfortranarray(local_faces.reshape(-1, 3), dtype=np.int32)
        self._body = body[self.nodes].astype(float)
        vertices = self._vertices(rest)
        edges = ipctk.edges(local_faces)
        self._mesh = ipctk.CollisionMesh(vertices, edges, local_faces)
        self._skin = (SELF_CONTACT_SKIN if settings.self_contact else SKIN) * self._dhat
        self._whole_mesh = ipctk.CollisionMesh(vertices, edges, local_faces)
        # Nodes of one number do not touch each other: the nodes of a body, and the nodes of all rigid bodies.
        fixed = np.zeros(len(rest), bool) if rigid is None else rigid
        whole = np.zeros(len(rest), bool) if rigid is None else ~np.isin(body, body[~rigid])
        together = np.where(whole, -1, body)
        alone = body.max() + 1 + np.arange(len(rest))
        if not settings.self_contact:
            self._mesh.can_collide = self._unless_alike(together)
        elif rigid is not None or settings.self_contact is not True:
            if settings.self_contact is not True:
                fixed = fixed | ~np.isin(body, settings.self_contact)
            self._mesh.can_collide = self._unless_alike(np.where(fixed, together, alone))
        if whole.any():
            self._whole_mesh.can_collide = self._unless_alike(np.where(whole, together, alone))
        self.barrier = ipctk.BarrierPotential(self._dhat, True)
        self._broad_phase = ipctk.LBVH()
        self._ccd = ipctk.AdditiveCCD()
        self._dofs = (3 * self.nodes[:, None] + np.arange(3)).ravel()
        self._friction = ipctk.FrictionPotential(STICKING_SLIP * self._dhat)
        self.restart()

    def restart(self) -> None:
        """Forget candidate pairs and friction. What follows then depends only on positions, not on the load path."""
        self._candidates = self._ipctk.Candidates()
        self._reference = np.full((len(self.nodes), 3), np.inf)
        self._sliding: tuple[object, np.ndarray] | None = None

    def _unless_alike(self, numbers: np.ndarray):
        """What ipctk asks before it pairs two surface nodes: whether their numbers [N] differ."""
        return self._ipctk.VertexPatchesCanCollide(numbers[self.nodes].astype(np.int32))

    def _vertices(self, position: np.ndarray) -> np.ndarray:
        return np.asfortranarray(self._zoom * position[self.nodes])

    def _is_near_reference(self, vertices: np.ndarray) -> bool:
        difference = vertices - self._reference
        return np.einsum("ij,ij->i", difference, difference).max() <= self._skin**2

    def _collect(self, start: np.ndarray, end: np.ndarray) -> None:
        """Collect all candidate pairs that can come closer than dhat on the straight path from start to end.

        The search covers the path and a skin around its end. Later steps inside that skin need no new search. Both
        boxes of a pair are inflated, so each needs only half the distance.
        """
        if self._is_near_reference(start) and self._is_near_reference(end):
            return
        self._candidates.build(self._mesh, start, end, 0.5 * self._dhat + self._skin, self._broad_phase)
        self._reference = end

    def collision_free_fraction(self, start: np.ndarray, end: np.ndarray) -> float:
        """Largest share in [0,1] of the step between positions [N,3] on which no surfaces meet (with a margin)."""
        start, end = self._vertices(start), self._vertices(end)
        self._collect(start, end)
        return self._candidates.compute_collision_free_stepsize(self._mesh, start, end, 0.0, self._ccd)

    def at(self, position: np.ndarray) -> ContactState:
        """Pairs closer than dhat at positions [N,3]. They must lie on the last step of `collision_free_fraction`."""
        vertices = self._vertices(position)
        collisions = self._new_collisions()
        collisions.build(self._candidates, self._mesh, vertices, self._dhat)
        return ContactState(self, collisions, vertices)

    def lag_friction(self, state: ContactState, start: np.ndarray) -> None:
        """Let friction act from now on against motion from `start`, with the normal forces and tangents of `state`.

        Normal forces that change with the unknown positions would have no potential; lagged ones have one (Li et al.
        2020, section 5). States that are made after this call contain the friction; earlier states do not.
        """
        pairs = self._ipctk.TangentialCollisions()
        arguments = self._mesh, state.vertices, state.collisions, self.barrier, self.settings.stiffness
        if self.settings.pair_friction:
            between = functools.cache(self.settings.friction_between)
            # ipctk blends the coefficients of two vertices; here they are numbers of bodies.
            pairs.build(*arguments, self._body, self._body, lambda a, b: between(round(a), round(b)))
        else:
            pairs.build(*arguments, self.settings.friction)
        self._sliding = pairs, self._vertices(start)

    def _new_collisions(self):
        collisions = self._ipctk.NormalCollisions()
        collisions.use_area_weighting = True
        collisions.collision_set_type = self._ipctk.NormalCollisions.IMPROVED_MAX_APPROX
        return collisions

    def intersects(self, position: np.ndarray) -> bool:
        """Whether any two surface triangles intersect, of one body or of two. Rigid bodies may pass through
        themselves, as the layer behind a rigid surface may, and through each other."""
        return self._ipctk.has_intersections(self._whole_mesh, self._vertices(position), self._broad_phase)

    def gap(self, position: np.ndarray) -> float:
        """Smallest distance in metres between surfaces that are kept apart; infinite if there are none."""
        vertices = self._vertices(position)
        extent = np.linalg.norm(np.ptp(vertices, axis=0))
        # Each search finds all pairs within its radius; a wide one of close surfaces would find far too many.
        radius = 0.0
        collisions = self._new_collisions()
        while collisions.empty() and radius <= extent:
            radius = max(self._dhat, 4 * radius)
            collisions.build(self._mesh, vertices, radius, 0.0, self._broad_phase)
        return math.sqrt(collisions.compute_minimum_distance(self._mesh, vertices)) / self._zoom  # ipctk gives squares

    def area(self, state: ContactState) -> float:
        """Rest area in square metres around the surface nodes on which a barrier acts. It is the mean of both sides."""
        touched = np.abs(state.barrier_gradient()).max(axis=1) > 0
        return 0.5 * float(np.asarray(self._mesh.vertex_areas)[touched].sum()) / self._zoom**2


class ContactState:
    """The pairs in contact at one position, with the derivatives of the barrier, and of friction if it acts.

    Args:
        contact: the contact that this state belongs to.
        collisions: ipctk's pairs closer than dhat.
        vertices: [V,3] positions of the surface nodes, in ipctk's lengths.
    """

    def __init__(self, contact: Contact, collisions, vertices: np.ndarray) -> None:
        self._contact = contact
        self.collisions = collisions
        self.vertices = vertices
        self._sliding = contact._sliding

    @property
    def is_empty(self) -> bool:
        """Whether no pair is closer than dhat and no friction acts."""
        return self.collisions.empty() and self._sliding is None

    def energy(self) -> float:
        """Barrier energy and the lagged potential of friction, in joule."""
        if self._sliding is None:
            return self.barrier_energy()
        contact = self._contact
        energy = contact._friction(self._sliding[0], contact._mesh, self.vertices - self._sliding[1])
        return self.barrier_energy() + energy / contact._zoom**3

    def barrier_energy(self) -> float:
        """Barrier energy in joule."""
        contact = self._contact
        energy = contact.barrier(self.collisions, contact._mesh, self.vertices)
        return contact.settings.stiffness * energy / contact._zoom**3

    def dissipation(self) -> float:
        """Work in joule that friction has taken since the positions at which it began to act."""
        if self._sliding is None:
            return 0.0
        return float(np.vdot(self.friction_gradient(), self.vertices - self._sliding[1])) / self._contact._zoom

    def barrier_gradient(self) -> np.ndarray:
        """Derivative of the barrier energy by the positions of the surface nodes [V,3], in newton."""
        if self.collisions.empty():
            return np.zeros(self.vertices.shape)
        contact = self._contact
        gradient = contact.barrier.gradient(self.collisions, contact._mesh, self.vertices)
        return contact.settings.stiffness * gradient.reshape(-1, 3) / contact._zoom**2

    def friction_gradient(self) -> np.ndarray:
        """Derivative of the potential of friction by the positions of the surface nodes [V,3], in newton."""
        if self._sliding is None:
            return np.zeros(self.vertices.shape)
        contact = self._contact
        gradient = contact._friction.gradient(self._sliding[0], contact._mesh, self.vertices - self._sliding[1])
        return gradient.reshape(-1, 3) / contact._zoom**2

    def gradient(self) -> np.ndarray:
        """Derivative of the energy by the positions [N,3], in newton: minus the contact force on each node."""
        result = np.zeros((self._contact.num_nodes, 3))
        if not self.is_empty:
            result[self._contact.nodes] = self.barrier_gradient() + self.friction_gradient()
        return result

    def hessian(self, project: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Second derivative of the energy: rows, columns (3 node + component) and values of its entries.

        Args:
            project: make each pair's block positive semi-definite.
        """
        contact = self._contact
        methods = contact._ipctk.PSDProjectionMethod
        method = methods.CLAMP if project else methods.NONE
        parts = []
        if not self.collisions.empty():
            barrier = contact.barrier.hessian(self.collisions, contact._mesh, self.vertices, method)
            parts.append((barrier.tocoo(), contact.settings.stiffness))
        if self._sliding is not None:
            pairs, start = self._sliding
            parts.append((contact._friction.hessian(pairs, contact._mesh, self.vertices - start, method).tocoo(), 1.0))
        if not parts:
            return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
        rows = np.concatenate([matrix.row for matrix, _ in parts])
        columns = np.concatenate([matrix.col for matrix, _ in parts])
        values = np.concatenate([scale * matrix.data for matrix, scale in parts]) / contact._zoom
        return contact._dofs[rows], contact._dofs[columns], values
