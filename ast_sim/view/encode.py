"""Scenes and curves as the compact JSON that the report's page reads.

Only the surface is kept. Displacements and stresses are int16 with one scale an array, so their error is at most
1 / 65534 of the largest value; everything is little-endian base64.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ast_sim.data.scene import NodeType, Scene, Trajectory
from ast_sim.view.fields import (
    deforming_rows,
    displacement_rmse,
    is_planar,
    require_same_scene,
    stress_at,
    stress_rmse,
    surface_owners,
)

Json = dict[str, Any]


class Surface:
    """The boundary of a scene, cut into the deforming bodies and the obstacles (all three nodes of type OBSTACLE).

    For either group: `triangles` [F, 3] numbers of its own nodes, `nodes` [n] their numbers in the scene, `elements`
    [F] the element behind each triangle.
    """

    def __init__(self, scene: Scene) -> None:
        surface = scene.surface()
        owners = surface_owners(scene, surface)
        obstacle = (scene.node_type == NodeType.OBSTACLE)[surface].all(axis=1)
        self.groups = {}
        for name, chosen in (("body", ~obstacle), ("obstacle", obstacle)):
            nodes, triangles = np.unique(surface[chosen], return_inverse=True)
            self.groups[name] = (triangles.reshape(-1, 3), nodes, owners[chosen])

    def encode(self, rest: np.ndarray) -> Json:
        """The triangles and rest positions of both groups; an empty group is None."""
        return {
            name: {
                "nodes": len(nodes),
                "triangles": base64_of(triangles, "<u4"),
                "rest": base64_of(rest[nodes], "<f4"),
            }
            if len(nodes)
            else None
            for name, (triangles, nodes, _) in self.groups.items()
        }

    def stress(self, trajectory: Trajectory) -> np.ndarray:
        """[S, n or F]: the stress at the nodes, or on the triangles, of the deforming bodies."""
        _, nodes, elements = self.groups["body"]
        return trajectory.stress[:, nodes if stress_at(trajectory) == "node" else elements, 0]

    def motion(self, trajectory: Trajectory, frames: np.ndarray) -> Json:
        """The displacements and stresses of a trajectory at those of `frames` that it has and that are finite."""
        frames = frames[frames < finite_frames(trajectory)]
        encoded: Json = {"frames": len(frames)}
        for name, (_, nodes, _) in self.groups.items():
            moved = trajectory.position[np.ix_(frames, nodes)] - trajectory.scene.rest_position[nodes]
            encoded[name] = packed(moved) if len(nodes) else None
        has_stress = trajectory.stress is not None and len(self.groups["body"][1])
        encoded["stress"] = packed(self.stress(trajectory)[frames]) if has_stress else None
        return encoded


def encode_scene(truth: Trajectory, frames: np.ndarray, predictions: Sequence[Trajectory | None] = ()) -> Json:
    """One scene: its surface, and those of `frames` that the truth and each run's prediction have."""
    for prediction in predictions:
        if prediction is not None:
            require_same_scene(truth, prediction)
    surface = Surface(truth.scene)
    low, high = _bounds(truth)
    ranges = {"displacement": _displacement_range(truth, surface)}
    if truth.stress is not None and len(surface.groups["body"][1]):
        ranges["stress"] = _color_range(surface.stress(truth))
    return {
        "planar": is_planar(truth.scene),
        "total": truth.num_frames,
        "frames": frames.tolist(),
        "groups": surface.encode(truth.scene.rest_position),
        "low": low.tolist(),
        "high": high.tolist(),
        "stress": stress_at(truth),
        "ranges": ranges,
        "truth": surface.motion(truth, frames),
        "predictions": [None if p is None else surface.motion(p, frames) for p in predictions],
    }


def encode_curves(truth: Trajectory, predictions: Sequence[Trajectory | None]) -> Json:
    """Per frame, the error of each run and of the predictor that learns nothing.

    Displacement: NORMAL nodes, against the first frame held still. Stress: outside the obstacles, against the mean
    of the true stress of that frame.
    """
    frames = [0 if p is None else min(finite_frames(p), truth.num_frames) for p in predictions]
    held = np.broadcast_to(truth.position[0], truth.position.shape)
    curves = {
        "displacement": {
            "runs": [
                None if p is None else displacement_rmse(truth, p.position[:n]).tolist()
                for p, n in zip(predictions, frames, strict=True)
            ],
            "trivial": displacement_rmse(truth, held).tolist(),
        }
    }
    if truth.stress is not None:
        rows = deforming_rows(truth)
        mean = truth.stress[:, rows].mean(axis=1, keepdims=True, dtype=np.float64) if rows.any() else 0.0
        comparable = [p is not None and stress_at(p) == stress_at(truth) for p in predictions]
        curves["stress"] = {
            "runs": [
                stress_rmse(truth, p.stress[:n]).tolist() if known else None
                for p, n, known in zip(predictions, frames, comparable, strict=True)
            ],
            "trivial": stress_rmse(truth, np.broadcast_to(mean, truth.stress.shape)).tolist(),
        }
    return curves


def motion_bytes(trajectory: Trajectory) -> int:
    """About how many bytes one frame of a trajectory takes on the page."""
    nodes = len(np.unique(trajectory.scene.surface()))
    return 8 * nodes * (3 if trajectory.stress is None else 4) // 3


def finite_frames(trajectory: Trajectory) -> int:
    """How many frames stand before the first one with a number that is not finite."""
    finite = np.isfinite(trajectory.position).all(axis=(1, 2))
    if trajectory.stress is not None:
        finite &= np.isfinite(trajectory.stress).all(axis=(1, 2))
    return len(finite) if finite.all() else int(np.argmin(finite))


def packed(values: np.ndarray) -> Json:
    """An array as int16 with one scale."""
    scale = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    return {"scale": scale, "data": base64_of(np.rint(values / scale), "<i2")}


def base64_of(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def finite_json(value: Any) -> Any:
    """The same value with None for numbers that JSON does not know, and plain numbers for those of numpy."""
    if isinstance(value, dict):
        return {str(key): finite_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return finite_json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _bounds(truth: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """The box to draw: that of the true motion, 10 % wider, and never flat."""
    low, high = truth.position.min(axis=(0, 1)).astype(float), truth.position.max(axis=(0, 1)).astype(float)
    size = max(float((high - low).max()), 1e-9)
    margin = np.maximum(0.1 * (high - low), 0.02 * size)
    return low - margin, high + margin


def _displacement_range(truth: Trajectory, surface: Surface) -> Json:
    nodes = surface.groups["body"][1]
    moved = truth.position[:, nodes] - truth.scene.rest_position[nodes]
    return _color_range(np.linalg.norm(moved, axis=2), share=1.0)


def _color_range(values: np.ndarray, share: float = 0.99) -> Json:
    """Colours run from 0 to `max`; `clipped` says that the largest 1 - `share` of the values lie above it."""
    largest = float(values.max(initial=0.0))
    upper = float(np.quantile(values, share)) if values.size else 0.0
    if not 0 < upper < largest:
        upper = largest if largest > 0 else 1.0
    return {"max": upper, "clipped": upper < largest}
