"""A drawn quasi-static scene with all that its solution depends on, whichever solver finds it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ast_sim.data.scene import AttributeValue, NodeType, Scene
from ast_sim.simulate.contact import ContactSettings
from ast_sim.simulate.material import NeoHookean


@dataclass(frozen=True, eq=False)
class SolidCase:
    """Deforming bodies of tetrahedra, some of whose nodes are prescribed, and rigid obstacles; S frames.

    Attributes:
        scene: what does not change; elements of OBSTACLE nodes are rigid, all others deform.
        targets: [S,N,3] float64, positions of the prescribed nodes in each frame in metres; rows of other nodes are
            ignored, frame 0 is at rest.
        material: of all elements (constants of rigid ones are ignored).
        contact: between bodies.
        stress_location: "node" for nodal von Mises stress, "element" for that of elements with their Cauchy stress.
        attributes: what the drawing wants to have recorded with the trajectory.
    """

    scene: Scene
    targets: np.ndarray
    material: NeoHookean
    contact: ContactSettings
    stress_location: str
    attributes: dict[str, AttributeValue] = field(default_factory=dict)

    @property
    def deforming(self) -> np.ndarray:
        """[E] bool: the elements that are not rigid."""
        obstacle = self.scene.node_type == NodeType.OBSTACLE
        return ~obstacle[self.scene.elements].all(axis=1)
