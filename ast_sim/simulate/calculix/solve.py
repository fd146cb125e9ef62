"""CalculiX (`ccx`) as a second solver of quasi-static cases: an independent check of the bundled solver.

Mesh, material (CIARLET_EL) and motion of the prescribed nodes are the same; bodies that yield (*PLASTIC) are solved by
CalculiX only. Contact differs: CalculiX uses a face-to-face penalty, so surfaces penetrate a little. The barrier of the
bundled solver leaves a little air instead.
"""

from __future__ import annotations

import resource
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import von_mises
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.named_field import PLASTIC_STRAIN, REACTION, NamedField
from ast_sim.scene import AttributeValue, Trajectory
from ast_sim.simulate.calculix.ccx_results import Results, read_results
from ast_sim.simulate.calculix.deck import Increments, contact_stiffness, write_deck
from ast_sim.simulate.calculix.program import JOB, Ended, find_ccx, run, version
from ast_sim.support.errors import SimulationError

POINTS = {4: 1, 10: 4}  # of integration, by the number of nodes of an element
# These are tried one after another until all frames converge: first softer contact, then shorter increments, too.
LADDER = (Increments(), Increments(stiffness=0.1), Increments(stiffness=0.1, largest=0.5))
# Those where bodies yield: shorter increments follow the load path.
YIELDING = (Increments(1.0, 0.25, 0.05), Increments(1.0, 0.05, 0.01), Increments(0.1, 0.05, 0.01))


@dataclass(frozen=True)
class CalculixSettings:
    """How CalculiX is run.

    Attributes:
        ladder: increments that are tried one after another until all frames converge; None: `YIELDING` if a body of
            the case yields, else `LADDER`.
        timeout: seconds after which one attempt is killed.
    """

    ladder: tuple[Increments, ...] | None = None
    timeout: float = 7200.0


def quasi_static(case: SolidCase, settings: CalculixSettings | None = None) -> Trajectory:
    """Solve a case with CalculiX.

    Args:
        case: what to solve. CalculiX does not hold a body apart from itself.
        settings: the attempts and their time limit.

    Returns:
        The frames of the attempt that reached the most, up to the first in which an element is inverted or a body
        intersects itself. `solve_seconds` is shared out among the frames in proportion to their iterations.

    Raises:
        MissingExtra: CalculiX is not installed.
        SimulationError: CalculiX is not used for such a case, ccx refuses the deck, or the output cannot be read. The
            folder with deck and output is then kept and named.
    """
    settings = settings or CalculixSettings()
    case, stored = case.followed()
    ccx = find_ccx()
    solver = f"calculix {version(ccx)}"
    first, *others = settings.ladder or (YIELDING if case.hardening else LADDER)
    best = _attempt(case, ccx, first, settings.timeout)
    for increments in others:
        if best.attributes["status"] == "complete":
            break
        trajectory = _attempt(case, ccx, increments, settings.timeout)
        if trajectory.num_frames > best.num_frames:
            best = trajectory
    return _with_frames(replace(best, attributes={**best.attributes, "solver": solver}), stored)


def _with_frames(trajectory: Trajectory, stored: list[int]) -> Trajectory:
    """The trajectory with the frames `stored` only; what was spent on the frames before one of them counts for it."""
    rows = [row for row in stored if row < trajectory.num_frames]
    if len(stored) == stored[-1] + 1:
        return trajectory
    attributes = dict(trajectory.attributes)
    for name, values in attributes.items():
        if isinstance(values, list) and len(values) == trajectory.num_frames:
            attributes[name] = [values[row] for row in rows]
            if name in ("solve_seconds", "newton_iterations", "halvings"):
                attributes[name] = np.diff(np.cumsum(values)[rows], prepend=0).tolist()
    if "stopped_by" in attributes:
        attributes["stopped_by"] = f"before frame {len(rows)}: {attributes['stopped_by']}"
    framed = {key: getattr(trajectory, key) for key in ("position", "stress", "cauchy_stress")}
    framed = {key: array[rows] for key, array in framed.items() if array is not None}
    fields = {name: one.select(rows) for name, one in trajectory.fields.items()}
    return replace(trajectory, attributes=attributes, fields=fields, **framed)


def _attempt(case: SolidCase, ccx: str, increments: Increments, timeout: float) -> Trajectory:
    """One run in a folder of its own."""
    folder = Path(tempfile.mkdtemp(prefix="ast_sim-calculix-"))
    try:
        with open(folder / f"{JOB}.inp", "w", encoding="ascii") as file:
            write_deck(file, case, increments)
        before = _processor_seconds()
        results = None
        try:
            stopped_by = run(ccx, folder, timeout)
        except Ended as error:
            stopped_by = str(error)
            results = Results.none(case.scene.num_nodes, case.scene.num_elements, bool(case.hardening))
        seconds = _processor_seconds() - before
        trajectory = _trajectory(case, results or _results(case, folder), increments, stopped_by, seconds)
    except SimulationError as error:
        raise SimulationError(f"{error} (deck and output are kept in {folder})") from error
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder)
    return trajectory


def _processor_seconds() -> float:
    """Processor time of all programs that this process has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _results(case: SolidCase, folder: Path) -> Results:
    scene = case.scene
    points = POINTS[scene.elements.shape[1]]
    size = len(case.prescribed_position) - 1, scene.num_nodes, scene.num_elements, points
    return read_results(folder, JOB, *size, yields=bool(case.hardening))


def _trajectory(
    case: SolidCase, results: Results, increments: Increments, stopped_by: str, seconds: float
) -> Trajectory:
    """The converged frames up to the first that fails a check, with the records that CalculiX gives."""
    scene = case.scene
    rest = scene.rest_position.astype(np.float64)
    position = np.concatenate([rest[None], rest + results.displacement])
    position[:, scene.prescribed] = case.prescribed_position[: len(position), scene.prescribed]
    position = position.astype(np.float32)
    jacobian, failure = _check(case, position)
    frames = len(jacobian)
    status: dict[str, AttributeValue] = {"status": "complete"}
    if frames < len(case.prescribed_position):
        status = {"status": "truncated", "stopped_by": f"frame {frames}: {failure or stopped_by}"}
    iterations = np.concatenate([[0], results.iterations])
    stress, cauchy_stress = _stress_arrays(case, results.stress[: frames - 1])
    return Trajectory(
        scene=scene,
        position=position[:frames],
        stress=stress,
        cauchy_stress=cauchy_stress,
        fields=_fields(case, results, frames),
        attributes={
            **status,
            **case.attributes,
            "solve_seconds": (seconds * iterations / max(iterations.sum(), 1))[:frames].tolist(),
            "newton_iterations": iterations[:frames].tolist(),
            "halvings": [0, *results.cutbacks.tolist()][:frames],
            "jacobian": jacobian,
            "min_jacobian": min(jacobian),
            "reaction": [0.0, *np.linalg.norm(results.reaction, axis=1).tolist()][:frames],
            "young": np.unique(case.material.young).tolist(),
            "poisson": np.unique(case.material.poisson).tolist(),
            "contact_stiffness": contact_stiffness(case) * increments.stiffness,
            "friction": case.contact.friction,
        },
    )


def _fields(case: SolidCase, results: Results, frames: int) -> dict[str, NamedField]:
    """Where a body yields: the equivalent plastic strain, and the forces on the prescribed nodes from outside.

    Strains that are extrapolated to nodes may be below 0 where there are none. Free nodes have no force but the rest
    of the iterations.
    """
    if results.plastic_strain is None or results.nodal_forces is None:
        return {}
    strain = np.maximum(results.plastic_strain, 0)
    forces = np.where(case.scene.prescribed[:, None], results.nodal_forces, 0)
    strain, forces = (np.concatenate([np.zeros((1, *of.shape[1:])), of]) for of in (strain, forces))
    return {
        PLASTIC_STRAIN: NamedField(strain[:frames].astype(np.float32), "node"),
        REACTION: NamedField(forces[:frames].astype(np.float32), "node", "N"),
    }


def _check(case: SolidCase, position: np.ndarray) -> tuple[list[float], str]:
    """Smallest determinant of a deformation gradient in each frame of [S,N,3] up to the first that fails, and why."""
    scene = case.scene
    elasticity = _elasticity(case)
    surface = scene.surface()
    bodies = [surface[scene.body[surface[:, 0]] == body] for body in np.unique(scene.body[case.scene.elements])]
    contacts = [Contact(scene.rest_position.astype(np.float64), faces, scene.body, case.contact) for faces in bodies]
    jacobian: list[float] = []
    for frame in position:
        if not np.isfinite(frame).all():
            return jacobian, "positions are not finite"
        smallest = float(elasticity.evaluate(frame.astype(np.float64)).J.min())
        if smallest <= 0:
            return jacobian, f"an element is inverted (det F = {smallest:.3g})"
        for body, contact in enumerate(contacts):
            if contact.intersects(frame.astype(np.float64)):
                return jacobian, f"body {body} intersects itself, which CalculiX does not prevent here"
        jacobian.append(smallest)
    return jacobian, ""


def _elasticity(case: SolidCase) -> Elasticity:
    """The deforming bodies."""
    scene = case.scene
    return deforming_body(scene, np.flatnonzero(~scene.rigid_elements), case.material)


def _stress_arrays(case: SolidCase, stress: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """The stress arrays of a trajectory as they are stored: stress, and Cauchy stress where stress is one of elements.

    A frame at rest is put before the frames of `stress` [S-1,E,6].
    """
    stress = np.concatenate([np.zeros((1, *stress.shape[1:])), stress])
    rigid = case.scene.rigid_elements
    stress[:, rigid] = 0  # it has no meaning
    mises = _von_mises(stress)
    if case.stress_location == "element":
        return mises[:, :, None].astype(np.float32), stress.astype(np.float32)
    elasticity = _elasticity(case)
    nodal = np.stack([elasticity.nodal_mean(frame[~rigid]) for frame in mises])
    return nodal[:, :, None].astype(np.float32), None


def _von_mises(stress: np.ndarray) -> np.ndarray:
    """[S,E] of the stress [S,E,6]."""
    tensor = stress.reshape(-1, 6)[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2]]]
    return von_mises(np.moveaxis(tensor, 0, -1)).reshape(stress.shape[:2])
