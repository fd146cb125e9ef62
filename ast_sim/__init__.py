"""Learned simulation of deforming bodies in contact by Adaptive Spatial Tokenization."""

import importlib

__version__ = "0.1.0"

_LAZY = {
    "Dataset": "ast_sim.data.file",
    "DatasetInfo": "ast_sim.data.file",
    "DatasetWriter": "ast_sim.data.file",
    "NodeType": "ast_sim.data.scene",
    "Scene": "ast_sim.data.scene",
    "Trajectory": "ast_sim.data.scene",
    "MODELS": "ast_sim.models",
    "build_model": "ast_sim.models",
    "keep_memory": "ast_sim.ops.library",
    "show_config": "ast_sim.ops.library",
}


def __getattr__(name: str):
    """Public names are imported at first use: the solver and the pictures work without torch."""
    if name not in _LAZY:
        raise AttributeError(f"module 'ast_sim' has no attribute {name!r}")
    return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])
