"""Meshes for the scenes that several tests make by hand."""

import numpy as np

from ast_sim.data.scene import NodeType, Scene

# Kuhn's subdivision of a hexahedron into six tetrahedra around the diagonal from corner 0 to corner 7.
KUHN = np.array([(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)])


def box(
    cells: tuple[int, int, int], size: tuple[float, float, float], center: tuple[float, float, float] = (0, 0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [N, 3] and tetrahedra [E, 4] of a box."""
    axes = [np.linspace(-s / 2, s / 2, n + 1) + c for s, n, c in zip(size, cells, center, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape([n + 1 for n in cells])
    corners = [index[x : x + cells[0], y : y + cells[1], z : z + cells[2]].ravel() for z, y, x in np.ndindex(2, 2, 2)]
    return nodes, np.stack(corners, axis=1)[:, KUHN].reshape(-1, 4)


def two_tetrahedra(**changes) -> Scene:
    """Two tetrahedra that share the face 1, 2, 3; node 0 is a handle, node 4 an obstacle."""
    arrays = {
        "rest_position": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32),
        "elements": np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32),
        "node_type": np.array([NodeType.HANDLE, 0, 0, 0, NodeType.OBSTACLE], np.uint8),
        "body": np.array([0, 0, 0, 0, 1], np.int32),
    }
    return Scene(**{**arrays, **changes})
