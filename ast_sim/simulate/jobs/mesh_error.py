"""What the mesh itself gets wrong: the largest force of a scene on its mesh and on one of another size.

On a mesh of half the size only the frame with that force is solved. It starts from the displacements of the coarse
mesh; Newton steps with linearised contact bring it near the equilibrium, and the contact solver finds it there. With
friction, such steps bring the frame before near its equilibrium, too: there the surfaces stuck to each other. The force
is the one that the solver finds frame by frame from rest, to 0.1 %, in a fifth to all of that time (docs/log.md,
2026-11-26). Where surfaces cut each other at the start, the solver does go frame by frame. Where this fails or would
take too long, the scene is solved on a mesh of twice the size. Its force and the one on the scene's own mesh have a
limit that follows from `ORDER`.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time

import numpy as np

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.frames import GivenUp
from ast_sim.mechanics.linearised.linearised_contact import CLEARANCE, STILL, NewtonSteps
from ast_sim.mechanics.reaction import Reaction
from ast_sim.mechanics.solid_frames import SolidFrames, solve_frame
from ast_sim.scene import Trajectory
from ast_sim.simulate.calculix import solve as calculix
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.parameters import Values
from ast_sim.simulate.shapes.mesh_transfer import transferred
from ast_sim.support.errors import AstSimError, SimulationError
from ast_sim.support.progress import duration

HALF, TWICE = 0.5, 2.0
ORDER = 1.5  # at which forces converge: 2 where parts bend, 1.5 to 1.7 where they touch (docs/results/verification.md)
MOST_SECONDS = 60.0  # processor time that half the size may take
# Iterations on that mesh that are usual, and how much longer one takes than on the mesh of the scene: there are 5 to 8
# times as many nodes, and the time of an iteration grows with their power 1.1 to 1.9.
USUAL_ITERATIONS = 30
LONGER = 24.0
MOST_STEPS = 10  # with linearised contact
NO_FORCE = 1e-9  # a force below this, relative to Young's modulus times the square of the size, is rounding
LEAST_COARSER = 0.9  # a mesh of twice the size has at most this share of the nodes, or it is none


@dataclass(frozen=True)
class MeshError:
    """The largest force, or torque where the moved nodes turn, of a scene on its mesh and on another one.

    Attributes:
        quantity: "force" or "torque".
        value: on the mesh of the scene, in newton or newton metres.
        relative: the length of the elements of the other mesh, relative to the scene's mesh: 1/2 or 2.
        other: the same force on that mesh.
    """

    quantity: str
    value: float
    relative: float
    other: float

    @property
    def off(self) -> float:
        """How far the mesh of the scene is off: from the force on the finer mesh, or from the limit that follows from
        both with the order `ORDER`, as a share of it; infinite if that limit is not above 0."""
        limit = self.other if self.relative < 1 else self.value + (self.value - self.other) / (2**ORDER - 1)
        return abs(self.value - limit) / limit if limit > 0 else np.inf

    def __str__(self) -> str:
        unit = {"force": "N", "torque": "N m"}[self.quantity]
        size = "half" if self.relative < 1 else "twice"
        about = "" if self.relative < 1 else "about "
        off = f"{about}{float(f'{100 * self.off:.2g}'):g} %" if np.isfinite(self.off) else "more than 100 %"
        forces = f"{self.quantity} {self.value:.3g} {unit}, at {size} the size {self.other:.3g} {unit}"
        return f"{forces}: this mesh is {off} off"


def mesh_error(
    spec: AssemblySpec, case: SolidCase, solved: Trajectory, values: Values, nodes: int | None, solver: str = "own"
) -> MeshError:
    """Solve a scene of an assembly on a second mesh.

    Args:
        spec: the specification.
        case, solved: the scene, and its frames as `ast_sim generate` makes them.
        values: of the parameters in it.
        nodes: about how many nodes the scene should have; None: as the sizes give.
        solver: of the scene, "own" or "calculix". CalculiX solves it on a mesh of twice the size.

    Raises:
        AstSimError: there is no force, or neither mesh can be made and solved; the text says why.
    """
    quantity, power = ("torque", 3) if "torque" in solved.attributes else ("force", 2)
    curve = _curve(solved, quantity)
    unit = LENGTH_UNITS[spec.unit]
    frame = int(np.argmax(curve))
    value = float(curve[frame])
    extent = unit * float(np.linalg.norm(np.ptp(case.scene.rest_position, axis=0)))
    young = float(np.min(np.broadcast_to(case.material.young, case.scene.num_elements)[~case.scene.rigid_elements]))
    if value <= NO_FORCE * young * extent**power:
        raise SimulationError(f"the first scene has no {quantity}")
    try:
        if solver != "own":
            raise SimulationError("CalculiX does not start from a coarse solution")
        _check_seconds(solved)
        finer = assembly.resized(spec, values, nodes, len(case.prescribed_position), HALF)
        position = _at_half_the_size(case, solved, finer, frame)
        return MeshError(quantity, value, HALF, _force(finer, position, quantity) * unit**power)
    except AstSimError as error:
        reason = error
    try:
        return MeshError(quantity, value, TWICE, _at_twice_the_size(spec, case, values, nodes, frame, quantity, solver))
    except AstSimError as error:
        raise SimulationError(f"at half the size: {reason}; at twice the size: {error}") from error


def _check_seconds(solved: Trajectory) -> None:
    """Raise SimulationError if half the size would take too long."""
    each = np.sum(solved.attributes["solve_seconds"]) / max(np.sum(solved.attributes["newton_iterations"]), 1)
    seconds = LONGER * USUAL_ITERATIONS * float(each)
    if seconds > MOST_SECONDS:
        raise SimulationError(f"it would take about {duration(seconds)}")


def _at_half_the_size(coarse: SolidCase, solved: Trajectory, fine: SolidCase, frame: int) -> np.ndarray:
    """The positions [N,3] of a frame on the finer mesh.

    Raises:
        SimulationError: the solver finds no equilibrium, or not in time.
    """
    end = process_time() + MOST_SECONDS
    try:
        return _from_coarse(coarse, solved, fine, frame, end)
    except SimulationError:
        one = solve_frame(fine, frame, assembly.SETTINGS, first=0, most_seconds=end - process_time())
    if one.position is None:
        raise SimulationError(one.failure)
    return one.position


def _from_coarse(coarse: SolidCase, solved: Trajectory, fine: SolidCase, frame: int, end: float) -> np.ndarray:
    """As `_at_half_the_size`, from the frame of the coarse mesh; `end`: processor time at which it is given up."""
    stuck = None
    steps = NewtonSteps(fine.scene, fine.material, CLEARANCE * coarse.contact.dhat, coarse.friction)
    if coarse.friction:
        stuck = _near(steps, _start(coarse, solved, fine, frame - 1), None)
    position = _near(steps, _start(coarse, solved, fine, frame), stuck)
    frames = SolidFrames(fine, assembly.SETTINGS)

    def watch(_: int) -> None:
        if process_time() > end:
            raise GivenUp(f"it takes more than {MOST_SECONDS:g} s")

    frames.watch(watch)
    frames.solver.newton.equilibrate_near(position, stuck)
    position = frames.solver.newton.position
    frames.check({"position": position.astype(np.float32)})
    return position


def _force(case: SolidCase, position: np.ndarray, quantity: str) -> float:
    """In pascal times the square of the unit of length (torque: the cube), at equilibrium."""
    driven = Driven.of(case.scene, case.prescribed_position)
    reaction = Reaction(case.scene, driven, case.material, case.contact_forces())
    return abs(reaction.torque(position)) if quantity == "torque" else float(np.linalg.norm(reaction.of(position)))


def _near(steps: NewtonSteps, position: np.ndarray, stuck: np.ndarray | None) -> np.ndarray:
    """The positions [N,3] after Newton steps until one is small."""
    for _ in range(MOST_STEPS):
        before = position
        position = steps.step(position, stuck=stuck)
        if steps.size(before, position) <= STILL:
            return position
    raise SimulationError(f"{MOST_STEPS} Newton steps with linearised contact do not converge")


def _start(coarse: SolidCase, solved: Trajectory, fine: SolidCase, frame: int) -> np.ndarray:
    """[N,3] where the nodes of the finer mesh are in a frame if they move as the bodies of the coarse mesh do there."""
    scene = coarse.scene
    rest = coarse.scene.rest_position.astype(np.float64)
    displacement = solved.position[frame].astype(np.float64) - rest
    body_of_element = scene.body[scene.elements[:, 0]]
    points = fine.scene.rest_position.astype(np.float64)
    position = fine.prescribed_position[frame].astype(np.float64)
    for body in np.unique(fine.scene.body[~fine.scene.prescribed]):
        free = (fine.scene.body == body) & ~fine.scene.prescribed
        elements = scene.elements[body_of_element == body]
        position[free] = points[free] + transferred(rest, elements, displacement, points[free])
    return position


def _at_twice_the_size(
    spec: AssemblySpec, case: SolidCase, values: Values, nodes: int | None, frame: int, quantity: str, solver: str
) -> float:
    """The force in newton (torque: newton metres) of a frame on a mesh of twice the size.

    Raises:
        AstSimError: there is no such mesh, or its frames up to this one cannot be solved.
    """
    whole = next((part.name for part in spec.parts if not part.rigid and part.size is None), None)
    if whole is not None:
        raise SimulationError(f"the mesh of {whole} stands in its file")
    coarser = assembly.resized(spec, values, nodes, len(case.prescribed_position), TWICE)
    if coarser.scene.num_nodes > LEAST_COARSER * case.scene.num_nodes:
        raise SimulationError("there is no coarser mesh of these parts")
    solve = assembly.solve if solver == "own" else calculix.quasi_static
    solved = assembly.in_newton(solve(coarser), spec.unit)
    if solved.num_frames <= frame:
        raise SimulationError(str(solved.attributes["stopped_by"]))
    return float(_curve(solved, quantity)[frame])


def _curve(solved: Trajectory, quantity: str) -> np.ndarray:
    """[S] the magnitude of the force or the torque in each frame."""
    return np.abs(solved.attributes["torque" if quantity == "torque" else "reaction"])
