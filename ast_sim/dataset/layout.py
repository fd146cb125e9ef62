"""The layout of a dataset file: the names and dtypes of its arrays, its attributes and how they are stored."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

import h5py
import numpy as np

from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.material import FRICTION, POISSON, YOUNG, Material
from ast_sim.number_arrays import real_numbers, three_numbers
from ast_sim.scene import AttributeValue, Scene
from ast_sim.support.argument_checks import in_short, require_type
from ast_sim.support.errors import DatasetError, counted

FORMAT = "ast_sim"
VERSION = 3
READABLE = (2, VERSION)  # a file of version 2 is one of version 3 without named fields
HASH = "sha256"  # attribute of every array and, over these and its attributes, of every trajectory
SPLITS: tuple[str, ...] = ("train", "valid", "test", "calibration")

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
FIELDS = "fields"  # the group of the named fields of a trajectory; each is an array of this kind
FIELD_KIND = (np.float32, 3)
NUMBERING = ("frames", "times")  # attributes of a trajectory that tell of its frames; they may be missing
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}  # in metres
Integration = Literal["quasi_static", "dynamic"]
StressLocation = Literal["none", "node", "element"]
GIVEN_FRAMES: dict[Integration, int] = {"quasi_static": 1, "dynamic": 2}  # the first frames, where a prediction starts
# The columns of the material in the scenes of the families that are generated here; an assembly has the third one if
# its scenes differ in friction.
_GENERATED = {
    "abcd": (YOUNG, POISSON),
    "abcd_xl": (YOUNG, POISSON),
    "assembly": (YOUNG, POISSON, FRICTION),
    "sphere_simple": ("stretch", "bending", "density"),
}


@dataclass(frozen=True)
class DatasetInfo:
    """What all trajectories of a dataset share. Lengths are in `length_unit`, times in seconds, stress in pascal.

    Attributes:
        family: name of the kind of scenes.
        integration: "quasi_static" (models predict the next increment) or "dynamic" (models predict the acceleration).
        stress_location: "none", "node" or "element".
        domain_center, domain_half_width: the cube that holds all positions; it is the root cell of the octree.
        contact_radius: distance below which surfaces are in contact.
        time_step: time between two frames; 0 if frames have no time.
        length_unit: "m", "cm", "mm", "um" or "in".
        generator: the origin of the data, such as program, versions, command, seed and licence. Its entry `material` is
            a list: the name of each column of `Scene.material`, such as ["young", "poisson"] (`ast_sim.Material`).
            Its entry `corners_only` is true if elements were of a higher order and keep their corners only.
    """

    family: str
    integration: Integration
    stress_location: StressLocation
    domain_center: tuple[float, float, float]
    domain_half_width: float
    contact_radius: float
    time_step: float
    length_unit: str = "m"
    generator: dict[str, Any] = field(default_factory=dict)

    def check(self, name: str = "dataset") -> None:
        """Check all values.

        Raises:
            DatasetError: a value is not allowed; the text names `name` and the attribute.
        """
        for key, allowed in (
            ("integration", GIVEN_FRAMES),
            ("stress_location", get_args(StressLocation)),
            ("length_unit", LENGTH_UNITS),
        ):
            if getattr(self, key) not in allowed:
                raise DatasetError(f"{name}: {key} is {getattr(self, key)!r}; must be one of {', '.join(allowed)}")
        if not isinstance(self.family, str) or not self.family:
            raise DatasetError(f"{name}: family is {in_short(self.family)}; must be a text")
        self._check_generator(name)
        three_numbers(name, "domain_center", self.domain_center)
        for key in ("domain_half_width", "contact_radius", "time_step"):
            number = real_numbers(name, key, getattr(self, key))
            if number.shape or not np.isfinite(number):
                raise DatasetError(f"{name}: {key} must be one finite number, not {in_short(getattr(self, key))}")
        if self.domain_half_width <= 0 or self.contact_radius < 0 or self.time_step < 0:
            raise DatasetError(f"{name}: domain_half_width must be above 0, contact_radius and time_step at least 0")

    def _check_generator(self, name: str) -> None:
        """Raise DatasetError unless the origin of the data is facts that JSON holds, with names of columns that fit."""
        if not isinstance(self.generator, Mapping):
            raise DatasetError(f"{name}: generator is {in_short(self.generator)}; must be facts by name")
        for key, value in self.generator.items():
            try:
                json.dumps({key: value}, sort_keys=True)
            except (TypeError, ValueError) as error:  # no kind of JSON; or it holds itself
                raise DatasetError(f"{name}: generator[{key!r}] is nothing that JSON holds: {error}") from error
        columns = self.generator.get("material", [])
        texts = isinstance(columns, list | tuple) and all(isinstance(one, str) and one for one in columns)
        if not texts or len(set(columns)) < len(columns):
            raise DatasetError(
                f"{name}: generator['material'] is {columns!r}; must be a list with one name for each column of the"
                " material, such as ['young', 'poisson']"
            )

    @property
    def corners_only(self) -> bool:
        """Whether elements were of a higher order and keep their corners only: they are stiffer, so no force of theirs
        is right."""
        return bool(self.generator.get(CORNERS_ONLY, False))

    def in_unit(self, unit: str, name: str) -> DatasetInfo:
        """The same facts in another unit of length.

        Raises:
            DatasetError: there is no such unit; the text names `name`.
        """
        if unit not in tuple(LENGTH_UNITS):  # a list has no hash
            raise DatasetError(f"{name}: length_unit {unit!r} is unknown: use one of {', '.join(LENGTH_UNITS)}")
        scale = LENGTH_UNITS[self.length_unit] / LENGTH_UNITS[unit]
        center_x, center_y, center_z = self.domain_center
        return replace(
            self,
            length_unit=unit,
            domain_center=(scale * center_x, scale * center_y, scale * center_z),
            domain_half_width=scale * self.domain_half_width,
            contact_radius=scale * self.contact_radius,
        )

    def material(self, width: int) -> Material:
        """The material of scenes with this number of columns, by the names that the origin of the data gives them, or
        by the family, if it is one that is generated here. Other columns have no meaning: they are called "column 0",
        "column 1" and so on.

        Raises:
            DatasetError: there are names for another number of columns.
        """
        named = self.generator.get("material")
        if named is None:
            generated = _GENERATED.get(self.family, ())[:width]
            unnamed = tuple(f"column {number}" for number in range(width))
            return Material(generated if len(generated) == width else unnamed)
        if len(named) != width:
            raise DatasetError(
                f"the material has {counted(width, 'column')}, but generator['material'] names"
                f" {', '.join(named) or 'none'}: give each column one name"
            )
        return Material(named)

    def times(self, frames: Iterable[int]) -> tuple[float, ...] | None:
        """The times of frames in seconds, by their numbers; None if frames have no time."""
        return tuple(self.time_step * number for number in frames) if self.time_step else None

    def attributes(self) -> dict[str, Any]:
        """The attributes of the file's root."""
        values = {"format": FORMAT, "version": VERSION, **asdict(self)}
        for key in ("domain_half_width", "contact_radius", "time_step"):
            values[key] = float(values[key])
        values["generator"] = json.dumps(self.generator, sort_keys=True)
        return values


def require_kind(name: str, scene: Scene, known: tuple[int, int] | None) -> tuple[int, int]:
    """The nodes per element and the number of material columns of a scene.

    Raises:
        DatasetError: they differ from the other scenes of the dataset, where these are `known`.
    """
    kind = scene.elements.shape[1], 0 if scene.material is None else scene.material.shape[1]
    if known not in (None, kind):
        raise DatasetError(
            f"{name}: has {counted(kind[0], 'node')} per element and {counted(kind[1], 'material column')}; other"
            f" samples have {known[0]} and {known[1]}"
        )
    return kind


def write_attributes(group: h5py.Group | h5py.Dataset, values: dict[str, Any]) -> None:
    """Store values of the types str, int, float and list of numbers as attributes, in the order of their names: the
    bytes of a file depend on the order.

    Raises:
        DatasetError: a value has another type; the text names the attribute.
    """
    for key in values:
        require_type("the name of an attribute", key, str, "a text")
    for key, value in sorted(values.items()):
        if isinstance(value, str):
            # A string of fixed length is stored in the object header, which has a checksum.
            text = value.encode(errors="backslashreplace")  # names of files may hold bytes that are no text
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
    """Convert an attribute that h5py has read to str, int, float or list of float.

    Raises:
        TypeError: the value has another type.
    """
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "iuf":
        return value.astype(float).tolist()
    if isinstance(value, np.integer | np.floating):
        return value.item()
    if isinstance(value, str):
        return value
    raise TypeError(f"a value of the type {type(value).__name__}")


def array_hash(dtype: np.dtype, shape: tuple[int, ...], parts: Iterable[np.ndarray]) -> str:
    """The SHA-256 of an array, of which `parts` are consecutive rows."""
    digest = hashlib.sha256(f"{dtype.str}{list(shape)}".encode())
    for part in parts:
        digest.update(np.ascontiguousarray(part).data)
    return digest.hexdigest()


def field_key(name: str, unit: str, location: str) -> str:
    """What stands for a named field in the hash of its trajectory: so its unit and its place cannot be edited."""
    return f"{FIELDS}/{name} in {unit} at {location}"


def trajectory_hash(arrays: dict[str, str], attributes: dict[str, AttributeValue]) -> str:
    """The SHA-256 of a trajectory, from the hashes of its arrays and its attributes."""
    content = {"arrays": arrays, "attributes": {key: attributes[key] for key in attributes if key != HASH}}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def numbering(attributes: Mapping[str, AttributeValue]) -> tuple[tuple[int, ...] | None, tuple[float, ...] | None]:
    """The numbers and the times of the frames, as the attributes of a trajectory tell; None if they do not."""
    frames, times = (attributes.get(key) for key in NUMBERING)
    numbers = tuple(int(number) for number in frames) if isinstance(frames, list) else None
    return numbers, tuple(times) if isinstance(times, list) else None
