"""Reading a simulation from the files of another program: a PVD collection, or a folder of VTU files, one a frame."""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ast_sim.data.scene import NodeType, Scene, Trajectory, connected_parts
from ast_sim.errors import DatasetError

# The cells that become elements, by what meshio calls them; cells of a lower dimension beside them are left out.
_ELEMENTS = {"tetra": 3, "triangle": 2}
_LOWER = {"vertex": 0, "line": 1, "triangle": 2}

# Positions and displacements agree if they differ by less than this share of the size of the mesh.
_AGREEMENT = 1e-4


@dataclass(frozen=True)
class FieldNames:
    """What the fields in the files are called. A name that is given must be there.

    Attributes:
        displacement: point field, from rest. None: "displacement" if it is there; else the points themselves move and
            the first frame is at rest.
        stress: von Mises stress, a point or a cell field with one number each. None: "von_mises" if it is there.
        node_type: point field with the numbers of `NodeType`. None: "node_type" if it is there; else all are NORMAL.
        obstacle, handle: point fields that are not zero at the nodes of obstacles, and at handles.
        body: point field that numbers the bodies. None: "body" if it is there; else the connected parts of the mesh.
        material: cell fields with one number each, which become the columns of `Scene.material`.
    """

    displacement: str | None = None
    stress: str | None = None
    node_type: str | None = None
    obstacle: str | None = None
    handle: str | None = None
    body: str | None = None
    material: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Frame:
    """One file: points [n, 3] float64, elements [E, k] int64, and its fields by name."""

    path: Path
    points: np.ndarray
    elements: np.ndarray
    point_fields: dict[str, np.ndarray]
    cell_fields: dict[str, np.ndarray]

    def field(self, place: str, name: str | None, default: str | None = None) -> np.ndarray | None:
        """A "point" or "cell" field as [rows, columns] float64; None if it has no name and no default is there.

        Raises:
            DatasetError: a field that was named is not there.
        """
        fields = self.point_fields if place == "point" else self.cell_fields
        wanted = name or default
        if wanted not in fields:
            if name is None:
                return None
            known = ", ".join(sorted(fields)) or "none"
            raise DatasetError(f"{self.path}: there is no {place} field {name!r}; there are: {known}")
        value = fields[wanted]
        if value.dtype.kind not in "iufb":
            raise DatasetError(f"{self.path}: the {place} field {wanted!r} does not hold numbers")
        return np.asarray(value, np.float64).reshape(len(value), -1)

    def numbers(self, place: str, name: str | None, default: str | None = None) -> np.ndarray | None:
        """A field with one number a row, [rows]."""
        value = self.field(place, name, default)
        if value is not None and value.shape[1] != 1:
            raise DatasetError(
                f"{self.path}: the {place} field {name or default!r} has {value.shape[1]} components; must have one"
            )
        return None if value is None else value[:, 0]


def read_series(source: Path, names: FieldNames) -> tuple[Trajectory, str]:
    """The simulation in a `.pvd` file, in a folder of `.vtu` files (in natural order), or in one `.vtu` file.

    Nodes that belong to no element are left out. The mesh must be the same in all frames: tetrahedra, or triangles.

    Returns:
        The trajectory and where its stress lives: "none", "node" or "element".

    Raises:
        DatasetError: naming the file, and the field, node or element that is missing, unknown or inconsistent.
    """
    files = frame_files(source)
    first = _read_frame(files[0])
    used = np.unique(first.elements)
    place = _stress_place(first, names)
    points, displacements, stresses = [], [], []
    for path in files:
        frame = first if path == files[0] else _read_frame(path)
        _require_same_mesh(frame, first)
        points.append(frame.points[used])
        displacements.append(_displacement(frame, names, used))
        if place != "none":
            stresses.append(_stress(frame, names, place)[used if place == "node" else slice(None)])
    rest, position = _rest_and_position(source, points, displacements)
    trajectory = Trajectory(
        scene=_scene(first, used, rest, names),
        position=position.astype(np.float32),
        stress=np.stack(stresses).astype(np.float32)[:, :, None] if stresses else None,
        attributes={"status": "complete", "source": source.name},
    )
    trajectory.check(str(source), place)
    return trajectory, place


def frame_files(source: Path) -> list[Path]:
    """The VTU files of a series, one a frame, in order of time.

    Raises:
        DatasetError: the source is none of the three kinds, or is damaged, or names a file that is not there.
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
    raise DatasetError(f"{source}: must be a .pvd file, a folder of .vtu files, or a .vtu file")


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


def _read_frame(path: Path) -> _Frame:
    mesh = _read_mesh(path)
    kind, blocks = _element_blocks(path, mesh.cells)
    elements = np.concatenate([mesh.cells[block].data for block in blocks]).astype(np.int64)
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    outside = ((elements < 0) | (elements >= len(points))).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise DatasetError(
            f"{path}: {kind} {row} refers to the nodes {elements[row].tolist()}; the points are 0 to {len(points) - 1}"
        )
    cell_fields = {name: np.concatenate([values[b] for b in blocks]) for name, values in mesh.cell_data.items()}
    return _Frame(path, points, elements, mesh.point_data, cell_fields)


def _read_mesh(path: Path) -> Any:
    """What meshio reads. On a damaged file it may raise anything, print, and even end the program."""
    import meshio

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            return meshio.read(path, file_format="vtu")
    except (Exception, SystemExit) as error:
        told = " ".join(f"{printed.getvalue()} {error if str(error) != '1' else ''}".split())
        raise DatasetError(f"{path}: cannot be read as VTU: {told or type(error).__name__}") from error


def _element_blocks(path: Path, cells: list[Any]) -> tuple[str, list[int]]:
    """The kind of the elements and the blocks of cells that hold them."""
    kinds = [block.type for block in cells]
    kind = next((kind for kind in _ELEMENTS if kind in kinds), None)
    other = [k for k in kinds if k != kind and _LOWER.get(k, 3) >= _ELEMENTS.get(kind, 0)]
    if kind is None or other:
        found = ", ".join(dict.fromkeys(kinds)) or "no cells"
        raise DatasetError(f"{path}: holds {found}; the elements must be tetra or triangle (linear), all of one kind")
    return kind, [index for index, k in enumerate(kinds) if k == kind]


def _require_same_mesh(frame: _Frame, first: _Frame) -> None:
    if not np.array_equal(frame.elements, first.elements):
        raise DatasetError(f"{frame.path}: its elements are not those of {first.path.name}; the mesh must not change")
    if len(frame.points) != len(first.points):
        raise DatasetError(f"{frame.path}: has {len(frame.points)} points, {first.path.name} {len(first.points)}")


def _displacement(frame: _Frame, names: FieldNames, used: np.ndarray) -> np.ndarray | None:
    """[used, 3], or None where the files hold none."""
    value = frame.field("point", names.displacement, "displacement")
    if value is None:
        return None
    if value.shape[1] not in (2, 3):
        raise DatasetError(f"{frame.path}: the displacement has {value.shape[1]} components; must have 2 or 3")
    return np.pad(value, ((0, 0), (0, 3 - value.shape[1])))[used]


def _rest_and_position(
    source: Path, points: list[np.ndarray], displacements: list[np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """The rest positions [N, 3] and the positions [S, N, 3].

    Beside displacements, a file holds either the points at rest or those that have moved; what stays the same in all
    frames, the points or the points less their displacement, is the rest.
    """
    at = np.stack(points)
    missing = [frame for frame, one in enumerate(displacements) if one is None]
    if missing and len(missing) < len(displacements):
        raise DatasetError(f"{source}: frame {missing[0]} has no displacement, others have")
    if missing:
        return at[0], at
    moved = np.stack(displacements)
    allowed = _AGREEMENT * np.ptp(at[0], axis=0).max()
    if np.abs(at - at[0]).max() <= allowed:
        return at[0], at[0] + moved
    back = at - moved
    if np.abs(back - back[0]).max() <= allowed:
        return back[0], at
    raise DatasetError(
        f"{source}: the displacement does not fit the points: neither they nor they less it stay the same; name the"
        " right field"
    )


def _stress_place(frame: _Frame, names: FieldNames) -> str:
    """Where the stress is in the first file: "none", "node" or "element"."""
    name = names.stress or "von_mises"
    if name in frame.point_fields:
        return "node"
    if name in frame.cell_fields:
        return "element"
    if names.stress is not None:
        known = ", ".join(sorted({*frame.point_fields, *frame.cell_fields})) or "none"
        raise DatasetError(f"{frame.path}: there is no field {names.stress!r}; there are: {known}")
    return "none"


def _stress(frame: _Frame, names: FieldNames, place: str) -> np.ndarray:
    return frame.numbers("point" if place == "node" else "cell", names.stress or "von_mises")


def _scene(frame: _Frame, used: np.ndarray, rest: np.ndarray, names: FieldNames) -> Scene:
    number = np.zeros(len(frame.points), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    elements = number[frame.elements]
    body = _whole_numbers(frame, names.body, "body", np.int32)
    material = [frame.numbers("cell", name) for name in names.material]
    return Scene(
        rest_position=rest.astype(np.float32),
        elements=elements,
        node_type=_node_type(frame, names)[used],
        body=connected_parts(elements, len(used)) if body is None else body[used],
        material=np.stack(material, axis=1).astype(np.float32) if material else None,
    )


def _node_type(frame: _Frame, names: FieldNames) -> np.ndarray:
    """[n] uint8 from the field of types, and from the marks of obstacles and handles."""
    types = _whole_numbers(frame, names.node_type, "node_type", np.uint8)
    if types is None:
        types = np.full(len(frame.points), NodeType.NORMAL, np.uint8)
    for name, kind in ((names.handle, NodeType.HANDLE), (names.obstacle, NodeType.OBSTACLE)):
        if name is not None:
            types[frame.numbers("point", name) != 0] = kind
    return types


def _whole_numbers(frame: _Frame, name: str | None, default: str, dtype: type) -> np.ndarray | None:
    value = frame.numbers("point", name, default)
    if value is None:
        return None
    limits = np.iinfo(dtype)
    wrong = ~((value == np.round(value)) & (value >= limits.min) & (value <= limits.max))
    if wrong.any():
        node = int(np.argmax(wrong))
        raise DatasetError(f"{frame.path}: {name or default} at node {node} is {value[node]:g}; must be a whole number")
    return value.astype(dtype)
