"""What VTK does not say of d3plot files: which nodes the points of each part are, and whether the files are whole.

VTK gives each part points of its own, and reads the numbers that users gave to nodes with a wrong width. Two parts of
one body share nodes; two bodies that touch do not: without the numbers both look alike. So the nodes of each part are
read here, and taken where they lie at the points that VTK gives the part, in ascending order.

Source: LS-DYNA Database Binary Output Files (Livermore Software Technology), chapters CONTROL DATA and GEOMETRY DATA.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.support.errors import DatasetError, counted

_CONTROL = 64  # words; the numbers of the words that are used here:
_FILE_TYPE, _DIMENSION, _NODES, _SOLIDS, _BEAMS, _SHELLS, _THICK, _EXTRA = 11, 15, 16, 23, 28, 31, 40, 57
_PLAIN = 4  # of the dimension: coordinates in space, numbers not packed
_WITH_MATERIALS = 5  # as before, but the types of the materials stand before the coordinates

_FROM_USERS = ("global", "point UserID", "cell UserIds")


# What stands behind the last state of a file; zeros may follow.
_ENDS = tuple(np.array([-999999], kind).tobytes() for kind in ("<f4", "<f8", ">f4", ">f8"))


def require_whole(path: Path) -> None:
    """Check that the files with the states of a d3plot file, d3plot01 and so on, are all there and whole.

    Raises:
        DatasetError: one is missing, or cut off; or the mesh changes in further files (d3plotaa).
    """
    beside = {file.name.removeprefix(path.name): file for file in path.parent.glob(f"{path.name}?*")}
    further = sorted(name for name in beside if re.fullmatch("[a-z]{2}", name))
    if further:
        raise DatasetError(f"{path}: goes on in {path.name}{further[0]} with another mesh; the mesh must not change")
    states = sorted((int(name), file) for name, file in beside.items() if name.isdigit())
    for count, (number, file) in enumerate(states, 1):
        if number != count:
            raise DatasetError(f"{path}: {path.name}{count:02d} is missing, but {file.name} is there: copy all files")
        if not file.read_bytes().rstrip(b"\0").endswith(tuple(end.rstrip(b"\0") for end in _ENDS)):
            raise DatasetError(f"{file}: is cut off: it does not end as the files of LS-DYNA do: copy it whole")


def with_nodes(path: Path, parts: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    """The parts without the numbers of users, and with the numbers of nodes in the file, `global`, if all are known."""
    parts = [{name: values for name, values in part.items() if name not in _FROM_USERS} for part in parts]
    known = [_nodes_at(part["points"], *_geometry(path)) for part in parts]
    if not parts or any(nodes is None for nodes in known):
        return parts
    return [{**part, "global": nodes} for part, nodes in zip(parts, known, strict=True) if nodes is not None]


def _nodes_at(points: np.ndarray, rest: np.ndarray, nodes_of: list[np.ndarray]) -> np.ndarray | None:
    """The nodes of the one part whose nodes lie at these points; None if there is none, or if there are several."""
    alike = [nodes for nodes in nodes_of if len(nodes) == len(points) and np.allclose(rest[nodes], points)]
    return alike[0] if len(alike) == 1 else None


def _geometry(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """The points at rest [n, 3], and the nodes of each part, ascending; none if the file is of a kind that is not
    understood here."""
    content = path.read_bytes()
    for width, order in ((4, "<"), (8, "<"), (4, ">"), (8, ">")):
        words = np.frombuffer(content, f"{order}i{width}", len(content) // width)
        if len(words) > _CONTROL and words[_FILE_TYPE] == 1 and words[_DIMENSION] in (_PLAIN, _WITH_MATERIALS):
            place = _CONTROL + max(int(words[_EXTRA]), 0)
            if words[_DIMENSION] == _WITH_MATERIALS:
                place += 2 + int(words[place + 1])
            count = int(words[_NODES])
            rest = np.frombuffer(content, f"{order}f{width}", len(words))[place : place + 3 * count].reshape(-1, 3)
            return rest.astype(np.float64), list(_parts(words, place + 3 * count, count))
    return np.zeros((0, 3)), []


def _parts(words: np.ndarray, place: int, count: int) -> Iterator[np.ndarray]:
    """The nodes of each part: solids, thick shells, beams and shells stand one after the other, a row of nodes each and
    the number of the part at its end."""
    for kind, nodes, others in ((_SOLIDS, 8, 0), (_THICK, 8, 0), (_BEAMS, 2, 3), (_SHELLS, 4, 0)):
        rows = abs(int(words[kind]))
        width = nodes + others + 1
        table = words[place : place + rows * width].reshape(-1, width) - 1
        place += rows * width
        if kind == _SOLIDS and words[kind] < 0:
            place += 2 * rows  # the last nodes of tetrahedra of ten nodes
        for part in np.unique(table[:, -1]):
            used = np.unique(table[table[:, -1] == part, :nodes])
            if len(used) and used[0] >= 0 and used[-1] < count:
                yield used.astype(np.int64)


def require_no_deleted(mesh: SourceMesh) -> None:
    """Raise DatasetError if elements of LS-DYNA are deleted, as where a material fails; VTK makes ghosts of them."""
    deleted = sum(int(np.count_nonzero(np.nan_to_num(ghosts))) for ghosts in mesh.cell_fields.get("vtkGhostType", []))
    if deleted:
        at = "" if mesh.time is None else f" at the time {mesh.time:g}"
        raise DatasetError(
            f"{mesh.path}: {counted(deleted, 'element is', 'elements are')} deleted{at}, but all frames of a scene have"
            " the same ones: end the results before"
        )
