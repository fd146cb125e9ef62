"""Lines that end the help of a command and take time to make: the settings of the models, the families."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ast_sim.support.errors import ConfigError


def all_settings() -> list[str]:
    """All settings for `train --set`."""
    from ast_sim.models.registry import find_model, find_preset, model_names
    from ast_sim.runs.train_config import TrainConfig
    from ast_sim.support.toml_settings import settings

    usual = find_preset("ast", "tiny").train
    lines = ["", "settings for --set, and their values in the preset tiny (none: unset):"]
    lines += ["", "training (of ast; other models list what differs):", *_settings("train.", TrainConfig, usual)]
    for name in model_names():
        try:
            model = find_model(name)
            tiny = find_preset(name, "tiny")
        except ConfigError as error:
            lines += ["", str(error)]
            continue
        own, common = ({s.key: s.default for s in settings(TrainConfig, train)} for train in (tiny.train, usual))
        lines += ["", f"{name}, presets {', '.join(model.presets)}:"]
        lines += [f"  train.{key}={value}  (in tiny)" for key, value in own.items() if value != common[key]]
        lines += _settings("model.", model.config, vars(tiny.model))
    return lines


def _settings(prefix: str, kind: type, values: Mapping[str, Any]) -> list[str]:
    from ast_sim.support.toml_settings import settings

    return [f"  {prefix}{s.key}={s.default}  ({s.type})\n        {s.help}" for s in settings(kind, values)]


def families() -> list[str]:
    """A line about each family of `generate`."""
    from ast_sim.simulate.families.known_families import FAMILIES

    lines = ["", "families:"]
    for name, family in FAMILIES.items():
        options = "".join(" SPEC" if option == "spec" else f" --{option}" for option in family.options)
        lines.append(f"  {name:17}{family.about}{f' ({options.strip()})' if options else ''}")
    return lines
