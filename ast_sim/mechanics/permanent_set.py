"""The permanent set of bodies that yield: what is left of their displacement when nothing presses them any more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ast_sim.material import YIELD_STRESS, Material
from ast_sim.mechanics.driven import Driven
from ast_sim.named_field import NamedField
from ast_sim.scene import Scene

OFFSET = 2e-3  # the plastic strain by which the yield stress of metal is usually defined
BACK = 1e-3  # nodes are back if they are no farther off, as a share of the way that the driven nodes went


class PermanentSet(NamedTuple):
    """The displacement that is left in a body, over its free nodes, in the unit of length.

    Attributes:
        frame: the number of the frame in the motion of the question, in which the prescribed nodes are back.
        body: the number of the body.
        largest: of the node that is left farthest from its place at rest.
        mean: of all free nodes of the body; each node counts once, however large its elements are.
    """

    frame: int
    body: int
    largest: float
    mean: float


def set_of_body(scene: Scene, body: int, way: np.ndarray, frame: int) -> PermanentSet:
    """The permanent set of a body that is let go.

    Args:
        scene: the scene.
        body: a body with free nodes.
        way: [N, 3], the displacements that are left.
        frame: the number of the frame in which they are left.
    """
    lengths = np.linalg.norm(way[(scene.body == body) & ~scene.prescribed].astype(np.float64), axis=1)
    return PermanentSet(frame, body, float(lengths.max()), float(lengths.mean()))


def yielding_bodies(scene: Scene, material: Material, strain: NamedField | None) -> list[int]:
    """The bodies with free nodes that yield: those with an element whose yield stress is above 0. If the material names
    no yield stress, those with a plastic strain above `OFFSET`.

    Args:
        scene: the scene.
        material: names the numbers of the scene's material.
        strain: the equivalent plastic strain in one frame; None: it is not known.
    """
    body_of_element = scene.body[scene.elements[:, 0]]
    if material.yields:
        yields = np.broadcast_to(material.numbers(YIELD_STRESS, scene.material), scene.num_elements) > 0
        bodies = body_of_element[yields]
    elif strain is not None:
        bodies = (scene.body if strain.location == "node" else body_of_element)[strain.values[0].max(axis=1) > OFFSET]
    else:
        return []
    return sorted(set(scene.body[~scene.prescribed].tolist()) & set(bodies.tolist()))


def permanent_sets(
    scene: Scene, yielding: list[int], driven: Driven, position: np.ndarray, frame: int
) -> list[PermanentSet]:
    """The permanent set of each body that yields, if a frame shows it.

    The driven nodes must have moved before, and all prescribed nodes must be back at their places at rest. A body that
    is held at other nodes, too, while its own nodes are driven, is not let go: it has none.

    Args:
        scene: the scene.
        yielding: the bodies that yield.
        driven: the driven nodes, with their path in the whole motion.
        position: [N, 3], the positions in the frame.
        frame: the number of the frame in the motion.
    """
    way = position - scene.rest_position
    travel = np.linalg.norm(driven.path[: frame + 1] - driven.path[0], axis=2).max(initial=0.0)
    if not travel or np.linalg.norm(way[scene.prescribed], axis=1).max(initial=0.0) > BACK * travel:
        return []
    strained = scene.prescribed & ~driven.nodes & (scene.body == driven.body)
    bodies = [body for body in yielding if body != driven.body or not strained.any()]
    return [set_of_body(scene, body, way, frame) for body in bodies]
