"""Whether what was read is what was written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType, Scene, Trajectory
from benchmarks.robustness.dialects.random_simulation import Simulation, corners_of

# What was read may differ by this share of the largest value: files have six digits, scenes are float32.
_SAME = 2e-5

# The word that a note must hold if a file has a defect.
_TOLD = {
    "inside out": "turned over",
    "twice": "taken once",
    "unused": "of no element",
    "unstitched": "joined",
    "order": "another order",
}


class Wrong(Exception):
    """What was read is not what was written."""


@dataclass
class Case:
    """A file or a folder in a dialect, and how it is read.

    Attributes:
        names: the names of the fields, for a series; None: a mesh without frames.
        groups: the points of the simulation in each named group of the file.
        times: whether the file holds the times of the frames.
        has_stress, has_marks: whether it holds them.
        unit_displacement: the values read are compared with the displacement times this.
    """

    path: Path
    names: FieldNames | None = None
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    times: bool = False


def check(case: Case, simulation: Simulation) -> None:
    """Read a case.

    Raises:
        Wrong: something else comes back than what was written, or a defect is mended without a word.
        DatasetError: the file is refused.
    """
    if case.names is None:
        mesh = read_mesh(case.path, corners=True)
        scene, used = mesh.scene(None, None)
        nodes = _check_scene(scene, mesh.points[used], simulation)
        _check_groups(case, mesh.groups, used, nodes)
        _require_notes(simulation, "; ".join(mesh.notes))
        return
    trajectory = read_series(case.path, case.names, corners=True)
    origin = np.array(trajectory.attributes.get("origin", [0.0, 0.0, 0.0]))
    nodes = _check_scene(trajectory.scene, trajectory.scene.rest_position + origin, simulation)
    _check_frames(case, trajectory, simulation, nodes)
    _require_notes(simulation, str(trajectory.attributes.get("notes", "")))


def _check_scene(scene: Scene, points: np.ndarray, simulation: Simulation) -> np.ndarray:
    """[N]: the point of the simulation that each node of the scene is."""
    wanted = simulation.corners
    if len(points) != len(wanted):
        raise Wrong(f"{len(points)} nodes, not {len(wanted)}")
    distance, row = KDTree(simulation.points[wanted]).query(points)
    if distance.max() > _SAME * max(np.abs(simulation.points).max(), simulation.size) or len(set(row)) != len(row):
        raise Wrong(f"nodes are off by {distance.max():g} of {simulation.size:g}")
    nodes = wanted[row]
    body = simulation.body_of_point[nodes]
    if len(set(zip(body.tolist(), scene.body.tolist(), strict=True))) != len(simulation.bodies):
        raise Wrong(f"{len(set(scene.body.tolist()))} bodies, not {len(simulation.bodies)}, or others")
    _check_elements(nodes[scene.elements], simulation)
    return nodes


def _check_elements(tetrahedra: np.ndarray, simulation: Simulation) -> None:
    """The tetrahedra fill each body once: its volume, and its surface, have the right size."""
    plain = [cells[:, :4] for _, kind, cells in simulation.blocks if kind.startswith("tetra")]
    written = {tuple(sorted(cell)) for cells in plain for cell in cells.tolist()}
    read = [tuple(sorted(cell)) for cell in tetrahedra.tolist()]
    if len(set(read)) != len(read) or not written <= set(read):
        raise Wrong("tetrahedra are missing, or stand twice")
    corners = simulation.points[tetrahedra]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    if volume.min() <= 0:
        raise Wrong("a tetrahedron has no positive volume")
    owner = simulation.body_of_point[tetrahedra[:, 0]]
    faces = np.sort(tetrahedra[:, [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]].reshape(-1, 3), axis=1)
    unique, count = np.unique(faces, axis=0, return_counts=True)
    a, b, c = np.moveaxis(simulation.points[unique[count == 1]], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    on = simulation.body_of_point[unique[count == 1][:, 0]]
    for number, body in enumerate(simulation.bodies):
        used = np.concatenate([c[:, : corners_of(k)].ravel() for k, c in body.blocks])
        extent = np.ptp(body.points[np.unique(used)], axis=0)
        x, y, z = extent
        if not np.isclose(volume[owner == number].sum(), x * y * z, rtol=1e-3):
            raise Wrong(f"body {number} has the volume {volume[owner == number].sum():g}, not {x * y * z:g}")
        if not np.isclose(area[on == number].sum(), 2 * (x * y + y * z + z * x), rtol=1e-3):
            raise Wrong(f"body {number} has a surface of {area[on == number].sum():g}: its cuts do not fit")


def _check_frames(case: Case, trajectory: Trajectory, simulation: Simulation, nodes: np.ndarray) -> None:
    wanted = simulation.displacement[:, nodes]
    if len(trajectory.position) != len(wanted):
        raise Wrong(f"{len(trajectory.position)} frames, not {len(wanted)}")
    moved = trajectory.position.astype(np.float64) - trajectory.scene.rest_position
    allowed = _SAME * (np.abs(wanted).max() + np.abs(simulation.points).max())
    if np.abs(moved - wanted).max() > allowed:
        raise Wrong(f"displacements are off by {np.abs(moved - wanted).max():g} of {np.abs(wanted).max():g}")
    types = np.where(simulation.tool, NodeType.OBSTACLE, np.where(simulation.fixed, NodeType.HANDLE, NodeType.NORMAL))
    if not np.array_equal(types[nodes], trajectory.scene.node_type):
        raise Wrong("other nodes are obstacles or handles")
    assert case.names is not None
    if case.names.stress is not None:
        stress = simulation.stress[:, nodes]
        if trajectory.stress is None or np.abs(trajectory.stress[:, :, 0] - stress).max() > _SAME * stress.max():
            raise Wrong("the stress is another one")
    if case.times and (trajectory.times is None or not np.allclose(trajectory.times, simulation.times, rtol=1e-5)):
        raise Wrong(f"the times are {trajectory.times}, not {simulation.times.tolist()}")


def _check_groups(case: Case, groups: dict[str, np.ndarray], used: np.ndarray, nodes: np.ndarray) -> None:
    for name, wanted in case.groups.items():
        key = next((known for known in groups if known.casefold() == name.casefold()), None)
        if key is None:
            raise Wrong(f"there is no group {name!r}; there are {sorted(groups)}")
        read = set(nodes[np.isin(used, groups[key])].tolist())
        if read != set(np.intersect1d(wanted, nodes).tolist()):
            raise Wrong(f"the group {name!r} has {len(read)} nodes, not {len(np.intersect1d(wanted, nodes))}")


def _require_notes(simulation: Simulation, notes: str) -> None:
    for defect in simulation.defects:
        if _TOLD[defect] not in notes:
            raise Wrong(f"no word on what is {defect!r}: {notes}")
