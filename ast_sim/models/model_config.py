"""The settings that all models share, and presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from ast_sim.batches.scheme import Scheme
from ast_sim.models.data_facts import DataFacts
from ast_sim.named_field import PLASTIC_STRAIN, REACTION, Output
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import FROM_DATA, LARGEST, known, require_range

WIDEST = 1 << 16  # the largest width or count of a layer

NODE_INPUTS = (
    "node features, of displacement, velocity, material, proximity, out_of_balance (elastic forces) and history (jumps"
    " start where the motion turned back last, and know what is predicted there)"
)


def setting(default: Any, text: str, least: float | None = None, most: float = LARGEST) -> Any:
    """A field of a settings class. `ast-sim train --help` shows its text. With `least`, a model refuses numbers below
    it and above `most`."""
    return field(default=default, metadata={"help": text, "limits": None if least is None else (least, most)})


def count(default: int | None, text: str, least: int = 1) -> Any:
    """A `setting` that counts something, such as blocks or the width of a layer."""
    return setting(default, text, least, WIDEST)


def check_heads(hidden: int, heads: int) -> None:
    """Raise ConfigError unless the width is a multiple of the number of heads."""
    if hidden % heads:
        raise ConfigError(f"model.hidden = {hidden} must be a multiple of model.heads = {heads}")


@dataclass(frozen=True)
class ModelConfig:
    """Settings of any model. Each model derives a class from this one, with a `name` of its own.

    When training starts, `resolve` fills in the settings that are None, and `data`.

    Attributes:
        data: what the model must know of its data. It is no setting.
    """

    name: str = setting("", "which model")
    node_inputs: tuple[str, ...] | None = setting(None, f"{NODE_INPUTS}; unset: chosen from the data")
    proximity_radius: float | None = setting(
        None, "with proximity: distance within which a node sees another body; unset: 1.5 mesh spacings", least=0
    )
    boundary_motion: bool | None = setting(
        None, "give each prescribed node its next increment as an input; unset: yes, and no with jumps"
    )
    jumps: bool | None = setting(
        False,
        "predict each frame directly from the first one, moved along with the prescribed nodes, not step by step;"
        " unset: yes in quasi-static scenes",
    )
    state: tuple[str, ...] = setting(
        (), "fields of the dataset to predict beside motion and stress, by name, such as PEEQ; reaction: nodal forces"
    )
    data: DataFacts = field(default=DataFacts(), metadata={FROM_DATA: True})

    def __post_init__(self) -> None:
        known = ("displacement", "velocity", "material", "proximity", "out_of_balance", "history")
        self.check_inputs("node_inputs", known)
        for item in fields(self):
            if limits := item.metadata.get("limits"):
                require_range(f"model.{item.name}", getattr(self, item.name), *limits)

    def check_inputs(self, key: str, known: tuple[str, ...]) -> None:
        """Raise ConfigError if a name in the setting `key` is not one of `known`, or stands there twice."""
        names = getattr(self, key) or ()
        if len(set(names)) < len(names):
            raise ConfigError(f"model.{key} is {', '.join(names[:10])}; name each once")
        for name in names:
            if name not in known:
                raise ConfigError(f"model.{key}: {name!r} is unknown: choose of {', '.join(known)}")

    def check_available(self, key: str) -> None:
        """Raise ConfigError if the setting `key` names an input that the dataset does not have."""
        inputs = getattr(self, key)
        if "material" in inputs and not self.data.material_width:
            raise ConfigError(f"model.{key}: material is an input, but the dataset has no material")
        if "velocity" in inputs and not self.data.dynamic:
            raise ConfigError(f"model.{key}: velocity is an input of dynamic scenes only")

    @property
    def gains_along_rollouts(self) -> bool:
        """Whether an unset `train.rollout_pool` becomes a pool. With inertia, rollouts diverge without one
        (docs/log.md, 2026-11-23)."""
        return self.data.dynamic

    @property
    def cell_side(self) -> float:
        """Side of the cells into which the model sorts nodes, in the unit of length; 0 for a model without cells."""
        return 0.0

    @property
    def graph_parts(self) -> dict[str, Any]:
        """The parts of the graph that the inputs need: arguments of `Graph.from_scene`."""
        inputs = known(self.node_inputs)
        elastic = "out_of_balance" in inputs
        return {"surface": "proximity" in inputs, "elastic": self.data.material if elastic else None}

    @property
    def scheme(self) -> Scheme:
        """How the model predicts, when nothing is left open."""
        return Scheme(bool(self.jumps), self.data.given_frames, self.history)

    @property
    def history(self) -> tuple[Output, ...] | None:
        """What a jump knows of the frame in which the motion turned back last: the outputs but the reactions, which
        follow from the others; None: all jumps start from the first frame."""
        if "history" not in (self.node_inputs or ()):
            return None
        return tuple(output for output in self.data.outputs if output.name != REACTION)

    def usual_inputs(self, facts: DataFacts, jumps: bool) -> tuple[str, ...]:
        """The inputs of nodes if `node_inputs` is unset: velocity in dynamic scenes, material in scenes that have one,
        and with jumps the elastic forces of tetrahedra, or the history where the material yields: it has a yield
        stress, or the plastic strain is predicted."""
        velocity = ("velocity",) if facts.dynamic else ()
        material = ("material",) if facts.material_width else ()
        if jumps and (facts.material.yields or PLASTIC_STRAIN in self.state):
            return (*velocity, *material, "history")
        forces = ("out_of_balance",) if jumps and facts.tetrahedra else ()
        return (*velocity, *material, *forces)

    def resolve(self, facts: DataFacts) -> Self:
        """The settings with nothing left open that has an effect.

        Raises:
            ConfigError: the data lacks something that the settings ask for, or a setting would have no effect.
        """
        jumps = not facts.dynamic if self.jumps is None else self.jumps
        if jumps and facts.dynamic:
            raise ConfigError(
                "model.jumps: the dataset is dynamic, so the positions of its nodes depend on their motion before, not"
                " only on the prescribed nodes: predict it step by step"
            )
        if jumps and self.boundary_motion:
            raise ConfigError(
                "model.boundary_motion is of no use here: with model.jumps, the start has the prescribed nodes in their"
                " places; leave it unset (none)"
            )
        inputs = self.usual_inputs(facts, jumps) if self.node_inputs is None else self.node_inputs
        if "out_of_balance" in inputs and not facts.tetrahedra:
            raise ConfigError("model.node_inputs: out_of_balance needs tetrahedra, but the elements are triangles")
        if "history" in inputs and not jumps:
            raise ConfigError("model.node_inputs: history is an input of models that jump (model.jumps)")
        radius = self.proximity_radius
        if radius is not None and "proximity" not in inputs:
            raise ConfigError("model.proximity_radius is of no use here: proximity is not in model.node_inputs")
        if radius is None and "proximity" in inputs:
            radius = 1.5 * facts.mesh_spacing
        resolved = replace(
            self,
            node_inputs=inputs,
            proximity_radius=radius,
            boundary_motion=not jumps and self.boundary_motion is not False,
            jumps=jumps,
            data=facts,
        )
        resolved.check_available("node_inputs")
        return resolved

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """Lines about these settings, by title, for a report. With the mesh spacing, for the start of a training."""
        return {}


@dataclass(frozen=True)
class ProximityConfig(ModelConfig):
    """Settings of a model that has no edges between bodies; it sees other bodies by proximity."""

    @property
    def gains_along_rollouts(self) -> bool:
        """See `ModelConfig`. Such models have a pool without inertia too."""
        return True

    def usual_inputs(self, facts: DataFacts, jumps: bool) -> tuple[str, ...]:
        """See `ModelConfig`. Displacement is an input, too, and proximity in quasi-static scenes. Proximity has not
        been measured in dynamic scenes."""
        proximity = () if facts.dynamic else ("proximity",)
        return ("displacement", *proximity, *super().usual_inputs(facts, jumps))


@dataclass(frozen=True)
class Preset:
    """Settings of a model with the settings of its training.

    Attributes:
        model: settings that are None follow from the data (`ModelConfig.resolve`).
        train: fields of TrainConfig.
    """

    model: ModelConfig
    train: Mapping[str, Any]


# As the AST paper trains its baselines.
PAPER_TRAINING = {"batch_size": 48, "peak_rate": 1e-4, "noise": 0.003, "stress_weight": 0.01}


def tiny(model: ModelConfig, peak_rate: float, **train: Any) -> Preset:
    """The preset `tiny` of a model: for any dataset, of a size that two cores train in minutes."""
    shared = {"batch_size": 8, "optimizer": "muon", "stress_weight": 0.1, "strain_weight": None, "rollout_pool": None}
    return Preset(replace(model, jumps=None), {**shared, "peak_rate": peak_rate, **train})
