"""What a study compares: the file STUDY.toml.

title = "Plates, 10 minutes"
minutes = 10             # of training a run, on `threads`; or samples = 40000, as many frame pairs for every run
rates = [2e-4, 5e-4, 1e-3]
seeds = [0, 1]
settings = ["train.mirror=x,y"]  # of every run

[data]
family = "deforming_plate"
train = 200

[models.ast]             # the name in the tables
[models.mgn]
model = "mgn"
settings = ["model.blocks=8"]
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import from_values


@dataclass(frozen=True)
class Data:
    """The scenes: generated, `train`, `valid` and `test` of them, or the scenes of the file `path`."""

    path: str | None = None
    family: str | None = None
    train: int = 100
    valid: int = 8
    test: int = 20
    seed: int = 0
    nodes: int | None = None
    frames: int | None = None


@dataclass(frozen=True)
class Entry:
    """A row of the tables: a model, a preset, settings beyond the study's; own `rates` and `seeds`, or the study's."""

    model: str = "ast"
    preset: str = "tiny"
    settings: tuple[str, ...] = ()
    rates: tuple[float, ...] | None = None
    seeds: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Study:
    """What all runs have in common.

    Each entry with several rates is trained with each of them and the first seed; the rate with the lowest rollout
    error on the validation scenes is its own, with which it is trained from all seeds.

    Attributes:
        minutes: of training of each run, or
        samples: frame pairs that each run sees.
        search: share of the budget with which the rates are compared; 1: the best of these runs is the first one.
        settings: of every run, beyond its preset.
        validations: rollouts of the validation scenes during a training; the checkpoint of the best is evaluated.
        horizons: how long test scenes are rolled out, in lengths of a scene.
    """

    title: str
    data: Data
    rates: tuple[float, ...]
    seeds: tuple[int, ...] = (0,)
    minutes: float | None = None
    samples: int | None = None
    search: float = 1.0
    threads: int = 1
    settings: tuple[str, ...] = ()
    validations: int = 10
    horizons: int = 10
    about: str = ""

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.samples is None):
            raise ConfigError("a study has a budget: either minutes or samples")
        if not self.rates or not self.seeds:
            raise ConfigError("a study needs at least one of rates and one of seeds")
        if not 0 < self.search <= 1:
            raise ConfigError(f"search = {self.search:g} is no share of the budget: above 0, at most 1")
        if (self.data.path is None) == (self.data.family is None):
            raise ConfigError("data: name either the path of a dataset or the family that is generated")

    def seeds_of(self, entry: Entry) -> tuple[int, ...]:
        """The seeds of all runs of an entry."""
        return entry.seeds or self.seeds


def read(path: Path) -> tuple[Study, dict[str, Entry]]:
    """The study of a file and its entries by name.

    Raises:
        ConfigError: naming the file and what is wrong in it.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        models = values.pop("models", {})
        if not models:
            raise ConfigError("there is nothing to compare: name models as [models.NAME]")
        return from_values(Study, values), {name: from_values(Entry, table) for name, table in models.items()}
    except (ConfigError, OSError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from error
