"""The fields that a trajectory and its prediction show: displacement, stress, named fields, and their errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.element_topology import FACE_TRIANGLES
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.errors import AstSimError


@dataclass(frozen=True, eq=False)
class Fields:
    """The fields of S frames over a scene of N nodes and E elements.

    Attributes:
        position: [S, N, 3], where the nodes are drawn.
        times: [S] float64, in seconds; where they are not known, the numbers of the frames.
        static: name -> [N], constant in time.
        point: name -> [S, N] or [S, N, c].
        cell: name -> [S, E] or [S, E, c].
        bands: name -> [S], of the whole answer, as `Answer.figures` has them.
        notes: what is unusual about the scene of an answer; empty if nothing is known.
    """

    position: np.ndarray
    times: np.ndarray
    static: dict[str, np.ndarray]
    point: dict[str, np.ndarray]
    cell: dict[str, np.ndarray]
    bands: dict[str, np.ndarray]
    notes: str


def fields(truth: Trajectory, prediction: Trajectory | None = None) -> Fields:
    """The fields of a trajectory. With a prediction of it, the fields of the prediction and its errors.

    Displacements start at the rest positions. Errors are prediction minus truth, frame by frame of the same number. A
    prediction may have some of the frames of the truth.
    """
    shown = truth if prediction is None else prediction
    if prediction is not None:
        require_same_scene(truth.scene, prediction.scene)
        truth = truth.select(prediction.numbers)
    position = shown.position
    point = {"displacement": position - truth.scene.rest_position}
    cell: dict[str, np.ndarray] = {}
    if prediction is not None:
        point["error"] = position - truth.position
        point["error_magnitude"] = np.linalg.norm(point["error"], axis=2)
    if shown.stress is not None:
        place = point if shown.stress_at == "node" else cell
        place["von_mises"] = shown.stress[:, :, 0]
        if prediction is not None and truth.stress is not None and truth.stress_at == shown.stress_at:
            place["von_mises_error"] = place["von_mises"] - truth.stress[:, :, 0]
    for name, one in shown.fields.items():
        place = point if one.location == "node" else cell
        place.setdefault(name, _columns(one.values))
        true = None if prediction is None else truth.fields.get(name)
        if true is not None and true.values.shape == one.values.shape:
            place.setdefault(f"{name}_error", _columns(one.values - true.values))
    static = {"node_type": truth.scene.node_type, "body": truth.scene.body}
    times = np.array(shown.numbers if shown.times is None else shown.times, np.float64)
    notes = str(shown.attributes.get("notes", ""))
    return Fields(position, times, static, point, cell, _bands(shown), notes)


def _bands(shown: Trajectory) -> dict[str, np.ndarray]:
    """The bands of an answer that has kept all its frames, and so a number for each."""
    return {
        name: np.array(value, np.float64)
        for name, value in shown.attributes.items()
        if name.endswith("_band") and isinstance(value, list) and len(value) == len(shown.position)
    }


def _columns(values: np.ndarray) -> np.ndarray:
    """[S, rows, c], without the last axis if c is 1."""
    return values[:, :, 0] if values.shape[2] == 1 else values


def require_same_scene(truth: Scene, prediction: Scene) -> None:
    """Raise AstSimError unless both have the same numbers of nodes and elements."""
    sizes = [(scene.num_nodes, scene.num_elements) for scene in (truth, prediction)]
    if sizes[0] != sizes[1]:
        (n, e), (n_found, e_found) = sizes
        raise AstSimError(
            f"the prediction has {n_found} nodes and {e_found} elements, but the truth has {n} and {e}: "
            "give the prediction of this very scene"
        )


def is_planar(scene: Scene) -> bool:
    """Whether the scene is two-dimensional: triangles that all lie at z = 0."""
    return scene.elements.shape[1] == 3 and not scene.rest_position[:, 2].any()


def surface_owners(scene: Scene, surface: np.ndarray) -> np.ndarray:
    """[F] int64: the element that each triangle of `Scene.surface()` [F, 3] belongs to."""
    if scene.elements.shape[1] == 3:
        return np.arange(len(surface))
    local = np.array(FACE_TRIANGLES[scene.elements.shape[1]]).reshape(-1, 3)
    faces = scene.elements[:, local].reshape(-1, 3)
    both = np.sort(np.concatenate([faces, surface]), axis=1)
    _, first, same = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return first[same.reshape(-1)[len(faces) :]] // len(local)


def displacement_rmse(truth: Trajectory, position: np.ndarray) -> np.ndarray:
    """[S] float64: root mean square of `position` [S, N, 3] - truth over NORMAL nodes and coordinates, for each frame.

    A scene without NORMAL nodes gives zeros.
    """
    normal = truth.scene.node_type == NodeType.NORMAL
    difference = position[:, normal].astype(np.float64) - truth.position[: len(position), normal]
    return root_mean_square(difference)


def root_mean_square(difference: np.ndarray) -> np.ndarray:
    """[S] float64: of each frame of `difference` [S, ...]; 0 where a frame has no numbers."""
    each = tuple(range(1, difference.ndim))
    return np.sqrt((difference**2).sum(axis=each) / max(np.prod(difference.shape[1:]), 1))
