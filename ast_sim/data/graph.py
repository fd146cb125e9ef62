"""What a model needs of a scene and what does not change with time; computed once per trajectory.

Legend: N nodes, E elements of k nodes, M edges, B scenes; a batch is the concatenation of its scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, Protocol

import torch
from torch import Tensor

from ast_sim.data.placement import Placement
from ast_sim.data.scene import NodeType, Scene
from ast_sim.ops.edges import EdgeSet


class Own(Protocol):
    """What a model adds to the graph of a scene; like the graph, that of a batch is the concatenation of its scenes."""

    @staticmethod
    def concatenate(parts: Sequence[Any]) -> Any:
        """Those of several scenes as one."""

    def placed(self, placement: Placement) -> Any:
        """That of the scene in another place."""


@dataclass(frozen=True, eq=False)
class Graph:
    """The static part of one scene or of a batch of scenes.

    Attributes:
        rest_position: [N, 3] float32.
        node_type: [N] int64, values of `NodeType`.
        one_hot: [N, 3] float32, 1 in the column of the node's type in the order of `NodeType`.
        elements: [E, k] int64, node numbers within the batch.
        material: [E, m] float32 or None.
        node_material: [N, m] float32, the mean over the elements at each node, or None.
        node_offsets, element_offsets: [B + 1] int64, where each scene's nodes and elements start and end.
        m2m: node to node, every element edge once in both directions; None with element nodes.
        e2m, m2e: element to each of its nodes, and the reverse; None without element nodes.
        rest_edges: [M, 4] float32, `edge_vectors` of e2m (elements at the mean of their nodes) or m2m at rest.
        body: [N] int64, or None without the surface.
        surface: [F, 3] int64, boundary triangles, counter-clockwise seen from outside, or None where it is not needed.
        surface_offsets: [B + 1] int64, where each scene's triangles start and end, or None.
        own: what one model alone needs, such as coarser meshes.
    """

    rest_position: Tensor
    node_type: Tensor
    one_hot: Tensor
    elements: Tensor
    material: Tensor | None
    node_material: Tensor | None
    node_offsets: Tensor
    element_offsets: Tensor
    m2m: EdgeSet | None
    e2m: EdgeSet | None
    m2e: EdgeSet | None
    rest_edges: Tensor
    body: Tensor | None = None
    surface: Tensor | None = None
    surface_offsets: Tensor | None = None
    own: Own | None = None

    @staticmethod
    def from_scene(scene: Scene, element_nodes: bool, surface: bool = False) -> Graph:
        """The graph of one scene: e2m and m2e if elements are nodes of their own, else m2m; its surface if asked."""
        n, e = scene.num_nodes, scene.num_elements
        elements = torch.from_numpy(scene.elements.astype("int64"))
        rest, node_type = torch.tensor(scene.rest_position), torch.from_numpy(scene.node_type.astype("int64"))
        material = None if scene.material is None else torch.tensor(scene.material)
        m2m = e2m = m2e = None
        if element_nodes:
            nodes = elements.reshape(-1)
            owners = torch.arange(e).repeat_interleave(elements.shape[1])
            e2m = EdgeSet.from_pairs(owners, nodes, e, n)
            m2e = EdgeSet.from_pairs(nodes, owners, n, e)
            rest_edges = edge_vectors(e2m, _element_mean(elements, rest), rest)
        else:
            first, second = torch.from_numpy(scene.edges().astype("int64")).unbind(1)
            m2m = EdgeSet.from_pairs(torch.cat([first, second]), torch.cat([second, first]), n, n)
            rest_edges = edge_vectors(m2m, rest, rest)
        return Graph(
            rest_position=rest,
            node_type=node_type,
            one_hot=torch.stack([node_type == kind for kind in NodeType], dim=1).float(),
            elements=elements,
            material=material,
            node_material=None if material is None else _node_mean(elements, material, n),
            node_offsets=torch.tensor([0, n]),
            element_offsets=torch.tensor([0, e]),
            m2m=m2m,
            e2m=e2m,
            m2e=m2e,
            rest_edges=rest_edges,
            **(_surface_of(scene) if surface else {}),
        )

    @staticmethod
    def concatenate(graphs: list[Graph]) -> Graph:
        """The graphs of several scenes as one; all with or all without element nodes and material."""
        if len(graphs) == 1:
            return graphs[0]
        nodes = list(accumulate((len(g.rest_position) for g in graphs), initial=0))
        return Graph(
            rest_position=torch.cat([g.rest_position for g in graphs]),
            node_type=torch.cat([g.node_type for g in graphs]),
            one_hot=torch.cat([g.one_hot for g in graphs]),
            elements=torch.cat([g.elements + shift for g, shift in zip(graphs, nodes, strict=False)]),
            material=None if graphs[0].material is None else torch.cat([g.material for g in graphs]),
            node_material=None if graphs[0].material is None else torch.cat([g.node_material for g in graphs]),
            node_offsets=_concatenate_offsets([g.node_offsets for g in graphs], nodes),
            element_offsets=_concatenate_offsets(
                [g.element_offsets for g in graphs], list(accumulate((len(g.elements) for g in graphs), initial=0))
            ),
            m2m=None if graphs[0].m2m is None else EdgeSet.concatenate([g.m2m for g in graphs]),
            e2m=None if graphs[0].e2m is None else EdgeSet.concatenate([g.e2m for g in graphs]),
            m2e=None if graphs[0].m2e is None else EdgeSet.concatenate([g.m2e for g in graphs]),
            rest_edges=torch.cat([g.rest_edges for g in graphs]),
            **({} if graphs[0].surface is None else _join_surfaces(graphs, nodes)),
            own=None if graphs[0].own is None else graphs[0].own.concatenate([g.own for g in graphs]),
        )

    def placed(self, placement: Placement) -> Graph:
        """The graph of a scene in another place: the same nodes and edges elsewhere."""
        if placement.is_identity:
            return self
        surface = self.surface
        return replace(
            self,
            rest_position=torch.from_numpy(placement.points(self.rest_position.numpy())),
            rest_edges=torch.from_numpy(placement.vectors(self.rest_edges.numpy())),
            surface=None if surface is None else torch.from_numpy(placement.triangles(surface.numpy())),
            own=None if self.own is None else self.own.placed(placement),
        )

    @property
    def num_scenes(self) -> int:
        return len(self.node_offsets) - 1

    @property
    def edges(self) -> EdgeSet:
        """The edge set that carries features: e2m with element nodes, else m2m."""
        return self.m2m if self.e2m is None else self.e2m

    @cached_property
    def prescribed(self) -> Tensor:
        """[N] bool: the nodes whose positions are given at all times (obstacles and handles)."""
        return self.node_type != NodeType.NORMAL

    @cached_property
    def normal_nodes(self) -> Tensor:
        """[*] int64: the nodes that a model moves."""
        return (self.node_type == NodeType.NORMAL).nonzero()[:, 0]

    @cached_property
    def solid_nodes(self) -> Tensor:
        """[*] int64: the nodes of no obstacle, which have a stress."""
        return (self.node_type != NodeType.OBSTACLE).nonzero()[:, 0]

    @cached_property
    def solid_elements(self) -> Tensor:
        """[*] int64: the elements with no obstacle node."""
        return (self.node_type != NodeType.OBSTACLE)[self.elements].all(dim=1).nonzero()[:, 0]

    def element_mean(self, x: Tensor) -> Tensor:
        """[N, F] -> [E, F]: the mean over the nodes of each element."""
        return _element_mean(self.elements, x)


def _surface_of(scene: Scene) -> dict[str, Tensor]:
    triangles = torch.from_numpy(scene.surface().astype("int64"))
    body = torch.from_numpy(scene.body.astype("int64"))
    return {"body": body, "surface": triangles, "surface_offsets": torch.tensor([0, len(triangles)])}


def _join_surfaces(graphs: list[Graph], nodes: list[int]) -> dict[str, Tensor]:
    triangles = list(accumulate((len(g.surface) for g in graphs), initial=0))
    return {
        "body": torch.cat([g.body for g in graphs]),
        "surface": torch.cat([g.surface + shift for g, shift in zip(graphs, nodes, strict=False)]),
        "surface_offsets": _concatenate_offsets([g.surface_offsets for g in graphs], triangles),
    }


def edge_vectors(edges: EdgeSet, senders: Tensor, receivers: Tensor) -> Tensor:
    """[M, 4]: d = sender - receiver and |d|, from positions [S, 3] and [R, 3]."""
    d = senders.index_select(0, edges.senders) - receivers.index_select(0, edges.receivers)
    return torch.cat([d, torch.linalg.vector_norm(d, dim=1, keepdim=True)], dim=1)


def _element_mean(elements: Tensor, x: Tensor) -> Tensor:
    e, k = elements.shape
    return x.index_select(0, elements.reshape(-1)).view(e, k, -1).mean(dim=1)


def _node_mean(elements: Tensor, x: Tensor, num: int) -> Tensor:
    """[E, F] -> [num, F]: the mean over the elements at each node; 0 where there is none."""
    nodes, share = elements.flatten(), x.repeat_interleave(elements.shape[1], dim=0)
    total = share.new_zeros(num, share.shape[1]).index_add_(0, nodes, share)
    return total / torch.bincount(nodes, minlength=num).clamp(min=1)[:, None]


def _concatenate_offsets(offsets: list[Tensor], shifts: list[int]) -> Tensor:
    if all(len(one) == 2 for one in offsets):
        return torch.tensor(shifts)
    parts = [one[1:] + shift for one, shift in zip(offsets, shifts, strict=False)]
    return torch.cat([offsets[0][:1], *parts])
