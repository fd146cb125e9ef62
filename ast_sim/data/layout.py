"""What a dataset file holds: names, dtypes and attributes, and how attributes are stored."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from typing import Any

import h5py
import numpy as np

from ast_sim.data.scene import AttributeValue, Scene
from ast_sim.errors import DatasetError

FORMAT = "ast_sim"
VERSION = 1
SPLITS = ("train", "valid", "test")

ARRAYS: dict[str, tuple[type, int]] = {
    "rest_position": (np.float32, 2),
    "elements": (np.int32, 2),
    "node_type": (np.uint8, 1),
    "body": (np.int32, 1),
    "material": (np.float32, 2),
    "position": (np.float32, 3),
    "stress": (np.float32, 3),
    "cauchy_stress": (np.float32, 3),
}
OPTIONAL = ("material", "stress", "cauchy_stress")
FRAMED = ("position", "stress", "cauchy_stress")
_INTEGRATIONS = ("quasi_static", "dynamic")
_LOCATIONS = ("none", "node", "element")


@dataclass(frozen=True)
class DatasetInfo:
    """What holds for every trajectory of a dataset; lengths in `length_unit`, times in seconds, stress in pascal.

    Attributes:
        family: name of the kind of scenes.
        integration: "quasi_static" (the next increment is predicted) or "dynamic" (the acceleration is).
        stress_location: "none", "node" or "element".
        domain_center, domain_half_width: the cube that holds all positions; the root cell of the octree.
        contact_radius: distance below which surfaces are in contact.
        time_step: time between two frames; 0 where there is none.
        generator: program, versions, command, seed, licence: whatever tells where the data are from.
    """

    family: str
    integration: str
    stress_location: str
    domain_center: tuple[float, float, float]
    domain_half_width: float
    contact_radius: float
    time_step: float
    length_unit: str = "m"
    generator: dict[str, Any] = field(default_factory=dict)

    def check(self, name: str = "dataset") -> None:
        """Raise DatasetError, naming `name` and the attribute, on a value that cannot be."""
        for key, allowed in (("integration", _INTEGRATIONS), ("stress_location", _LOCATIONS)):
            if getattr(self, key) not in allowed:
                raise DatasetError(f"{name}: {key} is {getattr(self, key)!r}; must be one of {', '.join(allowed)}")
        numbers = (*self.domain_center, self.domain_half_width, self.contact_radius, self.time_step)
        if len(self.domain_center) != 3 or not all(map(math.isfinite, numbers)):
            raise DatasetError(f"{name}: domain_center, domain_half_width, contact_radius and time_step must be finite")
        if self.domain_half_width <= 0 or self.contact_radius < 0 or self.time_step < 0:
            raise DatasetError(f"{name}: domain_half_width must be above 0, contact_radius and time_step at least 0")

    def attributes(self) -> dict[str, Any]:
        """The attributes of the file's root."""
        values = {"format": FORMAT, "version": VERSION, **asdict(self)}
        values["domain_center"] = [float(number) for number in self.domain_center]
        for key in ("domain_half_width", "contact_radius", "time_step"):
            values[key] = float(values[key])
        values["generator"] = json.dumps(self.generator, sort_keys=True)
        return values


def scene_kind(scene: Scene) -> tuple[int, int]:
    """What all scenes of a dataset share: the nodes per element and the number of material columns."""
    return scene.elements.shape[1], 0 if scene.material is None else scene.material.shape[1]


def write_attributes(group: h5py.Group, values: dict[str, Any]) -> None:
    """Store str, int, float and lists of numbers as attributes.

    Raises:
        DatasetError: naming the attribute whose value is of another kind.
    """
    for key, value in values.items():
        if isinstance(value, str):
            # Fixed length: such a string lies in the object header, which has a checksum.
            text = value.encode()
            group.attrs.create(key, text, dtype=h5py.string_dtype("utf-8", max(1, len(text))))
        elif isinstance(value, (int, np.integer, np.bool_)):
            group.attrs[key] = np.int64(value)
        elif isinstance(value, (float, np.floating)):
            group.attrs[key] = np.float64(value)
        elif isinstance(value, (list, tuple, np.ndarray)) and np.asarray(value).dtype.kind in "iufb":
            group.attrs[key] = np.asarray(value, np.float64).reshape(-1)
        else:
            raise DatasetError(f"the attribute {key} is {value!r}; must be a str, int, float or a list of numbers")


def plain_value(value: Any) -> AttributeValue:
    """An attribute as h5py gives it, as str, int, float or list of float.

    Raises:
        TypeError: for a value of any other kind.
    """
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, str):
        return value
    if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iuf":
        return [float(number) for number in value]
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, np.floating):
        return float(value)
    raise TypeError(f"a value of the type {type(value).__name__}")
