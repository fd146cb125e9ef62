"""Reading a simulation of another program: a PVD file, a folder with a file for each frame, or one file for all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.formats.together import labelled, require_one_time, together
from ast_sim.importers.frames_in_file import frames_in, only_frame
from ast_sim.importers.mesh_file import MeshFile, mesh_of, raw_field
from ast_sim.importers.order_of_files.by_name import ordered
from ast_sim.importers.order_of_files.doubts import doubts_of_times
from ast_sim.importers.order_of_files.frame_files import frame_files
from ast_sim.importers.scene_mesh import marked_nodes
from ast_sim.importers.solids.constant_fields import ConstantFields
from ast_sim.importers.solids.frames_match import in_order_of, order_of_cells
from ast_sim.importers.solids.kept_fields import KeptFields
from ast_sim.importers.solids.kept_frames import KeptFrames
from ast_sim.importers.solids.moved_points import UnnamedDisplacements
from ast_sim.importers.solids.positions import (
    displacement_of,
    far_origin,
    fields_of_vector,
    rest_and_position,
    told_of_components,
    warn_of_rounding,
    with_layers,
)
from ast_sim.importers.solids.stitching import Stitching
from ast_sim.importers.solved_jobs.job import Job, read_job
from ast_sim.importers.solved_jobs.job_results import job_frames
from ast_sim.importers.stress import STRESS_UNITS, Symmetry, of_components, order_of, stress_place, von_mises
from ast_sim.material import PRESSURES
from ast_sim.mesh_rules import require_extent
from ast_sim.plausibility.axes import MIRRORED
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.argument_checks import several
from ast_sim.support.errors import ConfigError, DatasetError, counted
from ast_sim.support.toml_settings import require_range


@dataclass(frozen=True)
class FieldNames:
    """The names of the fields in the files. A field that is named here must be present.

    Attributes:
        displacement: point field, the displacement from rest, or what the names of fields of one component each have
            in common, "U" of U1, U2 and U3. None: "displacement" if it is present; else the points themselves move, and
            the first frame is at rest.
        stress: point or cell field: the von Mises stress, or the components of a stress tensor; or what the names of
            fields of one component each have in common, "S" of S11, S22, .... None: "von_mises" if it is present.
        node_type: point field with the numbers of `NodeType`. None: "node_type" if it is present; else all nodes are
            NORMAL.
        obstacle, handle: what the nodes of obstacles and the handles are: a point field that is not zero there, a group
            of nodes, or a place BODY:PLACE as in `parse_clamp`.
        body: point or cell field with the numbers of the bodies. None: "body" if it is present; else each connected
            part of the mesh is a body.
        material: cell fields with one number each; they become the columns of `Scene.material`. "young=E" takes the
            field E and calls the column young; `ast_sim.Material` says which names have a meaning.
        stress_order: the components that the columns of the stress hold, such as ("xx", "xy", "xz", "yy", "yz", "zz").
            Empty: as the file names them; else the normal stresses come first. Six columns in XDMF need it.
        stress_unit: the unit of the stress, and of a young and a yield_stress in the material; None is pascal.
        fields: further point or cell fields, as NAME or NAME=UNIT, that become named fields of the dataset.
        reaction: point field, the forces that act on the nodes from outside.
        newton: the unit of these forces in newton.

    Raises:
        ConfigError: a name is no text or empty, or the unit is no number above 0.
    """

    displacement: str | None = None
    stress: str | None = None
    node_type: str | None = None
    obstacle: str | None = None
    handle: str | None = None
    body: str | None = None
    material: tuple[str, ...] = ()
    stress_order: tuple[str, ...] = ()
    stress_unit: str | None = None
    fields: tuple[str, ...] = ()
    reaction: str | None = None
    newton: float = 1.0

    def __post_init__(self) -> None:
        lists = {name: several(name, getattr(self, name), "names") for name in ("material", "stress_order", "fields")}
        alone = {name: [text] for name, text in vars(self).items() if text is not None and name != "newton"}
        for name, texts in {**alone, **lists}.items():
            if not all(isinstance(text, str) and text for text in texts):
                raise ConfigError(f"FieldNames: {name} is {getattr(self, name)!r}; it must be a name")
        require_range("FieldNames: newton", self.newton, 1e-30)  # above 0

    @property
    def material_columns(self) -> tuple[str, ...]:
        """The names of the columns of the material."""
        return tuple(name.partition("=")[0] for name in self.material)

    @property
    def material_fields(self) -> tuple[str, ...]:
        """The cell fields that they come from."""
        return tuple(name.partition("=")[2] or name for name in self.material)


def read_series(
    source: Path,
    names: FieldNames,
    origin: np.ndarray | None = None,
    deck: Path | None = None,
    corners: bool = False,
) -> Trajectory:
    """Read the simulation in a `.pvd` file, in a folder with a file for each frame, or in one file.

    The elements are made as in `read_mesh`: nodes that belong to no element are left out, shells beside tetrahedra
    become rigid obstacles. The mesh must be the same in all frames; its elements may stand in another order.

    Args:
        origin: [3] float64, subtracted from all points before they are rounded to float32. None: zero if the mesh lies
            near zero, else near the centre of the first frame; see `far_origin`.
        deck: the deck of CalculiX whose job has given the results `source`. It says which nodes are prescribed and what
            the elements are made of; see `read_job`.
        corners: take only the corners of second-order tetrahedra.

    Returns:
        The trajectory; its `stress_location` is "none", "node" or "element". Its attribute `origin` is what was
        subtracted, if that is not zero; `material` has the names of its columns; `notes` says what was not taken as it
        stands in the files.

    Raises:
        DatasetError: a file, field, node or element is missing or wrong; the text names the file and what is wrong.
        MissingExtra: the reader of a format is not installed.
    """
    job = None if deck is None else read_job(deck)
    names = names if job is None else replace(names, material=names.material or tuple(job.materials))
    further = KeptFields.of(names.fields, names.reaction)
    mesh, kept, notes, place = _read_frames(source, names, job, corners, further)
    scene, used = mesh.scene(names.body, names.node_type)
    types = _node_type(mesh, names, scene, used)
    rest, position = _rest_and_position(source, mesh, kept, used)
    require_extent(str(source), rest, scene.elements)
    origin = far_origin(position[0]) if origin is None else origin
    warn_of_rounding(source, rest - origin, position - origin)
    scene = replace(scene, rest_position=(rest - origin).astype(np.float32), node_type=types)
    scene = replace(scene, material=_material(mesh, names, job is not None))
    stress, more = _stress(mesh, kept, used, place, scene, _pascals(names))
    rigid = {at: ~scene.deforming(at) for at in ("node", "element")}
    fields, missing = further.named(source, mesh.at_nodes(used), mesh.at_elements, rigid, names.newton)
    done = {name: 1 for name, is_so in ((MIRRORED, mesh.mirrored), (CORNERS_ONLY, mesh.reduced)) if is_so}
    trajectory = Trajectory(
        scene,
        (position - origin).astype(np.float32),
        stress,
        _attributes(source, origin, names, [*mesh.notes, *notes, *more, *missing]) | done,
        stress_location=place,
        times=kept.ascending_times(),
        fields=fields,
    )
    trajectory.check(str(source), place)
    return trajectory


def _attributes(source: Path, origin: np.ndarray, names: FieldNames, notes: list[str]) -> dict[str, Any]:
    """What a trajectory says of its source."""
    attributes: dict[str, Any] = {"status": "complete", "source": source.name}
    attributes |= {"origin": origin.tolist()} if origin.any() else {}
    attributes |= {"material": ", ".join(names.material_columns)} if names.material else {}
    return attributes | ({"notes": "; ".join(notes)} if notes else {})


def _read_frames(
    source: Path, names: FieldNames, job: Job | None, corners: bool, further: KeptFields
) -> tuple[MeshFile, KeptFrames, list[str], str]:
    """The mesh of a simulation, what is kept of its frames in order of time, notes, and where the stress is."""
    kept = KeptFrames()
    first = None
    stitching = None
    named = (names.obstacle, names.handle, names.node_type or "node_type", names.body or "body")
    used_fields = tuple(filter(None, named))
    constant = ConstantFields((*used_fields, *names.material_fields))
    place = "none"
    order = ()
    symmetry = Symmetry()
    unnamed = UnnamedDisplacements()
    notes = []
    given = frames(source) if job is None else job_frames(job, source, _pascals(names), tuple(further.wanted.values()))
    for frame in given:
        frame.require_consistent()
        frame = frame if names.stress is None else of_components(frame, names.stress, names.stress_order)
        if first is None or stitching is None:
            first = frame
            stitching = Stitching(frame)
            place, order, notes = stress_place(frame, names.stress, names.stress_order)
        frame, said = in_order_of(frame, first, kept.points[-1] if kept.points else first.points)
        notes += said
        cells = order_of_cells(frame, first)
        if cells is not None and not said and len(notes) < 2:
            notes.append(
                f"the elements of {frame.path.name} stand in another order: they are reordered as in the first"
            )
        stitching.look(frame, used_fields, fields_of_vector(names.displacement, frame.point_fields))
        constant.look(frame, cells)
        kept.times.append(frame.time)
        kept.points.append(frame.points)
        kept.displacements.append(displacement_of(frame, names.displacement, raw_field))
        if kept.displacements[-1] is None:
            unnamed.look(frame)
        further.look(frame, cells, raw_field)
        if place != "none":
            name = names.stress or "von_mises"
            values = raw_field(frame, "point" if place == "node" else "cell", name)
            now = order_of(frame.path, name, values, frame.columns.get(name, ()), names.stress_order)
            if now != order:
                one, other = (", ".join(parts) or "one number" for parts in (now, order))
                raise DatasetError(f"{frame.path}: {name!r} holds {one}, in the first frame {other}: write it alike")
            symmetry.look(frame.path, values, order)
            values = von_mises(values, order) if order else values[:, 0]
            kept.stresses.append(values if place == "node" or cells is None else values[cells])
        elif "von_mises" in {*frame.point_fields, *frame.cell_fields}:
            raise DatasetError(
                f"{frame.path}: holds 'von_mises', which the first frame lacks: write it into each frame, or into none"
            )
    assert first is not None and stitching is not None
    symmetry.require(source, names.stress or "von_mises")
    notes += [*constant.notes(), *told_of_components(names.displacement, first.point_fields)]
    notes += _put_in_order_of_time(source, kept, further)
    if all(one is None for one in kept.displacements):
        unnamed.require_at_rest(source, kept.points)
    return mesh_of(first, stitching, corners), kept, notes, place


def _put_in_order_of_time(source: Path, kept: KeptFrames, further: KeptFields) -> list[str]:
    """The frames of files in order of their times, or with the times that a list of the files states; notes."""
    files, times, _, notes = frame_files(source)
    if source.is_dir():
        by_time, said = ordered([file for (file,) in files], kept.times)
        kept.reorder(by_time)
        further.reorder(by_time)
        return [*notes, *said, *kept.without_times()]
    if times is None:
        return [*notes, *(kept.doubts() or kept.without_times()), *kept.doubts_of_end()]
    notes = [*notes, *doubts_of_times(source, times, kept.times)]
    kept.times = list(times)
    return notes


def frames(source: Path) -> Iterator[SourceMesh]:
    """The frames of a simulation, one after the other; see `frame_files` for the errors."""
    of_frames = frame_files(source)
    for files in of_frames.files:
        if len(files) > 1:
            labels = of_frames.labels or [""] * len(files)
            pairs = zip(files, labels, strict=True)
            parts = [labelled(only_frame(file), label) for file, label in pairs]
            require_one_time(parts)
            yield together(parts)
        elif source.is_dir() or len(of_frames.files) > 1:
            yield only_frame(files[0])
        else:
            yield from frames_in(files[0])


def _pascals(names: FieldNames) -> float:
    """The unit of stress of the files in pascal."""
    return STRESS_UNITS[names.stress_unit or "Pa"]


def _stress(
    mesh: MeshFile, kept: KeptFrames, used: np.ndarray, place: str, scene: Scene, pascals: float
) -> tuple[np.ndarray | None, list[str]]:
    """[S, N or E, 1] float32 in pascal, and a note if obstacles have none: it is 0 there."""
    if place == "none":
        return None, []
    if place == "node":
        values = list(map(mesh.at_nodes(used), kept.stresses))
    else:
        values = list(map(mesh.at_elements, kept.stresses))
    stress = (pascals * np.stack(values)).astype(np.float32)[:, :, None]
    lacking = np.isnan(stress[:, :, 0]).any(axis=0) & ~scene.deforming(place)
    if not lacking.any():
        return stress, []
    stress[:, lacking] = 0
    return stress, [f"the stress is NaN at {counted(lacking.sum(), 'row')} of obstacles: it is 0 there"]


def _material(mesh: MeshFile, names: FieldNames, of_job: bool) -> np.ndarray | None:
    """[E, m] float32: the material; pressures are in pascal, in the one of a job already."""
    columns = mesh.columns(names.material_fields)
    if columns is None or of_job:
        return columns
    units = [_pascals(names) if name in PRESSURES else 1.0 for name in names.material_columns]
    return columns * np.array(units, np.float32)


def _rest_and_position(
    source: Path, mesh: MeshFile, kept: KeptFrames, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The rest positions [N, 3] and the positions [S, N, 3] of the used nodes, the last of which are not in the file:
    they lie behind shells and in the middles of edges."""
    rows = mesh.node_rows[used]
    at = np.stack([points[rows] for points in kept.points])
    moved = [None if one is None else one[rows] for one in kept.displacements]
    rest, position = rest_and_position(source, at, moved)
    edges = np.searchsorted(used, mesh.edges)
    count = len(used) - len(edges)
    if mesh.shells is not None:
        shells = mesh.shells.renumbered(used)
        rest, position = with_layers(source, shells, rest[:count], position[:, :count])
    return (
        np.concatenate([rest[:count], rest[edges].mean(axis=1)]),
        np.concatenate([position[:, :count], position[:, edges].mean(axis=2)], axis=1),
    )


def _node_type(mesh: MeshFile, names: FieldNames, scene: Scene, used: np.ndarray) -> np.ndarray:
    """The types of the used nodes, replaced where nodes are marked as handles and obstacles; notes on marks that say
    nothing, or two things."""
    types = scene.node_type.copy()
    handles, obstacles = np.zeros((2, len(used)), bool)
    for name, marks, kind in (
        (names.handle, handles, NodeType.HANDLE),
        (names.obstacle, obstacles, NodeType.OBSTACLE),
    ):
        if name is not None:
            marks[marked_nodes(mesh, scene, used, name)] = True
            types[marks] = kind
            mesh.notes.extend([] if marks.any() else [f"{name!r} marks no node"])
    both = (handles & obstacles).sum()
    if both:
        told = counted(both, f"node of {names.handle!r} is", f"nodes of {names.handle!r} are")
        mesh.notes.append(f"{told} in {names.obstacle!r}, too: obstacles, not handles")
    soft = obstacles & np.isin(scene.body, scene.body[types == NodeType.NORMAL])
    if soft.any():
        told = counted(soft.sum(), f"node of {names.obstacle!r} belongs", f"nodes of {names.obstacle!r} belong")
        mesh.notes.append(f"{told} to a body that deforms, and an obstacle is a rigid body: is a handle meant?")
    types[mesh.shell_nodes[used]] = NodeType.OBSTACLE
    return types
