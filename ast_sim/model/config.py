"""What the settings of every model have in common, and presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

from ast_sim.data.file import DatasetInfo
from ast_sim.errors import ConfigError


def setting(default: Any, text: str) -> Any:
    """A field with its explanation."""
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class ModelConfig:
    """Settings of any model; those of one are a subclass with a `name` of its own.

    The last group is taken from the dataset when training starts.
    """

    time_conditioned = False  # no setting here: see `TimeConditionedConfig`

    name: str = setting("", "which model")
    node_inputs: tuple[str, ...] = setting(
        ("displacement",), "node features: displacement, velocity, material, proximity"
    )
    proximity_radius: float | None = setting(
        None, "with proximity: distance from which another body is seen; unset: 1.5 mesh spacings"
    )
    boundary_motion: bool = setting(True, "the next increment of prescribed nodes is an input")

    integration: Literal["quasi_static", "dynamic"] = setting("quasi_static", "p + v, or 2 p - p_previous + a")
    stress: Literal["none", "node", "element"] = setting("none", "where a stress is predicted")
    material_width: int = setting(0, "material scalars of an element")
    domain_center: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "centre of the cube that holds the scenes")
    domain_half_width: float = setting(1.0, "half the side of that cube")
    contact_radius: float = setting(0.0, "distance from which other surfaces count as near")

    def __post_init__(self) -> None:
        self.check_inputs("node_inputs", ("displacement", "velocity", "material", "proximity"))

    def check_inputs(self, key: str, known: tuple[str, ...]) -> None:
        """Raise ConfigError for inputs that there are none of, or that the dataset does not have."""
        inputs = getattr(self, key)
        for name in inputs:
            if name not in known:
                raise ConfigError(f"model.{key}: {name!r} is unknown: choose of {', '.join(known)}")
        if "material" in inputs and not self.material_width:
            raise ConfigError(f"model.{key}: material is an input, but the dataset has no material")
        if "velocity" in inputs and self.integration != "dynamic":
            raise ConfigError(f"model.{key}: velocity is an input of dynamic scenes only")

    def check_positive(self, *keys: str) -> None:
        """Raise ConfigError for a number below 1."""
        for key in keys:
            if getattr(self, key) < 1:
                raise ConfigError(f"model.{key} is {getattr(self, key)}; it must be at least 1")

    def check_heads(self) -> None:
        """Raise ConfigError unless the width can be cut for the heads."""
        if self.hidden % self.heads:
            raise ConfigError(f"model.hidden = {self.hidden} must be a multiple of model.heads = {self.heads}")

    @property
    def dynamic(self) -> bool:
        return self.integration == "dynamic"

    @property
    def gains_along_rollouts(self) -> bool:
        """Whether there is a `train.rollout_pool` where it is left open: with inertia rollouts run away without one
        (docs/log.md, 2026-11-23)."""
        return self.dynamic

    @property
    def cell_side(self) -> float:
        """Side of the cells that the model puts nodes into, in units of length; 0: it has none."""
        return 0.0

    @property
    def sees_surfaces(self) -> bool:
        """Whether the inputs need the surfaces of the bodies."""
        return "proximity" in self.node_inputs

    def resolve(self, info: DatasetInfo, material_width: int, mesh_spacing: float) -> Self:
        """The settings with everything filled in that the dataset decides.

        Args:
            info: of the dataset.
            material_width: material scalars of an element in the dataset; 0 if it has none.
            mesh_spacing: mean length of a mesh edge.

        Raises:
            ConfigError: the dataset lacks what the settings ask for.
        """
        return replace(
            self,
            integration=info.integration,
            stress=info.stress_location,
            material_width=material_width,
            domain_center=tuple(float(c) for c in info.domain_center),
            domain_half_width=float(info.domain_half_width),
            contact_radius=float(info.contact_radius),
            proximity_radius=1.5 * mesh_spacing if self.proximity_radius is None else self.proximity_radius,
        )

    def settings_for(self, info: DatasetInfo, material_width: int) -> dict[str, Any]:
        """The settings that a dataset calls for, by name: as inputs velocities if it moves in time, and materials if
        they differ. A preset that adapts takes them."""
        velocity = ["velocity"] if info.integration == "dynamic" else []
        return {"node_inputs": [*velocity, *(["material"] if material_width else [])]}

    def facts(self, length_unit: str, mesh_spacing: float | None = None) -> dict[str, str]:
        """What a report and, with the mesh spacing, a training say of these settings."""
        return {}


@dataclass(frozen=True)
class TimeConditionedConfig(ModelConfig):
    """Settings of a model that can predict a frame at once from the first one, instead of from the one before."""

    time_conditioned: bool = setting(
        False, "predict each frame at once from the first, the prescribed nodes and the time; no step by step"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time_conditioned and self.dynamic:
            raise ConfigError(
                "model.time_conditioned: the dataset is dynamic, and where its nodes are depends on how they moved, not"
                " only on where the prescribed ones are: predict it step by step"
            )

    @property
    def gains_along_rollouts(self) -> bool:
        """See `ModelConfig`; without inertia, too."""
        return True

    def settings_for(self, info: DatasetInfo, material_width: int) -> dict[str, Any]:
        """See `ModelConfig`; the displacement always, and in quasi-static scenes (in dynamic ones it has not been
        measured) proximity: no edge between bodies tells that another one is near."""
        nodes = super().settings_for(info, material_width)["node_inputs"]
        proximity = ["proximity"] if info.integration == "quasi_static" else []
        return {"node_inputs": ["displacement", *proximity, *nodes]}


@dataclass(frozen=True)
class Preset:
    """A model with the training settings that belong to it (fields of TrainConfig).

    Attributes:
        model: as in a paper, or for any dataset.
        train: settings of the training.
        adapts: whether it takes `settings_for` the dataset; the AST paper's presets do not.
    """

    model: ModelConfig
    train: Mapping[str, Any]
    adapts: bool = False
