"""Scene family `assembly`: the parts of one product, from a specification of the user; see `simulate.own_assembly`.

Lengths are in the unit of the specification. Forces and energies of a trajectory are in newton and joule all the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.mechanics import Checkpoint, Drawn, SolidCase, SolverSettings, quasi_static
from ast_sim.named_field import REACTION
from ast_sim.scene import Trajectory
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.linear_limits import Limit, limits
from ast_sim.simulate.own_assembly.parameters import Values, completed, drawn, told
from ast_sim.simulate.own_assembly.rest_check import BadAssembly, check
from ast_sim.simulate.own_assembly.standing import PlacedPart, Reference, case, placed, reference
from ast_sim.simulate.shapes.cad.gmsh_process import MeshingFailed
from ast_sim.simulate.shapes.mesh_check import BadMesh
from ast_sim.support.errors import ConfigError, SimulationError, warn

DRAWS = 10  # draws of the parameters before a sample is given up
MESHES = 4  # further meshes, at most, are made to come near to a wanted number of nodes
NODE_TOLERANCE = 0.1  # of the wanted number: this is near
# Elements are longer by this power of the factor by which nodes are fewer: between the powers for surfaces and for
# volumes. It is larger where elements are about as long as the part: its shape then sets the number of nodes.
USUAL_POWER, LARGEST_POWER = 0.4, 2.0
LEAST_SHARE = 0.97  # a coarser mesh has at most this share of the nodes, or there is none
SETTINGS = SolverSettings(force_tolerance=1e-3, max_iterations=200)
DEFAULT_NODES = None
MINIMUM_NODES = 20
MINIMUM_FRAMES = 2
# Units of the solver, pascal and the unit of length, in newton and joule: the power of the length in each product.
_POWERS = {"reaction": 2, "torque": 3, "elastic_energy": 3, "contact_energy": 3, "dissipation": 3, "work": 3}


def info(spec: AssemblySpec) -> dict[str, Any]:
    """The fields of `DatasetInfo` but the domain and the generator."""
    shared = reference(spec)
    return {
        "family": "assembly",
        "integration": "quasi_static",
        "stress_location": "node",
        "contact_radius": 3 * shared.contact_distance,
        "time_step": 0.0,
        "length_unit": spec.unit,
    }


def draw_scene(spec: AssemblySpec, sample: tuple[int, int, int], nodes: int | None, frames: int) -> Drawn:
    """The scene of a sample.

    Args:
        sample: the seed, the number of the split, and the number of the sample in it.
        nodes: about how many nodes it has; None: as the sizes of the specification give.
        frames: frames of the motion.

    Raises:
        SimulationError: none of `DRAWS` draws gave a scene. The text says why the first did not.
    """
    first: SimulationError | None = None
    shared = reference(spec)
    for attempt in range(DRAWS):
        values = drawn(spec.parameters, *sample, attempt)
        try:
            scene = scene_of(spec, values, nodes, frames, shared)
        except (BadMesh, MeshingFailed, BadAssembly) as error:
            first = first or error
            continue
        case = replace(scene.case, attributes={**scene.case.attributes, "redrawn": attempt})
        return replace(scene, case=case)
    raise SimulationError(f"none of {DRAWS} draws gave a scene; the first: {first}") from first


def scene_of(
    spec: AssemblySpec, values: Values, nodes: int | None, frames: int, shared: Reference | None = None
) -> Drawn:
    """The scene with these values of the parameters, checked, and its other meshes.

    Raises:
        BadMesh, MeshingFailed, BadAssembly: the text names the part, what is wrong, where, and the values.
        ConfigError: a region holds no node, or a number is not allowed.
    """
    shared = shared or reference(spec)
    try:
        factor, parts = _sized(spec, values, nodes)
        made = _checked(spec, values, frames, parts, shared)
    except (BadMesh, MeshingFailed, BadAssembly) as error:
        raise type(error)(f"with {told(spec.parameters, values)}: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"{spec.path.name}, with {told(spec.parameters, values)}: {error}") from error
    return Drawn(made, partial(_remeshed, spec, values, frames, shared, factor, made.scene.num_nodes))


def resized(spec: AssemblySpec, values: Values, nodes: int | None, frames: int, relative: float) -> SolidCase:
    """The scene with these values whose elements are `relative` times as long; errors as `scene_of`.

    Elements of mesh files keep their size, unless `relative` is a half.
    """
    factor, _ = _sized(spec, values, nodes)
    parts = placed(spec, values, factor * relative, halved=relative == 0.5)
    return _checked(spec, values, frames, parts, reference(spec))


def check_spec(spec: AssemblySpec, nodes: int | None, frames: int, keep: tuple[int, ...] | None = None) -> None:
    """Make, but do not solve, the scene in the middle of all ranges and the scenes at the ends of each range.

    Warnings tell each of their notes, and for each part the worst that linear elements get wrong in it.

    Raises:
        SimulationError, ConfigError: as `scene_of`.
    """
    shared = reference(spec)
    notes = {}
    worst: dict[tuple[str, str], Limit] = {}
    for values in ends_of_ranges(spec):
        case = scene_of(spec, values, nodes, frames, shared).case
        notes |= dict.fromkeys((case if keep is None else case.keeping(keep)).notes())
        for limit in limits(spec, case):
            key = limit.part, limit.kind
            worst[key] = max(limit, worst.get(key, limit), key=lambda one: one.badness)
    for note in [*notes, *(limit.text for limit in worst.values())]:
        warn(note)


def ends_of_ranges(spec: AssemblySpec) -> Iterator[Values]:
    """Values in the middle of all ranges, then values with one parameter at an end of its range."""
    yield completed(spec.parameters, {})
    for name, one in spec.parameters.items():
        for end in one.ends if one.is_drawn else ():
            yield completed(spec.parameters, {name: end})


def solve(case: SolidCase, checkpoint: Checkpoint | None = None, patient: bool = False) -> Trajectory:
    """Solve a drawn scene."""
    return quasi_static(case, SETTINGS, checkpoint, patient)


def in_newton(trajectory: Trajectory, unit: str) -> Trajectory:
    """The trajectory with forces in newton and energies in joule; lengths and areas stay in the unit of length."""
    attributes = dict(trajectory.attributes)
    for name, power in _POWERS.items():
        if name not in attributes:
            continue
        attributes[name] = (LENGTH_UNITS[unit] ** power * np.asarray(attributes[name])).tolist()
    fields = dict(trajectory.fields)
    if REACTION in fields:
        scale = np.float32(LENGTH_UNITS[unit] ** 2)
        fields[REACTION] = replace(fields[REACTION], values=scale * fields[REACTION].values)
    return replace(trajectory, attributes=attributes, fields=fields)


def _sized(spec: AssemblySpec, values: Values, nodes: int | None) -> tuple[float, list[PlacedPart]]:
    """The factor of all element sizes with which the scene has about that many nodes, and the parts."""
    factor = 1.0
    parts = placed(spec, values)
    if not nodes:
        return factor, parts
    best = (factor, parts)
    power = USUAL_POWER
    for _ in range(MESHES):
        count = sum(len(part.position) for part in parts)
        if abs(count - nodes) < abs(sum(len(part.position) for part in best[1]) - nodes):
            best = factor, parts
        if abs(count - nodes) <= NODE_TOLERANCE * nodes:
            break
        change = (count / nodes) ** power
        factor *= change
        parts = placed(spec, values, factor)
        fewer = count / sum(len(part.position) for part in parts)
        power = (
            float(np.clip(np.log(change) / np.log(fewer), USUAL_POWER, LARGEST_POWER)) if fewer != 1 else LARGEST_POWER
        )
    return best


def _checked(spec: AssemblySpec, values: Values, frames: int, parts: list[PlacedPart], shared: Reference) -> SolidCase:
    made = case(spec, values, frames, parts, shared)
    check(spec, made, shared)
    return made


def _remeshed(
    spec: AssemblySpec, values: Values, frames: int, shared: Reference, factor: float, nodes: int, share: float
) -> SolidCase:
    """The same scene on a mesh with that share of the nodes.

    Raises:
        BadMesh, MeshingFailed, BadAssembly: there is no such mesh.
    """
    made = _checked(spec, values, frames, placed(spec, values, factor * share**-0.4), shared)
    if share < 1 and made.scene.num_nodes > LEAST_SHARE * nodes:
        raise BadMesh("there is no coarser mesh of these parts")
    return made
