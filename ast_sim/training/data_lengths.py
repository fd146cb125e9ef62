"""Measurements of the training data: the scales that settings follow from, and the ranges of the scope."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ast_sim.batches.frame_pairs import target_counts
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.inference.evaluation.measures import SquaredError, rmse_pooled
from ast_sim.material import hints
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig
from ast_sim.plausibility.findings import Finding, refusal
from ast_sim.plausibility.motion import negative_stress
from ast_sim.plausibility.topology import folded_inside_out
from ast_sim.prescribed_motion import Motion
from ast_sim.runs.scope import Scope, edge_lengths, held_share_of, middle_of, size_of, spacing_of, whole_motion
from ast_sim.scene import AttributeValue, NodeType
from ast_sim.support.errors import TrainingError, warn

# Facts of the data (`DataFacts`), and the attributes of trajectories that hold them.
RECORDED = {"young": "young", "poisson": "poisson", "contact_range": "dhat", "friction": "friction"}
MEASURED = 100  # training trajectories, at most, that are measured


@dataclasses.dataclass(frozen=True)
class DataScales:
    """Scales of the training split.

    Attributes:
        displacement, increment: root mean square per coordinate, over all frames and NORMAL nodes.
        spacing: mean length of the mesh edges of the deforming bodies at rest.
        nodes: median number of nodes of a scene.
        trajectories, pairs: number of trajectories, and number of frames that can be a target.
        planar: whether z is 0 in all scenes.
        recorded: numbers that the solver recorded with all scenes alike, by the name of the fact; see RECORDED. 0:
            it recorded none, or several.
        room: the smallest distance of a node from the boundary of the domain.
        middles: the lowest and the highest middle of the box around the deforming bodies at rest, along x, y and z.
    """

    displacement: float
    increment: float
    spacing: float
    nodes: int
    trajectories: int
    pairs: int
    planar: bool = False
    recorded: Mapping[str, float] = dataclasses.field(default_factory=dict)
    room: float = math.inf
    middles: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())


def measure(dataset: Dataset) -> DataScales:
    """Measure the scales on at most MEASURED trajectories, evenly spread over the training split.

    Raises:
        TrainingError: the split is empty.
        ConfigError: a scene for training or validation has some frames of its motion only.
        DatasetError: in one of these scenes nothing can deform, or its material cannot be one.
    """
    count = dataset.count("train")
    if count == 0:
        raise TrainingError(f"{dataset.path} has no trajectories to train on: the split train is empty")
    require_whole_motions(dataset, "train", "valid")
    displacement = []
    increment = []
    lengths = []
    nodes = []
    constants = []
    middles = []
    planar = True
    center = np.array(dataset.info.domain_center)
    room = math.inf
    doubts: list[tuple[str, Finding]] = []
    for name, trajectory in dataset.spread("train", MEASURED):
        scene = trajectory.scene
        position = trajectory.position
        scene.require_predictable(name)
        dataset.material.require_possible(name, scene.material, ~scene.rigid_elements)
        doubts += [(name, finding) for finding in (*folded_inside_out(scene), *negative_stress(trajectory))]
        normal = scene.node_type == NodeType.NORMAL
        displacement.append(SquaredError.between(position, scene.rest_position, normal))
        increment.append(SquaredError.between(position[1:], position[:-1], normal))
        lengths.append(edge_lengths(scene))
        nodes.append(scene.num_nodes)
        middles.append(middle_of(scene))
        constants.append({key: trajectory.attributes.get(name) for key, name in RECORDED.items()})
        room = min(room, dataset.info.domain_half_width - float(np.abs(position - center).max()))
        planar = planar and not scene.rest_position[:, 2].any() and not position[:, :, 2].any()
    for doubt in (*hints(dataset.material.columns), *([refusal(doubts)] if doubts else ())):
        warn(f"{dataset.path}: {doubt}")
    return DataScales(
        displacement=rmse_pooled(displacement),
        increment=rmse_pooled(increment),
        spacing=float(np.concatenate(lengths).mean(dtype=np.float64)),
        nodes=int(np.median(nodes)),
        trajectories=count,
        pairs=sum(target_counts(dataset, "train")),
        planar=planar,
        recorded=_alike(constants),
        room=max(0.0, room),
        middles=(tuple(np.min(middles, axis=0).tolist()), tuple(np.max(middles, axis=0).tolist())),
    )


def _alike(constants: list[dict[str, AttributeValue | None]]) -> dict[str, float]:
    """The numbers that are the same in all scenes, the largest of several; 0 for the others."""
    first = constants[0]
    alike = {key: value for key, value in first.items() if all(constant[key] == value for constant in constants)}
    known = {key: value for key, value in alike.items() if isinstance(value, float | int | list)}
    return {key: float(np.max(known.get(key, 0.0), initial=0.0)) for key in first}


def scope_of(dataset: Dataset, data: DataFacts, mirror: Sequence[str] = ()) -> Scope:
    """The ranges of the training split, measured on the same trajectories, and what the model knows of its data;
    `mirror` names the axes along which the training mirrors scenes."""
    rows, materials, increments, extents = [], [], [], []
    for _, trajectory in dataset.spread("train", MEASURED):
        scene = trajectory.scene
        motion = Motion(trajectory.position)
        moves = motion.increments(scene)
        increments += [length for length in moves if length > 0]
        sizes = (scene.num_nodes, size_of(scene), spacing_of(scene), held_share_of(scene))
        whole = whole_motion(scene, motion, data.dynamic)
        rows.append((*sizes, whole.travel(scene), max(moves)))
        extents.append(whole.extent(scene))
        if scene.material is not None:
            materials.append(scene.material[scene.deforming_elements])
    names = ("nodes", "size", "spacing", "held", "travel", "increment")
    by_name = dict(zip(names, zip(*rows, strict=True), strict=True))
    low, high = _widest(extents, mirror)
    material = np.concatenate(materials) if materials else np.zeros((1, 0))
    info = dataset.info
    return Scope(
        family=info.family,
        length_unit=info.length_unit,
        time_step=float(info.time_step),
        corners=dataset.element_size,
        **{key: (float(min(values)), float(max(values))) for key, values in by_name.items()},
        usual_increment=float(np.median(increments or [0.0])),
        motion_low=tuple(low.tolist()),
        motion_high=tuple(high.tolist()),
        material_low=tuple(material.min(axis=0).tolist()),
        material_high=tuple(material.max(axis=0).tolist()),
        data=data,
    )


def _widest(extents: Sequence[tuple[np.ndarray, np.ndarray]], mirror: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """[3] and [3]: the lowest and the highest displacement of all scenes; along the axes `mirror`, either way."""
    low = np.min([lowest for lowest, _ in extents], axis=0)
    high = np.max([highest for _, highest in extents], axis=0)
    mirrored = np.isin(["x", "y", "z"], list(mirror))
    farthest = np.maximum(-low, high)
    return np.where(mirrored, -farthest, low), np.where(mirrored, farthest, high)


def largest_error(scales: DataScales, model: ModelConfig) -> float:
    """A pool of rollouts drops a state whose error, in units of length, is above this; see docs/log.md."""
    return (0.4 if model.data.dynamic else 1.8) * scales.displacement
