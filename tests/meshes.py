"""Meshes for the scenes that several tests make by hand."""

from collections.abc import Sequence

import meshio
import numpy as np

from ast_sim.scene import NodeType, Scene

Mesh = tuple[np.ndarray, np.ndarray]

# Kuhn's subdivision of a hexahedron into six tetrahedra around the diagonal from corner 0 to corner 7.
KUHN = np.array([(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)])


def box(
    cells: tuple[int, int, int], size: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)
) -> Mesh:
    """Nodes [N, 3] and tetrahedra [E, 4] of a box."""
    half = np.array(size) / 2
    return box_between(cells, center - half, center + half)


def box_between(cells: tuple[int, int, int], low: Sequence[float], high: Sequence[float]) -> Mesh:
    """Nodes [N, 3] and tetrahedra [E, 4] of a box from its lowest corner to its highest."""
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    corners = [index[x : x + cells[0], y : y + cells[1], z : z + cells[2]].ravel() for z, y, x in np.ndindex(2, 2, 2)]
    return nodes, np.stack(corners, axis=1)[:, KUHN].reshape(-1, 4)


def plate_and_punch(
    size: tuple[float, float, float] = (0.4, 0.4, 0.04), cells: tuple[int, int, int] = (8, 8, 2), gap: float = 0.001
) -> meshio.Mesh:
    """A plate that lies on the plane z = 0 around the origin, and a punch of 0.1 x 0.1 x 0.1 above it."""
    x, y, z = size
    plate, plate_tets = box_between(cells, (-x / 2, -y / 2, 0.0), (x / 2, y / 2, z))
    punch, punch_tets = box_between((2, 2, 2), (-0.05, -0.05, z + gap), (0.05, 0.05, z + gap + 0.1))
    return meshio.Mesh(np.concatenate([plate, punch]), {"tetra": np.concatenate([plate_tets, punch_tets + len(plate)])})


def two_tetrahedra(**changes) -> Scene:
    """Two tetrahedra that share the face 1, 2, 3; node 0 is a handle, node 4 an obstacle."""
    arrays = {
        "rest_position": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32),
        "elements": np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32),
        "node_type": np.array([NodeType.HANDLE, 0, 0, 0, NodeType.OBSTACLE], np.uint8),
        "body": np.array([0, 0, 0, 0, 1], np.int32),
    }
    return Scene(**{**arrays, **changes})
