"""The input deck of a quasi-static case for CalculiX: mesh, materials, contact, prescribed motion, output.

Nodes and elements keep their order and are numbered from 1. The CalculiX CrunchiX manual explains the keywords.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TextIO

import numpy as np
from scipy.spatial import KDTree

from ast_sim.element_topology import equal_rows, triangle_sides, unit_normals
from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.driven import Driven
from ast_sim.scene import Scene
from ast_sim.support.errors import ConfigError, SimulationError

# The elements by their number of nodes. Their nodes have the same order as in a scene.
ELEMENT_TYPES = {4: "C3D4", 10: "C3D10"}
# The corners of the faces S1 to S4.
CALCULIX_FACES = ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3))
# A body counts as sharper than another if its convex edges are sharper by more than this angle, in radian.
SHARPER = np.pi / 12


@dataclass(frozen=True)
class Increments:
    """How a load step is cut into increments. Lengths are in frames.

    Attributes:
        stiffness: factor on the default contact stiffness.
        largest: longest increment.
        first: the increment that a frame begins with.
        smallest: shortest increment. A solve that needs a shorter one ends.
    """

    stiffness: float = 1.0
    largest: float = 1.0
    first: float = 1.0
    smallest: float = 1e-5


def contact_stiffness(case: SolidCase) -> float:
    """Pressure per penetration in Pa/m: 100 E/h, but 10 Y/h where a body yields and this is less.

    E is Young's modulus of the softest deforming element, Y the lowest yield stress, and h the mean length of the
    surface's edges. Where a tool goes back, CalculiX moves it before it looks for contact. If it moves by more than the
    surfaces have passed into each other, contact is lost and the body springs back as a whole within one iteration;
    with 100 E/h, metal and tool are some micrometres in each other, and no increment is short enough.
    """
    scene = case.scene
    young = np.broadcast_to(case.material.young, scene.num_elements)[~scene.rigid_elements]
    pressures = [100 * float(young.min()), *(10 * float(table[0, 0]) for table in case.hardening.values())]
    return min(pressures) / _mean_edge(scene, ~scene.rigid_elements)


def _mean_edge(scene: Scene, elements: np.ndarray) -> float:
    """Mean length of the edges of the surface triangles of some elements [E] bool, in metres."""
    chosen = np.zeros(scene.num_nodes, bool)
    chosen[scene.elements[elements]] = True
    surface = scene.surface()
    corners = scene.rest_position[surface[chosen[surface].all(axis=1)]].astype(np.float64)
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def write_deck(file: TextIO, case: SolidCase, increments: Increments) -> None:
    """Write the deck of a case.

    Raises:
        ConfigError: elements are not tetrahedra.
        SimulationError: nothing moves.
    """
    if case.scene.elements.shape[1] not in ELEMENT_TYPES:
        raise ConfigError("CalculiX is used for tetrahedra only: solve cloth with the own solver")
    if not (case.scene.prescribed & (case.prescribed_position != case.prescribed_position[0]).any(axis=(0, 2))).any():
        raise SimulationError("CalculiX needs prescribed nodes that move, but this case has none")
    for block in (_mesh(case), _contact(case, increments), _steps(case, increments)):
        file.writelines(line + "\n" for line in block)


def _rows(numbers: np.ndarray) -> Iterator[str]:
    """Zero-based numbers as lines of at most 16 one-based ones."""
    for start in range(0, len(numbers), 16):
        yield ", ".join(str(number + 1) for number in numbers[start : start + 16])


def _mesh(case: SolidCase) -> Iterator[str]:
    scene = case.scene
    yield "*NODE, NSET=NODES"
    for number, (x, y, z) in enumerate(scene.rest_position.astype(np.float64), start=1):
        yield f"{number}, {x:.9e}, {y:.9e}, {z:.9e}"
    yield f"*ELEMENT, TYPE={ELEMENT_TYPES[scene.elements.shape[1]]}, ELSET=ELEMENTS"
    for number, nodes in enumerate(scene.elements + 1, start=1):
        yield f"{number}, " + ", ".join(map(str, nodes))
    yield from _materials(case)
    yield "*NSET, NSET=DRIVEN"
    yield from _rows(np.flatnonzero(Driven.of(scene, case.prescribed_position).nodes))


def _materials(case: SolidCase) -> Iterator[str]:
    """A section for each material: of Ciarlet, or with a body of its own that yields."""
    scene = case.scene
    body = scene.body[scene.elements[:, 0]]
    constants = np.empty((scene.num_elements, 3))
    constants[:, 0] = case.material.young
    constants[:, 1] = case.material.poisson
    constants[:, 2] = np.where(np.isin(body, list(case.hardening)), body, -1)
    rigid = scene.rigid_elements
    constants[rigid] = constants[~rigid][0]  # moved as a whole, so no constant matters
    kinds, kind = np.unique(constants, axis=0, return_inverse=True)
    for number, (young, poisson, yielding) in enumerate(kinds):
        yield f"*ELSET, ELSET=MATERIAL{number}"
        yield from _rows(np.flatnonzero(kind.ravel() == number))
        law = "CIARLET_EL" if yielding < 0 else "ELASTOPLASTIC"
        yield f"*MATERIAL, NAME={law}_{number}"
        yield "*USER MATERIAL, CONSTANTS=2" if yielding < 0 else "*ELASTIC"
        yield f"{young:.9e}, {poisson:.9e}"
        if yielding >= 0:
            yield "*PLASTIC"
            yield from (f"{stress:.9e}, {strain:.9e}" for stress, strain in case.hardening[int(yielding)])
        yield f"*SOLID SECTION, ELSET=MATERIAL{number}, MATERIAL={law}_{number}"


def _contact(case: SolidCase, increments: Increments) -> Iterator[str]:
    scene = case.scene
    bodies = np.unique(scene.body)
    if len(bodies) == 1:
        return
    element, face = _surface_faces(scene)
    for body in bodies:
        of_body = scene.body[scene.elements[element, 0]] == body
        yield f"*SURFACE, NAME=BODY{body}, TYPE=ELEMENT"
        for number, side in zip(element[of_body] + 1, face[of_body] + 1, strict=True):
            yield f"{number}, S{side}"
    stiffness = contact_stiffness(case) * increments.stiffness
    rigid = scene.rigid_bodies
    pairs = [pair for pair in combinations(bodies, 2) if not rigid.issuperset(pair)]
    frictions = sorted({case.contact.friction_between(*pair) for pair in pairs})
    for number, friction in enumerate(frictions):
        yield f"*SURFACE INTERACTION, NAME=CONTACT{number}"
        yield "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"
        yield f"{stiffness:.9e}"
        if friction > 0:
            yield "*FRICTION"
            yield f"{friction:.9e}, {stiffness / 10:.9e}"
    for pair in pairs:
        # An obstacle is the master.
        soft = rigid.isdisjoint(pair)
        slave, master = slave_first(scene, *pair) if soft else sorted(pair, key=rigid.__contains__)
        number = frictions.index(case.contact.friction_between(*pair))
        yield f"*CONTACT PAIR, INTERACTION=CONTACT{number}, TYPE=SURFACE TO SURFACE"
        yield f"BODY{slave}, BODY{master}"


def slave_first(scene: Scene, one: int, other: int) -> tuple[int, int]:
    """Two deforming bodies in the order slave, master.

    Pressure acts along the normals of the master's faces. Where an edge of one body rests on a rounded face of the
    other, these normals must be the normals of the rounded face. Of the two bodies where they are closest, the sharper
    one is therefore the slave. If neither is sharper, the body with the finer mesh is the slave.
    """
    surface = scene.surface()
    body_of_face = scene.body[surface[:, 0]]
    faces = {body: surface[body_of_face == body] for body in (one, other)}
    position = scene.rest_position.astype(np.float64)
    mesh_size = {body: _mean_edge(scene, scene.body[scene.elements[:, 0]] == body) for body in (one, other)}
    sharpness: dict[int, float] = {}
    for body, opposite in ((one, other), (other, one)):
        distance, _ = KDTree(position[np.unique(faces[opposite])]).query(position)
        distance[np.setdiff1d(np.arange(scene.num_nodes), faces[body])] = np.inf
        near = distance <= distance.min() + max(mesh_size.values())
        sharpness[body] = _convex_angle(position, faces[body], near)
    if abs(sharpness[one] - sharpness[other]) > SHARPER:
        slave = max((one, other), key=lambda body: sharpness[body])
    else:
        slave = min((one, other), key=lambda body: mesh_size[body])
    return slave, other if slave == one else one


def _convex_angle(position: np.ndarray, faces: np.ndarray, near: np.ndarray) -> float:
    """Largest angle in radian between the normals on both sides of a convex edge at one of the nodes `near` [N]."""
    corners = position[faces]
    normal = unit_normals(corners)
    edges = triangle_sides(faces)
    first, second = equal_rows(edges)
    concerned = near[edges[first]].any(axis=1)
    one, other = first[concerned] // 3, second[concerned] // 3
    across = corners[other].mean(axis=1) - corners[one].mean(axis=1)
    convex = np.einsum("ij,ij->i", across, normal[one]) < 0
    cosine = np.einsum("ij,ij->i", normal[one], normal[other])[convex]
    return float(np.arccos(np.clip(cosine, -1, 1)).max(initial=0))


def _surface_faces(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Element and face number (0 to 3, for S1 to S4) of each boundary face."""
    faces = np.sort(scene.elements[:, np.array(CALCULIX_FACES)].reshape(-1, 3), axis=1)
    _, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    return np.divmod(np.sort(first[count == 1]), 4)


def _steps(case: SolidCase, increments: Increments) -> Iterator[str]:
    """For each frame, a step of one unit of time, which ends exactly at the frame.

    One step with *TIME POINTS would save some iterations. But after an increment was cut, CalculiX 2.20 passes over a
    time point that it reaches within rounding, and fails at the next increment, of length -4e-15.
    """
    prescribed = np.flatnonzero(case.scene.prescribed)
    only_last = "FREQUENCY=1000000"
    for target in case.prescribed_position[1:]:
        yield "*STEP, NLGEOM, INC=100000"
        yield "*STATIC"
        yield f"{min(increments.first, increments.largest)}, 1., {increments.smallest}, {increments.largest}"
        yield "*BOUNDARY"
        displacement = target[prescribed] - case.prescribed_position[0, prescribed]
        for node, vector in zip(prescribed + 1, displacement, strict=True):
            for axis, value in enumerate(vector, start=1):
                yield f"{node}, {axis}, {axis}, {value:.9e}"
        yield f"*NODE FILE, {only_last}"
        yield "U, RF" if case.hardening else "U"
        if case.hardening:
            yield f"*EL FILE, {only_last}"
            yield "PEEQ"
        yield f"*EL PRINT, ELSET=ELEMENTS, {only_last}"
        yield "S"
        yield f"*NODE PRINT, NSET=DRIVEN, TOTALS=ONLY, {only_last}"
        yield "RF"
        yield "*END STEP"
