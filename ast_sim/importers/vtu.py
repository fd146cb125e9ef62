"""Reading a simulation of another program from a PVD file, a folder of VTU files (each is a frame) or a VTKHDF file."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ast_sim.importers.mesh_file import MeshFile, read_mesh
from ast_sim.importers.shells import Shells
from ast_sim.importers.vtkhdf import vtkhdf_frames
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.errors import DatasetError

# Points count as equal if they differ by less than this share of the size of the mesh.
_AGREEMENT = 1e-4

# Rounding to float32 may change the displacements by this share of the largest one before a warning is given.
_ROUNDING = 0.01


@dataclass(frozen=True)
class FieldNames:
    """The names of the fields in the files. A field that is named here must be present.

    Attributes:
        displacement: point field, the displacement from rest. None: "displacement" if it is present; else the points
            themselves move, and the first frame is at rest.
        stress: point or cell field with one number each, the von Mises stress. None: "von_mises" if it is present.
        node_type: point field with the numbers of `NodeType`. None: "node_type" if it is present; else all nodes are
            NORMAL.
        obstacle, handle: point fields that are not zero at the nodes of obstacles, and at handles.
        body: point or cell field with the numbers of the bodies. None: "body" if it is present; else each connected
            part of the mesh is a body.
        material: cell fields with one number each; they become the columns of `Scene.material`.
    """

    displacement: str | None = None
    stress: str | None = None
    node_type: str | None = None
    obstacle: str | None = None
    handle: str | None = None
    body: str | None = None
    material: tuple[str, ...] = ()


def read_series(source: Path, names: FieldNames, origin: np.ndarray | None = None) -> Trajectory:
    """Read the simulation in a `.pvd` file, in a folder of `.vtu` files (in natural order), or in one `.vtu` or
    `.vtkhdf` file.

    Nodes that belong to no element are left out. Shells beside tetrahedra become rigid obstacles. The mesh, of
    tetrahedra or triangles, must be the same in all frames.

    Args:
        origin: [3] float64, subtracted from all points before they are rounded to float32. None: zero if the mesh lies
            near zero, else near the centre of the first frame; see `far_origin`.

    Returns:
        The trajectory; its `stress_location` is "none", "node" or "element". Its attribute `origin` is what was
        subtracted, if that is not zero; `notes` says which cells were left out or became obstacles.

    Raises:
        DatasetError: a file, field, node or element is missing or wrong; the text names the file and what is wrong.
    """
    series = frames(source)
    first = next(series)
    scene, used = first.scene(names.body, names.node_type)
    place = _stress_place(first, names)
    points, displacements, stresses = [], [], []
    for frame in itertools.chain([first], series):
        _require_same_mesh(frame, first)
        points.append(frame.points[used])
        displacements.append(_displacement(frame, names, used))
        if place == "node":
            stresses.append(frame.numbers("point", names.stress or "von_mises")[used])
        elif place == "element":
            stresses.append(frame.numbers("cell", names.stress or "von_mises"))
    rest, position = _rest_and_position(source, points, displacements)
    if first.shells is not None:
        rest, position = _with_layers(source, first.shells.renumbered(used), rest, position)
    origin = far_origin(position[0]) if origin is None else origin
    _warn_of_rounding(source, rest - origin, position - origin)
    attributes: dict[str, Any] = {"status": "complete", "source": source.name}
    attributes |= {"origin": origin.tolist()} if origin.any() else {}
    attributes |= {"notes": "; ".join(first.notes)} if first.notes else {}
    trajectory = Trajectory(
        scene=replace(
            scene,
            rest_position=(rest - origin).astype(np.float32),
            node_type=_node_type(first, names, scene.node_type, used),
            material=first.columns(names.material),
        ),
        position=(position - origin).astype(np.float32),
        stress=np.stack(stresses).astype(np.float32)[:, :, None] if stresses else None,
        attributes=attributes,
        stress_location=place,
    )
    trajectory.check(str(source), place)
    return trajectory


def frames(source: Path) -> Iterator[MeshFile]:
    """The frames of a simulation in order of time, one after the other; see `frame_files` for the errors."""
    if source.suffix == ".vtkhdf" and source.is_file():
        yield from vtkhdf_frames(source)
    else:
        for path in frame_files(source):
            yield read_mesh(path)


def far_origin(points: np.ndarray) -> np.ndarray:
    """[3] float64: what is subtracted from points [N, 3] before they are rounded to float32.

    float32 has 24 bits: a mesh of size 1 at a distance of 5e6 keeps steps of 0.5. The origin is the centre of the
    points, rounded to a multiple of a power of ten that is 10 to 100 times the size of the mesh. So it is zero for a
    mesh near zero.
    """
    lowest, highest = points.min(axis=0), points.max(axis=0)
    size = (highest - lowest).max()
    if not np.isfinite(size) or size <= 0:
        return np.zeros(3)
    unit = 10.0 ** np.ceil(np.log10(10 * size))
    return np.round((lowest + highest) / 2 / unit) * unit + 0.0


def _warn_of_rounding(source: Path, rest: np.ndarray, position: np.ndarray) -> None:
    """Warn if the displacements change when the rest points [N, 3] and the positions [S, N, 3] become float32."""
    small = rest.astype(np.float32).astype(np.float64)
    largest = max(np.abs(one - rest).max() for one in position)
    worst = max(np.abs(one.astype(np.float32) - small - (one - rest)).max() for one in position)
    if worst > _ROUNDING * largest:
        warnings.warn(
            f"{source}: the largest displacement is {largest:.3g}, and rounding to float32 changes displacements by up"
            f" to {worst:.3g}: the motion is too small for coordinates of up to {np.abs(position).max():.3g}",
            stacklevel=3,
        )


def frame_files(source: Path) -> list[Path]:
    """The VTU files of a simulation in order of time; each is a frame.

    Raises:
        DatasetError: the source is no simulation, it is damaged, or it lists a file that does not exist.
    """
    if source.is_dir():
        files = sorted(source.glob("*.vtu"), key=natural_order)
        if not files:
            raise DatasetError(f"{source}: the folder holds no .vtu file")
        return files
    if not source.is_file():
        raise DatasetError(f"{source}: there is no such file or folder")
    if source.suffix == ".vtu":
        return [source]
    if source.suffix == ".pvd":
        return _collection(source)
    raise DatasetError(f"{source}: must be a .pvd file, a folder of .vtu files, or a .vtu or .vtkhdf file")


def natural_order(path: Path) -> list[Any]:
    """A sort key by which frame_10 comes after frame_9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", path.name)]


def _collection(source: Path) -> list[Path]:
    try:
        root = ElementTree.parse(source).getroot()
        entries = [
            (float(entry.get("timestep", "nan")), entry.attrib["file"]) for entry in root.iterfind("Collection/DataSet")
        ]
    except (OSError, ElementTree.ParseError, ValueError, KeyError) as error:
        raise DatasetError(f"{source}: is damaged or no PVD file: {error}") from error
    if not entries:
        raise DatasetError(f"{source}: lists no frames (no DataSet in a Collection)")
    times = [time for time, _ in entries]
    if len(entries) > 1 and (not np.isfinite(times).all() or len(set(times)) < len(times)):
        raise DatasetError(f"{source}: every frame needs a timestep of its own; files in several parts must be merged")
    files = [source.parent / name for _, name in sorted(entries)]
    for file in files:
        if file.suffix != ".vtu":
            raise DatasetError(f"{source}: lists {file.name}, which is no .vtu file")
        if not file.is_file():
            raise DatasetError(f"{source}: lists {file}, which does not exist")
    return files


def _require_same_mesh(frame: MeshFile, first: MeshFile) -> None:
    # The nodes of a shell's elements are in another order if its other side looks at the body.
    if not np.array_equal(np.sort(frame.elements, axis=1), np.sort(first.elements, axis=1)):
        raise DatasetError(f"{frame.path}: its elements are not those of {first.path.name}; the mesh must not change")
    if len(frame.points) != len(first.points):
        raise DatasetError(f"{frame.path}: has {len(frame.points)} points, {first.path.name} {len(first.points)}")


def _displacement(frame: MeshFile, names: FieldNames, used: np.ndarray) -> np.ndarray | None:
    """The displacements [used, 3]; None if the file holds none."""
    if names.displacement is None and "displacement" not in frame.fields["point"]:
        return None
    value = frame.field("point", names.displacement or "displacement")
    if value.shape[1] not in (2, 3):
        raise DatasetError(f"{frame.path}: the displacement has {value.shape[1]} components; must have 2 or 3")
    return np.pad(value, ((0, 0), (0, 3 - value.shape[1])))[used]


def _rest_and_position(
    source: Path, points: list[np.ndarray], displacements: list[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """The rest positions [N, 3] and the positions [S, N, 3].

    A file with displacements holds either the points at rest or the moved points. If the points are the same in all
    frames, they are the rest positions. If the points minus their displacements are the same, these are.
    """
    at = np.stack(points)
    given = [one for one in displacements if one is not None]
    if not given:
        return at[0], at
    if len(given) < len(displacements):
        frame = next(frame for frame, one in enumerate(displacements) if one is None)
        raise DatasetError(f"{source}: frame {frame} has no displacement, others have")
    moved = np.stack(given)
    allowed = _AGREEMENT * np.ptp(at[0], axis=0).max()
    if np.abs(at - at[0]).max() <= allowed:
        return at[0], at[0] + moved
    back = at - moved
    if np.abs(back - back[0]).max() <= allowed:
        return back[0], at
    raise DatasetError(
        f"{source}: the displacement does not fit the points: in some frame the points, and the points minus the"
        " displacement, differ from frame 0; name the right field"
    )


def _stress_place(frame: MeshFile, names: FieldNames) -> str:
    """Where a file holds the stress: "none", "node" or "element"."""
    name = names.stress or "von_mises"
    if name in frame.fields["point"]:
        return "node"
    if name in frame.fields["cell"]:
        return "element"
    if names.stress is not None:
        known = ", ".join(sorted({*frame.fields["point"], *frame.fields["cell"]})) or "none"
        raise DatasetError(f"{frame.path}: there is no field {names.stress!r}; there are: {known}")
    return "none"


def _with_layers(source: Path, shells: Shells, rest: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rest points and positions with the points behind the shells, which turn with the shells.

    Raises:
        DatasetError: a shell is not rigid.
    """
    count = len(shells.nodes)
    for frame, points in enumerate(position):
        bent = shells.bent(rest, points)
        if bent is not None:
            raise DatasetError(
                f"{source}: the shell at {np.round(rest[bent[0]], 6).tolist()} is not rigid: in"
                f" frame {frame} an edge changes by {bent[1]:.3g};"
                " shells beside tetrahedra must be rigid: mesh this body with tetrahedra"
            )
    layers = np.stack([shells.behind(points) for points in position])
    return (
        np.concatenate([rest[:-count], shells.behind(rest)]),
        np.concatenate([position[:, :-count], layers], axis=1),
    )


def _node_type(frame: MeshFile, names: FieldNames, types: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The types of the used nodes; those at the marks of handles and obstacles are replaced."""
    types = types.copy()
    for name, kind in ((names.handle, NodeType.HANDLE), (names.obstacle, NodeType.OBSTACLE)):
        if name is not None:
            types[frame.numbers("point", name)[used] != 0] = kind
    types[frame.shell_nodes[used]] = NodeType.OBSTACLE
    return types
