"""Every op on the same few scenes, for the tests that hold for all of them.

A new op is one function and one entry of OPS. The function takes scene numbers and returns, for the batch of these
scenes, the results of each scene (outputs and gradients of its rows) and the results that the scenes share (gradients
of weights).
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ast_sim.ops import (
    CellMap,
    EdgeSet,
    Octree,
    TetrahedronSet,
    attention,
    attention_block,
    breadth_first,
    counting_sort,
    elastic_forces,
    farthest_point_sample,
    linear,
    mesh_edges,
    message_sum,
    mlp,
    octree,
    outer_faces,
    proximity,
    segment_mean,
    segment_sum,
    sparse_conv,
    sparse_conv_transposed,
)
from ast_sim.training.muon import orthogonalized

Results = tuple[list[list[Tensor]], list[Tensor]]
SIZES = [700, 1, 0, 2500, 130]  # rows of scene 0, 1, ...


def rows(scenes: Sequence[int], *width: int, key: int = 0, sizes: Sequence[int] = SIZES) -> Tensor:
    """Random rows of these scenes; a scene has the same rows in every batch."""
    parts = []
    for s in scenes:
        g = torch.Generator().manual_seed(1000 * key + s)
        parts.append(torch.randn(sizes[s], *width, generator=g))
    return torch.cat(parts)


def shared(*shape: int, key: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(7000 + key)) / 4


def offsets_of(scenes: Sequence[int], sizes: Sequence[int] = SIZES) -> Tensor:
    return torch.tensor([0, *(sizes[s] for s in scenes)]).cumsum(0)


def split(x: Tensor, offsets: Tensor) -> list[Tensor]:
    return [x[a:b] for a, b in zip(offsets[:-1], offsets[1:], strict=True)]


def differentiated(function: Callable, inputs: Sequence[Tensor], offsets: Sequence[Tensor], out: Tensor) -> Results:
    """The output of function(*inputs), whose scenes lie between the offsets `out`, and the gradients of all inputs.

    The first inputs have rows per scene, between `offsets`, one for each; the others are shared.
    """
    leaves = [x.detach().requires_grad_() for x in inputs]
    y = function(*leaves)
    cotangent = torch.cat(
        [torch.randn(n, *y.shape[1:], generator=torch.Generator().manual_seed(n)) for n in out.diff().tolist()]
    )
    gradients = torch.autograd.grad(y, leaves, cotangent)
    per_scene = zip(
        split(y.detach(), out), *(split(g, o) for g, o in zip(gradients, offsets, strict=False)), strict=True
    )
    return [list(x) for x in per_scene], list(gradients[len(offsets) :])


def by_rows(function: Callable, inputs: Sequence[Tensor], of_rows: int, offsets: Tensor) -> Results:
    return differentiated(function, inputs, [offsets] * of_rows, offsets)


# ---- the ops ----


def octree_of(scenes: Sequence[int], depth: int = 6) -> Octree:
    return octree(rows(scenes, 3).tanh(), offsets_of(scenes), (0.0, 0.0, 0.0), 1.0, depth)


def level_of(scenes: Sequence[int]) -> CellMap:
    return octree_of(scenes, 4).coarsen()


def octree_results(scenes: Sequence[int]) -> Results:
    tree, nodes = octree_of(scenes), offsets_of(scenes)
    found = []
    map = tree.coarsen()
    coarse = map.coarse
    for b in range(len(scenes)):
        fine, cells = slice(*tree.cell_offsets[b : b + 2]), slice(*coarse.cell_offsets[b : b + 2])
        node = slice(*nodes[b : b + 2])
        mine = (map.coarse_index >= cells.start) & (map.coarse_index < cells.stop)
        found.append(
            [
                tree.keys[fine],
                tree.node_cell[node] - fine.start,
                tree.node_order[node] - node.start,
                tree.coordinates()[fine],
                coarse.keys[cells],
                map.fine[mine] - fine.start,
                map.coarse_index[mine] - cells.start,
            ]
        )
    return found, [map.pair_offsets]


def sample_results(scenes: Sequence[int]) -> Results:
    points, offsets = (40 * rows(scenes, 3)).int(), offsets_of(scenes)
    indices, of_samples = farthest_point_sample(points, offsets, 60)
    return [[x - start] for x, start in zip(split(indices, of_samples), offsets[:-1], strict=True)], []


def conv_results(scenes: Sequence[int]) -> Results:
    map = level_of(scenes)
    x = torch.cat([shared(int(n), 40, key=int(n)) for n in map_fine_offsets(scenes).diff()])
    return differentiated(
        lambda x, w: sparse_conv(x, w, map),
        (x, shared(27, 40, 24)),
        [map_fine_offsets(scenes)],
        map.coarse.cell_offsets,
    )


def conv_transposed_results(scenes: Sequence[int]) -> Results:
    map = level_of(scenes)
    x = torch.cat([shared(int(n), 24, key=int(n)) for n in map.coarse.cell_offsets.diff()])
    return differentiated(
        lambda x, w: sparse_conv_transposed(x, w, map),
        (x, shared(27, 24, 40)),
        [map.coarse.cell_offsets],
        map_fine_offsets(scenes),
    )


def map_fine_offsets(scenes: Sequence[int]) -> Tensor:
    return octree_of(scenes, 4).cell_offsets


def attention_results(scenes: Sequence[int], p: float = 0.0) -> Results:
    keys = [90, 300, 7, 40, 600]
    q_offsets, k_offsets = offsets_of(scenes), offsets_of(scenes, keys)
    inputs = (
        rows(scenes, 3, 32, key=1),
        rows(scenes, 3, 32, key=2, sizes=keys),
        rows(scenes, 3, 32, key=3, sizes=keys),
    )
    return differentiated(
        lambda q, k, v: attention(q, k, v, q_offsets, k_offsets, 0.2, p, 5)[0],
        inputs,
        [q_offsets, k_offsets, k_offsets],
        q_offsets,
    )


def dropout_results(scenes: Sequence[int]) -> Results:
    return attention_results(scenes, 0.2)


def block_results(scenes: Sequence[int]) -> Results:
    keys = [90, 300, 7, 40, 600]
    q_offsets, k_offsets = offsets_of(scenes), offsets_of(scenes, keys)
    turns = (rows(scenes, 16, key=3), rows(scenes, 16, key=4, sizes=keys))
    weights = [
        shared(40),
        shared(40),
        shared(24),
        shared(24),
        shared(32, 40),
        shared(64, 24),
        shared(40, 32),
        shared(40),
    ]
    weights += [shared(40), shared(40), shared(66, 40), shared(66), shared(40, 33), shared(40)]
    vectors = (rows(scenes, 40, key=1), rows(scenes, 24, key=2, sizes=keys))
    return differentiated(
        lambda x, context, *weights: attention_block(x, context, *turns, q_offsets, k_offsets, weights, 2),
        (*vectors, *weights),
        [q_offsets, k_offsets],
        q_offsets,
    )


def edges_of(scenes: Sequence[int]) -> EdgeSet:
    """About six random edges a node within each scene."""
    sets = []
    for s in scenes:
        g = torch.Generator().manual_seed(s)
        pairs = torch.randint(0, max(SIZES[s], 1), (2, 6 * SIZES[s]), generator=g)
        sets.append(EdgeSet.from_pairs(*pairs, SIZES[s], SIZES[s]))
    return EdgeSet.concatenate(sets)


def message_results(scenes: Sequence[int]) -> Results:
    edges, offsets = edges_of(scenes), offsets_of(scenes)
    of_edges = edges.receiver_offsets[offsets]
    features = rows(scenes, 4, key=3, sizes=[6 * n for n in SIZES])
    weights = [
        shared(24, 4),
        shared(24),
        shared(40, 24),
        shared(36, 40),
        shared(36, key=1),
        shared(36),
        shared(36, key=2),
    ]
    return differentiated(
        lambda s, r, e, a, b, c, *w: message_sum(edges, s, r, e, (a, b, c), *w),
        (rows(scenes, 40, key=1), rows(scenes, 40, key=2), features, *weights),
        [offsets, offsets, of_edges],
        offsets,
    )


def message_results_with_latents(scenes: Sequence[int]) -> Results:
    edges, offsets = edges_of(scenes), offsets_of(scenes)
    of_edges = edges.receiver_offsets[offsets]
    latents = rows(scenes, 40, key=3, sizes=[6 * n for n in SIZES])
    weights = [shared(36, 40), shared(36, key=1), shared(36), shared(36, key=2)]
    return differentiated(
        lambda s, r, e, *w: message_sum(edges, s, r, e, None, *w),
        (rows(scenes, 40, key=1), rows(scenes, 40, key=2), latents, *weights),
        [offsets, offsets, of_edges],
        offsets,
    )


def segments_of(scenes: Sequence[int]) -> tuple[Octree, Tensor]:
    return octree_of(scenes, 3), offsets_of(scenes)


def segment_results(scenes: Sequence[int], op: Callable) -> Results:
    tree, nodes = segments_of(scenes)
    return differentiated(
        lambda x: op(x, tree.node_order, tree.node_offsets), (rows(scenes, 33),), [nodes], tree.cell_offsets
    )


def tets_of(scenes: Sequence[int]) -> TetrahedronSet:
    """About three random elements a node within each scene; a scene of fewer than four nodes has none."""
    sets = []
    for s in scenes:
        g = torch.Generator().manual_seed(s)
        num = 3 * SIZES[s] if SIZES[s] > 3 else 0
        elements = torch.randint(0, max(SIZES[s], 1), (num, 4), generator=g)
        sets.append(TetrahedronSet.from_elements(elements, SIZES[s]))
    return TetrahedronSet.concatenate(sets)


def elastic_results(scenes: Sequence[int]) -> Results:
    tets, offsets = tets_of(scenes), offsets_of(scenes)
    rest, lame = rows(scenes, 3, key=1), rows(scenes, 2, key=2, sizes=[3 * n if n > 3 else 0 for n in SIZES])
    return by_rows(lambda x: elastic_forces(x, rest, lame, tets), (rows(scenes, 3),), 1, offsets)


def proximity_results(scenes: Sequence[int]) -> Results:
    """Random triangles of four bodies; a scene of fewer than four nodes has none."""
    offsets, sizes = offsets_of(scenes), [SIZES[s] if SIZES[s] > 3 else 0 for s in scenes]
    body = torch.cat([torch.arange(SIZES[s]) % 4 for s in scenes])
    surfaces = []
    for s, start in zip(scenes, offsets.tolist(), strict=False):
        g = torch.Generator().manual_seed(s)
        surfaces.append(start + torch.randint(0, max(SIZES[s], 1), (SIZES[s] if SIZES[s] > 3 else 0, 3), generator=g))
    surface_offsets = torch.tensor([0, *sizes]).cumsum(0)
    motion = 0.1 * rows(scenes, 3, key=1)
    out = proximity(rows(scenes, 3), motion, offsets, body, torch.cat(surfaces), surface_offsets, 0.3)
    return [[x] for x in split(out, offsets)], []


def breadth_first_results(scenes: Sequence[int]) -> Results:
    tets, offsets = tets_of(scenes), offsets_of(scenes)
    wanted = torch.cat([(torch.arange(SIZES[s]) % 7 > 0).long() for s in scenes])
    rank = breadth_first(tets.elements, wanted)
    parts = zip(split(rank, offsets), split(wanted, offsets), strict=True)
    return [[torch.where(mine > 0, x - x[mine > 0].min(), -1)] if mine.any() else [x] for x, mine in parts], []


def sort_results(scenes: Sequence[int]) -> Results:
    """The places in each scene, which are the places of its corners."""
    tets, offsets = tets_of(scenes), offsets_of(scenes)
    order, ends = counting_sort(tets.elements.flatten(), tets.num_nodes)
    starts = ends[offsets]
    return [[x - a] for x, a in zip(split(order, starts), starts, strict=False)], []


def edges_results(scenes: Sequence[int]) -> Results:
    tets, offsets = tets_of(scenes), offsets_of(scenes)
    edges = mesh_edges(tets.elements, tets.num_nodes)
    parts = split(edges.senders, edges.receiver_offsets[offsets])
    return [[x - a] for x, a in zip(parts, offsets, strict=False)], []


def faces_results(scenes: Sequence[int]) -> Results:
    tets = tets_of(scenes)
    faces = [0, *(4 * len(tets_of([s])) for s in scenes)]
    starts = torch.tensor(faces).cumsum(0)
    outer = outer_faces(tets.elements, tets.num_nodes)
    parts = split(outer, torch.searchsorted(outer, starts))
    return [[x - a] for x, a in zip(parts, starts, strict=False)], []


def linear_results(scenes: Sequence[int]) -> Results:
    inputs = (rows(scenes, 48, key=1), rows(scenes, 35, key=2), shared(70, 48), shared(70))
    return by_rows(lambda x, residual, w, b: linear(x, w, b, "geglu", residual), inputs, 2, offsets_of(scenes))


def mlp_results(scenes: Sequence[int]) -> Results:
    weights = (shared(40, 57), shared(40), shared(33, 40), shared(33), shared(33, key=1), shared(33, key=2))
    inputs = (rows(scenes, 48, key=1), rows(scenes, 9, key=2), rows(scenes, 33, key=3), *weights)
    return by_rows(
        lambda x, beside, residual, w, b, v, c, gamma, beta: mlp(x, w, b, v, c, beside, (gamma, beta), residual),
        inputs,
        3,
        offsets_of(scenes),
    )


def orthogonalized_results(scenes: Sequence[int]) -> Results:
    """A scene is two matrices here."""
    matrices = rows(scenes, 40, 24, sizes=[2] * len(SIZES))
    return by_rows(orthogonalized, (matrices,), 1, offsets_of(scenes, [2] * len(SIZES)))


OPS: dict[str, Callable[[Sequence[int]], Results]] = {
    "octree": octree_results,
    "farthest_point_sample": sample_results,
    "sparse_conv": conv_results,
    "sparse_conv_transposed": conv_transposed_results,
    "attention": attention_results,
    "attention with dropout": dropout_results,
    "attention_block": block_results,
    "message_sum": message_results,
    "message_sum with latents": message_results_with_latents,
    "segment_sum": lambda scenes: segment_results(scenes, segment_sum),
    "segment_mean": lambda scenes: segment_results(scenes, segment_mean),
    "elastic_forces": elastic_results,
    "proximity": proximity_results,
    "breadth_first": breadth_first_results,
    "counting_sort": sort_results,
    "mesh_edges": edges_results,
    "outer_faces": faces_results,
    "linear": linear_results,
    "mlp": mlp_results,
    "orthogonalized": orthogonalized_results,
}
BY_PLACE = {"attention with dropout"}  # the mask of a scene depends on its place in the batch
ALL = range(len(SIZES))
