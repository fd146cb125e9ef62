"""Whether what was read is what was written."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.plausibility.topology import at_rest
from ast_sim.scene import NodeType, Scene, Trajectory
from benchmarks.robustness.dialects.random_simulation import Simulation, corners_of
from benchmarks.robustness.dialects.scene_nodes import SAME, Wrong, pairs_of
from benchmarks.robustness.dialects.told import require_told


@dataclass
class Case:
    """A file or a folder in a dialect, and how it is read.

    Attributes:
        names: the names of the fields, for a series; None: a mesh without frames.
        groups: the points of the simulation in each named group of the file.
        times: whether the file holds the times of the frames.
        told: patterns of notes that must come beside the ones on cells and defects.
    """

    path: Path
    names: FieldNames | None = None
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    times: bool = False
    told: tuple[str, ...] = ()


def check(case: Case, simulation: Simulation) -> None:
    """Read a case.

    Raises:
        Wrong: something else comes back than what was written, a defect is mended without a word, or something is told
            that is not so: a note, a warning, or that something looks wrong.
        DatasetError: the file is refused.
    """
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        pairs, notes, looks_wrong = _compare(case, simulation)
    frames = len(simulation.displacement)
    without_times = case.names is not None and not case.times and frames > 1
    of_times = (rf"no times tell the {frames} frames apart: they count 0, 1, 2, \.\.\.",) if without_times else ()
    require_told(simulation, pairs, (*case.told, *of_times, *_of_marks(case.names, simulation)), notes)
    told = [str(one.message) for one in warned if not issubclass(one.category, DeprecationWarning)]
    if told or looks_wrong:
        raise Wrong(f"without a reason it is warned: {'; '.join([*told, *looks_wrong])}")


def _of_marks(names: FieldNames | None, simulation: Simulation) -> list[str]:
    """Patterns of the notes on fields that mark no node; a place, such as 0:xmin, always marks some."""
    marks = [] if names is None else [(names.obstacle, simulation.tool), (names.handle, simulation.fixed)]
    return [f"{name!r} marks no node" for name, nodes in marks if name and ":" not in name and not nodes.any()]


def _compare(case: Case, simulation: Simulation) -> tuple[np.ndarray, list[str], list[str]]:
    """The nodes as in `pairs_of`, the notes, and what looks wrong."""
    if case.names is None:
        mesh = read_mesh(case.path, corners=simulation.corners_only)
        scene, used = mesh.scene(None, None)
        pairs = _check_scene(scene, mesh.points[used], simulation)
        _check_groups(case, mesh.groups, used, pairs)
        _check_reduced(mesh.reduced, simulation)
        return pairs, mesh.notes, list(map(str, at_rest(scene)))
    trajectory = read_series(case.path, case.names, corners=simulation.corners_only)
    origin = np.array(trajectory.attributes.get("origin", [0.0, 0.0, 0.0]))
    pairs = _check_scene(trajectory.scene, trajectory.scene.rest_position + origin, simulation)
    _check_frames(case, trajectory, simulation, pairs)
    _check_reduced(CORNERS_ONLY in trajectory.attributes, simulation)
    notes = str(trajectory.attributes.get("notes", ""))
    return pairs, notes.split("; ") if notes else [], list(map(str, in_trajectory(trajectory)))


def _check_scene(scene: Scene, points: np.ndarray, simulation: Simulation) -> np.ndarray:
    """[N, 2]: the points of the simulation between which each node of the scene lies; see `pairs_of`."""
    pairs = pairs_of(scene, points, simulation)
    body = simulation.body_of_point[pairs[:, 0]]
    if len(set(zip(body.tolist(), scene.body.tolist(), strict=True))) != len(simulation.bodies):
        raise Wrong(f"{len(set(scene.body.tolist()))} bodies, not {len(simulation.bodies)}, or others")
    _check_elements(pairs[scene.elements[:, :4], 0], simulation)
    return pairs


def _check_reduced(reduced: bool, simulation: Simulation) -> None:
    """Forces of elements that have lost nodes are wrong, and the reader must know it."""
    whole = {"tetra10"} if simulation.ten_nodes else set()
    curved = {kind for kind in simulation.kinds - whole if kind[-1].isdigit()}
    if reduced != bool(curved):
        raise Wrong(f"{'elements' if reduced else 'no elements'} are said to keep their corners only")


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


def _check_frames(case: Case, trajectory: Trajectory, simulation: Simulation, pairs: np.ndarray) -> None:
    wanted = simulation.displacement[:, pairs].mean(axis=2)
    if len(trajectory.position) != len(wanted):
        raise Wrong(f"{len(trajectory.position)} frames, not {len(wanted)}")
    moved = trajectory.position.astype(np.float64) - trajectory.scene.rest_position
    allowed = SAME * (np.abs(wanted).max() + np.abs(simulation.points).max())
    if np.abs(moved - wanted).max() > allowed:
        raise Wrong(f"displacements are off by {np.abs(moved - wanted).max():g} of {np.abs(wanted).max():g}")
    tool, fixed = (marks[pairs].all(axis=1) for marks in (simulation.tool, simulation.fixed))
    types = np.where(tool, NodeType.OBSTACLE, np.where(fixed, NodeType.HANDLE, NodeType.NORMAL))
    if not np.array_equal(types, trajectory.scene.node_type):
        raise Wrong("other nodes are obstacles or handles")
    assert case.names is not None
    if case.names.stress is not None:
        stress = simulation.stress[:, pairs].mean(axis=2)
        if trajectory.stress is None or np.abs(trajectory.stress[:, :, 0] - stress).max() > SAME * stress.max():
            raise Wrong("the stress is another one")
    if case.times and (trajectory.times is None or not np.allclose(trajectory.times, simulation.times, rtol=1e-5)):
        raise Wrong(f"the times are {trajectory.times}, not {simulation.times.tolist()}")


def _check_groups(case: Case, groups: dict[str, np.ndarray], used: np.ndarray, pairs: np.ndarray) -> None:
    for name, wanted in case.groups.items():
        key = next((known for known in groups if known.casefold() == name.casefold()), None)
        if key is None:
            raise Wrong(f"there is no group {name!r}; there are {sorted(groups)}")
        read = np.isin(used, groups[key])
        inside = np.isin(pairs, wanted).all(axis=1)
        if (read != inside).any():
            raise Wrong(f"the group {name!r} has {read.sum()} nodes, not {inside.sum()}, or others")
