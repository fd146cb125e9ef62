"""Transolver (Wu, Luo, Wang, Wang, Long 2024, arXiv 2402.02366), the variant for irregular meshes.

    inputs of a node --MLP--> x;   then in each block x = x + PhysicsAttention(LN(x)), x = x + MLP(LN(x));
    x --LN, Linear--> motion, stress

Every node spreads itself over a few slices of its scene, the slices attend to each other, and every node gets its share
of the slices back. There are no mesh edges and no cells: the position of a node is an input.

Unlike the paper, but like the released code: each head learns a temperature. One projection of the features gives the
weights of a slice, and another is averaged. All heads share the projections to slices and to query, key and value. The
"placeholder" of the released code, a second bias of the first MLP, is left out.

Legend: N nodes, B scenes, H heads of width D, S slices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch
from ast_sim.batches.graph import Graph
from ast_sim.models.layers import Linear
from ast_sim.models.model_config import Preset, ProximityConfig, check_heads, count, setting, tiny
from ast_sim.models.node_inputs import node_features, normalizer_of
from ast_sim.models.normalizer import FeatureNormalizer, Normalizer
from ast_sim.models.registry import Model
from ast_sim.models.simulator import Latent, Prediction, Simulator, Use
from ast_sim.ops import mesh_edges
from ast_sim.scene import Scene

EPSILON = 1e-5  # added to the weight of a slice, so that an empty one is 0


@dataclass(frozen=True)
class TransolverConfig(ProximityConfig):
    """The settings of Transolver."""

    name: Literal["transolver"] = setting("transolver", "Transolver: attention between learned slices")
    hidden: int = count(128, "width of node features, a multiple of the number of heads")
    blocks: int = count(8, "blocks of Physics-Attention and MLP")
    heads: int = count(8, "attention heads")
    slices: int = count(64, "slices over which each head spreads a scene")
    mlp_ratio: int = count(1, "hidden units of the MLP of each block, as a multiple of `hidden`")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_heads(self.hidden, self.heads)


class GeluMLP(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int):
        super().__init__()
        self.first = Linear(inputs, hidden)
        self.second = Linear(hidden, outputs)

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        """x [N, inputs] -> [N, outputs]."""
        return self.second(F.gelu(self.first(x)), residual=residual)


class PhysicsAttention(nn.Module):
    """Attention between slices over which the nodes are spread. With projections a and v [N, H, D] of the nodes:

    weights    w_ns = softmax over s of (W_S a_n + b_S)_s / temperature, for each head;
    slices     z_s = sum_n w_ns v_n / (sum_n w_ns + epsilon), over the nodes of a scene;
    attention  z'_s = sum_r softmax over r of (W_Q z_s . W_K z_r / sqrt(D)) W_V z_r;
    nodes      y_n = W_O sum_s w_ns z'_s + b_O, the heads side by side.
    """

    def __init__(self, config: TransolverConfig):
        super().__init__()
        self.heads = config.heads
        width = config.hidden // config.heads
        self.project = Linear(config.hidden, 2 * config.hidden)  # a and v
        self.slice = Linear(width, config.slices)
        self.temperature = nn.Parameter(torch.full((config.heads, 1, 1), 0.5))
        self.slice_query, self.slice_key, self.slice_value = (Linear(width, width, bias=False) for _ in range(3))
        self.out = Linear(config.hidden, config.hidden)

    def forward(self, x: Tensor, offsets: Tensor, residual: Tensor) -> Tensor:
        """x [N, hidden] in the scenes of `offsets` [B + 1] -> y + residual, [N, hidden]."""
        sizes = offsets.diff().tolist()
        a, v = self.project(x).view(len(x), 2, self.heads, -1).permute(1, 2, 0, 3).unbind(0)  # [H, N, D]
        weights, values = self.weights(a).split(sizes, dim=1), v.split(sizes, dim=1)
        slices = torch.stack([_mean(w, v) for w, v in zip(weights, values, strict=True)])
        y = torch.cat([w @ z for w, z in zip(weights, self._attend(slices), strict=True)], dim=1)
        return self.out(y.transpose(0, 1).flatten(1), residual=residual)

    def weights(self, a: Tensor) -> Tensor:
        """a [H, N, D] -> w [H, N, S], the share of each node in each slice. The shares of a node add up to 1."""
        # As in the released code for structured meshes, the temperature stays away from 0. It divides weight and bias,
        # which are small, instead of the scores.
        temperature = self.temperature.clamp(0.1, 5.0)
        return torch.softmax(torch.baddbmm(self.slice.bias / temperature, a, self.slice.weight.mT / temperature), dim=2)

    def _attend(self, slices: Tensor) -> Tensor:
        """z [B, H, S, D] -> z' of the same shape, for each scene and head."""
        rows = slices.flatten(0, 2)
        projections = (self.slice_query, self.slice_key, self.slice_value)
        q, k, v = (project(rows).view(slices.shape) for project in projections)
        return torch.softmax(q @ k.mT * q.shape[-1] ** -0.5, dim=3) @ v


def _mean(weights: Tensor, value: Tensor) -> Tensor:
    """[H, S, D]: the means of value [H, n, D] with weights [H, n, S]."""
    return weights.mT @ value / (weights.sum(dim=1) + EPSILON)[:, :, None]


class TransolverBlock(nn.Module):
    """x + PhysicsAttention(LN(x)), then x + MLP(LN(x))."""

    def __init__(self, config: TransolverConfig):
        super().__init__()
        self.norm = nn.LayerNorm(config.hidden)
        self.attention = PhysicsAttention(config)
        self.norm_mlp = nn.LayerNorm(config.hidden)
        self.mlp = GeluMLP(config.hidden, config.mlp_ratio * config.hidden, config.hidden)

    def forward(self, x: Tensor, offsets: Tensor) -> Tensor:
        """x [N, hidden] in the scenes of `offsets` [B + 1] -> [N, hidden]."""
        x = self.attention(self.norm(x), offsets, residual=x)
        return self.mlp(self.norm_mlp(x), residual=x)


class Transolver(Simulator):
    """Physics-Attention over all nodes of a scene. Stress of elements follows from the mean of their nodes' features.

    A scene's prediction does not depend on the other scenes of its batch, except for the rounding of matrix products,
    which depends on the number of rows.
    """

    config: TransolverConfig

    def __init__(self, config: TransolverConfig):
        super().__init__(config)
        self.node_inputs = normalizer_of(config, "node")
        self.positions = FeatureNormalizer([("vector", 3), ("vector", 3)])
        self.encoder = GeluMLP(self.node_inputs.width + self.positions.width, 2 * config.hidden, config.hidden)
        self.blocks = nn.ModuleList(TransolverBlock(config) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.hidden)
        self.decoder = Linear(config.hidden, 3 + config.data.output_columns("node"))
        if on_elements := config.data.output_columns("element"):
            self.element_decoder = Linear(config.hidden, on_elements)
        for module in self.modules():
            if isinstance(module, Linear):  # as released
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`. It has no edges."""
        no_edges = mesh_edges(torch.empty(0, 2, dtype=torch.int64), scene.num_nodes)
        return replace(super().graph(scene), edges=no_edges, rest_edges=torch.empty(0, 4, dtype=torch.float32))

    def inputs_of(self, batch: Batch, use: Use = Normalizer.__call__) -> tuple[Tensor, Tensor]:
        """See `Simulator`: of the nodes, and their positions at rest and now from the centre of the domain, [N, 6]."""
        center = batch.position.new_tensor(self.config.data.domain_center * 2, dtype=torch.float32)
        positions = torch.cat([batch.graph.rest_position, batch.position], dim=1) - center
        return use(self.node_inputs, node_features(self.config, batch)), use(self.positions, positions)

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        x = self.encoder(torch.cat(self.inputs_of(batch), dim=1))
        for block in self.blocks:
            x = block(x, batch.graph.node_offsets)
        x = self.norm(x)
        data = self.config.data
        wanted = data.output_columns("element") and batch.wants_elements
        on_elements = self.element_decoder(batch.graph.element_mean(x)) if wanted else None
        return Prediction.of(data, self.decoder(x), on_elements, Latent(x, batch.graph.node_offsets))


PRESETS = {
    "tiny": tiny(TransolverConfig(hidden=64, blocks=4, heads=4, slices=32, mlp_ratio=2), peak_rate=3e-3),
    # StructBench (github.com/qilinli/StructBench), configs/deforming_plate/transolver.toml; noise of 3 mm, weights 1.
    "original": Preset(
        TransolverConfig(node_inputs=()),
        {"batch_size": 2, "peak_rate": 1e-3, "clip": 0.1, "noise": 0.003, "stress_weight": 1.0},
    ),
}

MODEL = Model(TransolverConfig, Transolver, PRESETS)
