"""Implicit dynamics of cloth: backward Euler. Each step is a minimisation.

Let x be the positions at the start of a step of length h, v their velocities, and y = x + h v + h^2 g. A step finds

    argmin_z  sum_i m_i |z_i - y_i|^2 / (2 h^2) + V(z) + B(z),    v' = (z - x) / h,

where V is the energy of the cloth, B is the energy of contact, and prescribed nodes stand at their targets. The step
ends when the Newton step divided by h^2, which is an error of the acceleration, is within a tolerance. The tolerance is
one on accelerations because a model learns accelerations from the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.cloth import Cloth, ClothMaterial
from ast_sim.mechanics.elements.inertia import Inertia
from ast_sim.mechanics.frames import FrameRecord, Frames
from ast_sim.mechanics.solver import Newton, NotConverged, SolverSettings
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.scene import AttributeValue, Scene, Trajectory

GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class DynamicSettings(SolverSettings):
    """When a time step has converged and when it is given up.

    Attributes:
        acceleration_tolerance: largest component of the last Newton step of a free node, divided by the square of the
            time step, in m/s^2.
        max_halvings: how often a time step that does not converge is halved.
    """

    acceleration_tolerance: float = 0.1
    max_halvings: int = 4


@dataclass(frozen=True, eq=False)
class ClothCase:
    """A sheet of cloth, rigid obstacles with prescribed motion, and S frames.

    Attributes:
        scene: triangles. Those whose nodes are all OBSTACLE nodes are rigid; all others are cloth. The rest position is
            the start; there the cloth is flat and unstrained.
        prescribed_position: [S,N,3] float64, of the prescribed nodes in each frame in metres. Rows of other nodes are
            ignored. Frame 0 is at rest.
        material: material of the cloth.
        contact: contact between the surfaces.
        time_step: time between two frames, in seconds.
        gravity: acceleration in m/s^2.
        velocity: [N,3] velocities of the free nodes in frame 0, in m/s; zero if None.
        attributes: what the drawing wants recorded with the trajectory.
    """

    scene: Scene
    prescribed_position: np.ndarray
    material: ClothMaterial
    contact: ContactSettings
    time_step: float
    gravity: tuple[float, float, float] = GRAVITY
    velocity: np.ndarray | None = None
    attributes: dict[str, AttributeValue] = field(default_factory=dict)

    @property
    def cloth_triangles(self) -> np.ndarray:
        """[T,3] the triangles that are not rigid, by `Scene.rigid_elements`."""
        return self.scene.elements[~self.scene.rigid_elements]


class BackwardEuler(Newton):
    """Cloth on its way through time; `advance` takes one time step.

    The result of a step depends only on the positions and velocities at its start.

    Args:
        case: the scene, its physical constants and its start.
        settings: tolerances.

    Attributes:
        cloth: the elastic potential.
        mass: [N] in kg; 0 for prescribed nodes.
        velocity: [N,3] velocities of the free nodes in m/s; 0 for prescribed nodes.
        halvings: halved time steps so far.
    """

    settings: DynamicSettings

    def __init__(self, case: ClothCase, settings: DynamicSettings | None = None) -> None:
        scene = case.scene
        rest = case.scene.rest_position.astype(np.float64)
        self.cloth = Cloth(rest, case.cloth_triangles, case.material)
        self.mass = np.where(scene.prescribed, 0, self.cloth.mass())
        self.velocity = np.zeros_like(rest)
        if case.velocity is not None:
            self.velocity[~scene.prescribed] = case.velocity[~scene.prescribed]
        self.halvings = 0
        self._time_step = case.time_step
        self._gravity = np.asarray(case.gravity, float)
        self._inertia = Inertia(self.cloth, self.mass, case.time_step)
        self._error = 0.0
        contact = Contact(rest, scene.surface(), scene.body, case.contact, ~scene.deforming_nodes)
        super().__init__(self._inertia, contact, scene.prescribed, rest, settings or DynamicSettings())

    def advance(self, target: np.ndarray) -> None:
        """Take one time step, at whose end the prescribed nodes stand at `target` [N,3].

        Raises:
            NotConverged: the step does not converge, even after the allowed halvings.
        """
        self._error = 0.0
        self._advance(target, self._time_step, 0)

    def _advance(self, target: np.ndarray, step: float, halvings: int) -> None:
        position = self.position
        try:
            self._time_integrate(target, step)
        except NotConverged as error:  # the velocity is still the one at the start of the step
            if halvings == self.settings.max_halvings:
                raise NotConverged(f"{error}, also after {halvings} halvings of the time step") from error
            self.halvings += 1
            self.restart(position)
            self._advance((position + target) / 2, step / 2, halvings + 1)
            self._advance(target, step / 2, halvings + 1)

    def _time_integrate(self, target: np.ndarray, step: float) -> None:
        start = self.position
        inertial = start + step * self.velocity
        self._inertia.weight = self.mass / step**2
        self._inertia.predicted = inertial + step**2 * self._gravity
        self.restart(start)
        friction_passes = self.settings.friction_passes if self.contact.settings.has_friction else 0
        if friction_passes:
            self._lag_friction(start)
        # Start where inertia takes the nodes: few Newton steps are left from there. If nodes collide on the way, start
        # halfway to the collision.
        end = np.where(self.prescribed[:, None], target, inertial)
        fraction = self.contact.collision_free_fraction(start, end)
        self.state = self._evaluate(end if fraction == 1 else start + 0.5 * fraction * (end - start))
        self._move(target)
        self._equilibrate(step)
        for _ in range(friction_passes):
            self._lag_friction(start)
            self._equilibrate(step)
        self.dissipation += self.state.contact.dissipation()
        self.velocity = np.where(self.prescribed[:, None], 0, (self.position - start) / step)

    def _equilibrate(self, step: float | None = None) -> None:
        """Newton with line search until the step is within tolerance."""
        step = self._time_step if step is None else step
        for _ in range(self.settings.max_iterations):
            gradient, _ = self._gradient(self.state)
            gradient[self.prescribed] = 0
            self._count()
            direction = self._direction(self.state, gradient, None)
            self.state = self._line_search(gradient, direction)
            error = float(np.abs(direction).max()) / (self.settings.acceleration_tolerance * step**2)
            if error <= 1:
                self._error = max(self._error, error)
                return
        raise NotConverged(f"no equilibrium after {self.settings.max_iterations} Newton iterations")

    def residual(self) -> float:
        """Newton step at the end of the last time step, divided by the tolerance: at most 1."""
        return self._error

    def elastic_energy(self) -> float:
        """Energy of membrane and bending in joule."""
        return self.state.potential.inner.energy

    def kinetic_energy(self) -> float:
        """Kinetic energy in joule."""
        return 0.5 * float(self.mass @ np.einsum("ij,ij->i", self.velocity, self.velocity))

    def potential_energy(self) -> float:
        """Energy in the field of gravity, in joule; zero at the origin."""
        return -float(self.mass @ (self.position @ self._gravity))


@dataclass(frozen=True, kw_only=True)
class DynamicRecord(FrameRecord):
    """A record with the energies of motion.

    Its residual is the last Newton step divided by the tolerance. Its work is done by the forces at the end of each
    frame.

    Attributes:
        kinetic_energy, potential_energy: in joule.
    """

    kinetic_energy: float
    potential_energy: float


def implicit_euler(
    case: ClothCase,
    settings: DynamicSettings | None = None,
    checkpoint: Checkpoint | None = None,
    patient: bool = False,
) -> Trajectory:
    """Solve a case frame by frame, to the tolerances of `settings`; see `Frames.trajectory`.

    The checkpoint keeps unfinished frames. If it holds some already, the solve goes on from them.
    """
    return ClothFrames(case, settings).trajectory(checkpoint, patient)


class ClothFrames(Frames[DynamicRecord]):
    """The frames of a `ClothCase` and its solver; arguments as for `implicit_euler`."""

    case: ClothCase
    solver: BackwardEuler

    @property
    def record_type(self) -> type[DynamicRecord]:
        """See `Frames`."""
        return DynamicRecord

    def __init__(self, case: ClothCase, settings: DynamicSettings | None) -> None:
        solver = BackwardEuler(case, settings)
        super().__init__(case, solver, solver.contact)

    def watch(self, progress: Callable[[int], None]) -> None:
        """See `Frames`."""
        self.solver.watch = lambda: progress(self.solver.iterations)

    def next_frame(self) -> tuple[dict[str, np.ndarray], DynamicRecord]:
        """See `Frames`."""
        solver = self.solver
        start = self.solver.position
        cost = self.advance()
        arrays = {"position": solver.position.astype(np.float32)}
        checked = self.check(arrays)
        reactions = np.where(self.case.scene.prescribed[:, None], solver.reactions(), 0)
        return arrays, DynamicRecord(
            **cost,
            **checked,
            residual=solver.residual(),
            contact_area=self.contact.area(solver.state.contact),
            reaction=float(np.linalg.norm(reactions[self.driven.nodes].sum(axis=0))),
            elastic_energy=solver.elastic_energy(),
            contact_energy=solver.state.contact.barrier_energy(),
            kinetic_energy=solver.kinetic_energy(),
            potential_energy=solver.potential_energy(),
            work=self.last("work") + float(np.vdot(reactions, solver.position - start)),
        )

    def jacobian(self, position: np.ndarray) -> np.ndarray:
        """See `Frames`."""
        return self.solver.cloth.jacobian(position)

    def exact_state(self) -> dict[str, np.ndarray]:
        """See `Frames`."""
        return {"position": self.solver.position, "velocity": self.solver.velocity}

    def go_on_from(self, state: dict[str, np.ndarray]) -> None:
        """See `Frames`."""
        self.solver.restart(state["position"])
        self.solver.velocity = state["velocity"]

    def attributes(self) -> dict[str, AttributeValue]:
        """See `Frames`."""
        return {**self.summary(self.solver.system.solver_name), **asdict(self.case.material)}
