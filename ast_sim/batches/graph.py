"""What a model needs to know of a scene that does not change with time. It is computed once for each trajectory.

Legend: N nodes, E elements of k nodes, M edges, B scenes; a batch is the concatenation of its scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.out_of_balance import ElasticTetrahedra
from ast_sim.element_topology import triangles_of_faces
from ast_sim.material import Material
from ast_sim.named_field import Output
from ast_sim.ops import EdgeSet, join_indices, join_offsets, mesh_edges, outer_faces
from ast_sim.scene import NodeType, Scene


class Own(Protocol):
    """What a model adds to the graph of a scene, such as coarser meshes. It concatenates as the graph does."""

    @staticmethod
    def concatenate(parts: Sequence[Any]) -> Any:
        """The additions to the graphs of several scenes as one."""

    def placed(self, placement: Placement) -> Any:
        """The addition to the graph of the same scene, mirrored and moved."""


@dataclass(frozen=True, eq=False)
class Graph:
    """What does not change with time, of one scene or of a batch of scenes.

    Attributes:
        rest_position: [N, 3] float32.
        node_type: [N] int64, values of `NodeType`.
        one_hot: [N, 3] float32, 1 in the column of the node's type in the order of `NodeType`.
        elements: [E, k] int64, node numbers within the batch.
        deforming_nodes, deforming_elements: [N] and [E] bool, as in `Scene`.
        material: [E, m] float32 or None.
        node_material: [N, m] float32, the mean over the elements at each node, or None.
        node_offsets, element_offsets: [B + 1] int64, where each scene's nodes and elements start and end.
        edges: from node to node, every element edge in both directions; with element nodes from each element to its
            nodes.
        m2e: from each node to its elements; None without element nodes.
        rest_edges: [M, 4] float32, `edge_vectors` of `edges` at rest. An element is at the mean of its nodes.
        body: [N] int64, the body of each node in its scene, counted from 0 whatever numbers the scene gives them.
        surface: [F, 3] int64, boundary triangles, counter-clockwise seen from outside; None if it is not needed.
        surface_offsets: [B + 1] int64, where each scene's triangles start and end; None if they are not needed.
        elasticity: what elastic forces need; None if they are not needed.
        own: what only one model needs, such as coarser meshes, or None.
    """

    rest_position: Tensor
    node_type: Tensor
    one_hot: Tensor
    elements: Tensor
    deforming_nodes: Tensor
    deforming_elements: Tensor
    material: Tensor | None
    node_material: Tensor | None
    node_offsets: Tensor
    element_offsets: Tensor
    edges: EdgeSet
    m2e: EdgeSet | None
    rest_edges: Tensor
    body: Tensor
    surface: Tensor | None = None
    surface_offsets: Tensor | None = None
    elasticity: ElasticTetrahedra | None = None
    own: Own | None = None

    @staticmethod
    def from_scene(scene: Scene, element_nodes: bool, surface: bool = False, elastic: Material | None = None) -> Graph:
        """The graph of one scene.

        Args:
            element_nodes: elements are nodes of the graph too.
            surface: the graph has the surface.
            elastic: the material of its tetrahedra; the graph has their elasticity.
        """
        n = scene.num_nodes
        e = scene.num_elements
        elements = torch.from_numpy(scene.elements.astype("int64"))
        rest = torch.tensor(scene.rest_position)
        node_type = torch.from_numpy(scene.node_type.astype("int64"))
        material = None if scene.material is None else torch.tensor(scene.material)
        if element_nodes:
            nodes = elements.reshape(-1)
            owners = torch.arange(e).repeat_interleave(elements.shape[1])
            edges = EdgeSet.from_pairs(owners, nodes, e, n)
            m2e = EdgeSet.from_pairs(nodes, owners, n, e)
            rest_edges = edge_vectors(edges, _element_mean(elements, rest), rest)
        else:
            edges = mesh_edges(elements, n)
            m2e = None
            rest_edges = edge_vectors(edges, rest, rest)
        triangles, triangle_offsets = _surface_of(scene, elements) if surface else (None, None)
        return Graph(
            rest_position=rest,
            node_type=node_type,
            one_hot=torch.from_numpy(np.equal.outer(scene.node_type, list(NodeType)).astype(np.float32)),
            elements=elements,
            deforming_nodes=torch.from_numpy(scene.deforming_nodes),
            deforming_elements=torch.from_numpy(scene.deforming_elements),
            material=material,
            node_material=None if material is None else _node_mean(elements, material, n),
            node_offsets=torch.tensor([0, n]),
            element_offsets=torch.tensor([0, e]),
            edges=edges,
            m2e=m2e,
            rest_edges=rest_edges,
            body=torch.from_numpy(np.unique(scene.body, return_inverse=True)[1]),
            surface=triangles,
            surface_offsets=triangle_offsets,
            elasticity=None if elastic is None else ElasticTetrahedra.of(scene, elastic),
        )

    @staticmethod
    def concatenate(graphs: Sequence[Graph]) -> Graph:
        """The graphs of several scenes as one. All have the same parts, or none of them has a part."""
        if len(graphs) == 1:
            return graphs[0]
        nodes = [len(g.rest_position) for g in graphs]

        def joined(key: str) -> Any:
            parts = [getattr(g, key) for g in graphs]
            if parts[0] is None:
                return None
            if key.endswith("_offsets"):
                return join_offsets(parts)
            if key in ("elements", "surface"):  # triangles and elements hold node numbers
                return join_indices(parts, nodes)
            return torch.cat(parts) if isinstance(parts[0], Tensor) else parts[0].concatenate(parts)

        return Graph(**{key.name: joined(key.name) for key in fields(Graph)})

    def placed(self, placement: Placement) -> Graph:
        """The graph of the same scene, mirrored and moved."""
        if placement.is_identity:
            return self
        surface = self.surface
        return replace(
            self,
            rest_position=placement.points(self.rest_position),
            rest_edges=placement.vectors(self.rest_edges),
            surface=None if surface is None else placement.triangles(surface),
            own=None if self.own is None else self.own.placed(placement),
        )

    @property
    def num_scenes(self) -> int:
        return len(self.node_offsets) - 1

    @cached_property
    def prescribed(self) -> Tensor:
        """[N] bool: the nodes whose positions are given at all times (obstacles and handles)."""
        return self.node_type != NodeType.NORMAL

    @cached_property
    def normal_nodes(self) -> Tensor:
        """[*] int64: the nodes that a model moves."""
        return (self.node_type == NodeType.NORMAL).nonzero()[:, 0]

    def body_sums(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """[N, F] -> [N, F] and [N, 1] float64: for each node the sum over the prescribed nodes of its body, and their
        number, at least 1."""
        scene = torch.arange(self.num_scenes).repeat_interleave(self.node_offsets.diff())
        body = scene * (int(self.body.max()) + 1) + self.body
        counted = torch.cat([x.double(), torch.ones(len(x), 1)], dim=1) * self.prescribed[:, None]
        sums = counted.new_zeros(int(body.max()) + 1, counted.shape[1]).index_add_(0, body, counted)[body]
        return sums[:, :-1], sums[:, -1:].clamp(min=1)

    def element_mean(self, x: Tensor) -> Tensor:
        """[N, F] -> [E, F]: the mean over the nodes of each element."""
        return _element_mean(self.elements, x)

    def at_nodes(self, outputs: Sequence[Output], values: Mapping[str, Tensor]) -> Tensor:
        """[N, *]: the values [N or E, *] of these outputs, side by side. A node has the mean of its elements."""
        num = len(self.rest_position)
        columns = [self.rest_position.new_zeros(num, 0)]
        for output in outputs:
            value = values[output.name]
            columns.append(value if output.location == "node" else _node_mean(self.elements, value, num))
        return torch.cat(columns, dim=1)


def _surface_of(scene: Scene, elements: Tensor) -> tuple[Tensor, Tensor]:
    """The surface and its offsets, as `Scene.surface`, whose NumPy the rooms without torch share; the kernel takes a
    seventh at 1,300 nodes."""
    if elements.shape[1] == 3:
        triangles = elements
    else:
        outer = outer_faces(elements, scene.num_nodes).numpy()
        oriented = triangles_of_faces(scene.elements, outer, scene.rest_volumes)
        triangles = torch.from_numpy(oriented.astype("int64"))
    return triangles, torch.tensor([0, len(triangles)])


def edge_vectors(edges: EdgeSet, senders: Tensor, receivers: Tensor) -> Tensor:
    """[M, 4]: d = sender - receiver and |d|, from the positions of senders [S, 3] and receivers [R, 3]."""
    d = senders.index_select(0, edges.senders) - receivers.index_select(0, edges.receivers)
    return torch.cat([d, torch.linalg.vector_norm(d, dim=1, keepdim=True)], dim=1)


def _element_mean(elements: Tensor, x: Tensor) -> Tensor:
    e, k = elements.shape
    return x.index_select(0, elements.reshape(-1)).view(e, k, -1).mean(dim=1)


def _node_mean(elements: Tensor, x: Tensor, num: int) -> Tensor:
    """[E, F] -> [num, F]: the mean over the elements at each node; 0 where there is none."""
    nodes = elements.flatten()
    share = x.repeat_interleave(elements.shape[1], dim=0)
    total = share.new_zeros(num, share.shape[1]).index_add_(0, nodes, share)
    return total / torch.bincount(nodes, minlength=num).clamp(min=1)[:, None]
