"""The process of one state of the repository in `newton`: it makes Newton steps, and tells their processor time.

Usage: `newton_worker.py CASE REPEATS`. It is run as a file, since the other state need not have it.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

import ast_sim
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linearised.linearised_contact import NewtonSteps

STEPS = 3
DEPTH = 0.02  # of the press, in metres
CLEARANCE = 8e-4
# Cells of the plate, or of each of two blocks of the same size.
CASES = {
    "plate of 1,302 nodes": (24, 16, 2),
    "plate of 6,132 nodes": (54, 36, 2),
    "plate of 25,791 nodes": (112, 75, 2),
    "plate of 155,231 nodes": (240, 160, 3),
    "two blocks of 1,458 nodes": (8, 8, 8),
    "two blocks of 26,450 nodes": (22, 22, 24),
}


def plate(cells: tuple[int, int, int]) -> tuple[ast_sim.Scene, np.ndarray, float]:
    """A plate, held at both ends, that a box presses in; a guess of its positions; no friction."""
    scene = ast_sim.Scene.join(
        ast_sim.plate((0.48, 0.32, 0.03), cells=cells),
        ast_sim.box((-0.05, -0.05, 0.0155), (0.05, 0.05, 0.1155), cells=(2, 2, 2)),
    )
    kinds = np.full(scene.num_nodes, ast_sim.NodeType.NORMAL, np.uint8)
    position = scene.rest_position.astype(np.float64)
    kinds[(scene.body == 0) & (abs(position[:, 0]) > 0.24 - 1e-6)] = ast_sim.NodeType.HANDLE
    kinds[scene.body == 1] = ast_sim.NodeType.OBSTACLE
    bent = (1 - (position[:, 0] / 0.24) ** 2) ** 2
    position[:, 2] -= DEPTH * np.where(scene.body == 1, 1, bent)
    return _typed(scene, kinds), position, 0.0


def two_blocks(cells: tuple[int, int, int]) -> tuple[ast_sim.Scene, np.ndarray, float]:
    """Two blocks that are pressed together over a whole side; a guess of their positions; with friction."""
    scene = ast_sim.Scene.join(
        ast_sim.box((-0.1, -0.1, 0), (0.1, 0.1, 0.2), cells=cells),
        ast_sim.box((-0.09, -0.09, 0.201), (0.09, 0.09, 0.401), cells=cells),
    )
    kinds = np.full(scene.num_nodes, ast_sim.NodeType.NORMAL, np.uint8)
    position = scene.rest_position.astype(np.float64)
    height = position[:, 2] / position[:, 2].max()
    kinds[(height < 1e-6) | (height > 1 - 1e-6)] = ast_sim.NodeType.HANDLE
    position[:, 2] -= DEPTH * height
    return _typed(scene, kinds), position, 0.15


def _typed(scene: ast_sim.Scene, kinds: np.ndarray) -> ast_sim.Scene:
    return ast_sim.Scene(scene.rest_position, scene.elements, kinds, scene.body)


def main() -> None:
    name, repeats = sys.argv[1], int(sys.argv[2])
    setups, steps = [], []
    for _ in range(repeats):
        scene, position, friction = (plate if name.startswith("plate") else two_blocks)(CASES[name])
        marks = [time.process_time()]
        solver = NewtonSteps(scene, NeoHookean(1e6, 0.4), CLEARANCE, friction)
        marks.append(time.process_time())
        for step in range(STEPS):
            position = solver.step(position, from_afar=step == 0)
            marks.append(time.process_time())
        setups.append(marks[1] - marks[0])
        steps.append(np.diff(marks[1:]).tolist())
    free = ~scene.prescribed
    print(
        json.dumps({"setup": setups, "steps": steps, "position": position[free][:: max(1, free.sum() // 500)].tolist()})
    )


if __name__ == "__main__":
    main()
