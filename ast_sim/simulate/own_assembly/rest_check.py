"""Checks of a drawn assembly before it is solved. Each mistake of a specification gives one line that says where.

Legend: N nodes.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.linearised.contact_forces import presses_itself_at_rest
from ast_sim.number_arrays import point
from ast_sim.plausibility.overlaps import below_faces, deepest_node
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.standing import Reference
from ast_sim.simulate.shapes.parts import quarters
from ast_sim.support.errors import SimulationError, counted

ON_A_LINE = 1e-3  # points lie on a line if their second extent, as a share of the first, is below this


class BadAssembly(SimulationError):
    """Parts that cannot be solved as they stand. Other values of the parameters may do."""


def check(spec: AssemblySpec, case: SolidCase, shared: Reference) -> None:
    """Check the assembly at rest, and its prescribed nodes in all frames.

    Raises:
        BadAssembly: nothing holds a part, no node is free, parts overlap or are closer than the contact distance, a
            part comes too close to itself, or prescribed nodes turn an element over.
    """
    _check_held(spec, case)
    _check_turned_over(spec, case)
    if case.scene.prescribed.all():
        raise BadAssembly("all nodes are fixed or moved, so nothing deforms: hold fewer of them, or mesh finer")
    rest = case.scene.rest_position.astype(np.float64)
    for pair in combinations(range(len(spec.parts)), 2):
        _check_apart(spec, case, rest, pair, shared)
    _check_self_contact(spec, case)


def _check_held(spec: AssemblySpec, case: SolidCase) -> None:
    scene = case.scene
    for number, part in enumerate(spec.parts):
        held = scene.rest_position[(scene.body == number) & scene.prescribed].astype(np.float64)
        if part.rigid:
            continue
        if not len(held):
            raise BadAssembly(
                f"nothing holds {part.name}: give parts.{part.name} a region that is fixed or moved, or make it rigid"
            )
        extents = np.linalg.svd(held - held.mean(axis=0), compute_uv=False)
        if len(held) < 3 or extents[1] <= ON_A_LINE * extents[0]:
            raise BadAssembly(
                f"{part.name} is held at {counted(len(held), 'node')}, on one line, around which it could turn: hold"
                " more"
            )


def _check_turned_over(spec: AssemblySpec, case: SolidCase) -> None:
    """Elements whose nodes are all prescribed cannot give way."""
    scene = case.scene
    rows = scene.elements[scene.prescribed[scene.elements].all(axis=1) & ~scene.rigid_elements]
    followed, stored = case.followed()
    for row, position in enumerate(followed.prescribed_position):
        wrong = (quarters(position, rows) <= 0).any(axis=0)
        if wrong.any():
            first = rows[np.argmax(wrong)]
            name = spec.parts[scene.body[first[0]]].name
            raise BadAssembly(
                f"{name}: its prescribed nodes turn {counted(wrong.sum(), 'element')} over between rest and frame"
                f" {np.searchsorted(stored, row)}, the first at"
                f" {point(case.prescribed_position[0][first].mean(axis=0))}: make the motion smaller"
            )


def _check_apart(
    spec: AssemblySpec, case: SolidCase, rest: np.ndarray, pair: tuple[int, int], shared: Reference
) -> None:
    """Raise BadAssembly if two parts overlap, or if contact would act between them at rest."""
    first, second = pair
    if spec.parts[first].rigid and spec.parts[second].rigid:
        return
    faces = [surface_of(case, number) for number in pair]
    names = f"{spec.parts[first].name} and {spec.parts[second].name}"
    contact = _contact_of(case, pair)
    depth, where = deepest_node(rest, *faces)
    crossing = contact.intersects(rest)
    if crossing or depth > 0:
        told = f"overlap at rest by {depth:.3g} {spec.unit} at" if depth > 0 else "cut each other at rest near"
        where = where if depth > 0 else nearest_node(rest, *faces)
        slight = 2 * shared.contact_distance  # surfaces that touch were set back by about the half
        overlap = below_faces(rest, faces[0], faces[1], slight) if 0 < depth < slight else None
        if overlap is not None:
            told = "stand at the same place, wholly or in part, around"
            where = overlap.where
        where = where + shared.origin
        raise BadAssembly(
            f"{names} {told} {point(where)}: move one of them by an offset, or mesh curved surfaces that touch finer;"
            " the parts of a press fit begin apart, and a move presses them together"
        )
    gap = contact.gap(rest)
    if gap < shared.contact_distance:
        where = nearest_node(rest, *faces) + shared.origin
        raise BadAssembly(
            f"{names} are {gap:.3g} {spec.unit} apart at rest, near {point(where)}, closer than the contact distance"
            f" {shared.contact_distance:g}: move one of them by an offset, or give a smaller contact_distance"
        )


def _check_self_contact(spec: AssemblySpec, case: SolidCase) -> None:
    bodies = case.contact.self_contact
    for number in () if isinstance(bodies, bool) else bodies:
        if presses_itself_at_rest(case.scene, number, case.contact.dhat):
            raise BadAssembly(
                f"{spec.parts[number].name}: a wall, slit or element is thinner than the contact distance"
                f" {case.contact.dhat:g} {spec.unit}: give a smaller contact_distance, or no self_contact"
            )


def gap_between(case: SolidCase, pair: tuple[int, int]) -> float:
    """The smallest distance between two bodies at rest."""
    return _contact_of(case, pair).gap(case.scene.rest_position.astype(np.float64))


def _contact_of(case: SolidCase, pair: tuple[int, int]) -> Contact:
    faces = np.concatenate([surface_of(case, number) for number in pair])
    rest = case.scene.rest_position.astype(np.float64)
    settings = ContactSettings(case.contact.dhat, 1.0)
    return Contact(rest, faces, case.scene.body, settings, ~case.scene.deforming_nodes)


def surface_of(case: SolidCase, body: int) -> np.ndarray:
    """[F,3]: the surface triangles of a body."""
    surface = case.scene.surface()
    return surface[case.scene.body[surface[:, 0]] == body]


def nearest_node(rest: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[3]: the node of the first surface that is nearest to a node of the second."""
    from scipy.spatial import KDTree

    nodes = np.unique(first)
    distance, _ = KDTree(rest[np.unique(second)]).query(rest[nodes])
    return rest[nodes[np.argmin(distance)]]
