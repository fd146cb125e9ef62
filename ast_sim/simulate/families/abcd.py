"""Scene family `abcd`: two CAD-like parts of two materials, squeezed together.

One part lies above the other, nearly touching it. The lower end of the lower part and the upper end of the upper part
are clamped (HANDLE). The upper clamp moves down in 20 increments by 10 to 25 % of the free height.
Lengths are scaled: the longest side of a pair is 1.8 units, and at rest the pair lies within [-1,1]^3. Mechanics
without gravity has no length of its own, so a unit counts as a metre. Every draw comes from the generator that is
passed in, in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.mechanics import Checkpoint, ContactSettings, Drawn, NeoHookean, SolidCase, SolverSettings, quasi_static
from ast_sim.mechanics.contact_and_friction import Contact
from ast_sim.scene import AttributeValue, NodeType, Scene, Trajectory
from ast_sim.simulate.shapes.cad.gmsh_process import MeshingFailed
from ast_sim.simulate.shapes.mesh_check import BadMesh
from ast_sim.simulate.shapes.pairing import HALF_EXTENT, PairOfParts, Unsuitable, put_likewise, put_together
from ast_sim.simulate.shapes.part_source import Mesher, PartSource, part_source
from ast_sim.simulate.shapes.parts import Part
from ast_sim.support.errors import SimulationError

INCREMENTS = 20
FRAMES = INCREMENTS + 1
DEFAULT_NODES = 4000
MINIMUM_NODES = 200
COARSE_ANGLE = 1.0  # smallest dihedral angle in degrees of pairs that are meshed again: enough for the solver
DRAWS = 30  # draws of parts and placements before a sample is given up
# Without friction, parts slide off each other, and that costs most iterations. Bent flanges touch their own webs.
CONTACT = ContactSettings(dhat=1e-3, stiffness=1e6, friction=0.15, self_contact=True)
# Codes for structures usually stop at 5e-3 of the mean force; 1e-3 is enough for buckling parts, too.
# When a part snaps over, its energy falls for a hundred iterations. Halved load steps would only meet the same fall.
SETTINGS = SolverSettings(force_tolerance=1e-3, max_iterations=200)
YOUNG = (5e5, 2e6)  # pascal; its logarithm is drawn uniformly
POISSON = (0.25, 0.4)
CRUSH = (0.1, 0.25)
INFO = DatasetInfo(
    family="abcd",
    integration="quasi_static",
    stress_location="element",
    domain_center=(0.0, 0.0, 0.0),
    domain_half_width=1.25,  # parts bulge
    contact_radius=0.003,
    time_step=0.0,
)


@dataclass(frozen=True)
class _Squeeze:
    """What the parts are made of, and how far they are squeezed.

    Attributes:
        young, poisson: [2] constants of the lower and of the upper part; Young's moduli in pascal.
        travel: how far the upper clamp moves down.
        attributes: what is recorded of the drawing.
    """

    young: np.ndarray
    poisson: np.ndarray
    travel: float
    attributes: dict[str, AttributeValue]


def draw(rng: np.random.Generator, nodes: int = DEFAULT_NODES, parts: PartSource | None = None) -> SolidCase:
    """The case of `draw_geometry`."""
    return draw_geometry(rng, nodes, parts).case


def draw_geometry(rng: np.random.Generator, nodes: int = DEFAULT_NODES, parts: PartSource | None = None) -> Drawn:
    """Draw a pair, its materials and how far it is squeezed.

    Args:
        rng: where all draws come from.
        nodes: about how many nodes both parts have together.
        parts: where they come from; `part_source()` if None.

    Raises:
        SimulationError: none of `DRAWS` draws gave a pair that can be used. The text says why the last could not.
    """
    parts = part_source() if parts is None else parts
    reason: SimulationError | None = None
    for _ in range(DRAWS):
        try:
            mesh = parts.draw(rng)
            drawn = mesh(nodes)
            pair = put_together(rng, *drawn, 2 * CONTACT.dhat)
            _check_walls(pair)
        except (BadMesh, MeshingFailed, Unsuitable) as error:
            reason = error
            continue
        squeeze = _draw_squeeze(rng, pair, drawn, parts.mesher)
        return Drawn(_case(pair, squeeze), partial(_remeshed, mesh, nodes, drawn, pair, squeeze))
    raise SimulationError(f"none of {DRAWS} draws gave two parts that can be squeezed; the last: {reason}") from reason


def _remeshed(
    mesh: Mesher, nodes: int, drawn: tuple[Part, Part], pair: PairOfParts, squeeze: _Squeeze, share: float
) -> SolidCase:
    """The case on a mesh with that share of the nodes. Its clamps end where the clamps of the drawn pair end.

    Raises:
        BadMesh, MeshingFailed, Unsuitable: there is no such mesh.
    """
    parts = mesh(round(share * nodes), COARSE_ANGLE)
    if sum(len(part.position) for part in parts) == len(pair.position) and share != 1:
        raise Unsuitable("there is no other mesh of these parts with that few nodes")
    other, raised = put_likewise(pair, drawn, parts, 2 * CONTACT.dhat)
    _check_walls(other)
    return _case(other, replace(squeeze, travel=squeeze.travel + raised))


def solve(case: SolidCase, checkpoint: Checkpoint | None = None, patient: bool = False) -> Trajectory:
    """Squeeze the pair."""
    return quasi_static(case, SETTINGS, checkpoint, patient)


def _check_walls(pair: PairOfParts) -> None:
    """Raise Unsuitable if a surface comes so close to itself that contact would act at rest."""
    contact = Contact(pair.position, pair.faces, pair.body, CONTACT)
    contact.collision_free_fraction(pair.position, pair.position)
    if not contact.at(pair.position).is_empty:
        raise Unsuitable(
            f"a wall, slit or element is thinner than {CONTACT.dhat:g}, the range of contact,"
            f" when the longest side of the pair is {2 * HALF_EXTENT:g}"
        )


def _draw_squeeze(rng: np.random.Generator, pair: PairOfParts, parts: tuple[Part, Part], mesher: str) -> _Squeeze:
    low, high = np.log(YOUNG)
    young = np.exp(rng.uniform(low, high, 2))
    poisson, crush = rng.uniform(*POISSON, 2), rng.uniform(*CRUSH)
    attributes: dict[str, AttributeValue] = {
        "parts": f"{parts[0].name}, {parts[1].name}",
        "crush": float(crush),
        "free_height": pair.height,
        "overlap": pair.overlap,
        "scale": pair.scale,
        "mesher": mesher,
    }
    # The clamp closes the gap and then squeezes by its share of the free height.
    return _Squeeze(young, poisson, crush * pair.height + 2 * CONTACT.dhat, attributes)


def _case(pair: PairOfParts, squeeze: _Squeeze) -> SolidCase:
    body = pair.body[pair.elements[:, 0]]
    # The solver uses constants and positions as the file stores them, in float32.
    material = np.stack([squeeze.young, squeeze.poisson], axis=1).astype(np.float32)[body]
    scene = Scene(
        rest_position=pair.position.astype(np.float32),
        elements=pair.elements.astype(np.int32),
        node_type=np.where(pair.clamped, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8),
        body=pair.body.astype(np.int32),
        material=material,
    )
    down = np.linspace(0, squeeze.travel, FRAMES)[:, None] * (pair.clamped & (pair.body == 1))
    prescribed_position = np.repeat(scene.rest_position.astype(np.float64)[None], FRAMES, axis=0)
    prescribed_position[:, :, 2] -= down
    return SolidCase(
        scene=scene,
        prescribed_position=prescribed_position,
        material=NeoHookean(*material.astype(np.float64).T),
        contact=CONTACT,
        stress_location="element",
        attributes=squeeze.attributes,
    )
