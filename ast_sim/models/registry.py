"""Models by name. Each model, ours or of another package, registers itself by an entry point."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points

import torch
from torch import Tensor

from ast_sim.batches.torch_settings import float32_layers, usual_settings
from ast_sim.models.model_config import ModelConfig, Preset
from ast_sim.models.simulator import Simulator
from ast_sim.support.errors import ConfigError, nearest_name

GROUP = "ast_sim.models"


@dataclass(frozen=True)
class Model:
    """What an entry point of the group `ast_sim.models` refers to. The entry point's name is `name` of the settings.

    Attributes:
        config: class of the settings.
        simulator: class of the model. Its argument is resolved settings.
        presets: by name; `ast-sim train` uses `tiny` by default.
    """

    config: type[ModelConfig]
    simulator: type[Simulator]
    presets: Mapping[str, Preset]


@cache
def _entries() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))


def model_names() -> list[str]:
    """The names of all installed models. No model is imported."""
    return list(dict.fromkeys(entry.name for entry in _entries()))


@cache
def find_model(name: str) -> Model:
    """Import a model by name.

    Raises:
        ConfigError: there is no such model (the message names the nearest), it cannot be imported (the message names
            its package), or several packages have a model of that name.
    """
    entries = [entry for entry in _entries() if entry.name == name]
    if not entries:
        raise _missing("model", name, model_names())
    if len(entries) > 1:
        packages = ", ".join(map(_package, entries))
        raise ConfigError(f"several packages have a model {name}: {packages}: uninstall all but one")
    entry = entries[0]
    try:
        model = entry.load()
        if not isinstance(model, Model) or model.config.name != name:
            raise TypeError(f"{entry.value} is no Model whose settings have the name {name!r}")
    except Exception as error:  # whatever a package does when it is imported
        raise ConfigError(
            f"the model {name} of the package {_package(entry)} cannot be imported: {type(error).__name__}: {error}:"
            " mend that package or uninstall it"
        ) from error
    return model


def find_preset(model: str, preset: str) -> Preset:
    """A preset of a model by name.

    Raises:
        ConfigError: as `find_model`, or there is no such preset (the message names the nearest).
    """
    presets = find_model(model).presets
    if preset not in presets:
        raise _missing(f"preset of {model}", preset, presets)
    return presets[preset]


def build_model(config: ModelConfig) -> Simulator:
    """The model of resolved settings, in float32 on the CPU, with random weights."""
    simulator = find_model(config.name).simulator
    with usual_settings(), float32_layers():
        return simulator(config)


def trained_model(config: ModelConfig, weights: Mapping[str, Tensor]) -> Simulator:
    """The model of resolved settings with these weights, for predictions. No random number of the program is drawn."""
    with torch.random.fork_rng(devices=[]):
        model = build_model(config)
    model.load_state_dict(weights)
    return model.eval()


def _package(entry: EntryPoint) -> str:
    """The name of the package that registers a model; of its module, if no package is known."""
    return entry.module if entry.dist is None else entry.dist.name


def _missing(what: str, name: str, known: Iterable[str]) -> ConfigError:
    known = list(known)
    hint = nearest_name(name, known) if known else ": install ast_sim with pip"
    return ConfigError(f"there is no {what} {name!r}{hint}")
