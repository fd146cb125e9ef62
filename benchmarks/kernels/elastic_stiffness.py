"""The stiffness of elastic tetrahedra and its projection, beside NumPy with the eigenvectors of 9 x 9 matrices."""

from __future__ import annotations

import numpy as np

import ast_sim
from ast_sim.mechanics.elements.elasticity import stiffness
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import elastic_body
from ast_sim.simulate.shapes.mesh import second_order
from benchmarks.kernels.case import Case

CELLS = {4: ((6, 6, 7), (10, 10, 10), (26, 26, 26)), 10: ((6, 6, 7), (10, 10, 10))}  # by the nodes of an element


def by_numpy(
    F: np.ndarray,
    gradients: np.ndarray,
    volume: np.ndarray,
    mu: float | np.ndarray,
    c: np.ndarray,
    spread: np.ndarray,
    project: bool,
) -> np.ndarray:
    """As `stiffness`: the second derivative by F as a 9 x 9 matrix at each point, its eigenvalues, and its product with
    the derivatives of F by the nodes."""
    nodes, points = len(gradients), len(volume)
    T = np.linalg.inv(F.transpose(2, 1, 0))  # F^-T
    identity = np.eye(3)
    second = np.einsum("p,ik,jl->pijkl", np.broadcast_to(mu, points), identity, identity)
    second += np.einsum("p,pij,pkl->pijkl", spread, T, T) - np.einsum("p,pil,pkj->pijkl", c, T, T)
    second = second.reshape(-1, 9, 9)
    if project:
        values, vectors = np.linalg.eigh(second)
        second = (vectors * np.maximum(values, 0)[:, None]) @ vectors.transpose(0, 2, 1)
    by_nodes = np.einsum("ik,ajp->paikj", identity, gradients).reshape(points, 3 * nodes, 9)
    full = volume[:, None, None] * (by_nodes @ second @ by_nodes.transpose(0, 2, 1))
    full = full.reshape(1 if nodes == 4 else 4, -1, 3 * nodes, 3 * nodes).sum(axis=0)
    return np.ascontiguousarray(full[:, *np.triu_indices(3 * nodes)].T)


def cases() -> list[Case]:
    return [_case(nodes, cells, project) for nodes in CELLS for cells in CELLS[nodes] for project in (False, True)]


def _case(nodes: int, cells: tuple[int, int, int], project: bool) -> Case:
    scene = ast_sim.box((0, 0, 0), (1, 1, 1), cells=cells)
    rest, elements = scene.rest_position.astype(np.float64), scene.elements.astype(np.int64)
    if nodes == 10:
        rest, elements = second_order(rest, elements)
    body = elastic_body(rest, elements, NeoHookean(1e6, 0.4))
    at_random = 0.05 / max(cells) * np.random.default_rng(0).normal(size=rest.shape)
    deformation = body.evaluate(rest * [1.2, 1.0, 0.7] + at_random)
    J, law = deformation.J, body.material
    arguments = deformation.F, body.gradients, body.volume, law.mu, law.pressure_factor(J), law.lam * J * J, project

    def check() -> None:
        exact = by_numpy(*arguments)
        assert np.abs(stiffness(*arguments) - exact).max() < 1e-12 * np.abs(exact).max()

    what = f"elastic_stiffness, {'projected' if project else 'as it is'}"
    shape = f"{len(elements)} elements of {nodes} nodes"
    peers = {"NumPy": lambda: by_numpy(*arguments)}
    return Case(what, shape, lambda: stiffness(*arguments), peers, len(elements), None, check)
