"""All models by name: their settings, their classes, their presets."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from ast_sim.baselines.bsms import BSMS, BSMSConfig
from ast_sim.baselines.bsms import PRESETS as BSMS_PRESETS
from ast_sim.baselines.hcmt import HCMT, HCMTConfig
from ast_sim.baselines.hcmt import PRESETS as HCMT_PRESETS
from ast_sim.baselines.mgn import MGN, MGNConfig
from ast_sim.baselines.mgn import PRESETS as MGN_PRESETS
from ast_sim.baselines.transolver import PRESETS as TRANSOLVER_PRESETS
from ast_sim.baselines.transolver import Transolver, TransolverConfig
from ast_sim.errors import ConfigError
from ast_sim.model.ast import AST
from ast_sim.model.ast_config import PRESETS as AST_PRESETS
from ast_sim.model.ast_config import ASTConfig
from ast_sim.model.config import ModelConfig, Preset
from ast_sim.model.simulator import Simulator

T = TypeVar("T")
AnyConfig = ASTConfig | MGNConfig | BSMSConfig | HCMTConfig | TransolverConfig


@dataclass(frozen=True)
class Model:
    """A model as a user chooses it."""

    config: type[ModelConfig]
    simulator: type[Simulator]
    presets: Mapping[str, Preset]


MODELS = {
    "ast": Model(ASTConfig, AST, AST_PRESETS),
    "mgn": Model(MGNConfig, MGN, MGN_PRESETS),
    "bsms": Model(BSMSConfig, BSMS, BSMS_PRESETS),
    "hcmt": Model(HCMTConfig, HCMT, HCMT_PRESETS),
    "transolver": Model(TransolverConfig, Transolver, TRANSOLVER_PRESETS),
}


def build_model(config: ModelConfig) -> Simulator:
    """The model of resolved settings."""
    return MODELS[config.name].simulator(config)


def find_preset(model: str, preset: str) -> Preset:
    """A preset of a model by name.

    Raises:
        ConfigError: there is none; the nearest is named.
    """
    return _named(f"preset of {model}", preset, _named("model", model, MODELS).presets)


def _named(what: str, name: str, known: Mapping[str, T]) -> T:
    if name not in known:
        near = difflib.get_close_matches(name, known, 1, 0)
        raise ConfigError(f"there is no {what} {name!r}: did you mean {near[0]}? There are {', '.join(known)}")
    return known[name]
