"""The frames of a job: the mesh of its deck, with the results that CalculiX has written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.formats.vtk_files import vtk_frames
from ast_sim.importers.solved_jobs.job import Job
from ast_sim.importers.solved_jobs.job_motion import require_as_prescribed
from ast_sim.importers.stress import order_of, von_mises
from ast_sim.material import PRESSURES
from ast_sim.mesh_arrays import deforms
from ast_sim.support.errors import DatasetError, counted, warn

# The coordinates of a deck and of its results may differ by this share of the size of the mesh; results have 6 digits.
_AGREEMENT = 1e-4

# What the keywords of a deck call a field, and how it is called in the results.
_IN_RESULTS = {"PEEQ": "PE", "RF": "FORC", "NT": "NDTEMP"}

# A field that is not zero at rest.
_TEMPERATURE = "NDTEMP"

# What *INITIAL CONDITIONS of these types make of fields at rest: they are not 0.
_AT_REST = {
    "STRESS": ("von_mises", "STRESS"),
    "PLASTICSTRAIN": ("PE",),
    "HARDENING": ("PE",),
    "DISPLACEMENT": ("displacement",),
}


def job_frames(job: Job, results: Path, pascals: float, wanted: Sequence[str] = ()) -> Iterator[SourceMesh]:
    """The frames of a job, the first at rest; fields `displacement`, `von_mises` if there are stresses, `node_type`,
    the wanted ones, and the materials at the elements.

    Args:
        pascals: the unit of stress of the deck. The columns of the material are in pascal; the stress is as it is.
        wanted: further fields at the nodes, by their names in the deck (PEEQ, RF) or in the results (PE, FORC).

    Raises:
        DatasetError: the results belong to another deck, hold nodes elsewhere than *BOUNDARY puts them, no displacement
            or not a wanted field, or start after the rest with a temperature, which is not known at rest.
    """
    materials = {
        name: [values * (pascals if name in PRESSURES else 1.0) for values in parts]
        for name, parts in job.materials.items()
    }
    ends = [f"the steps end at {', '.join(f'{end:g}' for end in job.ends)}"] if job.ends else []
    mesh = replace(job.mesh, path=results, cell_fields=materials, notes=[*job.mesh.notes, *ends])
    last = None
    for frame in vtk_frames(results):
        fields = {"node_type": job.node_type, **_fields(job, frame, wanted)}
        if last is None:
            mesh = _with_adjusted(job, frame, mesh)
        if last is None and frame.time:
            if any(_IN_RESULTS.get(name, name) == _TEMPERATURE for name in wanted):
                raise DatasetError(f"{results}: holds no frame at rest, so the temperature there is not known")
            _require_zero_at_rest(job, results, {_IN_RESULTS.get(name, name) for name in fields})
            rest = {name: values if name == "node_type" else np.zeros_like(values) for name, values in fields.items()}
            mesh.notes.append("a frame at rest stands before the results")
            yield replace(mesh, point_fields=rest, time=0.0)
        last = frame.time
        require_as_prescribed(job, results, frame.time or 0.0, fields["displacement"])
        yield replace(mesh, point_fields=fields, time=frame.time)
    if last is not None and job.ends and last < job.ends[-1] * (1 - 1e-6):
        warn(
            f"{results}: ends at the time {last:g}, but the steps of {job.mesh.path.name} end at {job.ends[-1]:g}: the"
            " job was not solved to its end, or its last increment was not written"
        )


def _with_adjusted(job: Job, frame: SourceMesh, mesh: SourceMesh) -> SourceMesh:
    """The mesh with the nodes that CalculiX has moved at rest where they are in the results, and a note on them."""
    rows, there = _same_nodes(job, frame)
    moved = _away(job, frame, rows, there)
    if not moved.any():
        return mesh
    points = mesh.points.copy()
    points[rows[moved]] = frame.points[there[moved]]
    told = (
        f"{counted(moved.sum(), 'node stands', 'nodes stand')} where CalculiX has put them at rest"
        f" ({', '.join(job.adjusting)})"
    )
    return replace(mesh, points=points, notes=[*mesh.notes, told])


def _require_zero_at_rest(job: Job, results: Path, fields: set[str]) -> None:
    """Raise DatasetError if *INITIAL CONDITIONS give one of the fields, which is taken for 0 at rest."""
    for kind in job.starts_with:
        known = fields.intersection(_AT_REST.get(kind, ()))
        if known:
            raise DatasetError(
                f"{results}: *INITIAL CONDITIONS of {job.mesh.path.name} give {kind}, so {min(known)} at rest is not 0"
                " and not in the results: leave the field out of the results (*EL FILE), or the conditions out"
            )


def _fields(job: Job, frame: SourceMesh, wanted: Sequence[str]) -> dict[str, np.ndarray]:
    """Displacement, von Mises stress and wanted fields at the points of the deck; NaN where the results have none."""
    rows, there = _same_nodes(job, frame)
    if "DISP" not in frame.point_fields:
        raise DatasetError(f"{frame.path}: holds no displacement: write U with *NODE FILE or *NODE OUTPUT")
    fields = {"displacement": np.asarray(frame.point_fields["DISP"], np.float64)[:, :3]}
    if "STRESS" in frame.point_fields:
        stress = np.asarray(frame.point_fields["STRESS"], np.float64)
        order = order_of(frame.path, "STRESS", stress, frame.columns.get("STRESS", ()), ())
        fields["von_mises"] = von_mises(stress, order)
    for name in wanted:
        stored = _IN_RESULTS.get(name, name)
        if stored not in frame.point_fields:
            known = ", ".join(sorted(frame.point_fields))
            raise DatasetError(f"{frame.path}: holds no field {name!r} (as {stored}); there are: {known}")
        fields[name] = np.asarray(frame.point_fields[stored], np.float64)
    given = {}
    for name, values in fields.items():
        given[name] = np.full((len(job.mesh.points), *values.shape[1:]), np.nan)
        given[name][rows] = values[there]
    _require_whole(job, frame.path, given)
    return given


def _require_whole(job: Job, path: Path, given: dict[str, np.ndarray]) -> None:
    """Check that all nodes of elements have a displacement, and all but the nodes of obstacles a stress.

    Raises:
        DatasetError: some have none.
    """
    used = _used(job.mesh)
    deforming = used[deforms(job.node_type[used])]
    for name, nodes, how in (
        ("displacement", used, "U for all nodes (*NODE FILE without NSET=)"),
        ("von_mises", deforming, "S for all elements (*EL FILE without NSET=)"),
    ):
        values = given.get(name, np.zeros(len(job.mesh.points)))[nodes]
        lacking = np.isnan(values if values.ndim == 1 else values.sum(axis=1))
        if lacking.any():
            raise DatasetError(f"{path}: {counted(lacking.sum(), 'node has', 'nodes have')} no {name}: write {how}")


def _same_nodes(job: Job, frame: SourceMesh) -> tuple[np.ndarray, np.ndarray]:
    """The points of the deck that are in the results, and where they are there.

    Raises:
        DatasetError: a node of an element is missing, nodes lie elsewhere, or the elements are not as many.
    """
    deck = job.mesh
    assert deck.same_point is not None and frame.same_point is not None
    numbers, rows, there = np.intersect1d(deck.same_point, frame.same_point, return_indices=True)
    used = _used(deck)
    other = f"{frame.path}: holds results of another deck than {deck.path.name}"
    counts = [sum(len(block.nodes) for block in mesh.blocks if block.dimension == 3) for mesh in (deck, frame)]
    if counts[1] > counts[0]:
        raise DatasetError(
            f"{frame.path}: holds {counted(counts[1], 'element')} of a volume, and {deck.path.name} {counts[0]:,}: it"
            " is of another deck, or CalculiX has made solids of shells and beams; then write *NODE FILE, OUTPUT=2D"
            " and *EL FILE, OUTPUT=2D"
        )
    missing = np.setdiff1d(deck.same_point[used], numbers)
    if len(missing):
        raise DatasetError(f"{other}: node {missing[0]} is not in it")
    away = _away(job, frame, rows, there)
    if away.any() and not (job.adjusting and 2 * away.sum() < len(away)):
        row = np.flatnonzero(away)[0]
        off = np.abs(deck.points[rows[row]] - frame.points[there[row]]).max()
        raise DatasetError(
            f"{other}: node {deck.same_point[rows[row]]} is off by {off:g} (CalculiX reads 20 characters of a number)"
        )
    if counts[0] != counts[1]:
        raise DatasetError(f"{other}: it has {counted(counts[1], 'element')} of a volume, the deck {counts[0]:,}")
    return rows, there


def _away(job: Job, frame: SourceMesh, rows: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Which of the nodes `rows` of the deck lie elsewhere than in the results, where they are the points `there`."""
    size = np.ptp(job.mesh.points[_used(job.mesh)], axis=0).max()
    return np.abs(job.mesh.points[rows] - frame.points[there]).max(axis=1) > _AGREEMENT * size


def _used(mesh: SourceMesh) -> np.ndarray:
    """The points of the elements."""
    return np.unique(np.concatenate([block.nodes.ravel() for block in mesh.blocks]))
