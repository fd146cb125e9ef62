"""The scope of a run: the ranges of sizes, materials and motions in its training scenes, kept in `scope.toml`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch

from ast_sim.models.data_facts import DataFacts
from ast_sim.ops import mesh_edges
from ast_sim.prescribed_motion import Motion
from ast_sim.scene import Scene

LEEWAY = 0.05  # a value up to 5 % outside a range counts as inside
_SPACINGS: WeakKeyDictionary[Scene, float] = WeakKeyDictionary()  # of the scenes that are in use


@dataclass(frozen=True)
class Scope:
    """Ranges (lowest, highest) over the training scenes; lengths in `length_unit`.

    Attributes:
        family, length_unit, time_step: as in the dataset's `DatasetInfo`.
        corners: number of nodes of an element, the same in all scenes.
        nodes: number of nodes of a scene.
        size: diagonal of the box around the deforming bodies at rest.
        spacing: mean length of the mesh edges of the deforming bodies at rest.
        held: diagonal of the box around the held nodes (the prescribed ones of the deforming bodies) at rest, as a
            share of `size`; 0 if nothing is held.
        travel: largest distance of a prescribed node from its place at rest; with inertia from its place in the first
            frame, where such scenes start.
        motion_low, motion_high: the lowest and the highest displacement of a prescribed node from there, along x, y and
            z; along an axis that training scenes were mirrored in, either way.
        increment: largest displacement of a prescribed node in one frame.
        usual_increment: the median of that displacement over all frames in which one moves; 0 if none ever does.
        material_low, material_high: the lowest and the highest number of each material column.
        data: what the model knows of its data.
    """

    family: str
    length_unit: str
    time_step: float
    corners: int
    nodes: tuple[float, float]
    size: tuple[float, float]
    spacing: tuple[float, float]
    held: tuple[float, float]
    travel: tuple[float, float]
    increment: tuple[float, float]
    usual_increment: float
    motion_low: tuple[float, ...]
    motion_high: tuple[float, ...]
    material_low: tuple[float, ...]
    material_high: tuple[float, ...]
    data: DataFacts

    @property
    def material_ranges(self) -> dict[str, tuple[float, float]]:
        """The lowest and the highest number of each material column, by its name."""
        return dict(zip(self.data.columns, zip(self.material_low, self.material_high, strict=True), strict=True))

    def notes(self, scene: Scene, motion: Motion, each_frame: bool) -> Iterator[str]:
        """One sentence for each property of a scene and its prescribed motion that lies outside its range. How far
        prescribed nodes move in one frame matters where `each_frame` is predicted from the one before."""
        length = f" {self.length_unit}"
        increment = max(motion.increments(scene)) if each_frame else 0.0
        motion = whole_motion(scene, motion, self.data.dynamic)
        travel = motion.travel(scene)
        for (low, high), value, text, unit in (
            ((self.corners, self.corners), scene.elements.shape[1], "the elements have {} nodes", ""),
            (self.nodes, scene.num_nodes, "the scene has {} nodes", ""),
            (self.size, size_of(scene), "the deforming bodies measure {} across", length),
            (self.spacing, spacing_of(scene), "the mesh edges have a mean length of {}", length),
            (self.held, held_share_of(scene), "the held nodes span {} of the size of the deforming bodies", ""),
            ((0.0, self.travel[1]), travel, "prescribed nodes move up to {} from their start", length),
            ((0.0, self.increment[1]), increment, "prescribed nodes move {} in one frame", length),
            *self._materials(scene),
        ):
            if not low - LEEWAY * abs(low) <= value <= high + LEEWAY * abs(high):
                shown, *limits = (f"{number:.4g}{unit}" for number in (value, *dict.fromkeys((low, high))))
                yield f"{text.format(shown)}; in training {' to '.join(limits)}"
        if travel <= (1 + LEEWAY) * self.travel[1]:  # else their travel tells it
            yield from self._directions(scene, motion)

    def _directions(self, scene: Scene, motion: Motion) -> Iterator[str]:
        """One sentence for each axis along which prescribed nodes move farther than in training."""
        leeway = LEEWAY * self.travel[1]
        for axis, low, high, *reached in zip(
            "xyz", self.motion_low, self.motion_high, *motion.extent(scene), strict=True
        ):
            for value in reached:
                if not low - leeway <= value <= high + leeway:
                    shown, *limits = (f"{number:.4g} {self.length_unit}" for number in (value, low, high))
                    yield f"prescribed nodes move {shown} along {axis}; in training {' to '.join(limits)}"

    def _materials(self, scene: Scene) -> Iterator[tuple[tuple[float, float], float, str, str]]:
        """The smallest and the largest number in each material column of the deforming bodies."""
        if scene.material is None:
            return
        for name, limits in self.material_ranges.items():
            numbers = self.data.material.numbers(name, scene.material)
            values = np.full(scene.num_elements, numbers)[scene.deforming_elements]
            for value in (values.min(initial=limits[0]), values.max(initial=limits[1])):
                yield limits, float(value), f"{name} of the material is {{}}", ""


def whole_motion(scene: Scene, motion: Motion, dynamic: bool) -> Motion:
    """The motion whose travel counts: without inertia it begins at rest, since what was prescribed before the first
    frame counts as much as what comes after it."""
    return motion if dynamic else motion.from_rest(scene)


def size_of(scene: Scene) -> float:
    """The diagonal of the box around the deforming bodies at rest; 0 if there are none."""
    return _diagonal(scene, scene.deforming_nodes)


def middle_of(scene: Scene) -> np.ndarray:
    """[3] float64: the middle of the box around the deforming bodies at rest; the origin if there are none."""
    lowest, highest = _box(scene, scene.deforming_nodes)
    return (lowest + highest) / 2


def _diagonal(scene: Scene, nodes: np.ndarray) -> float:
    lowest, highest = _box(scene, nodes)
    return float(np.linalg.norm(highest - lowest))


def _box(scene: Scene, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[3] and [3] float64: the lowest and the highest coordinates of nodes at rest; zeros if there are none."""
    points = scene.rest_position[nodes].T.astype(np.float64, order="C")  # rows are reduced faster
    return (points.min(axis=1), points.max(axis=1)) if points.size else (np.zeros(3), np.zeros(3))


def held_share_of(scene: Scene) -> float:
    """The diagonal of the box around the held nodes at rest, as a share of `size_of`; 0 if there are none."""
    return _diagonal(scene, scene.deforming_nodes & scene.prescribed) / (size_of(scene) or 1.0)


def spacing_of(scene: Scene) -> float:
    """The mean length of the mesh edges of the deforming bodies at rest; 0 if there are none. It is computed once for
    each scene."""
    if scene not in _SPACINGS:
        lengths = edge_lengths(scene)
        _SPACINGS[scene] = float(lengths.mean(dtype=np.float64)) if len(lengths) else 0.0
    return _SPACINGS[scene]


def edge_lengths(scene: Scene) -> np.ndarray:
    """The lengths of the mesh edges of the deforming bodies at rest."""
    edges = mesh_edges(torch.from_numpy(scene.elements.astype(np.int64)), scene.num_nodes)
    one, other = edges.receivers.numpy(), edges.senders.numpy()
    deforming = (one < other) & scene.deforming_nodes[one] & scene.deforming_nodes[other]
    one, other = one[deforming], other[deforming]
    return np.linalg.norm(scene.rest_position[one] - scene.rest_position[other], axis=1)
