"""Newton steps with linearised contact: from nearly right positions to equilibrium in a few steps.

At positions x, with K the stiffness, f the derivative of the elastic energy, and each near pair of a surface node and
a triangle of another body, of two edges, or of two places of one body, with its gap g and its outward normal n, a step
finds the displacement u of the free nodes:

    minimise  1/2 u K u + f u   subject to   C u + g >= clearance,

where a row of C is the normal velocity of the node relative to the nearest point of the triangle. This is one step of
sequential quadratic programming. Its dual has one unknown a pair, the force of contact l >= 0:

    minimise  1/2 l B l + b l,   B = C K^-1 C^T,   b = g - clearance - C K^-1 f,   then   u = K^-1 (C^T l - f).

With the factorization K = L L^T, B is the product of L^-1 C^T with itself.

With Coulomb friction each pair has tangential forces, too, at most the coefficient times the normal force. They resist
slip from where the surfaces stuck to each other. A single step does not know the load path. If nothing else is
given, its surfaces have slid along the last fiftieth of a straight path from rest: surfaces that slide get the whole
friction against their motion, and surfaces that stick hardly feel it (docs/log.md, 2026-11-25). Bodies may overlap at
x, and elements may be turned over: these get the forces and the stiffness of the nearest upright shape (Irving, Teran
and Fedkiw 2004). A node is on the side of a surface where it is nearest: the start must be nearly right.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ast_sim.mechanics.elements.elasticity import Deformation, upright
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.mechanics.linear_algebra.compliance import Compliance, compliance_of
from ast_sim.mechanics.linear_algebra.linear_system import LinearSystem
from ast_sim.mechanics.linearised.near_pairs import NearPairs, NearSurfaces
from ast_sim.scene import Scene
from ast_sim.support.errors import SimulationError

CLEARANCE = (
    0.8  # bodies that barriers keep apart stand off by this share of the barriers' range (docs/log.md, 2026-11-24)
)
OVERLAP = 1e-6  # pairs may overlap by this much at the end of a step, in mean edge lengths of the surfaces
FEW = 16  # a round takes at least this number of the pairs that would overlap,
SHARE = 4  # or this part of them,
MORE = 16  # or this part of all that were taken before, if that is more
YIELDING = 1e-5  # contact yields by this share of what the bodies do, so that pairs that say the same share a force
ROUNDED = 1e-12  # an overlap of this part of the deepest is rounding
PATIENCE, MOST_PIVOTS = 3, 30  # turns of all wrong pairs without fewer of them; turns in all, for each pair
SWEEPS = 100  # over the pairs, at most
CHANGE = 1e-3  # forces of friction are found when a sweep changes them by less
TINY = 1e-300  # instead of zero in a denominator
STILL = 0.05  # a step of this size (`NewtonSteps.size`) or less is the last one (docs/log.md, 2026-11-25)
SLIGHT = 1e-3  # a displacement below this, in mean edge lengths, is none: before bodies touch, only rounding is left
SMALLEST = 1 / 64  # a step is shortened at most so far where it turns an element over


class NewtonSteps:
    """Newton steps of the elastic bodies of a scene; made once for each scene.

    Args:
        scene: tetrahedra. Its prescribed nodes stay where they are in a step.
        material: of all elements; the constants of rigid ones are ignored.
        clearance: in the unit of length, the gap that bodies in contact keep.
        friction: Coulomb's coefficient.

    Attributes:
        elasticity: the deforming bodies.
        system: of their free nodes.
        surfaces: of all bodies, derived by the free dofs.
        watch: is called now and then in a step, with how many forces of contact it knows. It may raise to stop.

    Raises:
        SimulationError: as `deforming_body`.
    """

    def __init__(self, scene: Scene, material: NeoHookean, clearance: float, friction: float = 0.0) -> None:
        self._scene = scene
        self._clearance = clearance
        self._friction = friction
        self._rest = scene.rest_position.astype(np.float64)
        self._deforming = np.flatnonzero(~scene.rigid_elements)
        self.elasticity = deforming_body(scene, self._deforming, material)
        held = np.ones(scene.num_nodes, bool)
        held[self.elasticity.elements] = False
        held |= scene.prescribed
        self.system = LinearSystem(self.elasticity.entries(), held)
        self.surfaces = NearSurfaces(scene, self.system.free)
        self.watch: Callable[[int], None] = lambda forces: None
        self._shortening = 1.0  # the share of the last step that was made
        self._evaluated: tuple[np.ndarray, Deformation] | None = None

    def step(self, position: np.ndarray, from_afar: bool = False, stuck: np.ndarray | None = None) -> np.ndarray:
        """The positions [N, 3] after one step from `position` [N, 3], float64.

        Args:
            from_afar: far from equilibrium the stiffness is hardly ever positive definite, so the projected one is
                taken at once. Otherwise it is taken where the exact one is not.
            stuck: [N, 3] where surfaces in contact stuck to each other; see the head of this file.

        Raises:
            SimulationError: the stiffness is singular, the forces of contact were not found, or the positions are too
                far from equilibrium.
        """
        try:
            with np.errstate(all="ignore"):
                reached = self._stepped(position, from_afar, stuck)
        except np.linalg.LinAlgError as error:
            raise SimulationError(f"the positions are too far from equilibrium: {error}") from error
        if not np.isfinite(reached).all():
            raise SimulationError("the positions are too far from equilibrium: the step is not finite")
        return reached

    def _stepped(self, position: np.ndarray, from_afar: bool, stuck: np.ndarray | None) -> np.ndarray:
        """See `step`."""
        deformation = upright(self._deformation(position))
        force = self.elasticity.gradient(deformation)[0].ravel()[self.system.free]
        pairs = self.surfaces.pairs(position, stuck)
        directions = pairs.directions if self._friction else pairs.directions[: len(pairs.gap)]
        for project in (True,) if from_afar else (False, True):
            values = self.elasticity.hessian(deformation, project)
            compliance = compliance_of(self.system, values, directions, self.watch)
            if compliance is not None:
                break
        else:
            raise SimulationError("the stiffness is singular: nothing holds a body, or an element has collapsed")
        return self._shortened(position, self._constrained(compliance, force, pairs))

    def _deformation(self, position: np.ndarray) -> Deformation:
        """The deformation at positions [N, 3]; a step begins where the one before has looked for turned elements."""
        if self._evaluated is None or not np.array_equal(position, self._evaluated[0]):
            self._evaluated = position.copy(), self.elasticity.evaluate(position)
        return self._evaluated[1]

    def size(self, before: np.ndarray, after: np.ndarray) -> float:
        """The size of the last step, between positions [N, 3]: the larger of the largest component of a move, in mean
        edge lengths of the surfaces, and the root mean square of the moves over the root mean square of the
        displacements from rest. Displacements below `SLIGHT` count as `SLIGHT`. A step that was shortened has the size
        of the whole one: where elements stop it, it has not converged."""
        free = self.system.free
        move, displacement = ((after - start).ravel()[free] for start in (before, self._rest))
        slight = SLIGHT * self.surfaces.length * math.sqrt(len(free))
        share = np.linalg.norm(move) / max(np.linalg.norm(displacement), slight)
        return float(max(np.abs(move).max() / self.surfaces.length, share)) / self._shortening

    def _constrained(self, compliance: Compliance, force: np.ndarray, pairs: NearPairs) -> np.ndarray:
        """The displacement [F] of the free dofs; see the head of this file."""
        unconstrained = compliance.solution(-force)
        count = len(pairs.gap)
        offset = pairs.directions @ unconstrained + np.concatenate([pairs.gap - self._clearance, pairs.slip])
        chosen, forces = self._pressed_pairs(compliance, offset[:count])
        if not self._friction or not forces.any():
            return unconstrained + (compliance.displacement(forces) if forces.any() else 0)
        active = np.flatnonzero(forces)
        active = active[np.argsort(chosen[active])]
        along = np.concatenate([chosen[active] + count, chosen[active] + 2 * count])
        compliance.want(along)
        columns = np.concatenate([active, np.arange(len(chosen), len(chosen) + len(along))])
        rows = np.concatenate([chosen[active], along])
        all_forces = np.zeros(len(chosen) + len(along))
        all_forces[columns] = _rubbed(
            compliance.matrix[np.ix_(columns, columns)], offset[rows], forces[active], self._friction
        )
        return unconstrained + compliance.displacement(all_forces)

    def _pressed_pairs(self, compliance: Compliance, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pairs [A] that may press on each other and their forces [A] >= 0, without friction.

        Where the compliance of a pair costs half a solution with the stiffness, pairs get one in rounds, first those
        that would overlap most with the forces so far. At the end no pair overlaps: these are the forces of all pairs.
        """
        chosen = np.zeros(0, int)
        forces = np.zeros(0)
        gap = offset.copy()
        while True:
            missing = np.flatnonzero(gap < -OVERLAP * self.surfaces.length)
            if not len(missing):
                return chosen, forces
            most = len(missing) if compliance.is_whole else max(FEW, len(missing) // SHARE, len(chosen) // MORE)
            deepest = missing[np.argsort(gap[missing], kind="stable")][:most]
            chosen = np.concatenate([chosen, deepest])
            compliance.want(deepest)
            forces = _pressed(compliance.matrix, offset[chosen])
            gap = offset + compliance.along(forces)[: len(offset)]
            gap[chosen] = 0

    def von_mises(self, position: np.ndarray, location: str) -> np.ndarray:
        """[N, 1] or [E, 1] float32: the stress in pascal at `location`, "node" or "element"; 0 in rigid bodies."""
        stress = self.elasticity.von_mises(self._deformation(position), location)
        if location == "node":
            return stress.astype(np.float32)[:, None]
        of_elements = np.zeros((self._scene.num_elements, 1), np.float32)
        of_elements[self._deforming, 0] = stress
        return of_elements

    def _shortened(self, position: np.ndarray, step: np.ndarray) -> np.ndarray:
        """`position` [N, 3] moved by the largest of 1, 1/2, 1/4, ... of `step` [F] that turns no element over."""
        share = 1.0
        while True:
            self._shortening = share
            moved = position.ravel().copy()
            moved[self.system.free] += share * step
            moved = moved.reshape(-1, 3)
            if share <= SMALLEST or self._deformation(moved).J.min() > 0:
                return moved
            share /= 2


def _pressed(compliance: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The forces l >= 0 [P] of contact without friction, which minimise 1/2 l B l + b l, by block principal pivoting
    (Kim and Park 2011): pairs that pull let go, pairs that overlap press, all at once. Where this does not leave fewer
    and fewer wrong pairs, one pair at a time, the last: this ends (Murty 1974). Where a fine tool presses on a coarse
    part, far more pairs than degrees of freedom touch; without `YIELDING`, B would be singular."""
    compliance = compliance + YIELDING * compliance.diagonal().mean() * np.eye(len(compliance))
    pressing = offset < 0
    slack = ROUNDED * np.abs(offset).max()
    fewest = len(offset) + 1
    patience = PATIENCE
    for _ in range(MOST_PIVOTS * len(offset)):
        rows = np.flatnonzero(pressing)
        forces = np.zeros(len(offset))
        forces[rows] = np.linalg.solve(compliance[np.ix_(rows, rows)], -offset[rows])
        wrong = np.flatnonzero(np.where(pressing, forces < 0, offset + compliance @ forces < -slack))
        if not len(wrong):
            return forces
        patience = PATIENCE if len(wrong) < fewest else patience - 1
        fewest = min(fewest, len(wrong))
        turned = wrong if patience > 0 else wrong[-1:]
        pressing[turned] = ~pressing[turned]
    raise SimulationError("the forces of contact were not found")


def _rubbed(compliance: np.ndarray, offset: np.ndarray, forces: np.ndarray, friction: float) -> np.ndarray:
    """The forces [3, P] of contact with Coulomb friction, from the forces [P] without, by block Gauss-Seidel
    (Jourdan, Alart and Jean 1998): each pair in turn gets the force that is right if the others stay.

    Args:
        compliance: B [3 P, 3 P], normals first, then the first and the second tangents.
        offset: b [3 P].
    """
    count = len(forces)
    all_forces = np.concatenate([forces, np.zeros(2 * len(forces))])
    of_pair = np.ascontiguousarray(compliance.reshape(3, count, 3 * count).swapaxes(0, 1))  # the three rows of each
    by_normal = of_pair[np.arange(count), :, np.arange(count)].tolist()  # what a pair's own normal force moves
    stiffest = compliance.diagonal().reshape(3, count)[1:].max(axis=0).tolist()
    pairs = list(zip(of_pair, offset.reshape(3, count).T, by_normal, stiffest, strict=True))
    for _ in range(SWEEPS):
        before = all_forces.copy()
        for pair, (rows, gap, (own, first_by_normal, second_by_normal), tangential) in enumerate(pairs):
            components = slice(pair, None, count)
            distance, first, second = (rows @ all_forces + gap).tolist()
            normal_before, one, other = all_forces[components].tolist()
            normal = max(0.0, normal_before - distance / own)
            one -= (first + first_by_normal * (normal - normal_before)) / tangential
            other -= (second + second_by_normal * (normal - normal_before)) / tangential
            share = min(1.0, friction * normal / max(math.hypot(one, other), TINY))
            all_forces[components] = normal, share * one, share * other
        if np.abs(all_forces - before).max() <= CHANGE * np.abs(all_forces).max():
            break
    return all_forces
