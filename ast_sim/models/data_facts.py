"""What a model must know of its data. These facts are no settings: the dataset has them, and nobody chooses them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ast_sim.dataset.layout import GIVEN_FRAMES, DatasetInfo, Integration, StressLocation
from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.material import FRICTION, Material
from ast_sim.named_field import STRESS, Output
from ast_sim.support.toml_settings import NOTHING


@dataclass(frozen=True)
class DataFacts:
    """Facts of a dataset; lengths in its unit. They are written into `scope.toml` of a run.

    Attributes:
        integration: "quasi_static" (next position: p + v) or "dynamic" (2 p - p_previous + a).
        stress: where stress is predicted: "none", "node" or "element".
        fields: the named fields that are predicted: name, location, columns and unit of each, as in `Output`.
        columns: the name of each column of the material of an element; none without material.
        domain_center, domain_half_width: the cube that holds all positions.
        contact_radius: distance within which surfaces count as near.
        mesh_spacing: mean length of a mesh edge of the deforming bodies at rest.
        tetrahedra: whether the elements are tetrahedra.
        corners_only: whether elements were of a higher order and keep their corners only; no force is right then.
        planar: whether z is 0 in all scenes.
        young, poisson, contact_range, friction: what the solver recorded, and is the same in all scenes: Young's
            modulus and Poisson's ratio of all elements, distance below which its surfaces repel, coefficient of
            friction; 0: it recorded none, or several.
        middle_low, middle_high: the lowest and the highest middle of the box around the deforming bodies at rest, along
            x, y and z; empty in older runs.
    """

    integration: Integration = "quasi_static"
    stress: StressLocation = "none"
    fields: tuple[tuple[str, str, int, str], ...] = ()
    columns: tuple[str, ...] = ()
    domain_center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    domain_half_width: float = 1.0
    contact_radius: float = 0.0
    mesh_spacing: float = 0.0
    tetrahedra: bool = False
    corners_only: bool = False
    planar: bool = False
    young: float = 0.0
    poisson: float = 0.0
    contact_range: float = 0.0
    friction: float = 0.0
    middle_low: tuple[float, ...] = ()
    middle_high: tuple[float, ...] = ()

    @staticmethod
    def of(
        info: DatasetInfo,
        columns: tuple[str, ...],
        mesh_spacing: float,
        planar: bool = False,
        tetrahedra: bool = True,
        recorded: Mapping[str, float] = NOTHING,
        fields: tuple[tuple[str, str, int, str], ...] = (),
        middles: tuple[tuple[float, ...], tuple[float, ...]] = ((), ()),
    ) -> DataFacts:
        """The facts of a dataset with this `info`; `recorded` has what the solver recorded, `middles` the lowest and
        the highest middle, the others are as above."""
        x, y, z = (float(c) for c in info.domain_center)
        return DataFacts(
            integration=info.integration,
            stress=info.stress_location,
            fields=fields,
            columns=columns,
            domain_center=(x, y, z),
            domain_half_width=float(info.domain_half_width),
            contact_radius=float(info.contact_radius),
            mesh_spacing=mesh_spacing,
            corners_only=info.corners_only,
            tetrahedra=tetrahedra,
            planar=planar,
            middle_low=middles[0],
            middle_high=middles[1],
            **recorded,
        )

    @property
    def generator(self) -> dict[str, Any]:
        """What an answer keeps of the origin of the data, as `DatasetInfo.generator` has it."""
        return {"material": list(self.columns), **({CORNERS_ONLY: True} if self.corners_only else {})}

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What is predicted beside the motion: the stress, if any, then the named fields."""
        stress = () if self.stress == "none" else (Output(STRESS, self.stress, 1, "Pa"),)
        return (*stress, *(Output(*field) for field in self.fields))

    def output_columns(self, location: str) -> int:
        """The number of columns of all outputs at each "node" or "element"; the motion does not count."""
        return sum(output.columns for output in self.outputs if output.location == location)

    @cached_property
    def material(self) -> Material:
        """The material of the scenes: its columns, and what the solver recorded."""
        elastic = {"young": self.young, "poisson": self.poisson} if self.young else {}
        return Material(self.columns, {**elastic, "friction": self.friction})

    @property
    def rubs(self) -> bool:
        """Whether friction acts in a scene."""
        return bool(self.friction) or FRICTION in self.columns

    @property
    def material_width(self) -> int:
        """The number of columns of the material."""
        return len(self.columns)

    @property
    def dynamic(self) -> bool:
        return self.integration == "dynamic"

    @property
    def given_frames(self) -> int:
        """The number of first frames from which a prediction starts."""
        return GIVEN_FRAMES[self.integration]
