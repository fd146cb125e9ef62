"""What a model needs of a scene and what does not change with time; computed once per trajectory.

Legend: N nodes, E elements of k nodes, M edges, B scenes; a batch is the concatenation of its scenes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
from torch import Tensor

from ast_sim.data.scene import NodeType, Scene
from ast_sim.ops.edges import EdgeSet


@dataclass(frozen=True, eq=False)
class Graph:
    """The static part of one scene or of a batch of scenes.

    Attributes:
        rest_position: [N, 3] float32.
        node_type: [N] int64, values of `NodeType`.
        elements: [E, k] int64, node numbers within the batch.
        material: [E, m] float32 or None.
        node_offsets, element_offsets: [B + 1] int64, where each scene's nodes and elements start and end.
        m2m: node to node, every element edge once in both directions; None with element nodes.
        e2m, m2e: element to each of its nodes, and the reverse; None without element nodes.
    """

    rest_position: Tensor
    node_type: Tensor
    elements: Tensor
    material: Tensor | None
    node_offsets: Tensor
    element_offsets: Tensor
    m2m: EdgeSet | None
    e2m: EdgeSet | None
    m2e: EdgeSet | None

    @staticmethod
    def from_scene(scene: Scene, element_nodes: bool) -> Graph:
        """The graph of one scene: e2m and m2e if elements are nodes of their own, else m2m."""
        n, e = scene.num_nodes, scene.num_elements
        elements = torch.from_numpy(scene.elements.astype("int64"))
        m2m = e2m = m2e = None
        if element_nodes:
            nodes = elements.reshape(-1)
            owners = torch.arange(e).repeat_interleave(elements.shape[1])
            e2m = EdgeSet.from_pairs(owners, nodes, e, n)
            m2e = EdgeSet.from_pairs(nodes, owners, n, e)
        else:
            first, second = torch.from_numpy(scene.edges().astype("int64")).unbind(1)
            m2m = EdgeSet.from_pairs(torch.cat([first, second]), torch.cat([second, first]), n, n)
        return Graph(
            rest_position=torch.tensor(scene.rest_position),
            node_type=torch.from_numpy(scene.node_type.astype("int64")),
            elements=elements,
            material=None if scene.material is None else torch.tensor(scene.material),
            node_offsets=torch.tensor([0, n]),
            element_offsets=torch.tensor([0, e]),
            m2m=m2m,
            e2m=e2m,
            m2e=m2e,
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
            elements=torch.cat([g.elements + shift for g, shift in zip(graphs, nodes, strict=False)]),
            material=None if graphs[0].material is None else torch.cat([g.material for g in graphs]),
            node_offsets=_concatenate_offsets([g.node_offsets for g in graphs], nodes),
            element_offsets=_concatenate_offsets(
                [g.element_offsets for g in graphs], list(accumulate((len(g.elements) for g in graphs), initial=0))
            ),
            m2m=None if graphs[0].m2m is None else EdgeSet.concatenate([g.m2m for g in graphs]),
            e2m=None if graphs[0].e2m is None else EdgeSet.concatenate([g.e2m for g in graphs]),
            m2e=None if graphs[0].m2e is None else EdgeSet.concatenate([g.m2e for g in graphs]),
        )

    @property
    def num_scenes(self) -> int:
        return len(self.node_offsets) - 1

    @cached_property
    def prescribed(self) -> Tensor:
        """[N] bool: the nodes whose positions are given at all times (obstacles and handles)."""
        return self.node_type != NodeType.NORMAL

    @cached_property
    def normal(self) -> Tensor:
        """[N] bool: the nodes that a model moves."""
        return self.node_type == NodeType.NORMAL

    def element_mean(self, x: Tensor) -> Tensor:
        """[N, F] -> [E, F]: the mean over the nodes of each element."""
        e, k = self.elements.shape
        return x.index_select(0, self.elements.reshape(-1)).view(e, k, -1).mean(dim=1)


def _concatenate_offsets(offsets: list[Tensor], shifts: list[int]) -> Tensor:
    if all(len(one) == 2 for one in offsets):
        return torch.tensor(shifts)
    parts = [one[1:] + shift for one, shift in zip(offsets, shifts, strict=False)]
    return torch.cat([offsets[0][:1], *parts])
