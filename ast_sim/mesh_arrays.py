"""The arrays of a scene: made of what a user has, joined, and exchanged with meshio."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from ast_sim.element_topology import CELL_KINDS
from ast_sim.material import Material
from ast_sim.number_arrays import (
    connected_parts,
    nodes_of_body,
    plain_array,
    real_numbers,
    require_array,
    require_nodes,
    rounding,
    whole_numbers,
)
from ast_sim.support.argument_checks import in_short, require_line, several
from ast_sim.support.errors import ConfigError, DatasetError, warn

if TYPE_CHECKING:
    import meshio


class NodeType(IntEnum):
    """How a node moves. The numbers are the same as in the data sets of MeshGraphNets."""

    NORMAL = 0  # a free node: it follows the mechanics, and models predict it
    OBSTACLE = 1  # a node of a rigid body with a prescribed motion
    HANDLE = 3  # a node of a deforming body with a prescribed position


def deforms(node_type: np.ndarray) -> np.ndarray:
    """[N] bool: the nodes that belong to no obstacle, from the types of the nodes [N]."""
    return node_type != NodeType.OBSTACLE


def scene_arrays(
    name: str,
    points: Any,
    cells: Any,
    node_type: Any,
    body: Any,
    material: Any,
    obstacles: Iterable[int],
    handles: Any,
) -> dict[str, Any]:
    """The arrays of a scene by name; arguments and errors are as in `Scene.of`."""
    require_line("name", name)
    position = real_numbers(name, "points", points)
    exact = np.asarray(points)
    if position.ndim == 2 and position.shape[1] == 2:
        position, exact = (np.pad(rows, ((0, 0), (0, 1))) for rows in (position, exact))
    require_array(name, "points", position, np.float32, (None, 3))
    count = len(position)
    elements = whole_numbers(name, "cells", cells, np.int32)
    require_array(name, "cells", elements, np.int32, (None, None))
    require_nodes(name, "cell", elements, count)
    for doubt in rounding(exact, position, elements):
        warn(f"{name}: {doubt}")
    parts = connected_parts(elements, count) if body is None else whole_numbers(name, "body", body, np.int32)
    require_array(name, "body", parts, np.int32, (count,))
    types = whole_numbers(name, "node_type", np.zeros(count) if node_type is None else node_type, np.uint8)
    require_array(name, "node_type", types, np.uint8, (count,))
    for number in several("obstacles", obstacles, "the numbers of bodies, such as [1]"):
        types[nodes_of_body(parts, number)] = NodeType.OBSTACLE
    if handles is not None:
        nodes = _nodes(name, handles, count)
        for doubt in of_obstacles("handles", nodes, types, parts):
            warn(f"{name}: {doubt}")
        types[nodes[deforms(types[nodes])]] = NodeType.HANDLE
    if isinstance(material, Material | Mapping):
        raise ConfigError(
            f"material is {in_short(material)}; it must be numbers, [E, m] or [m], such as (2e5, 0.3): their names"
            " belong to a dataset (DatasetInfo.generator) or a run"
        )
    columns = None if material is None else real_numbers(name, "material", material)
    if columns is not None and columns.ndim == 1:
        columns = np.tile(columns, (len(elements), 1))
    return {"rest_position": position, "elements": elements, "node_type": types, "body": parts, "material": columns}


def of_obstacles(what: str, nodes: np.ndarray, types: np.ndarray, body: np.ndarray) -> list[str]:
    """One sentence if some of the nodes, which `what` would make handles, are obstacles, which they stay."""
    rigid = nodes[~deforms(types[nodes])]
    if not len(rigid):
        return []
    return [
        f"{what}: {len(rigid)} of {len(nodes)} nodes stay obstacles, the first is node {rigid[0]} of body"
        f" {body[rigid[0]]}: an obstacle moves as a whole"
    ]


def _nodes(name: str, handles: Any, count: int) -> np.ndarray:
    """The numbers of the nodes, from numbers or from a mask [N]."""
    nodes = plain_array(name, "handles", handles)
    if not nodes.ndim:
        raise ConfigError(f"handles is {in_short(handles)}; it must be a list of nodes, or True or False for each")
    if nodes.dtype == bool:
        require_array(name, "handles", nodes, np.bool_, (count,))
        return np.flatnonzero(nodes)
    nodes = whole_numbers(name, "handles", nodes, np.int64).reshape(-1)
    require_nodes(name, "handle", nodes[:, None], count)
    return nodes


def joined_arrays(given: Sequence[Any]) -> dict[str, Any]:
    """The arrays of one scene, from several scenes; errors are as in `Scene.join`."""
    for scene in given:
        if not hasattr(scene, "rest_position"):
            raise ConfigError(f"a scene to join is {in_short(scene)}; it must be a Scene")
    if not given:
        raise ConfigError("there is no scene to join: name at least one")
    scenes: list[Mapping[str, Any]] = [vars(scene) for scene in given]
    kinds = {
        (scene["elements"].shape[1], 0 if scene["material"] is None else scene["material"].shape[1]) for scene in scenes
    }
    if len(kinds) != 1:
        told = "; ".join(f"{nodes} and {columns}" for nodes, columns in sorted(kinds))
        raise DatasetError(
            f"scenes to join must agree in the nodes of an element and the columns of the material; here are: {told}"
        )
    keys = ("rest_position", "elements", "node_type", "body", "material")
    columns: dict[str, list[Any]] = {key: [] for key in keys}
    first_node = first_body = 0
    for scene in scenes:
        bodies = scene["body"].astype(np.int64) + first_body
        if bodies.max() > np.iinfo(np.int32).max:
            raise DatasetError(
                f"the scenes to join would have a body {bodies.max()}, which is too large: number them from 0"
            )
        shifted = {**scene, "elements": scene["elements"] + np.int32(first_node), "body": bodies.astype(np.int32)}
        for key in keys:
            columns[key].append(shifted[key])
        first_node += len(scene["rest_position"])
        first_body = int(bodies.max()) + 1
    return {key: None if parts[0] is None else np.concatenate(parts) for key, parts in columns.items()}


def arrays_of_mesh(mesh: meshio.Mesh) -> tuple[Any, np.ndarray, dict[str, Any]]:
    """Points, cells, and the fields of the scene that the mesh has; errors are as in `Scene.from_meshio`."""
    if not hasattr(mesh, "cells"):
        raise DatasetError(f"the mesh is {in_short(mesh)}; it must be a mesh of meshio")
    blocks = [index for index, block in enumerate(mesh.cells) if len(block.data)]
    kinds = sorted({mesh.cells[index].type for index in blocks})
    if len(kinds) != 1 or kinds[0] not in CELL_KINDS.values():
        known = ", ".join(CELL_KINDS.values())
        told = ", ".join(kinds) or "none"
        raise DatasetError(
            f"the cells of a scene are of one kind ({known}), but this mesh has: {told}. Use ast_sim.read_scene for it"
        )
    fields = {key: mesh.point_data[key] for key in ("node_type", "body") if key in mesh.point_data}
    if "material" in mesh.cell_data:
        parts = [np.asarray(mesh.cell_data["material"][index]) for index in blocks]
        fields["material"] = np.concatenate([part.reshape(len(part), -1) for part in parts])
    return mesh.points, np.concatenate([mesh.cells[index].data for index in blocks]), fields


def mesh_of_arrays(
    position: np.ndarray, elements: np.ndarray, node_type: np.ndarray, body: np.ndarray, material: np.ndarray | None
) -> meshio.Mesh:
    """What `Scene.to_meshio` returns."""
    import meshio

    return meshio.Mesh(  # of copies, to which its owner can write
        position.copy(),
        [(CELL_KINDS[elements.shape[1]], elements.copy())],
        point_data={"node_type": node_type.copy(), "body": body.copy()},
        cell_data={} if material is None else {"material": [material.copy()]},
    )
