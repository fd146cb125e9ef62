"""Scenes and curves as compact JSON for the scripts of the report.

Only the surface is kept. Displacements and stresses are int16 with one scale per array, so their error is at most 1 /
65534 of the largest value. Everything is little-endian base64.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ast_sim.number_arrays import ranges
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.errors import AstSimError
from ast_sim.view.fields import displacement_rmse, is_planar, require_same_scene, root_mean_square, surface_owners

Json = dict[str, Any]


class Boundary:
    """The boundary of a scene in two groups: the deforming bodies and the obstacles (`Scene.deforming_elements`).

    Each group has `triangles` [F, 3], numbers of the group's own nodes; `nodes` [n], the numbers of these nodes in the
    scene; and `elements` [F], the element behind each triangle.
    """

    def __init__(self, scene: Scene) -> None:
        surface = scene.surface()
        owners = surface_owners(scene, surface)
        deforming = scene.deforming_elements[owners]
        self.groups = {}
        for name, chosen in (("body", deforming), ("obstacle", ~deforming)):
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

    def stress(self, trajectory: Trajectory) -> np.ndarray | None:
        """[S, n or F]: the stress at the nodes, or on the triangles, of the deforming bodies; None if there is none."""
        _, nodes, elements = self.groups["body"]
        if trajectory.stress is None or not len(nodes):
            return None
        return trajectory.stress[:, nodes if trajectory.stress_at == "node" else elements, 0]

    def motion(self, trajectory: Trajectory, frames: np.ndarray) -> Json:
        """Displacements and stresses of a trajectory in all of `frames` that it has and that are finite."""
        frames = frames[frames < finite_frames(trajectory)]
        encoded: Json = {"frames": len(frames)}
        for name, (_, nodes, _) in self.groups.items():
            moved = trajectory.position[np.ix_(frames, nodes)] - trajectory.scene.rest_position[nodes]
            encoded[name] = packed(moved) if len(nodes) else None
        stress = self.stress(trajectory)
        encoded["stress"] = None if stress is None else packed(stress[frames])
        return encoded


def encode_scene(truth: Trajectory, frames: np.ndarray, predictions: Sequence[Trajectory | None] = ()) -> Json:
    """One scene: its surface, and the motion of the truth and of each run's prediction at `frames`."""
    for prediction in predictions:
        if prediction is not None:
            require_same_scene(truth.scene, prediction.scene)
            if prediction.numbers != truth.numbers[: prediction.num_frames]:
                raise AstSimError(
                    f"a page shows frames from the first one on, but the prediction has {ranges(prediction.numbers)}:"
                    " predict all frames"
                )
    surface = Boundary(truth.scene)
    low, high = _bounds(truth)
    scales = {"displacement": _displacement_range(truth, surface)}
    stress = surface.stress(truth)
    if stress is not None:
        scales["stress"] = _color_range(stress)
    return {
        "planar": is_planar(truth.scene),
        "total": truth.num_frames,
        "frames": frames.tolist(),
        "groups": surface.encode(truth.scene.rest_position),
        "low": low.tolist(),
        "high": high.tolist(),
        "stress": truth.stress_at,
        "ranges": scales,
        "truth": surface.motion(truth, frames),
        "predictions": [None if p is None else surface.motion(p, frames) for p in predictions],
    }


def encode_curves(truth: Trajectory, predictions: Sequence[Trajectory | None]) -> Json:
    """For each frame, the error of each run and of a predictor that learns nothing.

    Displacement errors are measured at NORMAL nodes; the predictor that learns nothing holds the first frame still.
    Stress errors are measured outside the obstacles; the predictor that learns nothing gives the mean of the true
    stress in the frame.
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
        place = truth.stress_at
        rows = truth.scene.deforming(place)
        true = truth.stress[:, rows]
        mean = true.mean(axis=1, keepdims=True, dtype=np.float64) if rows.any() else 0.0
        curves["stress"] = {
            "runs": [
                None
                if p is None or p.stress is None or p.stress_at != place
                else root_mean_square(p.stress[:n, rows].astype(np.float64) - true[:n]).tolist()
                for p, n in zip(predictions, frames, strict=True)
            ],
            "trivial": root_mean_square(mean - true).tolist(),
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
    broken = np.flatnonzero(~finite)
    return int(broken[0]) if len(broken) else trajectory.num_frames


def packed(values: np.ndarray) -> Json:
    """An array as int16 with one scale."""
    scale = float(np.abs(values).max(initial=0.0)) / 32767 or 1.0
    return {"scale": scale, "data": base64_of(np.rint(values / scale), "<i2")}


def base64_of(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def finite_json(value: Any) -> Any:
    """The same value, with None for numbers that JSON does not know, and plain numbers in place of numpy's."""
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
    """The box to draw: the box of the true motion, made 10 % wider and never flat."""
    low, high = truth.position.min(axis=(0, 1)).astype(float), truth.position.max(axis=(0, 1)).astype(float)
    size = max(float((high - low).max()), 1e-9)
    margin = np.maximum(0.1 * (high - low), 0.02 * size)
    return low - margin, high + margin


def _displacement_range(truth: Trajectory, surface: Boundary) -> Json:
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
