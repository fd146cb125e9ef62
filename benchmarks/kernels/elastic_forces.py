"""Elastic forces of tetrahedra and their gradient, beside the composition in torch and sums in NumPy."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from ast_sim.ops import TetrahedronSet, elastic_forces
from ast_sim.ops.library import OPS
from benchmarks.kernels.case import Case

CELLS = [(6, 6, 7), (10, 10, 10), (45, 45, 46)]  # 392, 1,331 and about 100,000 nodes


def cases() -> list[Case]:
    return [_case(cells, backward) for cells in CELLS for backward in (False, True)]


def box(cells: tuple[int, int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Nodes and elements of a box of unit cubes, each cut into six tetrahedra around its diagonal."""
    nodes = torch.stack(torch.meshgrid(*(torch.arange(n + 1) for n in cells), indexing="ij"), -1).reshape(-1, 3)
    stride = torch.tensor([(cells[1] + 1) * (cells[2] + 1), cells[2] + 1, 1])
    first = nodes[(nodes < torch.tensor(cells)).all(1)] @ stride
    paths = torch.tensor(list(itertools.permutations(stride.tolist())))  # along the edges to the opposite corner
    corners = torch.cat([torch.zeros(6, 1, dtype=torch.int64), paths.cumsum(1)], 1)
    return nodes.float(), (first[:, None, None] + corners).reshape(-1, 4)


def _by_numpy(position: np.ndarray, rest: np.ndarray, lame: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """The same forces as sums over indices, as a finite element library assembles them."""
    Ds, Dm = ((x[elements[:, 1:]] - x[elements[:, :1]]).transpose(0, 2, 1) for x in (position, rest))
    inverse, volume = np.linalg.inv(Dm), np.abs(np.linalg.det(Dm)) / 6
    F = np.einsum("eij,ejk->eik", Ds, inverse)
    G = (np.einsum("eki,ekj->eij", F, F) - np.eye(3, dtype=F.dtype)) / 2
    S = lame[:, 0, None, None] * np.einsum("eii->e", G)[:, None, None] * np.eye(3, dtype=F.dtype)
    S += 2 * lame[:, 1, None, None] * G
    H = -np.einsum("e,eij,ejk,elk->eli", volume, F, S, inverse, optimize=["einsum_path", (1, 2), (1, 2), (0, 1)])
    corners = np.concatenate([-H.sum(1, keepdims=True), H], 1).reshape(-1, 3)
    index = elements.ravel()
    return np.stack([np.bincount(index, corners[:, i], len(position)) for i in range(3)], 1)


def _case(cells: tuple[int, int, int], backward: bool) -> Case:
    g = torch.Generator().manual_seed(0)
    rest, elements = box(cells)
    position = (rest + 0.1 * torch.randn(rest.shape, generator=g)).requires_grad_(backward)
    lame, dforce = torch.rand(len(elements), 2, generator=g) + 0.5, torch.randn(rest.shape, generator=g)
    tets = TetrahedronSet.from_elements(elements, len(rest))
    arrays = (rest, lame, tets.elements, tets.node_order, tets.node_offsets)

    def call(function):
        def with_gradient():
            force = function()
            return [force, *torch.autograd.grad(force, position, dforce)]

        return with_gradient if backward else lambda: [function()]

    ours = call(lambda: elastic_forces(position, rest, lame, tets))
    peers = {"torch composition": call(lambda: OPS["elastic_forces"].composition(position, *arrays))}
    if not backward:
        of_numpy = [x.numpy() for x in (position, rest, lame, elements)]
        peers["NumPy einsum"] = lambda: [torch.from_numpy(_by_numpy(*of_numpy)).float()]

    def check() -> None:
        for peer in peers.values():
            for a, b in zip(ours(), peer(), strict=True):
                assert (a - b).abs().max() <= 1e-5 * b.abs().max()

    op = f"elastic_forces, {'forward and backward' if backward else 'forward'}"
    return Case(op, f"{len(rest)} nodes, {len(elements)} elements", ours, peers, len(elements), None, check)
