"""The edges of a mesh, its outer faces and the corners at each node, beside NumPy's and torch's sorts."""

from __future__ import annotations

import numpy as np
import torch

from ast_sim.element_topology import signed_volumes, surface_triangles, triangles_of_faces, unique_edges
from ast_sim.ops import counting_sort, mesh_edges, outer_faces
from benchmarks.kernels.case import Case
from benchmarks.kernels.elastic_forces import box

CELLS = [(20, 9, 1), (10, 10, 10), (40, 40, 40)]  # 420, 1,331 and 68,921 nodes


def cases() -> list[Case]:
    return [make(*box(cells)) for cells in CELLS for make in (_edges, _faces, _corners)]


def _edges(nodes: torch.Tensor, elements: torch.Tensor) -> Case:
    count, narrow = len(nodes), elements.numpy().astype(np.int32)

    def by_sorts() -> np.ndarray:
        first, second = unique_edges(narrow, count).T.astype(np.int64)
        return np.sort(np.concatenate([first * count + second, second * count + first]))

    def check() -> None:
        edges = mesh_edges(elements, count)
        assert np.array_equal(edges.receivers * count + edges.senders, by_sorts())

    return Case(
        "mesh_edges",
        f"{count} nodes, {len(elements)} elements",
        lambda: mesh_edges(elements, count),
        {"NumPy": by_sorts},
        len(elements),
        None,
        check,
    )


def _faces(nodes: torch.Tensor, elements: torch.Tensor) -> Case:
    position, narrow = nodes.numpy(), elements.numpy().astype(np.int32)
    volumes = signed_volumes(position, narrow)

    def ours() -> np.ndarray:
        return triangles_of_faces(narrow, outer_faces(elements, len(nodes)).numpy(), volumes)

    def check() -> None:
        assert np.array_equal(ours(), surface_triangles(position, narrow))

    peers = {"NumPy": lambda: surface_triangles(position, narrow)}
    shape = f"{len(nodes)} nodes, {len(elements)} elements, oriented"
    return Case("outer_faces", shape, ours, peers, len(elements), None, check)


def _corners(nodes: torch.Tensor, elements: torch.Tensor) -> Case:
    index = elements.flatten()

    def check() -> None:
        assert torch.equal(counting_sort(index, len(nodes))[0], torch.argsort(index, stable=True))

    peers = {"torch.argsort, stable": lambda: torch.argsort(index, stable=True)}
    shape = f"{len(index)} corners at {len(nodes)} nodes"
    return Case("counting_sort", shape, lambda: counting_sort(index, len(nodes)), peers, len(index), None, check)
