"""Small scenes and trajectories that the data tests share."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import h5py
import numpy as np

from ast_sim.batches.graph import Graph
from ast_sim.dataset.layout import (
    ARRAYS,
    HASH,
    DatasetInfo,
    array_hash,
    plain_value,
    trajectory_hash,
    write_attributes,
)
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.element_topology import signed_volumes, turned_over
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.simulate.shapes.mesh import second_order


def block(nx: int, ny: int, nz: int, material: np.ndarray | None = None) -> Scene:
    """A block of nx x ny x nz unit cubes, six tetrahedra each; the nodes with x = 0 are handles."""
    points = np.stack(np.meshgrid(*(np.arange(n + 1) for n in (nx, ny, nz)), indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(nx + 1, ny + 1, nz + 1)
    corner = {
        (i, j, k): number[i : i + nx, j : j + ny, k : k + nz].ravel() for i in (0, 1) for j in (0, 1) for k in (0, 1)
    }
    # Each tetrahedron follows one path of the three axes from corner 000 to corner 111.
    paths = [((1, 0, 0), (1, 1, 0)), ((1, 0, 0), (1, 0, 1)), ((0, 1, 0), (1, 1, 0))]
    paths += [((0, 1, 0), (0, 1, 1)), ((0, 0, 1), (1, 0, 1)), ((0, 0, 1), (0, 1, 1))]
    elements = np.array([np.stack([corner[0, 0, 0], corner[a], corner[b], corner[1, 1, 1]], 1) for a, b in paths])
    elements = elements.reshape(-1, 4).astype(np.int32)
    return Scene(
        rest_position=points.astype(np.float32),
        elements=turned_over(elements, signed_volumes(points, elements) < 0),
        node_type=np.where(points[:, 0] == 0, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8),
        body=np.zeros(len(points), np.int32),
        material=material,
    )


def raised(scene: Scene) -> Scene:
    """The block with nodes in the middles of its edges: second-order tetrahedra."""
    position, elements = second_order(scene.rest_position.astype(float), scene.elements)
    types = np.where(position[:, 0] == 0, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    return Scene(np.float32(position), np.int32(elements), types, np.zeros(len(position), np.int32), scene.material)


def trajectory(
    scene: Scene, frames: int, seed: int = 0, stress: str = "none", tensor: bool = False, **attributes
) -> Trajectory:
    """A random walk of the nodes, and random stress at the location; with `tensor` also random Cauchy stress."""
    generator = np.random.default_rng(seed)
    steps = 0.01 * generator.standard_normal((frames, scene.num_nodes, 3))
    rows = {"none": 0, "node": scene.num_nodes, "element": scene.num_elements}[stress]
    return Trajectory(
        scene=scene,
        position=(scene.rest_position + np.cumsum(steps, axis=0)).astype(np.float32),
        stress=generator.random((frames, rows, 1), np.float32) if rows else None,
        attributes={"seed": seed, **attributes},
        cauchy_stress=generator.random((frames, scene.num_elements, 6), np.float32) if tensor else None,
    )


def info(**changes) -> DatasetInfo:
    values = {
        "family": "test",
        "integration": "quasi_static",
        "stress_location": "none",
        "domain_center": (0.5, 0.5, 0.5),
        "domain_half_width": 2.0,
        "contact_radius": 0.01,
        "time_step": 0.0,
    }
    return DatasetInfo(**{**values, **changes})


def write(path, trajectories: dict[str, Iterable[Trajectory]], **changes):
    """A dataset file of these trajectories; returns its path."""
    with DatasetWriter(path, info(**changes)) as writer:
        for split, members in trajectories.items():
            for member in members:
                writer.add(split, member)
    return path


def mesh_graph(scene: Scene) -> Graph:
    """What a model without element nodes needs of a scene."""
    return Graph.from_scene(scene, element_nodes=False)


def sign(file: h5py.File) -> None:
    """Give every trajectory of an edited file hashes that fit, as one who knows the format would; what cannot be read
    stays as it is."""
    for name in ("train/000000", "train/000001", "test/000000"):
        with contextlib.suppress(OSError, RuntimeError, TypeError, KeyError):
            sample, hashes = file[name], {}
            for key in (key for key in ARRAYS if key in sample):
                array = sample[key]
                readable = array.nbytes < 1 << 20 and not array.external
                hashes[key] = array_hash(array.dtype, array.shape, [array[()]]) if readable else ""
                write_attributes(array, {HASH: hashes[key]})
            attributes = {key: plain_value(value) for key, value in sample.attrs.items()}
            write_attributes(sample, {HASH: trajectory_hash(hashes, attributes)})
