"""What AST is made of, and the presets of the paper's table "Model hyperparameter"."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from ast_sim.data.file import DatasetInfo
from ast_sim.errors import ConfigError
from ast_sim.model.config import Preset, TimeConditionedConfig, setting


@dataclass(frozen=True)
class ASTConfig(TimeConditionedConfig):
    """The settings of AST."""

    name: Literal["ast"] = setting("ast", "Adaptive Spatial Tokenization")
    hidden: int = setting(128, "width of node, edge and cell features")
    decoder_hidden: int = setting(32, "hidden width of the output MLPs")
    d_token: int = setting(256, "width of a token")
    heads: int = setting(8, "attention heads")
    head_dim: int = setting(64, "width of a head: a multiple of 16 up to 128")
    ffn_inner: int = setting(512, "width of the feed-forward network after gating")
    L_SA: int = setting(12, "self-attention blocks on the tokens")
    num_tokens: int = setting(512, "tokens at most; a scene with fewer cells takes them all")
    dropout: float = setting(0.1, "dropout on attention weights and feed-forward outputs")
    mesh_steps: int = setting(0, "more message passings on the mesh, so many before the cells and so many after them")
    L_cell: int | None = setting(5, "octree level of the cells; unset: cells of about `cell_spacings` mesh spacings")
    cell_spacings: float = setting(1.5, "cell side in mesh spacings where L_cell is unset")
    places: Literal["absolute", "relative"] = setting(
        "absolute", "what attention sees of places: where a cell is, or the way between two"
    )
    exchanges: int = setting(
        0, "how often nodes and tokens attend to each other, sharing the L_SA blocks; 0: nodes learn by C2M from cells"
    )
    l_ocnn: int = setting(0, "levels that sparse convolutions coarsen the cells by before they become tokens")
    element_inputs: tuple[str, ...] = setting(
        ("displacement",), "element features: displacement, velocity, material, stress; empty: no element nodes"
    )
    edge_strain: bool = setting(False, "edge features as differences to rest, [dp0, |dp0|, dp - dp0, |dp| - |dp0|]")
    factorized: bool = setting(True, "random weight factorization W = diag(g) V on the layers of the MLPs")
    residual: tuple[str, ...] = setting(("m2m",), "message passings with a residual, of m2m, e2m, m2c, c2m, m2e")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_inputs("element_inputs", ("displacement", "velocity", "material", "stress"))
        if "stress" in self.element_inputs and self.stress != "element":
            raise ConfigError("model.element_inputs: stress needs a dataset with stress on elements")
        if self.stress == "element" and not self.element_inputs:
            raise ConfigError("model.element_inputs: a stress on elements needs element nodes, such as displacement")
        if self.mesh_steps < 0 or (self.mesh_steps and self.element_inputs):
            raise ConfigError(
                "model.mesh_steps: 0 or more; with element nodes (element_inputs) no edge joins two nodes"
            )
        if self.exchanges and self.places != "relative":
            raise ConfigError("model.exchanges needs model.places=relative: nodes have no other place in attention")
        if self.exchanges < 0:
            raise ConfigError(f"model.exchanges is {self.exchanges}; it must be at least 0")
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
    def cell_side(self) -> float:
        """See `ModelConfig`: 2^(1-L) of the half width (paper, section Sparse Convolution)."""
        return self.domain_half_width * 2.0 ** (1 - self.L_cell)

    def resolve(self, info: DatasetInfo, material_width: int, mesh_spacing: float) -> Self:
        """See `ModelConfig`. L_cell follows from the mesh spacing where it is unset; a stress on elements needs element
        nodes: without element inputs displacement is taken."""
        depth = self.L_cell
        if depth is None:
            side = self.cell_spacings * mesh_spacing
            depth = min(max(round(1 + math.log2(info.domain_half_width / side)), self.l_ocnn + 1), 21)
        needs_elements = info.stress_location == "element" and not self.element_inputs
        elements = ("displacement",) if needs_elements else self.element_inputs
        resolved = super(ASTConfig, replace(self, element_inputs=elements)).resolve(info, material_width, mesh_spacing)
        return replace(resolved, L_cell=depth)

    def settings_for(self, info: DatasetInfo, material_width: int) -> dict[str, Any]:
        """See `TimeConditionedConfig`; element nodes if there is a stress on elements. With inertia nodes learn from
        cells: after exchanges rollouts of cloths ran away in one of two trainings (docs/log.md, 2026-11-24)."""
        material = ["material"] if material_width else []
        elements = ["displacement", *material] if info.stress_location == "element" else []
        by_cells = {"places": "absolute", "exchanges": 0} if info.integration == "dynamic" else {}
        return {**super().settings_for(info, material_width), "element_inputs": elements, **by_cells}

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """See `ModelConfig`."""
        share = f" = {self.cell_side / mesh_spacing:.2g} x mesh spacing" if mesh_spacing else ""
        return {"Cell side": f"{self.cell_side:.3g} {length_unit}{share}, octree level {self.L_cell}"}


_PAPER = {"batch_size": 48, "peak_rate": 1e-4 * math.sqrt(48 / 2), "noise": 0.003, "stress_weight": 0.01}

PRESETS = {
    "tiny": Preset(
        ASTConfig(
            hidden=64, decoder_hidden=64, d_token=64, heads=2, head_dim=32, ffn_inner=128, L_SA=2, num_tokens=128,
            dropout=0.0, L_cell=None, places="relative", exchanges=2, element_inputs=(), edge_strain=True,
            factorized=False,
        ),
        {
            "batch_size": 4, "optimizer": "muon", "peak_rate": 1e-3, "stress_weight": 0.1, "rollout_pool": None,
            "shift": None,
        },
        adapts=True,
    ),
    "deforming_plate": Preset(ASTConfig(), _PAPER),
    "sphere_simple": Preset(
        ASTConfig(node_inputs=("velocity",), element_inputs=("velocity",), integration="dynamic"),
        {**_PAPER, "noise_gamma": 0.1},
    ),
    "abcd": Preset(
        ASTConfig(L_cell=8, d_token=512, node_inputs=("displacement", "material"), material_width=1), _PAPER
    ),
    "abcd_xl": Preset(
        ASTConfig(
            L_cell=12, l_ocnn=4, d_token=512, element_inputs=("material", "stress", "displacement"),
            stress="element", material_width=1,
        ),
        _PAPER,
    ),
}  # fmt: skip
