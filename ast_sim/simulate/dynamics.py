"""Implicit dynamics of cloth: backward Euler, each step a minimisation.

With x the positions at the start of a step of length h, v their velocities and y = x + h v + h^2 g, a step finds

    argmin_z  sum_i m_i |z_i - y_i|^2 / (2 h^2) + V(z) + B(z),    v' = (z - x) / h,

V the energy of the cloth, B that of contact, and prescribed nodes at their targets. It ends when the Newton step, as
an error of the acceleration (over h^2), is within a tolerance: accelerations are what a model learns from the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np

from ast_sim.data.scene import AttributeValue, NodeType, Scene, Trajectory
from ast_sim.simulate.checkpoint import Checkpoint
from ast_sim.simulate.cloth import Cloth, ClothMaterial
from ast_sim.simulate.contact import Contact, ContactSettings
from ast_sim.simulate.frames import FrameRecord, Frames
from ast_sim.simulate.inertia import Inertia
from ast_sim.simulate.solver import Newton, NotConverged, SolverSettings

GRAVITY = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class DynamicSettings(SolverSettings):
    """When a time step has converged and when it is given up.

    Attributes:
        acceleration_tolerance: largest component of the last Newton step of a free node over the square of the time
            step, in m/s^2.
        max_halvings: how often a time step is halved where it does not converge.
    """

    acceleration_tolerance: float = 0.1
    max_halvings: int = 4


@dataclass(frozen=True, eq=False)
class ClothCase:
    """A sheet of cloth, rigid obstacles with prescribed motion, and S frames.

    Attributes:
        scene: triangles; those of OBSTACLE nodes are rigid, all others are cloth, flat and at its start at rest.
        targets: [S,N,3] float64, positions of the prescribed nodes in each frame in metres; rows of other nodes are
            ignored, frame 0 is at rest.
        material: of the cloth.
        contact: between the surfaces.
        time_step: between two frames, in seconds.
        gravity: in m/s^2.
        velocity: [N,3] of the free nodes in frame 0, in m/s; none move if None.
        attributes: what the drawing wants to have recorded with the trajectory.
    """

    scene: Scene
    targets: np.ndarray
    material: ClothMaterial
    contact: ContactSettings
    time_step: float
    gravity: tuple[float, float, float] = GRAVITY
    velocity: np.ndarray | None = None
    attributes: dict[str, AttributeValue] = field(default_factory=dict)

    @property
    def cloth_triangles(self) -> np.ndarray:
        """[T,3] the triangles that are not rigid."""
        obstacle = self.scene.node_type == NodeType.OBSTACLE
        return self.scene.elements[~obstacle[self.scene.elements].all(axis=1)]


class BackwardEuler(Newton):
    """Cloth on its way through time; `advance` brings it one time step on.

    What a step does depends on the positions and velocities at its start alone.

    Args:
        case: the scene, its laws and its start.
        settings: tolerances.

    Attributes:
        cloth: the elastic potential.
        mass: [N] in kg; 0 for prescribed nodes.
        velocity: [N,3] of the free nodes in m/s; 0 for prescribed ones.
        halvings: halved time steps so far.
    """

    settings: DynamicSettings

    def __init__(self, case: ClothCase, settings: DynamicSettings | None = None) -> None:
        scene, rest = case.scene, case.scene.rest_position.astype(np.float64)
        self.cloth = Cloth(rest, case.cloth_triangles, case.material)
        self.mass = np.where(scene.prescribed, 0, self.cloth.mass())
        self.velocity = np.zeros_like(rest)
        if case.velocity is not None:
            self.velocity[~scene.prescribed] = case.velocity[~scene.prescribed]
        self.halvings = 0
        self._time_step, self._gravity = case.time_step, np.asarray(case.gravity, float)
        self._inertia = Inertia(self.cloth, self.mass, case.time_step)
        self._error = 0.0
        contact = Contact(rest, scene.surface(), scene.body, case.contact, scene.node_type == NodeType.OBSTACLE)
        super().__init__(self._inertia, contact, scene.prescribed, rest, settings or DynamicSettings())

    def advance(self, target: np.ndarray) -> None:
        """Go on by one time step, at whose end the prescribed nodes stand at `target` [N,3].

        Raises:
            NotConverged: also after the allowed halvings of the time step.
        """
        self._error = 0.0
        self._advance(target, self._time_step, 0)

    def _advance(self, target: np.ndarray, step: float, halvings: int) -> None:
        position = self.position
        try:
            self._time_integrate(target, step)
        except NotConverged as error:  # the velocity is still that at the start
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
        friction_passes = 0 if self.contact.settings.friction == 0 else self.settings.friction_passes
        if friction_passes:
            self._lag_friction(start)
        # From where nodes go by inertia few Newton steps are left; where they would collide, from halfway there.
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
        """Last Newton step of the last time step over that of the stop test: at most 1."""
        return self._error

    def elastic_energy(self) -> float:
        """In joule, membrane and bending."""
        return self.state.potential.inner.energy

    def kinetic_energy(self) -> float:
        """In joule."""
        return 0.5 * float(self.mass @ np.einsum("ij,ij->i", self.velocity, self.velocity))

    def potential_energy(self) -> float:
        """In the field of gravity, in joule, zero at the origin."""
        return -float(self.mass @ (self.position @ self._gravity))


@dataclass(frozen=True, kw_only=True)
class DynamicRecord(FrameRecord):
    """A record with the energies of motion; the residual is the last Newton step over that of the stop test, work is
    done by the forces at the end of each frame.

    Attributes:
        kinetic_energy, potential_energy: in joule.
    """

    kinetic_energy: float
    potential_energy: float


def implicit_euler(
    case: ClothCase, settings: DynamicSettings | None = None, checkpoint: Checkpoint | None = None
) -> Trajectory:
    """Solve a case frame by frame, to the tolerances of `settings`; see `Frames.trajectory`.

    The checkpoint is where unfinished frames are kept, and taken from if there are any.
    """
    return ClothFrames(case, settings).trajectory(checkpoint)


class ClothFrames(Frames):
    """The frames of a `ClothCase` and its solver; arguments as for `implicit_euler`."""

    case: ClothCase
    solver: BackwardEuler
    record_type = DynamicRecord

    def __init__(self, case: ClothCase, settings: DynamicSettings | None) -> None:
        solver = BackwardEuler(case, settings)
        super().__init__(case, solver, solver.contact)

    def watch(self, progress: Callable[[int], None]) -> None:
        """See `Frames`."""
        self.solver.watch = lambda: progress(self.solver.iterations)

    def next_frame(self) -> tuple[dict[str, np.ndarray], DynamicRecord]:
        """See `Frames`."""
        solver, start = self.solver, self.solver.position
        cost = self.advance()
        arrays = {"position": solver.position.astype(np.float32)}
        checked = self.check(arrays)
        reactions = np.where(self.case.scene.prescribed[:, None], solver.reactions(), 0)
        return arrays, DynamicRecord(
            **cost,
            **checked,
            residual=solver.residual(),
            contact_area=self.contact.area(solver.state.contact),
            reaction=float(np.linalg.norm(reactions[self.driven].sum(axis=0))),
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
