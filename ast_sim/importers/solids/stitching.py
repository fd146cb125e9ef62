"""Points that stand in a file several times: meshes whose elements, patches or pieces have points of their own.

Points at one place are joined if the file says that they are one point, or if the mesh is cut all over (no two elements
share a point), or where whole faces of two separate parts lie on each other and the parts are pieces of the file or
patches, or stay together in all frames. The fields of points that are joined must agree in every frame: bodies that
touch and then part have points of their own, and keep them. Elements of a few, and elements that come apart, are bodies
if the file numbers their points: then two numbers are two points.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solids.splitting import faces_of
from ast_sim.number_arrays import connected_parts
from ast_sim.support.errors import DatasetError, counted

# Points are at one place if they are nearer than this share of the size of the mesh.
_SAME_PLACE = 1e-6

# Fields agree if they differ by less than this share of their largest value.
_SAME_VALUE = 1e-5

# Separate parts, at least this many, that all hold the same number of elements are patches of one mesh, and a mesh of
# fewer elements is not cut all over if its points have numbers.
_PATCHES = 4

# Names of fields that number points or processes: they differ at a point that stands several times.
_NUMBERING = ("id", "ids", "index", "rank", "partition", "proc", "process", "globalnodeid", "vtkoriginalpointids")


class Stitching:
    """Finds the points of a simulation that are one point; `look` is called with each frame, the first included."""

    def __init__(self, mesh: SourceMesh) -> None:
        self.mesh = mesh
        self.blocks = [block for block in mesh.blocks if block.dimension >= 2]
        self.frames = 0
        self.moved = False
        self.apart = False
        self.pairs = np.zeros((0, 2), np.int64)
        self.disagree: dict[str, np.ndarray] = {}
        self.reason = self._candidates()
        self.agree = np.ones(len(self.pairs), bool)

    def _candidates(self) -> str:
        """Find the pairs of points that may be one; why they may: "ids", "cut", "pieces", "patches", "parts" or ""."""
        mesh = self.mesh
        points = self.mesh.points
        used = np.unique(np.concatenate([np.zeros(0, np.int64), *(block.nodes.ravel() for block in self.blocks)]))
        if not len(used):
            return ""
        self.tolerance = _SAME_PLACE * float(np.ptp(points[used], axis=0).max())
        if mesh.same_point is not None:
            order = used[np.argsort(mesh.same_point[used], kind="stable")]
            same = np.flatnonzero(np.diff(mesh.same_point[order]) == 0)
            self.pairs = np.stack([order[same], order[same + 1]], axis=1)
            if len(self.pairs):
                return "ids"
        count = np.zeros(len(points), np.int64)
        for block in self.blocks:
            count += np.bincount(block.nodes.ravel(), minlength=len(points))
        few = sum(len(block.nodes) for block in self.blocks) < _PATCHES
        if mesh.same_point is not None and (count.max() > 1 or few):  # two numbers are two points
            return ""
        pairs = KDTree(points[used]).query_pairs(self.tolerance, output_type="ndarray")
        if not len(pairs):
            return ""
        self.pairs = used[pairs]
        return "cut" if count.max() == 1 else self._between_parts()

    def _parts(self) -> np.ndarray:
        """[n]: the part of the mesh to which each point belongs, the nodes within edges and faces included."""
        links = [np.repeat(block.nodes[:, :1], block.nodes.shape[1], axis=1).ravel() for block in self.blocks]
        ends = [block.nodes.ravel() for block in self.blocks]
        pairs = np.stack([np.concatenate(links), np.concatenate(ends)], axis=1)
        return connected_parts(pairs, len(self.mesh.points))

    def _between_parts(self) -> str:
        """Keep the pairs of points between parts that have a whole face in common."""
        size = len(self.mesh.points)
        part = self._parts()
        place = _joined(self.pairs, size)
        faces = [_padded(face) for block in self.blocks for face in faces_of(block.shape, block.corners)]
        together = np.concatenate(faces)
        owner = part[together[:, 0]]
        keys = np.sort(np.where(together >= 0, place[together], -1), axis=1)
        order = np.lexsort(keys.T)
        like = (keys[order[1:]] == keys[order[:-1]]).all(axis=1) & (owner[order[1:]] != owner[order[:-1]])
        common = np.sort(np.stack([owner[order[1:]][like], owner[order[:-1]][like]], axis=1), axis=1)
        joint = set(map(tuple, np.unique(common, axis=0).tolist()))
        ends_of = np.sort(part[self.pairs], axis=1)
        kept = np.array([tuple(two) in joint for two in ends_of.tolist()], bool)
        self.pairs = self.pairs[kept]
        if not len(self.pairs):
            return ""
        pieces = self.mesh.pieces
        if pieces is not None and (pieces[self.pairs[:, 0]] != pieces[self.pairs[:, 1]]).all():
            return "pieces"
        elements = np.zeros(part.max() + 1, np.int64)
        for block in self.blocks:
            elements += np.bincount(part[block.nodes[:, 0]], minlength=len(elements))
        elements = elements[elements > 0]
        return "patches" if len(elements) >= _PATCHES and np.ptp(elements) == 0 else "parts"

    def look(
        self,
        mesh: SourceMesh,
        used_fields: tuple[str, ...] = (),
        displacement: Collection[str] = ("displacement",),
    ) -> None:
        """Compare the points and the fields of a frame at the pairs.

        Args:
            displacement: the fields in which points that have numbers of their own come apart.
            used_fields: fields that say what a point is, such as its body: they count even if they look like numbers
                of points, and cell fields among them count as well.
        """
        self.frames += 1
        if not len(self.pairs):
            return
        one, other = self.pairs.T
        apart = np.linalg.norm(mesh.points[one] - mesh.points[other], axis=1) > self.tolerance
        self._differ("the place", apart)
        self.apart = self.apart or bool(apart.any())
        self.moved = self.moved or not np.array_equal(mesh.points, self.mesh.points)
        for name, values in mesh.point_fields.items():
            if values.dtype.kind not in "iufb" or (_numbers(name, values) and name not in used_fields):
                continue
            values = values.reshape(len(values), -1).astype(np.float64)
            largest = np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values))
            a, b = values[one], values[other]
            same = (np.abs(a - b) <= _SAME_VALUE * largest) | (np.isnan(a) & np.isnan(b)) | (a == b)
            self.moved = self.moved or (values.shape[1] == 3 and bool(largest))
            self._differ(f"the field {name!r}", ~same.all(axis=1))
            self.apart = self.apart or (name in displacement and not same.all())
        for name in filter(mesh.cell_fields.__contains__, used_fields):
            lowest, highest = _ends_at_points(mesh, name)
            self._differ(f"the field {name!r}", (lowest[one] != lowest[other]) | (highest[one] != highest[other]))

    def _differ(self, what: str, rows: np.ndarray) -> None:
        self.agree &= ~rows
        if rows.any():
            self.disagree[what] = self.disagree.get(what, np.zeros(len(rows), bool)) | rows

    def joined(self) -> tuple[np.ndarray, list[str]]:
        """[n]: the point that stands for each point of the file, the first of all that are one; and notes.

        Raises:
            DatasetError: each element has points of its own, and fields differ at points of one place.
        """
        size = len(self.mesh.points)
        if not len(self.pairs):
            return np.arange(size), []
        if self.reason == "parts" and not (self.frames > 1 and self.moved):
            return np.arange(size), []
        kept = self.pairs[self.agree] if self.reason in ("cut", "ids") else self._whole_parts()
        label = _joined(kept, size)
        alone = self._alone(label) if self.reason == "cut" else ""
        if alone and self.apart and self.mesh.same_point is not None:
            count = counted(len(np.unique(self.pairs)), "point")
            return np.arange(size), [f"{count} at places of others have numbers of their own and come apart"]
        if alone:
            raise DatasetError(alone)
        places = len(np.unique(label[kept]))
        if not len(kept):
            return np.arange(size), []
        count = int(np.isin(label, label[kept]).sum())
        return label, [f"{counted(count, 'point')} at {counted(places, 'place')} are joined: {_WHY[self.reason]}"]

    def _whole_parts(self) -> np.ndarray:
        """The pairs between parts that agree at all of them."""
        if self.agree.all():
            return self.pairs
        part = self._parts()
        keys, group = np.unique(np.sort(part[self.pairs], axis=1), axis=0, return_inverse=True)
        whole = np.ones(len(keys), bool)
        whole[group.ravel()[~self.agree]] = False
        return self.pairs[whole[group.ravel()]]

    def _alone(self, label: np.ndarray) -> str:
        """What is wrong if elements have no neighbour although they lie on others."""
        count = np.zeros(len(label), np.int64)
        for block in self.blocks:
            count += np.bincount(label[block.nodes.ravel()], minlength=len(label))
        alone = sum(int((count[label[block.nodes]] == 1).all(axis=1).sum()) for block in self.blocks)
        total = sum(len(block.nodes) for block in self.blocks)
        if not self.disagree or alone <= 0.1 * total:
            return ""
        what, rows = max(self.disagree.items(), key=lambda one: int(one[1].sum()))
        at = self.mesh.points[self.pairs[np.argmax(rows), 0]].tolist()
        path = self.mesh.path if self.frames == 1 else f"{self.mesh.path} and {counted(self.frames - 1, 'later frame')}"
        return (
            f"{path}: each element has points of its own, and {what} differs at {rows.sum()} of"
            f" {counted(len(rows), 'pair')} of points at one place, the first at {at}: average the field at the"
            " points, or leave it out"
        )


_WHY = {
    "ids": "the file gives them one number",
    "cut": "each element has points of its own",
    "pieces": "pieces of the file meet there",
    "patches": "patches of the mesh meet there",
    "parts": "parts of the mesh stay together there in all frames",
}


def _ends_at_points(mesh: SourceMesh, name: str) -> tuple[np.ndarray, np.ndarray]:
    """[n], [n]: the lowest and the highest value of a cell field in the cells at each point."""
    lowest, highest = np.full(len(mesh.points), np.inf), np.full(len(mesh.points), -np.inf)
    for block, values in zip(mesh.blocks, mesh.cell_fields[name], strict=True):
        if values.ndim == 1 and values.dtype.kind in "iufb":
            each = np.repeat(values.astype(np.float64), block.nodes.shape[1])
            np.minimum.at(lowest, block.nodes.ravel(), each)
            np.maximum.at(highest, block.nodes.ravel(), each)
    return lowest, highest


def _joined(pairs: np.ndarray, size: int) -> np.ndarray:
    """[size]: the first of all points that pairs connect with each point."""
    graph = coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(size, size))
    label = connected_components(graph, directed=False)[1]
    first = np.full(label.max() + 1, size, np.int64)
    np.minimum.at(first, label, np.arange(size))
    return first[label]


def _padded(face: np.ndarray) -> np.ndarray:
    """[f, 4]: faces of three nodes get -1 as the fourth."""
    return face if face.shape[1] == 4 else np.pad(face, ((0, 0), (0, 1)), constant_values=-1)


def _numbers(name: str, values: np.ndarray) -> bool:
    """Whether a field numbers points or processes."""
    if values.dtype.kind in "iu" and values.ndim == 1 and len(np.unique(values)) == len(values) > 8:
        return True
    return name.lower().replace("_", "").rstrip("s") in {word.rstrip("s") for word in _NUMBERING}
