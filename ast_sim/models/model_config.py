"""The settings that all models share, and presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

from ast_sim.dataset.layout import GIVEN_FRAMES, DatasetInfo
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import LARGEST, require_range

WIDEST = 1 << 16  # the largest width or count of a layer

NODE_INPUTS = "node features, of displacement, velocity, material, proximity and out_of_balance (elastic forces)"


def setting(default: Any, text: str, least: float | None = None, most: float = LARGEST) -> Any:
    """A field of a settings class. `ast-sim train --help` shows its text. With `least`, a model refuses numbers below
    it and above `most`."""
    return field(default=default, metadata={"help": text, "limits": None if least is None else (least, most)})


def count(default: int | None, text: str, least: int = 1) -> Any:
    """A `setting` that counts something, such as blocks or the width of a layer."""
    return setting(default, text, least, WIDEST)


@dataclass(frozen=True)
class DataFacts:
    """What the settings of a model may depend on in the data.

    Attributes:
        info: facts of the dataset.
        material_width: numbers that describe the material of an element; 0 without material.
        mesh_spacing: mean length of a mesh edge.
        planar: whether z is 0 in all scenes.
        tetrahedra: whether the elements are tetrahedra.
        recorded: what the solver recorded and is the same in all scenes: young, poisson, contact_range, friction.
    """

    info: DatasetInfo
    material_width: int
    mesh_spacing: float
    planar: bool = False
    tetrahedra: bool = True
    recorded: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelConfig:
    """Settings of any model. Each model derives a class from this one, with a `name` of its own.

    When training starts, `resolve` fills in the settings that are None, and all fields from `integration` on.
    """

    name: str = setting("", "which model")
    node_inputs: tuple[str, ...] | None = setting(None, f"{NODE_INPUTS}; unset: chosen from the data")
    proximity_radius: float | None = setting(
        None, "with proximity: distance within which a node sees another body; unset: 1.5 mesh spacings", least=0
    )
    boundary_motion: bool = setting(True, "give each prescribed node its next increment as an input; off with jumps")
    jumps: bool | None = setting(
        False,
        "predict any frame at once from the first frame, carried along by the prescribed nodes, not step by step;"
        " unset: yes in quasi-static scenes",
    )

    integration: Literal["quasi_static", "dynamic"] = setting(
        "quasi_static", "next position: p + v if quasi_static, 2 p - p_previous + a if dynamic; from the dataset"
    )
    stress: Literal["none", "node", "element"] = setting("none", "where stress is predicted; from the dataset")
    material_width: int = setting(0, "numbers that describe the material of an element; from the dataset")
    domain_center: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "centre of the domain; from the dataset")
    domain_half_width: float = setting(1.0, "half the side of the domain, a cube; from the dataset")
    contact_radius: float = setting(0.0, "distance within which surfaces count as near; from the dataset")
    tetrahedra: bool = setting(False, "the elements are tetrahedra; from the dataset")
    young: float = setting(0.0, "Young's modulus of all elements, if the solver recorded one; from the dataset")
    poisson: float = setting(0.0, "Poisson's ratio of all elements, likewise; from the dataset")
    contact_range: float = setting(0.0, "distance below which the solver's surfaces repel, likewise; from the dataset")
    friction: float = setting(0.0, "coefficient of friction, likewise; from the dataset")
    planar: bool = setting(False, "nodes stay at their z, as in scenes that lie in the plane z = 0; from the dataset")

    def __post_init__(self) -> None:
        self.check_inputs("node_inputs", ("displacement", "velocity", "material", "proximity", "out_of_balance"))
        for item in fields(self):
            if limits := item.metadata.get("limits"):
                require_range(f"model.{item.name}", getattr(self, item.name), *limits)

    def check_inputs(self, key: str, known: tuple[str, ...]) -> None:
        """Raise ConfigError if a name in the setting `key` is not one of `known`."""
        for name in getattr(self, key) or ():
            if name not in known:
                raise ConfigError(f"model.{key}: {name!r} is unknown: choose of {', '.join(known)}")

    def check_available(self, key: str) -> None:
        """Raise ConfigError if the setting `key` names an input that the dataset does not have."""
        inputs = getattr(self, key)
        if "material" in inputs and not self.material_width:
            raise ConfigError(f"model.{key}: material is an input, but the dataset has no material")
        if "velocity" in inputs and self.integration != "dynamic":
            raise ConfigError(f"model.{key}: velocity is an input of dynamic scenes only")

    def check_heads(self) -> None:
        """Raise ConfigError unless the width is a multiple of the number of heads."""
        if self.hidden % self.heads:
            raise ConfigError(f"model.hidden = {self.hidden} must be a multiple of model.heads = {self.heads}")

    @property
    def dynamic(self) -> bool:
        return self.integration == "dynamic"

    @property
    def given_frames(self) -> int:
        """The number of first frames from which a prediction starts."""
        return GIVEN_FRAMES[self.integration]

    @property
    def gains_along_rollouts(self) -> bool:
        """Whether an unset `train.rollout_pool` becomes a pool. With inertia, rollouts diverge without one
        (docs/log.md, 2026-11-23)."""
        return self.dynamic

    @property
    def cell_side(self) -> float:
        """Side of the cells into which the model sorts nodes, in the unit of length; 0 for a model without cells."""
        return 0.0

    @property
    def graph_parts(self) -> dict[str, bool]:
        """The parts of the graph that the inputs need: arguments of `Graph.from_scene`."""
        return {"surface": "proximity" in self.node_inputs, "elasticity": "out_of_balance" in self.node_inputs}

    def resolve(self, facts: DataFacts) -> Self:
        """The settings with nothing left open.

        If `node_inputs` is unset, velocity becomes an input of dynamic scenes, material of scenes that have one, and
        with jumps the elastic forces of tetrahedra.

        Raises:
            ConfigError: the data lacks something that the settings ask for.
        """
        info = facts.info
        jumps = info.integration == "quasi_static" if self.jumps is None else self.jumps
        if jumps and info.integration == "dynamic":
            raise ConfigError(
                "model.jumps: the dataset is dynamic, so the positions of its nodes depend on their motion before, not"
                " only on the prescribed nodes: predict it step by step"
            )
        velocity = ("velocity",) if info.integration == "dynamic" else ()
        forces = ("out_of_balance",) if jumps and facts.tetrahedra else ()
        chosen = (*velocity, *(("material",) if facts.material_width else ()), *forces)
        if "out_of_balance" in (self.node_inputs or ()) and not facts.tetrahedra:
            raise ConfigError("model.node_inputs: out_of_balance needs tetrahedra, but the elements are triangles")
        resolved = replace(
            self,
            node_inputs=chosen if self.node_inputs is None else self.node_inputs,
            proximity_radius=1.5 * facts.mesh_spacing if self.proximity_radius is None else self.proximity_radius,
            integration=info.integration,
            stress=info.stress_location,
            material_width=facts.material_width,
            domain_center=tuple(float(c) for c in info.domain_center),
            domain_half_width=float(info.domain_half_width),
            contact_radius=float(info.contact_radius),
            tetrahedra=facts.tetrahedra,
            **facts.recorded,
            planar=facts.planar,
            jumps=jumps,
            boundary_motion=self.boundary_motion and not jumps,
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

    def resolve(self, facts: DataFacts) -> Self:
        """See `ModelConfig`. If `node_inputs` is unset, displacement becomes an input, and proximity in quasi-static
        scenes. Proximity has not been measured in dynamic scenes."""
        resolved = super().resolve(facts)
        if self.node_inputs is not None:
            return resolved
        proximity = () if resolved.dynamic else ("proximity",)
        return replace(resolved, node_inputs=("displacement", *proximity, *resolved.node_inputs))


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
    shared = {"batch_size": 8, "optimizer": "muon", "stress_weight": 0.1, "rollout_pool": None}
    return Preset(replace(model, jumps=None), {**shared, "peak_rate": peak_rate, **train})
