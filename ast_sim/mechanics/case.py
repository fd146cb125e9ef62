"""A drawn quasi-static scene, with all that its solution depends on, and its other meshes. Any solver can solve it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linearised.contact_forces import ContactForces
from ast_sim.motion_between_frames import Course, Leg
from ast_sim.scene import AttributeValue, Scene
from ast_sim.support.errors import SimulationError

NOTES, NEXT_NOTE = "notes", "\n"  # the attribute that holds what a user should know of a scene, and what separates it
NEARBY = (1.0, 0.95, 1.05, 0.9, 1.1)  # sizes of meshes that are tried, relative to the wanted one


@dataclass(frozen=True, eq=False)
class SolidCase:
    """Deforming bodies of tetrahedra and rigid obstacles in S frames. The motion of clamps and obstacles is prescribed.

    Attributes:
        scene: what does not change. Elements whose nodes are all OBSTACLE nodes are rigid; all others deform.
        prescribed_position: [S,N,3] float64, of the prescribed nodes in each frame in metres. Rows of other nodes are
            ignored. Frame 0 is at rest.
        material: material of all elements; the constants of rigid elements are ignored.
        contact: contact between bodies.
        stress_location: "node": von Mises stress at nodes. "element": von Mises stress and Cauchy stress of elements.
        attributes: what the drawing wants recorded with the trajectory.
        course: how the prescribed nodes get from frame to frame; None: straight.
        hardening: of the bodies that yield, by their numbers: rows of true stress in pascal and plastic strain.
            `material` has their elastic constants.
    """

    scene: Scene
    prescribed_position: np.ndarray
    material: NeoHookean
    contact: ContactSettings
    stress_location: str
    attributes: dict[str, AttributeValue] = field(default_factory=dict)
    course: Course | None = None
    hardening: dict[int, np.ndarray] = field(default_factory=dict)

    def keeping(self, frames: tuple[int, ...]) -> SolidCase:
        """The case with frame 0 and these frames only; load steps go where the nodes turn between them."""
        stored = (0, *frames)
        course = self.course or Course(self.prescribed_position, self.scene.prescribed)
        return replace(self, prescribed_position=self.prescribed_position[list(stored)], course=course.storing(stored))

    @property
    def friction(self) -> float:
        """The largest coefficient of friction that acts, for what knows one alone."""
        return max(self.contact.frictions(self.scene))

    def contact_forces(self) -> ContactForces:
        """The forces of its contact, with one coefficient of friction."""
        return ContactForces(self.scene, self.contact.dhat, self.friction)

    def notes(self) -> list[str]:
        """What a user should know of the scene, a sentence each."""
        drawn = str(self.attributes.get(NOTES, ""))
        return [*filter(None, drawn.split(NEXT_NOTE)), *(self.course.notes() if self.course else ())]

    def legs(self, frame: int) -> list[Leg]:
        """What load steps follow from the frame before to this one."""
        return [Leg(self.prescribed_position[frame])] if self.course is None else self.course.legs(frame)

    def on_legs(self) -> np.ndarray:
        """[L,N,3]: where the prescribed nodes are in frame 0 and at the end of each leg."""
        ends = [leg.end for frame in range(1, len(self.prescribed_position)) for leg in self.legs(frame)]
        return np.stack([self.prescribed_position[0], *ends])

    def straight(self, frame: int) -> list[Leg]:
        """What load steps follow from rest to a frame, past the frames between."""
        return [Leg(self.prescribed_position[frame])] if self.course is None else self.course.straight(frame)

    def on_the_way(self, frame: int, share: float) -> np.ndarray:
        """[N,3]: where the prescribed nodes are at a share of the way from rest to a frame, past the frames between."""
        leg = Leg(self.prescribed_position[frame]) if self.course is None else self.course.direct(frame)
        if leg.along is not None:
            return leg.along(share)
        return self.prescribed_position[0] + share * (leg.end - self.prescribed_position[0])

    def followed(self) -> tuple[SolidCase, list[int]]:
        """The same case with a frame wherever a leg ends, and the numbers that the frames of this case have there."""
        ends, stored = [self.prescribed_position[0]], [0]
        for frame in range(1, len(self.prescribed_position)):
            ends += [leg.end for leg in self.legs(frame)]
            stored.append(len(ends) - 1)
        return replace(self, prescribed_position=np.stack(ends), course=None), stored

    @property
    def farthest(self) -> np.ndarray:
        """[N,3]: where the prescribed nodes are in the frame in which one of them is farthest from its place at rest;
        the last one of several."""
        travel = np.linalg.norm(self.prescribed_position - self.prescribed_position[0], axis=2)[
            :, self.scene.prescribed
        ].max(axis=1, initial=0)
        return self.prescribed_position[len(travel) - 1 - int(np.argmax(travel[::-1]))]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A drawn scene, and a function that meshes it in other sizes.

    Attributes:
        case: the scene as the generator meshes it.
        remesh: a function of a share above 0. It returns the same geometry, materials and motion on a mesh that has
            about that share of the nodes of the deforming bodies. It raises SimulationError if there is no such mesh;
            the text says why.
    """

    case: SolidCase
    remesh: Callable[[float], SolidCase]

    def remesh_nearly(self, share: float) -> SolidCase:
        """As `remesh`. If that mesh fails, others of nearly that size are tried, as a user would do.

        Raises:
            SimulationError: all of them failed. The text says why the first did.
        """
        first: SimulationError | None = None
        for nearby in NEARBY:
            try:
                return self.remesh(nearby * share)
            except SimulationError as error:
                first = first or error
        assert first is not None
        raise first
