"""Scenes made by hand: a bending plate of structured tetrahedra under an analytic ball, a stretched strip in 2-D."""

from __future__ import annotations

import numpy as np
from meshes import box

from ast_sim.data.scene import NodeType, Scene, Trajectory

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
