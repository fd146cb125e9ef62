"""Hierarchical Contact Mesh Transformer (Yu et al. 2024, arXiv 2312.12467), on bi-stride hierarchies.

    contact blocks on the mesh and its contacts
    down  x_l = D_l(x_l-1 of the kept nodes) on each mesh of the hierarchy,  bottom,
    up    U_l(x_l with the rows of the kept nodes replaced by x_l+1)

A block attends along mesh edges with features e. A contact block attends along contact edges with features c as well,
with the same projections. Each LN has its own weights:

    y = x + O [attention(LN x, LN e), attention(LN x, LN c)],    x' = y + FFN(LN y)

The attention (`channel_attention`) gets q, k and v from nodes and p and g from edges. One MLP encodes the edges of all
meshes. Blocks do not change edge features.

Legend: N nodes, M edges of a set, L levels below the mesh.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.bistride import Hierarchy, build_hierarchy, subset
from ast_sim.models.layers import layer
from ast_sim.models.model_config import PAPER_TRAINING, Preset, check_heads, count, setting, tiny
from ast_sim.models.registry import Model
from ast_sim.models.simulator import Prediction
from ast_sim.models.world_edge_model import Decoder, Edges, WorldEdgeConfig, WorldEdgeSimulator
from ast_sim.ops import EdgeSet, segment_sum
from ast_sim.scene import NodeType, Scene


@dataclass(frozen=True)
class HCMTConfig(WorldEdgeConfig):
    """The settings of HCMT."""

    name: Literal["hcmt"] = setting("hcmt", "Hierarchical Contact Mesh Transformer")
    heads: int = count(4, "attention heads: scores are divided by the square root of a head's width")
    contact_blocks: int = count(2, "blocks on the finest mesh and its contacts, before the hierarchy", least=0)
    levels: int = count(6, "coarser meshes below the finest one")
    contacts: Literal["all", "obstacles"] = setting("all", "world edges: all, or only obstacles to moving nodes")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_heads(self.hidden, self.heads)


class MeshTransformerBlock(nn.Module):
    """Attention along one or two sets of edges, then a feed-forward network. No layer has a bias."""

    def __init__(self, config: HCMTConfig, edge_sets: int):
        super().__init__()
        width = config.hidden
        self.head_width = width // config.heads
        self.norm = nn.LayerNorm(width)
        self.edge_norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(edge_sets))
        self.q, self.k, self.v, self.p, self.g = (layer(width, width, bias=False) for _ in range(5))
        self.out = layer(edge_sets * width, width, bias=False)
        self.forward_norm = nn.LayerNorm(width)
        self.feed_forward = nn.ModuleList(layer(width, width, bias=False) for _ in range(3))

    def forward(self, x: Tensor, *edge_sets: Edges) -> Tensor:
        """x [N, hidden] and the edges of each set with their features [M, hidden] -> [N, hidden]."""
        y = self.norm(x)
        attended = []
        q, k, v = self.q(y), self.k(y), self.v(y)
        for norm, (edges, features) in zip(self.edge_norms, edge_sets, strict=True):
            e = norm(features)
            attended.append(channel_attention(edges, q, k, v, self.p(e), self.g(e), self.head_width))
        x = self.out(torch.cat(attended, dim=1), residual=x)
        first, second, last = self.feed_forward
        return last(second(first(self.forward_norm(x), "relu"), "relu"), residual=x)


class HCMT(WorldEdgeSimulator[HCMTConfig]):
    """The Hierarchical Contact Mesh Transformer. The edges of all meshes share statistics."""

    def __init__(self, config: HCMTConfig):
        super().__init__(config)
        self.node_encoder, self.mesh_encoder, self.world_encoder = self.encoders()
        self.contact = nn.ModuleList(MeshTransformerBlock(config, 2) for _ in range(config.contact_blocks))
        self.down = nn.ModuleList(MeshTransformerBlock(config, 1) for _ in range(config.levels))
        self.bottom = MeshTransformerBlock(config, 1)
        self.up = nn.ModuleList(MeshTransformerBlock(config, 1) for _ in range(config.levels))
        self.decoder = Decoder(config)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`. `own` is the hierarchy of meshes."""
        graph = super().graph(scene)
        own = build_hierarchy(graph.edges, graph.rest_position, self.config.levels, pooled=False, mesh=graph.edges)
        return replace(graph, own=own)

    def world(self, batch: Batch) -> EdgeSet:
        """The contact edges."""
        edges = super().world(batch)
        if self.config.contacts == "all":
            return edges
        ends = torch.stack([batch.graph.node_type[edges.senders], batch.graph.node_type[edges.receivers]])
        return subset(edges, (ends == NodeType.OBSTACLE).any(0) & (ends == NodeType.NORMAL).any(0))

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        nodes, on_mesh, [(world, on_world)] = self.inputs_of(batch)
        meshes = [(edges, self.mesh_encoder(features)) for edges, features in on_mesh]
        kept = [pooling.kept for pooling in Hierarchy.of(batch.graph).poolings]
        contacts = (world, self.world_encoder(on_world))

        x = self.node_encoder(nodes)
        saved = []
        for block in self.contact:
            x = block(x, meshes[0], contacts)
        for block, mesh, chosen in zip(self.down, meshes, kept, strict=False):
            saved.append(block(x, mesh))
            x = saved[-1].index_select(0, chosen)
        x = self.bottom(x, meshes[-1])
        for i, block in reversed(list(enumerate(self.up))):
            x = block(saved[i].index_copy(0, kept[i], x), meshes[i])
        return self.decoder(x, batch)


LIMIT = 2.0  # largest magnitude of a score
CHUNK = 1 << 17  # elements of an array that are computed at a time, so that they stay in the cache


def channel_attention(edges: EdgeSet, q: Tensor, k: Tensor, v: Tensor, p: Tensor, g: Tensor, head_width: int) -> Tensor:
    """[N, F]: attention along edges, with a weight for each channel and no softmax. A node without edges gets 0.

        s_c = clip(k_ic q_jc p_ec / sqrt(d), -2, 2),    out_jc = sum over e: i -> j of v_ic g_ec exp(s_c)

    Memory bandwidth limits these elementwise operations. So all of them are applied to a few edges at a time. Only the
    inputs are kept for the gradient, which computes the rest again.

    Args:
        edges: M edges among N nodes.
        q, k, v: [N, F].
        p, g: [M, F].
        head_width: d.
    """
    return _ChannelAttention.apply(q, k, v, p, g, edges, 1 / math.sqrt(head_width))


class _ChannelAttention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, q, k, v, p, g, edges: EdgeSet, scale: float) -> Tensor:
        ctx.save_for_backward(q, k, v, p, g)
        ctx.edges = edges
        ctx.scale = scale
        messages = torch.empty_like(p)
        for rows in _chunks(p):
            q_e, k_e, v_e = _gather(q, k, v, edges, rows)
            weight = k_e.mul_(q_e).mul_(p[rows]).mul_(scale).clamp_(-LIMIT, LIMIT).exp_()
            torch.mul(v_e.mul_(g[rows]), weight, out=messages[rows])
        return segment_sum(messages, *edges.by_receiver)

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (dout,) = grad_outputs
        q, k, v, p, g = ctx.saved_tensors
        edges = ctx.edges
        scale = ctx.scale
        dq, dk, dv, dp, dg = (torch.empty_like(p) for _ in range(5))  # one row for each edge
        for rows in _chunks(p):
            q_e, k_e, v_e = _gather(q, k, v, edges, rows)
            kq = k_e * q_e
            p_e = p[rows]
            g_e = g[rows]
            score = (kq * p_e).mul_(scale)
            inside = score.abs().le_(LIMIT)
            dmessage = dout.index_select(0, edges.receivers[rows]).mul_(score.clamp_(-LIMIT, LIMIT).exp_())
            torch.mul(dmessage, g_e, out=dv[rows])
            torch.mul(dmessage, v_e, out=dg[rows])
            dscore = dmessage.mul_(v_e).mul_(g_e).mul_(inside).mul_(scale)
            torch.mul(kq, dscore, out=dp[rows])
            dscore.mul_(p_e)
            torch.mul(dscore, q_e, out=dk[rows])
            torch.mul(dscore, k_e, out=dq[rows])
        by_sender = edges.by_sender
        of_nodes = segment_sum(dq, *edges.by_receiver), segment_sum(dk, *by_sender), segment_sum(dv, *by_sender)
        return *of_nodes, dp, dg, None, None


def _chunks(x: Tensor) -> list[slice]:
    """Slices of the rows of x, of about `CHUNK` elements each."""
    rows = max(1, CHUNK // max(1, x.shape[1]))
    return [slice(start, min(start + rows, len(x))) for start in range(0, len(x), rows)]


def _gather(q: Tensor, k: Tensor, v: Tensor, edges: EdgeSet, rows: slice) -> tuple[Tensor, ...]:
    """q of the receivers, k and v of the senders of some edges, as copies."""
    senders = edges.senders[rows]
    return q.index_select(0, edges.receivers[rows]), k.index_select(0, senders), v.index_select(0, senders)


PRESETS = {
    "tiny": tiny(HCMTConfig(hidden=64, hidden_layers=1, levels=3), peak_rate=2e-3, batch_size=4),
    # As the AST paper trains it, one scene on each of four GPUs (sections "Batch Size and Learning Rate", "Baselines").
    "paper": Preset(HCMTConfig(), {**PAPER_TRAINING, "batch_size": 4}),
    # As its authors train it, except for their schedule, 0.1^(step / 1e6).
    "original": Preset(
        HCMTConfig(contacts="obstacles"),
        {"steps": 2_000_000, "batch_size": 1, "peak_rate": 1e-4, "warmup": 0, "noise": 0.003, "stress_weight": 1.0},
    ),
}

MODEL = Model(HCMTConfig, HCMT, PRESETS)
