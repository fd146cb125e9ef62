"""Scenes made by hand: a plate under a ball, a strip in 2-D, a cloth that falls on a ball, two blocks in contact."""

from __future__ import annotations

import numpy as np
from meshes import box

from ast_sim.scene import NodeType, Scene, Trajectory

RADIUS = 0.05


def plate(frames: int = 9, depth: float = 0.04, stress: str = "node", seed: int | None = None) -> Trajectory:
    """A clamped plate that a ball bends by `depth` and leaves again; `seed` adds smooth errors, as a prediction has."""
    nodes, elements = box((12, 8, 2), (0.48, 0.32, 0.03))
    ball, ball_elements = box((4, 4, 4), (2.0, 2.0, 2.0))
    largest = np.abs(ball).max(axis=1, keepdims=True)
    length = np.linalg.norm(ball, axis=1, keepdims=True)
    ball = RADIUS * ball * largest / np.where(length == 0, 1, length) + (0.05, 0.0, 0.015 + RADIUS)
    n = len(nodes)
    node_type = np.concatenate([np.full(n, NodeType.NORMAL), np.full(len(ball), NodeType.OBSTACLE)]).astype(np.uint8)
    node_type[:n][np.abs(nodes[:, 0]) > 0.239] = NodeType.HANDLE
    rest = np.concatenate([nodes, ball]).astype(np.float32)
    scene = Scene(
        rest,
        np.concatenate([elements, ball_elements + n]).astype(np.int32),
        node_type,
        np.concatenate([np.zeros(n), np.ones(len(ball))]).astype(np.int32),
    )
    amplitude = depth * np.sin(np.pi * np.arange(frames) / max(frames - 1, 1))
    shape = np.cos(np.pi * nodes[:, 0] / 0.48) ** 2 * (1 - 0.4 * (nodes[:, 1] / 0.16) ** 2)
    position = np.repeat(rest[None], frames, axis=0)
    position[:, :n, 2] -= amplitude[:, None] * shape
    position[:, n:, 2] -= amplitude[:, None]
    bending = np.abs(np.cos(2 * np.pi * nodes[:, 0] / 0.48)) * (0.2 + np.abs(nodes[:, 2]) / 0.015)
    values = np.zeros((frames, len(rest)))
    values[:, :n] = 1.2e6 * amplitude[:, None] * bending
    if seed is not None:
        rng = np.random.default_rng(seed)
        wave = np.sin(rng.uniform(5, 15, 2) @ nodes[:, :2].T + rng.uniform(0, 6))
        free = node_type[:n] == NodeType.NORMAL
        position[:, :n, 2] += 0.15 * amplitude[:, None] * wave * free
        values[:, :n] *= 1 + 0.3 * wave
    if stress == "element":
        values = values[:, scene.elements].mean(axis=2)
    field = None if stress == "none" else values[:, :, None].astype(np.float32)
    attributes = {"status": "complete", "seed": 7, "solve_seconds": [0.03] * frames}
    return Trajectory(scene, position, field, attributes)


def strip(frames: int = 6, stress: str = "element") -> Trajectory:
    """A 2-D strip of triangles, pulled at its right end and pressed by a square obstacle."""
    shape, size = (10, 4), (0.5, 0.1)
    axes = [np.linspace(0, s, n + 1) for s, n in zip(size, shape, strict=True)]
    nodes = np.stack([*(a.ravel() for a in np.meshgrid(*axes, indexing="ij")), np.zeros(55)], axis=1)
    index = np.arange(len(nodes)).reshape(shape[0] + 1, shape[1] + 1)
    a, b, c, d = (index[i : i + shape[0], j : j + shape[1]].ravel() for i, j in np.ndindex(2, 2))
    triangles = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    square = np.array([(0.2, 0.12, 0), (0.3, 0.12, 0), (0.3, 0.2, 0), (0.2, 0.2, 0)])
    rest = np.concatenate([nodes, square]).astype(np.float32)
    elements = np.concatenate([triangles, np.array([(0, 1, 2), (0, 2, 3)]) + len(nodes)]).astype(np.int32)
    node_type = np.full(len(rest), NodeType.NORMAL, dtype=np.uint8)
    node_type[: shape[1] + 1] = NodeType.HANDLE
    node_type[len(nodes) :] = NodeType.OBSTACLE
    body = (np.arange(len(rest)) >= len(nodes)).astype(np.int32)
    scene = Scene(rest, elements, node_type, body)
    growth = np.arange(frames) / max(frames - 1, 1)
    position = np.repeat(rest[None], frames, axis=0)
    position[:, : len(nodes), 1] -= 0.3 * growth[:, None] * nodes[:, 0] ** 2
    position[:, len(nodes) :, 1] -= 0.05 * growth[:, None]
    values = 1e5 * growth[:, None] * (1 + rest[scene.elements].mean(axis=1)[:, 0])[None]
    if stress == "node":
        values = 1e5 * growth[:, None] * (1 + rest[:, 0])[None]
    field = None if stress == "none" else values[:, :, None].astype(np.float32)
    return Trajectory(scene, position, field, {"status": "complete"})


def cloth(frames: int = 9, cells: int = 12) -> Trajectory:
    """A square cloth of triangles that falls over a ball, which is an obstacle of triangles; dynamic, no stress."""
    axis = np.linspace(-0.5, 0.5, cells + 1)
    nodes = np.stack([*(a.ravel() for a in np.meshgrid(axis, axis, indexing="ij")), np.zeros((cells + 1) ** 2)], axis=1)
    index = np.arange(len(nodes)).reshape(cells + 1, cells + 1)
    a, b, c, d = (index[i : i + cells, j : j + cells].ravel() for i, j in np.ndindex(2, 2))
    triangles = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])
    solid, solid_elements = box((4, 4, 4), (2.0, 2.0, 2.0))
    skin = Scene(solid.astype(np.float32), solid_elements.astype(np.int32), *np.zeros((2, len(solid)))).surface()
    used, skin = np.unique(skin, return_inverse=True)
    ball = solid[used] / np.linalg.norm(solid[used], axis=1, keepdims=True) * 0.2 + (0, 0, -0.22)
    rest = np.concatenate([nodes, ball]).astype(np.float32)
    kinds = np.repeat([NodeType.NORMAL, NodeType.OBSTACLE], [len(nodes), len(ball)]).astype(np.uint8)
    elements = np.concatenate([triangles, skin.reshape(-1, 3) + len(nodes)]).astype(np.int32)
    scene = Scene(rest, elements, kinds, (kinds == NodeType.OBSTACLE).astype(np.int32))
    growth = np.linspace(0, 1, frames)[:, None]
    position = np.repeat(rest[None], frames, axis=0)
    position[:, : len(nodes), 2] -= 0.45 * growth * np.hypot(*nodes[:, :2].T)
    return Trajectory(scene, position, None, {"status": "complete", **records(frames, 0.004)})


def pair(frames: int = 9, cells: int = 4, crush: float = 0.1) -> Trajectory:
    """Two blocks of tetrahedra, the upper one pressed down on the lower: stress in elements, no obstacle."""
    shape = (2 * cells, 2 * cells, cells)
    lower, elements = box(shape, (0.6, 0.6, 0.3), (0, 0, -0.155))
    upper, _ = box(shape, (0.4, 0.4, 0.3), (0.05, 0, 0.155))
    n = len(lower)
    rest = np.concatenate([lower, upper]).astype(np.float32)
    node_type = np.where(np.isin(rest[:, 2], rest[[0, -1], 2]), NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    material = np.repeat([[1e6, 0.45], [2e6, 0.4]], len(elements), axis=0).astype(np.float32)
    scene = Scene(
        rest,
        np.concatenate([elements, elements + n]).astype(np.int32),
        node_type,
        np.repeat([0, 1], n).astype(np.int32),
        material,
    )
    growth = np.linspace(0, 1, frames)[:, None]
    height = (rest[:, 2] - rest[0, 2]) / (rest[-1, 2] - rest[0, 2])
    position = np.repeat(rest[None], frames, axis=0)
    position[:, :, 2] -= crush * growth * height
    position[:, :, :2] *= (1 + 0.3 * crush * growth * np.sin(np.pi * height))[:, :, None]
    middle = rest[scene.elements].mean(axis=1)
    stress = 1e6 * crush * growth * (1 + np.cos(4 * middle[:, 0]))[None]
    attributes = {"status": "complete", **records(frames, 0.02), "young": [1e6, 2e6], "poisson": [0.45, 0.4]}
    return Trajectory(scene, position, stress[:, :, None].astype(np.float32), attributes)


def records(frames: int, area: float) -> dict[str, list[float] | float | str]:
    """What a solver records of a sample, by hand."""
    steps = np.arange(frames)
    return {
        "newton_iterations": [0.0, *(3.0 + steps[1:] % 5)],
        "contact_area": (area * steps / max(frames - 1, 1)).tolist(),
        "min_gap": 4e-4,
        "min_jacobian": 0.6,
        "max_residual": 0.8,
        "work": (0.5 * steps**2).tolist(),
        "elastic_energy": (0.5 * steps**2).tolist(),
        "contact_energy": [0.0] * frames,
        "dissipation": [0.0] * frames,
        "dhat": 1e-3,
        "friction": 0.0,
        "solver": "ipc",
    }
