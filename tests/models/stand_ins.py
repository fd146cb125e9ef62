"""Structured scenes of each family's kind, with invented motion: enough to run a model, not to judge one."""

import numpy as np
from meshes import box

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import NodeType, Scene, Trajectory


def sheet(cells, size, height) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and triangles of a rectangle."""
    x, y = (np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, cells, strict=True))
    nodes = np.stack([*(a.ravel() for a in np.meshgrid(x, y, indexing="ij")), np.full(len(x) * len(y), height)], axis=1)
    index = np.arange(len(nodes)).reshape(len(x), len(y))
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return nodes, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def trajectory(family: str, seed: int = 0, frames: int = 5) -> Trajectory:
    """Two bodies, the second above the first; the lower one sags, the upper one moves down."""
    rng = np.random.default_rng(seed)
    if family == "sphere_simple":
        parts = [sheet((9, 8), (0.5, 0.5), 0.0), sheet((3, 3), (0.1, 0.1), -0.1)]
    else:
        parts = [box((6, 4, 2), (0.5, 0.3, 0.1), (0, 0, 0)), box((2, 2, 2), (0.12, 0.12, 0.1), (0.05, 0, 0.12))]
    sizes = [len(nodes) for nodes, _ in parts]
    rest = np.concatenate([nodes for nodes, _ in parts])
    elements = np.concatenate([parts[0][1], parts[1][1] + sizes[0]])
    body = np.repeat([0, 1], sizes)
    kind = np.where(body == 0, NodeType.NORMAL, NodeType.OBSTACLE)
    kind[(body == 0) & (np.abs(rest[:, 0]) > 0.249)] = NodeType.HANDLE
    if family in ("abcd", "abcd_xl"):  # two deforming bodies: only the outer faces are prescribed
        kind = np.where(np.abs(rest[:, 2] - np.where(body == 0, -0.05, 0.17)) < 1e-6, NodeType.HANDLE, NodeType.NORMAL)
    time = np.linspace(0, 1, frames)[:, None]
    shape = np.where(body == 0, np.clip(1 - (rest[:, 0] / 0.25) ** 2, 0, 1), 1.0)
    position = np.repeat(rest[None], frames, axis=0)
    position[:, :, 2] -= 0.02 * time**2 * shape * rng.uniform(0.5, 1.5)
    rows = {"deforming_plate": len(rest), "abcd_xl": len(elements)}.get(family)
    stress = None if rows is None else (1e4 * time[:, :, None] * rng.random((1, rows, 1))).astype(np.float32)
    material = rng.uniform(0.5, 2, (len(elements), 1)).astype(np.float32) if family.startswith("abcd") else None
    scene = Scene(
        rest.astype(np.float32), elements.astype(np.int32), kind.astype(np.uint8), body.astype(np.int32), material
    )
    return Trajectory(scene, position.astype(np.float32), stress, {"seed": seed})


def write(path, family: str, count: int = 2, frames: int = 5):
    """A dataset file with `count` training trajectories of the family's kind; returns its path."""
    info = DatasetInfo(
        family=family,
        integration="dynamic" if family == "sphere_simple" else "quasi_static",
        stress_location={"deforming_plate": "node", "abcd_xl": "element"}.get(family, "none"),
        domain_center=(0.0, 0.0, 0.0),
        domain_half_width=1.0,
        contact_radius=0.03,
        time_step=0.01 if family == "sphere_simple" else 0.0,
    )
    with DatasetWriter(path, info) as writer:
        for seed in range(count):
            writer.add("train", trajectory(family, seed, frames))
    return path
