"""The presets of AST, from the paper's table "Model hyperparameter", and `tiny` for any dataset."""

from __future__ import annotations

import math

from ast_sim.models.ast.ast_config import ASTConfig
from ast_sim.models.ast.network import AST
from ast_sim.models.model_config import PAPER_TRAINING, Preset, tiny
from ast_sim.models.registry import Model

_PAPER = {**PAPER_TRAINING, "peak_rate": 1e-4 * math.sqrt(48 / 2)}

PRESETS = {
    "tiny": tiny(
        ASTConfig(
            hidden=64, decoder_hidden=64, d_token=64, heads=2, head_dim=32, ffn_inner=128, L_SA=2, num_tokens=128,
            dropout=0.0, L_cell=None, places=None, exchanges=None, node_inputs=None, element_inputs=None,
            edge_strain=True, factorized=False,
        ),
        peak_rate=3e-3,
        shift=None,
    ),
    "deforming_plate": Preset(ASTConfig(), _PAPER),
    "sphere_simple": Preset(
        ASTConfig(node_inputs=("velocity",), element_inputs=("velocity",)), {**_PAPER, "noise_gamma": 0.1}
    ),
    "abcd": Preset(ASTConfig(L_cell=8, d_token=512, node_inputs=("displacement", "material")), _PAPER),
    "abcd_xl": Preset(
        ASTConfig(L_cell=12, l_ocnn=4, d_token=512, element_inputs=("material", "stress", "displacement")), _PAPER
    ),
}  # fmt: skip

MODEL = Model(ASTConfig, AST, PRESETS)
