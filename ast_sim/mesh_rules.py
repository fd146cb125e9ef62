"""What a mesh must be for a scene, and what it must be for a prediction."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ast_sim.element_topology import flat_elements
from ast_sim.mesh_arrays import NodeType, deforms
from ast_sim.support.errors import DatasetError


def require_extent(name: str, points: np.ndarray, elements: np.ndarray, among: np.ndarray | None = None) -> None:
    """Raise DatasetError if elements [E, k], only the ones `among` [E] bool, are flat; the text names `name`, the first
    one and their number."""
    rows = np.arange(len(elements)) if among is None else np.flatnonzero(among)
    flat = rows[flat_elements(points, elements[rows])]
    if len(flat):
        kind = "area" if elements.shape[1] == 3 else "volume"
        raise DatasetError(
            f"{name}: element {flat[0]} with the nodes {elements[flat[0]].tolist()} has no {kind}; {len(flat)} of"
            f" {len(rows)} elements have none: repair the mesh"
        )


def require_deforming(name: str, position: np.ndarray, elements: np.ndarray, node_type: np.ndarray) -> None:
    """What `Scene.require_predictable` does."""
    if (node_type != NodeType.NORMAL).all():
        raise DatasetError(f"{name}: all nodes are obstacles or handles, so nothing deforms: leave this scene out")
    deforming = deforms(node_type)
    if (position[deforming] == position[deforming][0]).all():
        raise DatasetError(f"{name}: all nodes that deform lie at one point at rest: give them their positions")
    require_extent(name, position, elements, np.any(deforming[elements], axis=1))


def require_mesh(name: str, elements: np.ndarray, node_type: np.ndarray, body: np.ndarray) -> None:
    """Raise DatasetError if an element refers to a node twice, if the type of a node is no `NodeType`, or if a body has
    a number below 0; the text names `name` and the first one."""
    pairs = combinations(range(elements.shape[1]), 2)
    repeated = np.logical_or.reduce([elements[:, a] == elements[:, b] for a, b in pairs])
    if repeated.any():
        row = int(np.argmax(repeated))
        raise DatasetError(f"{name}: element {row} refers to a node twice: {elements[row].tolist()}")
    unknown = np.logical_and.reduce([node_type != kind for kind in NodeType])
    if unknown.any():
        node = int(np.argmax(unknown))
        known = ", ".join(f"{kind.value} {kind.name}" for kind in NodeType)
        raise DatasetError(f"{name}: node {node} has the type {node_type[node]}; known are {known}")
    if (body < 0).any():
        node = int(np.argmax(body < 0))
        raise DatasetError(f"{name}: node {node} is of the body {body[node]}, but bodies are numbered from 0")
