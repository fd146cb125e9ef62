"""How the parts stand and move: from meshes and values of the parameters to a case for the solver.

All lengths are in the unit of the specification; the solver has none of its own. Positions are relative to `origin`,
because float32 would be too coarse for small parts far from the origin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ast_sim.importers.shells import find_shells
from ast_sim.material import ELASTIC, YOUNG, Material
from ast_sim.mechanics.case import NEXT_NOTE, NOTES, SolidCase
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.motion_between_frames import Course, MovedNodes
from ast_sim.number_arrays import point
from ast_sim.scene import AttributeValue, NodeType, Scene
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec, PartSpec
from ast_sim.simulate.own_assembly.parameters import Values, completed, recorded
from ast_sim.simulate.own_assembly.part_mesh import PartMesh, part_meshes
from ast_sim.simulate.own_assembly.touching import set_back
from ast_sim.simulate.own_assembly.yielding import hardening_columns, hardening_of, material_columns
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import ConfigError

NEAR_ORIGIN = 10  # diagonals of the assembly from the origin up to which positions stay as they are
CONTACT_SHARE = 5e-4  # contact distance, as a share of the diagonal
SOFTEST = 1e3  # pascal: a smaller Young's modulus is probably meant in MPa


@dataclass(frozen=True)
class Reference:
    """What all scenes of a specification share. It follows from the scene with all parameters in the middle.

    Attributes:
        origin: [3] the point that positions are relative to.
        contact_distance: distance below which surfaces repel each other.
        stiffness: of contact, in pascal.
    """

    origin: tuple[float, float, float]
    contact_distance: float
    stiffness: float


@dataclass(frozen=True, eq=False)
class PlacedPart:
    """A part as it stands.

    Attributes:
        part: what the specification says of it.
        position: [N,3] float64, in the assembly.
        cells: [E,4] or [E,10] tetrahedra, [F,3] triangles of a rigid surface.
        moves: [N] 0 for nodes that stand still, k + 1 for the nodes of the k-th move, -1 for free nodes.
        notes: what a user should know of it, a sentence each.
    """

    part: PartSpec
    position: np.ndarray
    cells: np.ndarray
    moves: np.ndarray
    notes: tuple[str, ...]


def reference(spec: AssemblySpec) -> Reference:
    """What all scenes of a specification share; errors as `placed`."""
    values = completed(spec.parameters, {})
    points = np.concatenate([part.position for part in placed(spec, values)])
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    diagonal = float(np.linalg.norm(high - low))
    origin = np.zeros(3)
    if np.abs(centre).max() > NEAR_ORIGIN * diagonal:
        step = 10.0 ** math.floor(math.log10(diagonal))
        origin = step * np.round(centre / step)
    young = [float(values[f"{part.name}.young"]) for part in spec.parts if not part.rigid]
    if not young:
        raise ConfigError(f"{spec.path}: all parts are rigid, so nothing deforms")
    distance = spec.contact_distance or float(f"{CONTACT_SHARE * diagonal:.2g}")
    x, y, z = origin.tolist()
    return Reference((x, y, z), distance, float(f"{np.exp(np.mean(np.log(young))):.3g}"))


def placed(spec: AssemblySpec, values: Values, factor: float = 1.0, halved: bool = False) -> list[PlacedPart]:
    """All parts as they stand, with what holds and moves them.

    Args:
        factor, halved: as for `part_meshes`.

    Raises:
        ConfigError: a region holds no node, or nodes are both fixed and moved; or as in `part_meshes`.
    """
    meshes = part_meshes(spec, values, factor, halved)
    return [_placed(part, mesh, values) for part, mesh in zip(spec.parts, meshes, strict=True)]


def _placed(part: PartSpec, mesh: PartMesh, values: Values) -> PlacedPart:
    position = part.placement.motion(values).at(1.0, mesh.position)
    if part.rigid:
        return PlacedPart(part, position, mesh.cells, np.full(len(position), len(part.moves)), mesh.notes)
    moves = np.full(len(position), -1)
    regions = [(f"parts.{part.name}.fixed", part.fixed), *((move.key, move.places) for move in part.moves)]
    for number, (key, places) in enumerate(regions):
        nodes = mesh.nodes_in(places, key)
        twice = nodes & (moves >= 0)
        if twice.any():
            other = regions[moves[twice][0]][0]
            raise ConfigError(
                f"{key}: {twice.sum()} of its nodes are also in {other}, the first at {point(mesh.position[twice][0])}"
            )
        moves[nodes] = number
    return PlacedPart(part, position, mesh.cells, moves, mesh.notes)


def case(spec: AssemblySpec, values: Values, frames: int, parts: list[PlacedPart], shared: Reference) -> SolidCase:
    """The case of the parts as they stand, with their motion in `frames` frames.

    Raises:
        ConfigError: a motion cannot be computed, a material is not allowed, or friction is negative.
    """
    parts = [_layered(part, [p for p in parts if not p.part.rigid], spec.order) for part in parts]
    parts, touching = _set_back(spec, parts, shared)
    offset = np.cumsum([0, *(len(part.position) for part in parts)])
    body = np.repeat(np.arange(len(parts)), np.diff(offset)).astype(np.int32)
    elements = np.concatenate([part.cells + start for part, start in zip(parts, offset, strict=False)])
    types = [np.where(part.moves < 0, NodeType.NORMAL, NodeType.HANDLE) for part in parts]
    types = [np.full(len(t), NodeType.OBSTACLE) if p.part.rigid else t for p, t in zip(parts, types, strict=True)]
    contact = _contact(spec, values, shared)
    material = _material(spec, values, contact)[body[elements[:, 0]]]
    scene = Scene(
        rest_position=(np.concatenate([part.position for part in parts]) - shared.origin).astype(np.float32),
        elements=elements.astype(np.int32),
        node_type=np.concatenate(types).astype(np.uint8),
        body=body,
        material=material,
    )
    columns = Material(tuple(material_columns(spec, friction_is_drawn(spec))))
    law = np.stack([columns.numbers(name, material) for name in ELASTIC])
    deforms = law[ELASTIC.index(YOUNG)] > 0
    law[:, ~deforms] = law[:, [np.argmax(deforms)]]  # what rigid elements have is ignored, but must be constants
    course = _course(scene, parts, values, frames, np.array(shared.origin))
    attributes: dict[str, AttributeValue] = {**recorded(values), "origin": list(shared.origin)}
    notes = dict.fromkeys([*(note for part in parts for note in part.notes), *touching, *_soft(spec, values)])
    attributes |= {NOTES: NEXT_NOTE.join(notes)} if notes else {}
    tables = [hardening_of(part, values) for part in spec.parts]
    hardening = {number: table for number, table in enumerate(tables) if len(table)}
    return SolidCase(scene, course.position, NeoHookean(*law), contact, "node", attributes, course, hardening)


def _set_back(spec: AssemblySpec, parts: list[PlacedPart], shared: Reference) -> tuple[list[PlacedPart], list[str]]:
    """The parts, set back where they touch, and notes on it."""
    bodies, names = [(part.position, part.cells) for part in parts], [part.part.name for part in parts]
    rigid = tuple(part.part.rigid for part in parts)
    position, notes = set_back(bodies, names, rigid, shared.contact_distance, spec.unit)
    return [replace(part, position=after) for part, after in zip(parts, position, strict=True)], notes


def _course(scene: Scene, parts: list[PlacedPart], values: Values, frames: int, origin: np.ndarray) -> Course:
    """How the prescribed nodes move; free nodes stay at rest."""
    rest = scene.rest_position.astype(np.float64)
    moved = []
    for number, part in enumerate(parts):
        of_body = np.flatnonzero(scene.body == number)
        for move, one in enumerate(part.part.moves):
            nodes = of_body[part.moves == move + 1]
            moved.append(MovedNodes(nodes, rest[nodes], one.motion(values), origin, one.key))
    return Course.of(rest, scene.prescribed, tuple(moved), frames)


def _contact(spec: AssemblySpec, values: Values, shared: Reference) -> ContactSettings:
    pairs = tuple((a, b, friction(values)) for (a, b), friction in spec.pair_friction.items())
    alone = tuple(number for number, part in enumerate(spec.parts) if part.self_contact and not part.rigid)
    friction = float(values["friction"])
    if min([friction, *(coefficient for _, _, coefficient in pairs)]) < 0:
        raise ConfigError(f"friction is {friction:g}; must be at least 0")
    return ContactSettings(shared.contact_distance, shared.stiffness, friction, alone or False, pairs)


def _material(spec: AssemblySpec, values: Values, contact: ContactSettings) -> np.ndarray:
    """[bodies, columns] float32: Young's modulus, Poisson's ratio, where it is drawn the largest friction with another
    part, and where parts yield their hardening; zeros in the first two for rigid parts."""
    count = len(spec.parts)
    rows = np.zeros((count, len(ELASTIC)))
    for number, part in enumerate(spec.parts):
        if not part.rigid:
            rows[number] = [values[f"{part.name}.{name}"] for name in ELASTIC]
            NeoHookean(*rows[number])
    if friction_is_drawn(spec):
        others = [[contact.friction_between(a, b) for b in range(count) if b != a] for a in range(count)]
        rows = np.column_stack([rows, np.max(others, axis=1)])
    return np.column_stack([rows, hardening_columns(spec, values)]).astype(np.float32)


def _soft(spec: AssemblySpec, values: Values) -> Iterator[str]:
    """A note on each modulus and each yield stress that looks like one in other units."""
    moduli = {f"{part.name}.young": float(values[f"{part.name}.young"]) for part in spec.parts if not part.rigid}
    yields = {f"{part.name}.hardening": part.hardening[0][0](values) for part in spec.parts if part.hardening}
    for name, value in {**moduli, **yields}.items():
        if value < SOFTEST:
            yield f"{name} is {value:.4g} Pa; moduli are in pascal in every unit of length, and 1 MPa is 1e6"


def friction_is_drawn(spec: AssemblySpec) -> bool:
    """Whether scenes differ in a coefficient of friction."""
    drawn = {name for name, one in spec.parameters.items() if one.is_drawn}
    formulas = [*spec.pair_friction.values(), *filter(None, [spec.parameters["friction"].formula])]
    return "friction" in drawn or any(one.names & drawn for one in formulas)


def _layered(part: PlacedPart, deforming: list[PlacedPart], order: int) -> PlacedPart:
    """A rigid surface as a thin layer of tetrahedra behind it, because all elements of a scene are of one kind."""
    if part.cells.shape[1] != 3:
        return part
    count = len(part.position)
    points = np.concatenate([part.position, *(other.position for other in deforming)])
    starts = count + np.cumsum([0, *(len(other.position) for other in deforming)])
    bodies = np.concatenate([other.cells + start for other, start in zip(deforming, starts, strict=False)])
    shells = find_shells(points, bodies, [part.cells])
    assert shells is not None and len(shells.nodes) == count  # no part shares a node with another
    behind = shells.behind(points)
    tetrahedra = shells.tetrahedra(np.concatenate([points, behind]))
    tetrahedra = np.where(tetrahedra >= len(points), tetrahedra - len(points) + count, tetrahedra)
    position = np.concatenate([part.position, behind])
    if order == 2:
        position, tetrahedra = second_order(position, tetrahedra)
    return PlacedPart(part.part, position, tetrahedra, np.full(len(position), part.moves[0]), part.notes)
