"""Is an answer physics? What can be said of positions alone, without a truth.

What the forces of contact do not explain of the elastic forces on the free nodes (`contact_forces`) is the residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ast_sim.element_topology import node_areas, signed_volumes, unit_normals
from ast_sim.material import FRICTION, Material
from ast_sim.mechanics.contact_and_friction import ContactSettings, load_ipctk
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.mechanics.linearised.contact_forces import ContactForces, free_of_themselves
from ast_sim.mechanics.linearised.linearised_contact import CLEARANCE, NewtonSteps
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.plausibility.overlaps import nodes_inside
from ast_sim.scene import Scene
from ast_sim.support.errors import ConfigError, MissingExtra, SimulationError, counted

TWICE = 1.5  # a closed surface winds once around what is inside, twice where two parts of it overlap
SLIGHT_STRAIN = 1e-3  # the balance is relative to the force of this strain at least: smaller ones are hardly any


@dataclass(frozen=True)
class Law:
    """The law of scenes: the material of their elements, and their contact.

    Attributes:
        material: names the numbers of a scene's material, and has the ones that all scenes share.
        contact_range: the distance in the scene's unit of length below which surfaces repel each other.
    """

    material: Material
    contact_range: float

    def of_elements(self, scene: Scene) -> NeoHookean:
        """The law of each element.

        Raises:
            ConfigError: the law of the material is not known.
            SimulationError: the constants of an element are not allowed.
        """
        return NeoHookean.of_scene(scene, self.material)

    def friction(self, scene: Scene) -> float:
        """Coulomb's coefficient, the largest of the scene."""
        return float(np.max(self.material.numbers(FRICTION, scene.material)))

    def contact(self, scene: Scene) -> ContactSettings:
        """Contact between bodies by barriers that are about as stiff as the bodies.

        Raises:
            ConfigError: the law of the material is not known.
            SimulationError: the range of contact is 0.
        """
        young = np.broadcast_to(self.of_elements(scene).young, scene.num_elements)[scene.deforming_elements]
        selves = free_of_themselves(scene, self.contact_range) if self.contact_range else ()
        return ContactSettings(self.contact_range, float(young.mean()), self.friction(scene), selves)

    def contact_forces(self, scene: Scene) -> ContactForces | None:
        """The forces of contact of a scene; None: its range is not known."""
        return ContactForces(scene, self.contact_range, self.friction(scene)) if self.contact_range else None

    def newton_steps(self, scene: Scene) -> NewtonSteps:
        """The Newton steps of a scene under this law.

        Raises:
            ConfigError: the law of the material is not known.
            SimulationError: the constants are not allowed, or an element has no volume.
        """
        friction = self.friction(scene)
        return NewtonSteps(scene, self.of_elements(scene), CLEARANCE * self.contact_range, friction)


@dataclass(frozen=True)
class CheckRow:
    """One property of an answer: its worst value over the frames, the number of that frame, and a sentence."""

    what: str
    value: float | None
    frame: int | None
    sentence: str


@dataclass(frozen=True)
class PhysicsCheck:
    """What `Answer.check` found. A value is the worst over the frames, or None where it is not known; the sentence says
    why.

    Attributes:
        turned_over: the number of deforming elements that are turned over.
        folded: the number of deforming elements that lie inside another part of their own body.
        depth: of the deepest surface node inside another body, in the unit of length.
        volume: of all that overlaps, to first order: the depth of each node inside another body times its share of
            the surface that faces the other one; in the cube of the unit of length.
        residual: the largest component of the forces on free nodes that contact does not explain, over the largest
            one that the solver's stop test allows. Frames of the solver have some 10 here, not 1, since stored
            positions are in single precision. With friction they have 10,000 to 100,000, 1 % of the forces: the solver
            takes sizes and directions of friction from the iteration before.
        imbalance: the sum of these forces over the magnitudes of the forces that hold and touch the bodies: how far the
            reactions are from balance.
    """

    turned_over: CheckRow
    folded: CheckRow
    depth: CheckRow
    volume: CheckRow
    residual: CheckRow
    imbalance: CheckRow

    @property
    def rows(self) -> tuple[CheckRow, ...]:
        """All of them, in the order of the table."""
        return self.turned_over, self.folded, self.depth, self.volume, self.residual, self.imbalance

    def __str__(self) -> str:
        rows = [("check", "worst", "frame", "in words")]
        for one in self.rows:
            value = "-" if one.value is None else f"{one.value:.3g}"
            rows.append((one.what, value, "-" if one.frame is None else str(one.frame), one.sentence))
        widths = [max(len(row[column]) for row in rows) for column in range(3)]
        return "\n".join(
            f"{what:{widths[0]}}  {value:>{widths[1]}}  {frame:>{widths[2]}}  {text}"
            for what, value, frame, text in rows
        )


def check_physics(
    scene: Scene, positions: np.ndarray, frames: Sequence[int], law: Law | None, unit: str
) -> PhysicsCheck:
    """Check frames [S, N, 3] with these numbers; `law` None: it is not known. `unit` is the unit of length."""
    turned = [turned_over(scene, position) for position in positions]
    folded = [_folded(scene, position.astype(np.float64)) for position in positions]
    overlaps = [_overlap(scene, position.astype(np.float64)) for position in positions]
    why = "the law of the material is not known: no forces are"
    forces: list[tuple[float, float]] = []
    if law is not None and len(positions):
        try:
            balance = _Balance(scene, law)
            forces = [balance.of(position.astype(np.float64)) for position in positions]
        except (ConfigError, SimulationError, MissingExtra) as error:
            why = f"no forces are known: {error}"

    def worst(what: str, values: list[float], text: str, zero: str) -> CheckRow:
        if not values:
            return CheckRow(what, None, None, "no frame was predicted" if not len(positions) else why)
        row = int(np.argmax(values))
        return CheckRow(what, values[row], frames[row], text.format(values[row]) if values[row] else zero)

    depths, volumes = zip(*overlaps, strict=True) if overlaps else ((), ())
    residuals, imbalances = zip(*forces, strict=True) if forces else ((), ())
    residual = (
        "the worst force is {:.3g} times what the solver accepts, whose test is stricter than `converged`: that is only"
        " about the size of the last Newton step"
    )
    if law and forces and law.friction(scene):
        residual += "; with friction, its own frames have up to some 100,000"
    inside_out = counted(int(max(turned, default=0)), "element is", "elements are")
    inside = "inside another part of"
    folded_in = counted(int(max(folded, default=0)), f"element lies {inside} its", f"elements lie {inside} their")
    return PhysicsCheck(
        worst("elements turned over", turned, f"{inside_out} inside out: stress means nothing there", "none is"),
        worst("elements folded in", folded, f"{folded_in} own body", "none is"),
        worst("deepest penetration", list(depths), f"a node lies {{:.3g}} {unit} inside another body", "none is"),
        worst("penetrated volume", list(volumes), f"bodies share about {{:.3g}} {unit}^3", "bodies share none"),
        worst("force residual", list(residuals), residual, "no force"),
        worst("balance of reactions", list(imbalances), "the reactions miss balance by {:.2g} of their size", "exact"),
    )


def turned_over(scene: Scene, position: np.ndarray) -> float:
    """How many deforming tetrahedra have another sign at positions [N, 3] than at rest; 0 in a scene of triangles."""
    if scene.elements.shape[1] == 3:
        return 0.0
    over = np.sign(scene.rest_volumes) * signed_volumes(position, scene.elements) <= 0
    return float((over & ~scene.rigid_elements).sum())


def _folded(scene: Scene, position: np.ndarray) -> float:
    """How many deforming tetrahedra have their middle inside another part of their body, too: the surface of the body
    winds around it twice (Jacobson, Kavan and Sorkine-Hornung 2013)."""
    if scene.elements.shape[1] == 3:
        return 0.0
    import igl  # takes 0.2 s

    surface = scene.surface().astype(np.int64)
    count = 0
    for body in np.unique(scene.body[scene.elements[~scene.rigid_elements, 0]]).tolist():
        faces = surface[scene.body[surface[:, 0]] == body]
        elements = scene.elements[(scene.body[scene.elements[:, 0]] == body) & ~scene.rigid_elements]
        middles = position[elements[:, :4]].mean(axis=1)
        count += int((np.abs(igl.fast_winding_number(position, faces, middles)) > TWICE).sum())
    return float(count)


def _overlap(scene: Scene, position: np.ndarray) -> tuple[float, float]:
    """The depth of the deepest node inside another body, and the volume that all pairs of bodies share.

    Both bodies of a pair say how much they share; the larger volume counts.
    """
    if scene.elements.shape[1] == 3:
        return 0.0, 0.0
    surface = scene.surface()
    owner = scene.body[surface[:, 0]]
    faces = {body: surface[owner == body] for body in np.unique(owner).tolist()}
    rigid = scene.rigid_bodies
    areas = node_areas(position, surface)
    deepest = total = 0.0
    for one, other in combinations(faces, 2):
        if rigid >= {one, other}:
            continue
        volumes = [0.0]
        for mine, theirs in ((one, other), (other, one)):
            nodes, depths, nearest = nodes_inside(position, faces[mine], faces[theirs])
            if len(nodes):
                deepest = max(deepest, float(depths.max()))
                normal = unit_normals(position[faces[theirs][nearest]])
                volumes.append(float(depths @ np.maximum(0, -np.einsum("ni,ni->n", areas[nodes], normal))))
        total += max(volumes)
    return deepest, total


class _Balance:
    """The balance of forces of a scene; made once, because what depends on its rest does not change."""

    def __init__(self, scene: Scene, law: Law) -> None:
        deforming = np.flatnonzero(~scene.rigid_elements)
        self._elasticity = deforming_body(scene, deforming, law.of_elements(scene))
        load_ipctk()  # without pairs of edges, what is left says nothing
        self._contact = ContactForces(scene, law.contact_range, law.friction(scene))
        self._held = scene.prescribed

    def of(self, position: np.ndarray) -> tuple[float, float]:
        """The residual and the imbalance of positions [N, 3]; infinite where an element is turned over."""
        deformation = self._elasticity.evaluate(position)
        if deformation.J.min() <= 0:
            return float("inf"), float("inf")
        forces, element_force = self._elasticity.gradient(deformation)
        pushed = self._contact.forces(self._contact.pairs(position), forces).sum(axis=0).reshape(-1, 3)
        left = np.zeros(forces.size)
        left[self._contact.free] = (forces - pushed).ravel()[self._contact.free]
        unit = self._elasticity.unit_force
        allowed = max(SolverSettings().force_tolerance * element_force, 1e-8 * unit)
        magnitude = float(np.linalg.norm(forces[self._held], axis=1).sum() + np.linalg.norm(pushed, axis=1).sum() / 2)
        unbalanced = float(np.linalg.norm(left.reshape(-1, 3).sum(axis=0)))
        return float(np.abs(left).max(initial=0)) / allowed, unbalanced / max(magnitude, SLIGHT_STRAIN * unit)
