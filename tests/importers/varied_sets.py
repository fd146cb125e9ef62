"""Random sets of simulations, as varied as ordinary ones, made by formulas: no finding may take them for a fault."""

from dataclasses import replace
from itertools import permutations

import numpy as np
from data_samples import block

from ast_sim.scene import NodeType, Scene, Trajectory

PRESSED = 5  # frames
CATALOG = [(2.1e11, 0.3), (7e10, 0.33), (2e8, 0.42), (2e9, 0.35), (5e6, 0.49), (2e5, 0.49), (1.2e12, 0.1), (2e6, 0.48)]


def simulation(rng, size, material=None, yields=np.inf, press=0.1, at="node", columns=True, cells=(3, 3, 2)):
    """A block that bends and is pressed from above, held at z = 0, moved at its top. The stress goes with the strain
    up to where it yields."""
    mesh = block(*cells)
    rest = mesh.rest_position * np.array(size) / np.array(cells)
    low, high = rest[:, 2].min(), rest[:, 2].max()
    types = np.where(rest[:, 2] == low, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    types[rest[:, 2] == high] = NodeType.HANDLE
    depth = (rest[:, 2] - low) / (high - low)
    bend = rng.uniform(0, 0.3)
    shape = depth[:, None] ** rng.uniform(1, 3) * [bend, 0, -1]
    shape[:, 0] += 0.2 * np.sin(np.pi * depth) * rest[:, 1] / size[1]
    travel = np.linspace(0, press * size[2], PRESSED)
    position = (rest + travel[:, None, None] * shape).astype(np.float32)
    young, poisson = material or (1e6, 0.4)
    scene = Scene(rest.astype(np.float32), mesh.elements, types, np.zeros(len(rest), np.int32))
    values = np.full((mesh.num_elements, 2), (young, poisson), np.float32) if columns else None
    stress = young * np.minimum(strain(scene, position), yields) * rng.uniform(0.8, 1.25, (1, mesh.num_elements))
    if at == "node":
        sums = np.zeros((PRESSED, len(rest)))
        count = np.bincount(mesh.elements.ravel(), minlength=len(rest))
        for corner in mesh.elements.T:
            for frame in range(PRESSED):
                np.add.at(sums[frame], corner, stress[frame])
        stress = sums / count
    attributes = {"material": "young, poisson"} if columns else {}
    stress = stress[..., None].astype(np.float32)
    return Trajectory(replace(scene, material=values), position, stress, attributes, stress_location=at)


def strain(scene, position):
    """[S, E]: the largest stretch of an element less 1; another measure than the one under test."""
    edges = [np.diff(x[..., scene.elements, :].astype(float), axis=-2) for x in (scene.rest_position, position)]
    gradient = np.linalg.inv(edges[0])[None] @ edges[1]
    return np.abs(np.linalg.svd(gradient, compute_uv=False) - 1).max(axis=-1)


def turned(trajectory, turn):
    """A simulation whose points are moved by `turn`, a function of points [..., 3]."""
    rest = turn(trajectory.scene.rest_position).astype(np.float32)
    position = turn(trajectory.position).astype(np.float32)
    return replace(trajectory, scene=replace(trajectory.scene, rest_position=rest), position=position)


def rotation(rng):
    """A turn by a multiple of 90 degrees about some axes, without a mirror."""
    order = list(permutations(range(3)))[rng.integers(6)]
    matrix = np.eye(3)[list(order)] * rng.choice([-1, 1], 3)[:, None]
    matrix[0] *= np.linalg.det(matrix)
    return lambda points: points @ matrix.T


def varied_set(rng):
    """From 2 to 25 simulations that differ as the simulations of one study do."""
    base = np.array([10, 6, 1]) * 10 ** rng.uniform(-3, 2) * rng.uniform(0.5, 2, 3)
    spread = rng.choice([0.0, 0.2, 1.0])
    at = rng.choice(["node", "element"])
    what = rng.choice(["one", "catalog", "drawn", "decades", "unnamed"])
    plastic = rng.random() < 0.3
    turns = rng.choice(["none", "all", "few"])
    cells = tuple(rng.integers(2, 4, 3).tolist())
    simulations = []
    for _ in range(rng.integers(2, 26)):
        material = {
            "one": CATALOG[0],
            "unnamed": CATALOG[4],
            "catalog": CATALOG[rng.integers(len(CATALOG))],
            "drawn": (10 ** rng.uniform(4, 12), rng.uniform(0, 0.49)),
            "decades": (10.0 ** rng.integers(3, 13), 0.3),
        }[what]
        size = base * np.exp(rng.uniform(-spread, spread, 3))
        press = 10 ** rng.uniform(-3, -0.5)
        yields = 10 ** rng.uniform(-4, -1) if plastic and rng.random() < 0.7 else np.inf
        one = simulation(rng, size, material, yields, press, at, what != "unnamed", cells)
        if plastic and rng.random() < 0.5:
            one = replace(one, position=one.position[-1:], stress=one.stress[-1:])
        if turns == "all" or (turns == "few" and rng.random() < 0.2):
            one = turned(one, rotation(rng))
        simulations.append(one)
    return simulations
