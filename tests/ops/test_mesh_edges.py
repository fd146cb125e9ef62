"""Edges and outer faces of a mesh, and the sort behind them: against compositions, numpy and by hand."""

import numpy as np
import pytest
import torch
from checks import assert_same_everywhere
from meshes import box

from ast_sim.element_topology import (
    LOCAL_EDGES,
    LOCAL_FACES,
    signed_volumes,
    surface_triangles,
    triangles_of_faces,
    unique_edges,
)
from ast_sim.ops import counting_sort, mesh_edges, outer_faces
from ast_sim.ops._edges import _counting_sort, _mesh_edges, _outer_faces


def mixed(cells):
    """The nodes and elements of a box of tetrahedra, whose nodes are numbered at random."""
    nodes, elements = box(cells, (1, 1, 1))
    number = np.random.default_rng(0).permutation(len(nodes))
    there = np.empty_like(nodes)
    there[number] = nodes
    return there, torch.from_numpy(number[elements].astype(np.int64))


def test_two_tetrahedra_by_hand():
    elements = torch.tensor([[0, 1, 2, 3], [1, 2, 3, 5]])
    edges = mesh_edges(elements, 6)
    neighbours = [[1, 2, 3], [0, 2, 3, 5], [0, 1, 3, 5], [0, 1, 2, 5], [], [1, 2, 3]]
    assert edges.senders.tolist() == sum(neighbours, [])
    assert edges.receivers.tolist() == [node for node, others in enumerate(neighbours) for _ in others]
    assert edges.receiver_offsets.tolist() == [0, 3, 7, 11, 15, 15, 18] and edges.num_senders == 6
    # Of the first all but the face 1 2 3, which is its last one; of the second all but its first one.
    assert outer_faces(elements, 6).tolist() == [0, 1, 2, 5, 6, 7]
    # Nodes of no element cost nothing, however many there are.
    assert outer_faces(elements, 2**40).tolist() == [0, 1, 2, 5, 6, 7]


def test_pairs_are_edges():
    edges = mesh_edges(torch.tensor([[2, 0], [1, 2]]), 3)
    assert (edges.senders.tolist(), edges.receivers.tolist()) == ([2, 2, 0, 1], [0, 1, 2, 2])
    assert len(mesh_edges(torch.zeros(0, 2, dtype=torch.int64), 0)) == 0


@pytest.mark.parametrize("cells", [(1, 1, 1), (7, 4, 3), (40, 40, 20)])
def test_a_mesh_has_the_edges_and_faces_that_numpy_finds(cells):
    nodes, elements = mixed(cells)  # the last one has more nodes than a task
    edges = mesh_edges(elements, len(nodes))
    once = edges.receivers < edges.senders
    pairs = torch.stack([edges.receivers, edges.senders], dim=1)[once]
    assert np.array_equal(pairs.numpy(), unique_edges(elements.numpy().astype(np.int32), len(nodes)))
    volumes = signed_volumes(nodes, elements.numpy())
    triangles = triangles_of_faces(elements.numpy(), outer_faces(elements, len(nodes)).numpy(), volumes)
    assert np.array_equal(triangles, surface_triangles(nodes, elements.numpy()))


@pytest.mark.parametrize("corners", [3, 4, 10])
@pytest.mark.parametrize("nodes", [1, 30, 500])
def test_the_kernels_are_the_compositions(nodes, corners):
    generator = torch.Generator().manual_seed(nodes)
    elements = torch.randint(0, nodes, (nodes, corners), generator=generator)
    elements[: nodes // 2, 0] = 0  # at this node there are many
    ends = torch.tensor(LOCAL_EDGES[corners])
    for ours, expected in zip(
        _mesh_edges(nodes, elements, ends), _mesh_edges.composition(nodes, elements, ends), strict=True
    ):
        assert torch.equal(ours, expected)
    if corners > 3:
        faces = torch.tensor(LOCAL_FACES)
        (ours,), (expected,) = (op(nodes, elements, faces) for op in (_outer_faces, _outer_faces.composition))
        assert torch.equal(ours, expected)
    places = counting_sort(elements.flatten(), nodes)
    for ours, expected in zip(places, _counting_sort.composition(nodes, elements.flatten()), strict=True):
        assert torch.equal(ours, expected)


CODE = """
import hashlib, torch
from ast_sim.ops import counting_sort, mesh_edges, outer_faces
elements = torch.randint(0, 300, (900, 4), generator=torch.Generator().manual_seed(1))
edges = mesh_edges(elements, 300)
results = [edges.senders, edges.receiver_offsets, outer_faces(elements, 300), *counting_sort(elements.flatten(), 300)]
print(hashlib.sha256(torch.cat(results).numpy().tobytes()).hexdigest())
"""


def test_every_instruction_set_gives_the_same():
    assert_same_everywhere(CODE)


def test_what_does_not_fit_is_refused():
    elements = torch.tensor([[0, 1, 2, 3]])
    with pytest.raises(ValueError, match=r"mesh_edges: elements\[0, 3\] = 3 is not an index below 3"):
        mesh_edges(elements, 3)
    with pytest.raises(ValueError, match=r"outer_faces: elements\[0, 0\] = -1 is not an index below 4"):
        outer_faces(elements - 1, 4)
    with pytest.raises(ValueError, match=r"counting_sort: index\[2\] = 2 is not an index below 2"):
        counting_sort(elements[0], 2)
    with pytest.raises(ValueError, match=r"counting_sort: num must lie in 0\.\.281474976710656, not -1"):
        counting_sort(elements[0], -1)
