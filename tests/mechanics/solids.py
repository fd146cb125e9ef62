"""Small cases of solids in contact that several tests solve."""

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.shapes import mesh


def stacked(lower, upper, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two meshes (positions, elements), the second `gap` above the first: positions, elements, bodies.

    It stands off the middle: of symmetric bodies two equilibria that mirror each other may have the same energy.
    """
    (a, a_elements), (b, b_elements) = lower, upper
    b = b + [0.013, 0.007, a[:, 2].max() - b[:, 2].min() + gap]
    elements = np.concatenate([a_elements, b_elements + len(a)])
    return np.concatenate([a, b]), elements, np.repeat([0, 1], [len(a), len(b)])


def scene_of(position: np.ndarray, elements: np.ndarray, body: np.ndarray, node_type: np.ndarray) -> Scene:
    return Scene(
        position.astype(np.float32), elements.astype(np.int32), node_type.astype(np.uint8), body.astype(np.int32)
    )


def pressed(lower, upper, depth: float, frames: int = 5, shift: float = 0.0, **contact) -> SolidCase:
    """The lower body stands on a clamped face, the upper one is held by its top, pressed down and then aside.

    Args:
        lower, upper: positions and elements.
        depth: how far the top comes down, in frames 1 to `frames`.
        shift: how far it goes aside along x after that, in as many frames.
        contact: settings beside dhat = 1e-3 and a stiffness of 1 MPa.
    """
    position, elements, body = stacked(lower, upper, gap=2e-3)
    z = position[:, 2]
    top, bottom = (body == 1) & np.isclose(z, z.max()), (body == 0) & np.isclose(z, z.min())
    scene = scene_of(position, elements, body, np.where(top | bottom, NodeType.HANDLE, NodeType.NORMAL))
    down = np.concatenate([np.linspace(0, depth, frames + 1), np.full(frames if shift else 0, depth)])
    aside = np.concatenate([np.zeros(frames + 1), np.linspace(0, shift, frames + 1)[1:] if shift else []])
    path = np.stack([aside, 0 * aside, -down], axis=1)
    rest = scene.rest_position.astype(float)
    young = np.where(body[elements[:, 0]] == 0, 1e6, 2e6)
    return SolidCase(
        scene,
        rest + np.where(top[:, None], path[:, None, :], 0.0),
        NeoHookean(young, np.full(len(elements), 0.3)),
        ContactSettings(1e-3, 1e6, **contact),
        stress_location="element",
        attributes={"name": "pressed"},
    )


def blocks() -> tuple:
    """Two blocks with meshes that do not match."""
    return mesh.block((0.1, 0.1, 0.06), 4), mesh.block((0.07, 0.07, 0.06), 3)
