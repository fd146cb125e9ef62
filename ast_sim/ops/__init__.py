"""The ops of ast_sim: torch custom ops over the C core, each beside its torch composition."""

from ast_sim.ops._attention import attention, attention_block, rotated
from ast_sim.ops._body_distance import WIDTH as PROXIMITY_WIDTH
from ast_sim.ops._body_distance import proximity
from ast_sim.ops._edges import (
    EdgeSet,
    breadth_first,
    counting_sort,
    join_indices,
    join_offsets,
    mesh_edges,
    offsets_of,
    outer_faces,
)
from ast_sim.ops._elastic_forces import TetrahedronSet, elastic_forces
from ast_sim.ops._fps import farthest_point_sample
from ast_sim.ops._linear import linear, products_in
from ast_sim.ops._message import message_edges, message_sum
from ast_sim.ops._mlp import mlp
from ast_sim.ops._octree import CellMap, Octree, octree
from ast_sim.ops._segment import segment_mean, segment_spread, segment_sum
from ast_sim.ops._sparse_conv import sparse_conv, sparse_conv_transposed

__all__ = [
    "PROXIMITY_WIDTH",
    "CellMap",
    "EdgeSet",
    "Octree",
    "TetrahedronSet",
    "attention",
    "attention_block",
    "breadth_first",
    "counting_sort",
    "elastic_forces",
    "farthest_point_sample",
    "join_indices",
    "join_offsets",
    "linear",
    "mesh_edges",
    "message_edges",
    "message_sum",
    "mlp",
    "octree",
    "offsets_of",
    "outer_faces",
    "products_in",
    "proximity",
    "rotated",
    "segment_mean",
    "segment_spread",
    "segment_sum",
    "sparse_conv",
    "sparse_conv_transposed",
]
