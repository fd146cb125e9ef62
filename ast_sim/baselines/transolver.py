"""Transolver (Wu, Luo, Wang, Wang, Long 2024, arXiv 2402.02366), the variant for irregular meshes.

    inputs of a node --MLP--> x;   then in each block x = x + PhysicsAttention(LN(x)), x = x + MLP(LN(x));
    x --LN, Linear--> motion, stress

Every node spreads itself over a few slices of its scene, the slices attend to each other, and every node takes its
share back. It knows no mesh edges and no cells: where a node is, is an input.

As in the released code, not in the paper: a learned temperature of each head; slices are weighted by one projection of
the features and average another; the heads share the projections of a slice and of its query, key and value. Its
placeholder, a second bias of the first MLP, is left out.

Legend: N nodes, B scenes, H heads of width D, S slices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ast_sim.data.batch import Batch
from ast_sim.data.graph import Graph
from ast_sim.data.scene import Scene
from ast_sim.model import features
from ast_sim.model.config import Preset, TimeConditionedConfig, setting
from ast_sim.model.linear import Linear
from ast_sim.model.normalizer import FeatureNormalizer
from ast_sim.model.simulator import Prediction, Simulator

EPSILON = 1e-5  # added to the weight of a slice, so that an empty one is 0


@dataclass(frozen=True)
class TransolverConfig(TimeConditionedConfig):
    """The settings of Transolver."""

    name: Literal["transolver"] = setting("transolver", "Transolver: attention between learned slices")
    hidden: int = setting(128, "width of the features of a node: a multiple of the heads")
    blocks: int = setting(8, "blocks of Physics-Attention and MLP")
    heads: int = setting(8, "attention heads")
    slices: int = setting(64, "slices that each head spreads a scene over")
    mlp_ratio: int = setting(1, "hidden units of the MLP of a block over `hidden`")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_positive("hidden", "blocks", "heads", "slices", "mlp_ratio")
        self.check_heads()


class MLP(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int):
        super().__init__()
        self.first = Linear(inputs, hidden)
        self.second = Linear(hidden, outputs)

    def forward(self, x: Tensor, residual: Tensor | None = None) -> Tensor:
        """x [N, inputs] -> [N, outputs]."""
        return self.second(F.gelu(self.first(x)), residual=residual)


class PhysicsAttention(nn.Module):
    """Attention between slices that the nodes are spread over. With [N, H, D] projections a and v of the nodes:

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
        """a [H, N, D] -> w [H, N, S], the share of each node in each slice; a node's shares add up to 1."""
        # Kept away from 0, as the released code does for structured meshes. What is small is divided, not the scores.
        temperature = self.temperature.clamp(0.1, 5.0)
        return torch.softmax(torch.baddbmm(self.slice.bias / temperature, a, self.slice.weight.mT / temperature), dim=2)

    def _attend(self, slices: Tensor) -> Tensor:
        """z [B, H, S, D] -> z', the same shape, each scene and head for itself."""
        rows = slices.flatten(0, 2)
        projections = (self.slice_query, self.slice_key, self.slice_value)
        q, k, v = (project(rows).view(slices.shape) for project in projections)
        return torch.softmax(q @ k.mT * q.shape[-1] ** -0.5, dim=3) @ v


def _mean(weights: Tensor, value: Tensor) -> Tensor:
    """Means [H, S, D] of value [H, n, D], weighted by weights [H, n, S]."""
    return weights.mT @ value / (weights.sum(dim=1) + EPSILON)[:, :, None]


class Block(nn.Module):
    """x + PhysicsAttention(LN(x)), then x + MLP(LN(x))."""

    def __init__(self, config: TransolverConfig):
        super().__init__()
        self.norm = nn.LayerNorm(config.hidden)
        self.attention = PhysicsAttention(config)
        self.norm_mlp = nn.LayerNorm(config.hidden)
        self.mlp = MLP(config.hidden, config.mlp_ratio * config.hidden, config.hidden)

    def forward(self, x: Tensor, offsets: Tensor) -> Tensor:
        """x [N, hidden] in the scenes of `offsets` -> as x."""
        x = self.attention(self.norm(x), offsets, residual=x)
        return self.mlp(self.norm_mlp(x), residual=x)


class Transolver(Simulator):
    """Physics-Attention over all nodes of a scene; a stress of elements comes from the mean of their nodes' features.

    A scene's prediction depends on no other scene in its batch; it agrees with that of the scene alone but for the
    rounding of matrix products over other numbers of rows.
    """

    config: TransolverConfig

    def __init__(self, config: TransolverConfig):
        super().__init__(config)
        self.node_inputs = features.normalizer_of(config, "node")
        self.positions = FeatureNormalizer([("vector", 3), ("vector", 3)])
        self.encoder = MLP(self.node_inputs.width + self.positions.width, 2 * config.hidden, config.hidden)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.blocks))
        self.norm = nn.LayerNorm(config.hidden)
        self.decoder = Linear(config.hidden, 4 if config.stress == "node" else 3)
        if config.stress == "element":
            self.element_decoder = Linear(config.hidden, 1)
        for module in self.modules():
            if isinstance(module, Linear):  # as released
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def graph(self, scene: Scene) -> Graph:
        """See `Simulator`; without edges."""
        return replace(super().graph(scene), m2m=None, rest_edges=torch.empty(0, 4))

    def _positions(self, batch: Batch) -> Tensor:
        """[N, 6]: at rest and now, from the centre of the domain."""
        center = torch.tensor(self.config.domain_center * 2)
        return torch.cat([batch.graph.rest_position, features.present(self.config, batch)], dim=1) - center

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs."""
        self.node_inputs.observe(features.node_features(self.config, batch))
        self.positions.observe(self._positions(batch))

    def forward(self, batch: Batch) -> Prediction:
        """Normalised outputs for the frame after `batch`."""
        inputs = self.node_inputs(features.node_features(self.config, batch))
        x = self.encoder(torch.cat([inputs, self.positions(self._positions(batch))], dim=1))
        for block in self.blocks:
            x = block(x, batch.graph.node_offsets)
        x = self.norm(x)
        out = self.decoder(x)
        stress = out[:, 3:] if self.config.stress == "node" else None
        if self.config.stress == "element":
            stress = self.element_decoder(batch.graph.element_mean(x))
        return Prediction(out[:, :3], stress)


PRESETS = {
    "tiny": Preset(
        TransolverConfig(hidden=64, blocks=4, heads=4, slices=32, mlp_ratio=2),
        {"batch_size": 4, "optimizer": "muon", "peak_rate": 2e-3, "stress_weight": 0.1, "rollout_pool": None},
        adapts=True,
    ),
    # StructBench (github.com/qilinli/StructBench), configs/deforming_plate/transolver.toml; noise of 3 mm, weights 1.
    "original": Preset(
        TransolverConfig(node_inputs=()),
        {"batch_size": 2, "peak_rate": 1e-3, "clip": 0.1, "noise": 0.003, "stress_weight": 1.0},
    ),
}
