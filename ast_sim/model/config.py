"""What a model is made of, and the presets of the paper's table "Model hyperparameter"."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from ast_sim.data.file import DatasetInfo
from ast_sim.errors import ConfigError


def _of(default, text: str):
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class ModelConfig:
    """The model of one run. The last group is taken from the dataset when training starts."""

    hidden: int = _of(128, "width of node, edge and cell features")
    decoder_hidden: int = _of(32, "hidden width of the output MLPs")
    d_token: int = _of(256, "width of a token")
    heads: int = _of(8, "attention heads")
    head_dim: int = _of(64, "width of a head: a multiple of 16 up to 128")
    ffn_inner: int = _of(512, "width of the feed-forward network after gating")
    L_SA: int = _of(12, "self-attention blocks on the tokens")
    num_tokens: int = _of(512, "tokens at most; a scene with fewer cells takes them all")
    dropout: float = _of(0.1, "dropout on attention weights and feed-forward outputs")
    L_cell: int | None = _of(5, "octree level of the cells; unset: cells of about `cell_spacings` mesh spacings")
    cell_spacings: float = _of(1.5, "cell side in mesh spacings where L_cell is unset")
    l_ocnn: int = _of(0, "levels that sparse convolutions coarsen the cells by before they become tokens")
    node_inputs: tuple[str, ...] = _of(("displacement",), "node features: displacement, velocity, material")
    element_inputs: tuple[str, ...] = _of(
        ("displacement",), "element features: displacement, velocity, material, stress; empty: no element nodes"
    )
    edge_strain: bool = _of(False, "edge features as differences to rest, [dp0, |dp0|, dp - dp0, |dp| - |dp0|]")
    boundary_motion: bool = _of(True, "the next increment of prescribed nodes is an input")
    factorized: bool = _of(True, "random weight factorization W = diag(g) V on the layers of the MLPs")
    residual: tuple[str, ...] = _of(("m2m",), "message passings with a residual, of m2m, e2m, m2c, c2m, m2e")

    integration: Literal["quasi_static", "dynamic"] = _of("quasi_static", "p + v, or 2 p - p_previous + a")
    stress: Literal["none", "node", "element"] = _of("none", "where a stress is predicted")
    material_width: int = _of(0, "material scalars of an element")
    domain_center: tuple[float, float, float] = _of((0.0, 0.0, 0.0), "centre of the cube that the octree divides")
    domain_half_width: float = _of(1.0, "half the side of that cube")

    def __post_init__(self) -> None:
        known = {"displacement", "velocity", "material", "stress"}
        for name in (*self.node_inputs, *self.element_inputs):
            if name not in known:
                raise ConfigError(f"model: input {name!r} is unknown: choose of {', '.join(sorted(known))}")
        if "stress" in self.node_inputs:
            raise ConfigError("model.node_inputs: stress is an element input only")
        if "stress" in self.element_inputs and self.stress != "element":
            raise ConfigError("model.element_inputs: stress needs a dataset with stress on elements")
        if "material" in (*self.node_inputs, *self.element_inputs) and not self.material_width:
            raise ConfigError("model: material is an input, but the dataset has no material")
        if "velocity" in (*self.node_inputs, *self.element_inputs) and self.integration != "dynamic":
            raise ConfigError("model: velocity is an input of dynamic scenes only")
        if self.stress == "element" and not self.element_inputs:
            raise ConfigError("model.element_inputs: a stress on elements needs element nodes, such as displacement")
        if self.head_dim % 16 or not 16 <= self.head_dim <= 128:
            raise ConfigError(f"model.head_dim must be a multiple of 16 up to 128, not {self.head_dim}")
        for name in self.residual:
            if name not in ("m2m", "e2m", "m2c", "c2m", "m2e"):
                raise ConfigError(f"model.residual: {name!r} is unknown: choose of m2m, e2m, m2c, c2m, m2e")
        if self.L_cell is not None and not 0 <= self.L_cell - self.l_ocnn <= self.L_cell <= 21:
            raise ConfigError(
                f"model.L_cell = {self.L_cell} and l_ocnn = {self.l_ocnn} must satisfy 0 <= l_ocnn <= L_cell <= 21"
            )

    @property
    def dynamic(self) -> bool:
        return self.integration == "dynamic"

    @property
    def cell_side(self) -> float:
        """Side of a cell in the unit of length: 2^(1-L) of the half width (paper, section Sparse Convolution)."""
        return self.domain_half_width * 2.0 ** (1 - self.L_cell)


@dataclass(frozen=True)
class Preset:
    """A model with the training settings that belong to it (fields of TrainConfig).

    Attributes:
        model: as in the paper, or for any dataset.
        train: settings of the training.
        adapts: whether the inputs follow the dataset: those of the paper's presets are the paper's.
    """

    model: ModelConfig
    train: dict
    adapts: bool = False

    def inputs(self, info: DatasetInfo, material_width: int) -> dict[str, list[str]]:
        """Node and element inputs that a dataset calls for: velocities if it moves in time, materials if they differ,
        element nodes if there is a stress on elements. Empty if the preset does not adapt."""
        if not self.adapts:
            return {}
        velocity = ["velocity"] if info.integration == "dynamic" else []
        material = ["material"] if material_width else []
        elements = ["displacement", *material] if info.stress_location == "element" else []
        return {"node_inputs": ["displacement", *velocity, *material], "element_inputs": elements}


_PAPER = {"batch_size": 48, "peak_rate": 1e-4 * math.sqrt(48 / 2), "noise": 0.003, "stress_weight": 0.01}

PRESETS = {
    "tiny": Preset(
        ModelConfig(
            hidden=64, decoder_hidden=64, d_token=64, heads=4, head_dim=32, ffn_inner=128, L_SA=4, num_tokens=128,
            dropout=0.0, L_cell=None, element_inputs=(), edge_strain=True,
        ),
        {"batch_size": 4, "peak_rate": 5e-4, "stress_weight": 0.1},
        adapts=True,
    ),
    "deforming_plate": Preset(ModelConfig(), _PAPER),
    "sphere_simple": Preset(
        ModelConfig(node_inputs=("velocity",), element_inputs=("velocity",), integration="dynamic"),
        {**_PAPER, "noise_gamma": 0.1},
    ),
    "abcd": Preset(
        ModelConfig(L_cell=8, d_token=512, node_inputs=("displacement", "material"), material_width=1), _PAPER
    ),
    "abcd_xl": Preset(
        ModelConfig(
            L_cell=12, l_ocnn=4, d_token=512, element_inputs=("material", "stress", "displacement"),
            stress="element", material_width=1,
        ),
        _PAPER,
    ),
}  # fmt: skip


def resolve(config: ModelConfig, info: DatasetInfo, material_width: int, mesh_spacing: float) -> ModelConfig:
    """The configuration with everything that the dataset decides filled in.

    A stress on elements needs element nodes: without element inputs in the configuration, displacement is taken.

    Args:
        config: of a preset, with or without overrides.
        info: of the dataset.
        material_width: material scalars of an element in the dataset; 0 if it has none.
        mesh_spacing: mean length of a mesh edge, for cells of `cell_spacings` where L_cell is unset.

    Raises:
        ConfigError: if the dataset lacks what the configuration asks for.
    """
    depth = config.L_cell
    if depth is None:
        side = config.cell_spacings * mesh_spacing
        depth = min(max(round(1 + math.log2(info.domain_half_width / side)), config.l_ocnn + 1), 21)
    needs_elements = info.stress_location == "element" and not config.element_inputs
    return replace(
        config,
        element_inputs=("displacement",) if needs_elements else config.element_inputs,
        L_cell=depth,
        integration=info.integration,
        stress=info.stress_location,
        material_width=material_width,
        domain_center=tuple(float(c) for c in info.domain_center),
        domain_half_width=float(info.domain_half_width),
    )
