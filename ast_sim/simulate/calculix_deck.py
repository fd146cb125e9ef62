"""The input deck of a quasi-static case for CalculiX: mesh, materials, contact, prescribed motion, output.

Nodes and elements keep their order and are numbered from 1. The keywords are those of the CalculiX CrunchiX manual.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import TextIO

import numpy as np

from ast_sim.data.scene import NodeType, Scene
from ast_sim.errors import SimulationError
from ast_sim.simulate.case import SolidCase

# Node sets of the faces S1 to S4 of a C3D4.
CALCULIX_FACES = ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3))


@dataclass(frozen=True)
class Increments:
    """How a load step is cut, in frames.

    Attributes:
        stiffness: factor of the default contact stiffness.
        largest: longest increment.
        smallest: shortest increment; needing a shorter one ends the solve.
    """

    stiffness: float = 1.0
    largest: float = 1.0
    smallest: float = 1e-5


def moving_nodes(case: SolidCase) -> np.ndarray:
    """[N] bool: prescribed nodes that leave their place at any time."""
    return case.scene.prescribed & (case.targets != case.targets[0]).any(axis=(0, 2))


def contact_stiffness(case: SolidCase) -> float:
    """Pressure per penetration in Pa/m: 100 E/h, E of the softest deforming element, h the mean edge of the surface."""
    scene = case.scene
    young = np.broadcast_to(case.material.young, scene.num_elements)[case.deforming]
    return 100 * float(young.min()) / _mean_edge(scene, case.deforming)


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
        SimulationError: elements that are no tetrahedra, or nothing that moves.
    """
    if case.scene.elements.shape[1] != 4:
        raise SimulationError("CalculiX is used for tetrahedra only; solve cloth with the own solver")
    if not moving_nodes(case).any():
        raise SimulationError("CalculiX needs prescribed nodes that move, this case has none in its frames")
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
    yield "*ELEMENT, TYPE=C3D4, ELSET=ELEMENTS"
    for number, nodes in enumerate(scene.elements + 1, start=1):
        yield f"{number}, " + ", ".join(map(str, nodes))
    constants = np.empty((scene.num_elements, 2))
    constants[:, 0], constants[:, 1] = case.material.young, case.material.poisson
    constants[~case.deforming] = constants[case.deforming][0]  # rigid: moved as a whole, whatever they are made of
    kinds, kind = np.unique(constants, axis=0, return_inverse=True)
    for number, (young, poisson) in enumerate(kinds):
        yield f"*ELSET, ELSET=MATERIAL{number}"
        yield from _rows(np.flatnonzero(kind.ravel() == number))
        yield f"*MATERIAL, NAME=CIARLET_EL_{number}"
        yield "*USER MATERIAL, CONSTANTS=2"
        yield f"{young:.9e}, {poisson:.9e}"
        yield f"*SOLID SECTION, ELSET=MATERIAL{number}, MATERIAL=CIARLET_EL_{number}"
    yield "*NSET, NSET=MOVING"
    yield from _rows(np.flatnonzero(moving_nodes(case)))


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
    yield "*SURFACE INTERACTION, NAME=CONTACT"
    yield "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR"
    yield f"{stiffness:.9e}"
    if case.contact.friction > 0:
        yield "*FRICTION"
        yield f"{case.contact.friction:.9e}, {stiffness / 10:.9e}"
    edge = {body: _mean_edge(scene, scene.body[scene.elements[:, 0]] == body) for body in bodies}
    rigid = {body: bool((scene.node_type[scene.body == body] == NodeType.OBSTACLE).all()) for body in bodies}
    for pair in combinations(bodies, 2):
        # The finer surface is the slave; of an obstacle and a body the obstacle is the master.
        slave, master = sorted(pair, key=lambda body: (rigid[body], edge[body]))
        if not (rigid[slave] and rigid[master]):
            yield "*CONTACT PAIR, INTERACTION=CONTACT, TYPE=SURFACE TO SURFACE"
            yield f"BODY{slave}, BODY{master}"


def _surface_faces(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Element and face number (0 to 3, for S1 to S4) of each boundary face."""
    faces = np.sort(scene.elements[:, np.array(CALCULIX_FACES)].reshape(-1, 3), axis=1)
    _, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    return np.divmod(np.sort(first[count == 1]), 4)


def _steps(case: SolidCase, increments: Increments) -> Iterator[str]:
    """A step of one unit of time for each frame, which ends there exactly.

    One step with *TIME POINTS would save some iterations, but CalculiX 2.20 passes over a point that it reaches within
    rounding after an increment was cut, and fails at the next increment, of length -4e-15.
    """
    prescribed = np.flatnonzero(case.scene.prescribed)
    only_last = "FREQUENCY=1000000"
    for target in case.targets[1:]:
        yield "*STEP, NLGEOM, INC=100000"
        yield "*STATIC"
        yield f"{increments.largest}, 1., {increments.smallest}, {increments.largest}"
        yield "*BOUNDARY"
        displacement = target[prescribed] - case.targets[0, prescribed]
        for node, vector in zip(prescribed + 1, displacement, strict=True):
            for axis, value in enumerate(vector, start=1):
                yield f"{node}, {axis}, {axis}, {value:.9e}"
        yield f"*NODE FILE, {only_last}"
        yield "U"
        yield f"*EL PRINT, ELSET=ELEMENTS, {only_last}"
        yield "S"
        yield f"*NODE PRINT, NSET=MOVING, TOTALS=ONLY, {only_last}"
        yield "RF"
        yield "*END STEP"
