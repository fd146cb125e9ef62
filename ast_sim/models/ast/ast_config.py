"""The settings of AST. The defaults come from the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import NODE_INPUTS, ProximityConfig, count, setting
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import known

CELL_SPACINGS = 1.5  # an unset side of a cell, in mesh spacings


@dataclass(frozen=True)
class ASTConfig(ProximityConfig):
    """The settings of AST."""

    name: Literal["ast"] = setting("ast", "Adaptive Spatial Tokenization")
    node_inputs: tuple[str, ...] | None = setting(("displacement",), f"{NODE_INPUTS}; unset: chosen from the data")
    hidden: int = count(128, "width of node, edge and cell features")
    decoder_hidden: int = count(32, "hidden width of the output MLPs")
    d_token: int = count(256, "width of a token")
    heads: int = count(8, "attention heads")
    head_dim: int = setting(64, "width of a head: a multiple of 16 up to 128")
    ffn_inner: int = count(512, "width of the feed-forward network after gating")
    L_SA: int = count(12, "self-attention blocks on the tokens", least=0)
    num_tokens: int = count(512, "most tokens of a scene; with fewer cells, every cell becomes a token")
    dropout: float = setting(0.1, "dropout on attention weights and feed-forward outputs", 0, 0.99)
    mesh_steps: int = count(0, "additional message passing steps on the mesh, before the cells and again after them", 0)
    L_cell: int | None = setting(5, "octree level of the cells; unset: chosen by `cell_spacings`")
    cell_spacings: float | None = setting(
        None, "approximate side of a cell, in mesh spacings, if L_cell is unset; unset: 1.5", 0.01, 1e6
    )
    places: Literal["absolute", "relative"] | None = setting(
        "absolute",
        "what attention knows: the position of each cell (absolute), or the offset between two (relative);"
        " unset: relative in quasi-static scenes, absolute in dynamic ones",
    )
    exchanges: int | None = count(
        0,
        "how often nodes and tokens attend to each other, between the L_SA blocks; 0: nodes get messages from cells"
        " (C2M); unset: 2 with relative places in quasi-static scenes, else 0",
        least=0,
    )
    l_ocnn: int = setting(0, "levels by which sparse convolutions coarsen the cells before they become tokens")
    element_inputs: tuple[str, ...] | None = setting(
        ("displacement",),
        "element features, of displacement, velocity, material and stress; empty: elements are no nodes of the graph;"
        " unset: displacement and material if stress is predicted on elements, else empty",
    )
    edge_strain: bool = setting(False, "edges have dp - dp0 and |dp| - |dp0| as inputs, not dp and |dp|")
    factorized: bool = setting(True, "random weight factorization W = diag(g) V of the MLPs' layers")
    residual: tuple[str, ...] = setting(("m2m",), "message passing steps with a residual, of m2m, e2m, m2c, c2m, m2e")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_inputs("element_inputs", ("displacement", "velocity", "material", "stress"))
        self.check_inputs("residual", ("m2m", "e2m", "m2c", "c2m", "m2e"))
        if self.mesh_steps and self.element_inputs:
            raise ConfigError("model.mesh_steps must be 0 with element_inputs: then no edge joins two nodes")
        if self.exchanges and self.places == "absolute":
            raise ConfigError("model.exchanges needs model.places=relative: attention knows no other place of a node")
        if self.head_dim % 16 or not 16 <= self.head_dim <= 128:
            raise ConfigError(f"model.head_dim must be a multiple of 16 up to 128, not {self.head_dim}")
        if self.L_cell is not None and self.cell_spacings is not None:
            raise ConfigError("model.cell_spacings is of no use with model.L_cell: leave one of them unset (none)")
        if self.L_cell is not None and not 0 <= self.L_cell - self.l_ocnn <= self.L_cell <= 21:
            raise ConfigError(
                f"model.L_cell = {self.L_cell} and l_ocnn = {self.l_ocnn} must satisfy 0 <= l_ocnn <= L_cell <= 21"
            )

    @property
    def level(self) -> int:
        """`L_cell` of resolved settings."""
        return known(self.L_cell)

    @property
    def cell_side(self) -> float:
        """See `ModelConfig`. The side is 2^(1-L) half widths (paper, section Sparse Convolution)."""
        return self.data.domain_half_width * 2.0 ** (1 - self.level)

    def resolve(self, facts: DataFacts) -> Self:
        """See `ProximityConfig`. An unset L_cell follows from the mesh spacing. Dynamic scenes get no exchanges:
        with them, rollouts of cloths diverged in one of two trainings (docs/log.md, 2026-11-24)."""
        resolved = super().resolve(facts)
        depth = self.L_cell
        elements = self.element_inputs
        places = self.places
        exchanges = self.exchanges
        if depth is None:
            side = (self.cell_spacings or CELL_SPACINGS) * facts.mesh_spacing
            depth = min(max(round(1 + math.log2(resolved.data.domain_half_width / side)), self.l_ocnn + 1), 21)
        if elements is None:
            material = ("material",) if facts.material_width else ()
            elements = ("displacement", *material) if resolved.data.output_columns("element") else ()
        if places is None:
            places = "absolute" if resolved.data.dynamic else "relative"
        if exchanges is None:
            exchanges = 2 if places == "relative" and not resolved.data.dynamic else 0
        resolved = replace(
            resolved, L_cell=depth, cell_spacings=None, element_inputs=elements, places=places, exchanges=exchanges
        )
        resolved.check_available("element_inputs")
        if "stress" in elements and resolved.data.stress != "element":
            raise ConfigError("model.element_inputs: stress needs a dataset with stress on elements")
        if resolved.data.output_columns("element") and not elements:
            raise ConfigError("model.element_inputs: what is predicted on elements needs some, such as displacement")
        resolved._check_residual()
        return resolved

    def _check_residual(self) -> None:
        """Raise ConfigError if `residual`, where it is chosen, names a step that the network does not have."""
        absent = {
            "m2m" if self.element_inputs else "e2m": "elements are nodes of the graph"
            if self.element_inputs
            else "there are no model.element_inputs",
            **({"c2m": "nodes and tokens attend to each other (model.exchanges)"} if self.exchanges else {}),
            **({} if self.data.output_columns("element") else {"m2e": "nothing is predicted on elements"}),
        }
        for name in self.residual if self.residual != type(self).residual else ():
            if name in absent:
                raise ConfigError(f"model.residual: {name} is of no use here: {absent[name]}; leave it out")

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """See `ModelConfig`."""
        share = f" = {self.cell_side / mesh_spacing:.2g} x mesh spacing" if mesh_spacing else ""
        return {"Cell side": f"{self.cell_side:.3g} {length_unit}{share}, octree level {self.L_cell}"}
