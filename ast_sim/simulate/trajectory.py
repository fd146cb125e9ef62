"""From a script of prescribed motion to a checked trajectory.

A frame is stored only if it converged and passed its checks, which are made on the float32 positions as they are
stored: no surface intersects, bodies are apart, no element is inverted, everything is finite, and the forces that
hold clamps and obstacles balance. At the first frame that fails the trajectory ends, with status "truncated".
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from ast_sim.data.scene import NodeType, Scene, Trajectory
from ast_sim.errors import SimulationError
from ast_sim.simulate.contact import Contact
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.material import NeoHookean
from ast_sim.simulate.solver import QuasiStatic, SolverSettings

# Sum of all reactions over the sum of their magnitudes, up to which a frame counts as balanced.
REACTION_TOLERANCE = 1e-4
# Reactions below those of this strain, times Young's modulus, are as good as none.
RESTING_STRAIN = 1e-3


class CheckFailed(SimulationError):
    """A converged frame that must not be stored."""


@dataclass(frozen=True)
class FrameRecord:
    """What is stored of a frame and what its checks measured.

    Attributes:
        position: [N,3] float32.
        stress: [N,1] float32, nodal von Mises stress in pascal; 0 at nodes of obstacles.
        gap: smallest distance between bodies in metres.
        jacobian: smallest determinant of a deformation gradient.
        reaction_residual: |sum of reactions| / sum of |reactions|.
    """

    position: np.ndarray
    stress: np.ndarray
    gap: float
    jacobian: float
    reaction_residual: float


def quasi_static(
    scene: Scene,
    targets: np.ndarray,
    material: NeoHookean,
    dhat: float,
    settings: SolverSettings | None = None,
) -> Trajectory:
    """Solve for the frames in which the prescribed nodes of a scene stand at `targets`.

    Args:
        scene: tetrahedra; those of OBSTACLE nodes are rigid, all others are of `material`.
        targets: [S,N,3] positions of the prescribed nodes in metres (other rows are ignored); frame 0 is at rest.
        material: of the deforming body.
        dhat: distance in metres below which the barrier acts; its stiffness is Young's modulus.
        settings: tolerances of the solver.

    Returns:
        The frames up to the first that did not converge or failed a check, with the records as attributes.

    Raises:
        SimulationError: the scene at rest already fails its checks.
    """
    started = perf_counter()
    rest = scene.rest_position.astype(np.float64)
    rigid = (scene.node_type == NodeType.OBSTACLE)[scene.elements].all(axis=1)
    elasticity = Elasticity(rest, scene.elements[~rigid], material)
    contact = Contact(rest, scene.surface(), scene.body, dhat, material.young)
    solver = QuasiStatic(elasticity, contact, scene.prescribed, rest, settings)
    seconds, iterations = [perf_counter() - started], [0]
    frames = [check_frame(solver)]
    status = {"status": "complete"}
    for target in targets[1:]:
        started, before = perf_counter(), solver.newton_iterations
        try:
            solver.advance(target)
            elapsed = perf_counter() - started
            frames.append(check_frame(solver))
        except SimulationError as error:
            status = {"status": "truncated", "stopped_by": f"frame {len(frames)}: {error}"}
            break
        seconds.append(elapsed)
        iterations.append(solver.newton_iterations - before)
    return Trajectory(
        scene=scene,
        position=np.stack([frame.position for frame in frames]),
        stress=np.stack([frame.stress for frame in frames]),
        attributes={
            **status,
            "solve_seconds": seconds,
            "newton_iterations": iterations,
            "min_gap": min(frame.gap for frame in frames),
            "min_jacobian": min(frame.jacobian for frame in frames),
            "reaction_residual": max(frame.reaction_residual for frame in frames),
            "young": material.young,
            "poisson": material.poisson,
            "dhat": dhat,
            "kappa": material.young,
        },
    )


def check_frame(solver: QuasiStatic) -> FrameRecord:
    """The solver's state as it is stored.

    Raises:
        CheckFailed: naming the check and its value.
    """
    elasticity, contact = solver.elasticity, solver.contact
    stored = solver.position.astype(np.float32)
    stress = elasticity.nodal_mean(elasticity.von_mises(solver.deformation)).astype(np.float32)[:, None]
    if not (np.isfinite(stored).all() and np.isfinite(stress).all()):
        raise CheckFailed("positions or stress are not finite")
    position = stored.astype(np.float64)
    gap, jacobian = contact.gap(position), float(elasticity.deformation(position).J.min())
    if gap <= 0 or contact.intersects(position):
        raise CheckFailed(f"surfaces intersect (gap {gap:.3g} m)")
    if jacobian <= 0:
        raise CheckFailed(f"an element is inverted (det F = {jacobian:.3g})")
    residual = reaction_residual(solver)
    if not residual <= REACTION_TOLERANCE:
        raise CheckFailed(f"reactions do not balance (relative residual {residual:.3g})")
    return FrameRecord(stored, stress, gap, jacobian, residual)


def reaction_residual(solver: QuasiStatic) -> float:
    """|sum of the reactions of clamps and obstacles| over the sum of their magnitudes, or of the resting force."""
    reactions = solver.reactions()[solver.prescribed]
    resting = RESTING_STRAIN * solver.elasticity.material.young * solver.elasticity.force_per_stress
    magnitude = max(float(np.linalg.norm(reactions, axis=1).sum()), resting)
    return float(np.linalg.norm(reactions.sum(axis=0))) / magnitude
