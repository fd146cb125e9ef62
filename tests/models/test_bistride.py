"""Bi-stride pooling by hand on small graphs, and against the dense formulas on meshes."""

import numpy as np
import pytest
import torch
import toy
from scipy.sparse import csr_array

from ast_sim.batches.graph import Graph, edge_vectors
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.models.bistride import Hierarchy, build_hierarchy, select
from ast_sim.ops import EdgeSet

PATH = [(0, 1), (1, 2), (2, 3), (3, 4)]
STAR = [(0, 1), (0, 2), (0, 3), (0, 4)]
CROSS = [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]


def line(*x: float) -> torch.Tensor:
    return torch.tensor([[value, 0, 0] for value in x], dtype=torch.float32)


def edge_set(pairs, num: int) -> EdgeSet:
    pairs = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    first, second = pairs.unbind(1)
    return EdgeSet.from_pairs(torch.cat([first, second]), torch.cat([second, first]), num, num)


def made(pairs, position, levels: int = 1, pooled: bool = True) -> Hierarchy:
    edges = edge_set(pairs, len(position))
    return build_hierarchy(edges, torch.as_tensor(position, dtype=torch.float32), levels, pooled, edges)


def pairs_of(edges: EdgeSet) -> list[tuple[int, int]]:
    """(receiver, sender) as stored."""
    return list(zip(edges.receivers.tolist(), edges.senders.tolist(), strict=True))


def dense(edges: EdgeSet) -> np.ndarray:
    matrix = np.zeros((edges.num_receivers, edges.num_senders))
    matrix[edges.receivers, edges.senders] = 1
    return matrix


def test_a_path_by_hand():
    """Depths 2 1 0 1 2 from the middle: the odd class is the smaller one. Then 0 1: the even one on a tie."""
    path = made(PATH, line(0, 1, 2, 3, 4), levels=3)
    first, second, third = path.poolings
    assert first.kept.tolist() == [1, 3] and pairs_of(path.edges[1]) == [(0, 1), (1, 0)]
    assert pairs_of(first.edges) == [(0, 0), (0, 2), (1, 2), (1, 4)]
    # degrees 1 2 2 2 1: shares 1 and 1/2 into node 1
    torch.testing.assert_close(first.weight[:, 0], torch.tensor([2 / 3, 1 / 3, 1 / 3, 2 / 3]))
    assert second.kept.tolist() == [0] and len(path.edges[2]) == 0
    assert pairs_of(second.edges) == [(0, 1)] and second.weight.tolist() == [[1]]
    assert third.kept.tolist() == [0] and pairs_of(third.edges) == [(0, 0)] and third.weight.tolist() == [[1]]
    x = torch.tensor([[1.0], [2], [3], [4], [5]])
    torch.testing.assert_close(first.pool(x), torch.tensor([[5 / 3], [13 / 3]]))
    torch.testing.assert_close(first.unpool(torch.tensor([[3.0], [6]])), torch.tensor([[2.0], [0], [3], [0], [4]]))
    # pooled positions 2/3 and 10/3
    torch.testing.assert_close(path.rest_edges[1], torch.tensor([[8 / 3, 0, 0, 8 / 3], [-8 / 3, 0, 0, 8 / 3]]))


def test_weights_of_the_second_level_start_from_the_weights_of_the_first():
    """Nine nodes in a row: depths 4 3 2 1 0 1 2 3 4, the odd class; of these four, with w' = 3/2 1 1 3/2, every other.

    The second start is the first of the two in the middle: depths 1 0 1 2, a tie, so 1 and 3 of the four are kept.
    """
    path = made([(i, i + 1) for i in range(8)], line(*range(9)), levels=2)
    first, second = path.poolings
    assert first.kept.tolist() == [1, 3, 5, 7] and second.kept.tolist() == [1, 3]
    assert pairs_of(second.edges) == [(0, 0), (0, 2), (1, 2)]
    # shares into node 1: 3/2 over one edge, and 1 over two
    torch.testing.assert_close(second.weight[:, 0], torch.tensor([0.75, 0.25, 1.0]))


def test_a_star_keeps_its_middle():
    star = made(STAR, CROSS)
    (pooling,) = star.poolings
    assert pooling.kept.tolist() == [0] and len(star.edges[1]) == 0
    assert pooling.weight.tolist() == [[0.25]] * 4 and pooling.edges.senders.tolist() == [1, 2, 3, 4]


def test_kept_nodes_at_most_two_edges_apart_are_joined():
    """A star with three arms of two edges: depths 0, 1 and 2, four nodes of each class."""
    arms = made([*STAR, (1, 5), (2, 6), (3, 7)], [*CROSS, [2, 0, 0], [-2, 0, 0], [0, 2, 0]])
    assert arms.poolings[0].kept.tolist() == [0, 5, 6, 7]  # the even ones on a tie
    assert set(pairs_of(arms.edges[1])) == {(0, 1), (0, 2), (0, 3), (1, 0), (2, 0), (3, 0)}


def test_components_are_pooled_apart_and_isolated_nodes_stay():
    """A path, a star and a node without edges, mixed up in their numbers."""
    number = np.array([3, 9, 0, 7, 5, 1, 2, 8, 4, 10, 6])  # of path 0-4, star 5-9, the single node
    pairs = [*PATH, *((a + 5, b + 5) for a, b in STAR)]
    position = np.zeros((11, 3))
    position[number] = [*line(0, 1, 2, 3, 4).tolist(), *(np.array(CROSS) + 20).tolist(), [50, 0, 0]]
    mixed = made([(number[a], number[b]) for a, b in pairs], position, levels=2)
    expected = np.sort(number[[1, 3, 5, 10]])
    pooling = mixed.poolings[0]
    assert pooling.kept.tolist() == expected.tolist()
    alone = expected.tolist().index(6)
    into = pooling.edges.receivers == alone
    assert pooling.edges.senders[into].tolist() == [6] and pooling.weight[into].tolist() == [[1]]
    x = torch.randn(11, 3)
    assert torch.equal(pooling.pool(x)[alone], x[6]) and torch.isfinite(pooling.weight).all()
    kept = [expected.tolist().index(number[i]) for i in (1, 3)]
    assert set(pairs_of(mixed.edges[1])) == {tuple(kept), tuple(kept[::-1])}
    groups = [set(mixed.component[number[part]].tolist()) for part in (slice(0, 5), slice(5, 10), slice(10, 11))]
    assert sorted(len(g) for g in groups) == [1, 1, 1] and len(set.union(*groups)) == 3


def test_of_the_nodes_near_the_centroid_the_one_with_least_depths_starts():
    """A triangle 0 1 2 with a tail 2 3 4: 0 lies nearest to the centroid, 2 almost as near and more central."""
    position = np.array([[1, 0, 0], [0, 3, 0], [-1.1, 0, 0], [0.1, -1.5, 0], [0, -1.5, 0]])
    matrix = csr_array(dense(edge_set([(0, 1), (1, 2), (2, 0), (2, 3), (3, 4)], 5)).astype(bool))
    # from 2: depths 1 1 0 1 2, sum 5; from 0: 0 1 1 2 3, sum 7, which would keep 0 and 3
    assert select(matrix, position).tolist() == [2, 4]
    position[2, 0] = -1.3  # no longer near enough
    position[3, 0] = 0.3
    assert select(matrix, position).tolist() == [0, 3]


def meshes() -> tuple[Graph, Graph]:
    return tuple(Graph.from_scene(toy.plate(seed).scene, element_nodes=False) for seed in (0, 1))


@pytest.mark.parametrize("pooled", [True, False])
def test_a_mesh_against_the_dense_formulas(pooled):
    """Depth classes, (A + I)^2, the weights and rest edges of each level, all by dense matrices in float64."""
    graph, _ = meshes()
    found = build_hierarchy(graph.edges, graph.rest_position, 3, pooled, graph.edges)
    a, w, position = dense(graph.edges), np.ones(len(graph.rest_position)), graph.rest_position.double().numpy()
    for pooling, edges, rest in zip(found.poolings, found.edges[1:], found.rest_edges[1:], strict=True):
        kept = pooling.kept.numpy()
        assert (np.diff(kept) > 0).all() and len(kept) <= (len(a) + 1) // 2 + (a.sum(0) == 0).sum()
        walk = a + np.diag(a.sum(0) == 0)
        share = w / np.maximum(a.sum(0), 1)
        weights = walk * share / (walk @ share)[:, None]
        np.testing.assert_allclose(pooling.pool(torch.eye(len(a))).numpy(), weights[kept], atol=1e-6)
        np.testing.assert_allclose(pooling.unpool(torch.eye(len(kept))).numpy(), weights[kept].T, atol=1e-6)
        two = ((a + np.eye(len(a))) @ (a + np.eye(len(a))) > 0)[np.ix_(kept, kept)]
        a, w = two * (1 - np.eye(len(kept))), (walk @ share)[kept]
        np.testing.assert_array_equal(dense(edges), a)
        position = weights[kept] @ position if pooled else position[kept]
        now = torch.from_numpy(position)
        torch.testing.assert_close(rest, edge_vectors(edges, now, now).float(), rtol=1e-5, atol=1e-6)


def test_one_class_of_depths_is_kept_in_every_component():
    """By a search of our own from each possible start: the kept nodes are all nodes of one parity from some start."""
    graph, _ = meshes()
    a = dense(graph.edges).astype(int)
    kept = set(select(csr_array(a.astype(bool)), graph.rest_position.double().numpy()).tolist())
    component = build_hierarchy(graph.edges, graph.rest_position, 1, True, graph.edges).component.numpy()
    for label in set(component):
        members = set(np.flatnonzero(component == label).tolist())
        classes = []
        for start in members:
            depth, front, level = {start: 0}, {start}, 0
            while front:
                level += 1
                front = {j for i in front for j in np.flatnonzero(a[i]).tolist()} - set(depth)
                depth |= dict.fromkeys(front, level)
            assert set(depth) == members
            even = {i for i, d in depth.items() if d % 2 == 0}
            classes.append(even if len(even) <= len(members) - len(even) else members - even)
        assert kept & members in classes


def test_contacts_are_pooled_by_the_dense_formula():
    graph, _ = meshes()
    found = build_hierarchy(graph.edges, graph.rest_position, 3, True, graph.edges)
    generator = torch.Generator().manual_seed(0)
    n = len(graph.rest_position)
    contacts = edge_set(torch.randint(0, n, (6, 2), generator=generator).tolist(), n)
    c = dense(contacts)
    for pooling, edges in zip(found.poolings, found.edges, strict=False):
        reach = dense(edges) + np.eye(len(c))
        kept = pooling.kept.numpy()
        c = ((reach @ c @ reach) > 0)[np.ix_(kept, kept)] * (1 - np.eye(len(kept)))
        contacts = pooling.pool_contacts(contacts)
        np.testing.assert_array_equal(dense(contacts), c)
        assert torch.equal(contacts.receivers, contacts.receivers.sort().values)
        assert contacts.receiver_offsets.tolist() == [0, *np.cumsum(c.sum(1)).astype(int).tolist()]
    none = found.poolings[0].pool_contacts(edge_set([], n))
    assert len(none) == 0 and none.num_receivers == none.num_senders == len(found.poolings[0].kept)


def test_a_batch_is_the_concatenation_of_its_scenes():
    one, other = (build_hierarchy(g.edges, g.rest_position, 2, True, g.edges) for g in meshes())
    both = Hierarchy.concatenate([one, other])
    shift = 0
    for level, pooling in enumerate(both.poolings):
        n = one.edges[level].num_senders
        assert pooling.edges.num_senders == n + other.edges[level].num_senders
        assert pooling.kept.tolist() == [*one.poolings[level].kept.tolist(), *(other.poolings[level].kept + n).tolist()]
        x = torch.randn(pooling.edges.num_senders, 5)
        alone = torch.cat([one.poolings[level].pool(x[:n]), other.poolings[level].pool(x[n:])])
        assert torch.equal(pooling.pool(x), alone)
        up = torch.cat([one.poolings[level].unpool(alone[: len(one.poolings[level].kept)]),
                        other.poolings[level].unpool(alone[len(one.poolings[level].kept) :])])  # fmt: skip
        assert torch.equal(pooling.unpool(alone), up)
        shift = max(shift, n)
    assert len(both.component.unique()) == len(one.component.unique()) + len(other.component.unique())
    contacts = edge_set([(0, one.edges[0].num_senders - 1), (0, 1)], both.edges[0].num_senders)
    assert pairs_of(both.between_components(contacts)) == [(0, n0 := one.edges[0].num_senders - 1), (n0, 0)]


def test_it_is_the_same_every_time():
    graph, _ = meshes()
    first, second = (build_hierarchy(graph.edges, graph.rest_position, 4, True, graph.edges) for _ in range(2))
    for a, b in zip(first.poolings, second.poolings, strict=True):
        assert torch.equal(a.kept, b.kept) and torch.equal(a.weight, b.weight)
    for a, b in zip(first.edges, second.edges, strict=True):
        assert torch.equal(a.senders, b.senders) and torch.equal(a.receivers, b.receivers)


@pytest.mark.parametrize("pooled", [True, False])
def test_the_hierarchy_of_a_mirror_image_has_mirrored_edges(pooled):
    graph = meshes()[0]
    mirror = Placement(np.float32([-1, 1, -1]), np.float32([0.25, 0, 0.5]), np.zeros(3, np.float32))
    there = mirror.points(graph.rest_position)
    found = build_hierarchy(graph.edges, graph.rest_position, 2, pooled, graph.edges).placed(mirror)
    expected = build_hierarchy(graph.edges, there, 2, pooled, graph.edges)
    for level in range(3):
        assert torch.equal(found.edges[level].senders, expected.edges[level].senders)
        torch.testing.assert_close(found.rest_edges[level], expected.rest_edges[level], rtol=0, atol=1e-6)
        assert not torch.allclose(found.rest_edges[level][:, 0], -expected.rest_edges[level][:, 0])


def test_pooling_and_unpooling_are_the_gradients_of_each_other():
    graph, _ = meshes()
    pooling = build_hierarchy(graph.edges, graph.rest_position, 1, True, graph.edges).poolings[0]
    fine, coarse = torch.randn(pooling.edges.num_senders, 2), torch.randn(len(pooling.kept), 2)
    for op, adjoint, x, y in (
        (pooling.pool, pooling.unpool, fine, coarse),
        (pooling.unpool, pooling.pool, coarse, fine),
    ):
        x = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad((op(x) * y).sum(), x)
        torch.testing.assert_close(gradient, adjoint(y))
