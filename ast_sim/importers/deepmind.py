"""A dataset from the files of a MeshGraphNets data set (Pfaff et al. 2021): `meta.json` and `*.tfrecord`.

Each record is a trajectory of N nodes, E elements and T frames. It holds `cells`, `node_type`, `mesh_pos`, `world_pos`
and, in deforming_plate, nodal von Mises `stress`. `meta.json` says which arrays there are and how they are stored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count, islice
from pathlib import Path

import numpy as np

from ast_sim.dataset.layout import SPLITS
from ast_sim.dataset.writer import FittedWriter
from ast_sim.importers.deepmind_meta import LENGTH, Meta, read_meta
from ast_sim.importers.tfrecord import count_records, find_values, read_records
from ast_sim.number_arrays import connected_parts, require_array
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.errors import DatasetError, counted
from ast_sim.support.progress import Progress, ShowProgress

SUFFIX = ".tfrecord"
META = "meta.json"


def is_deepmind(source: Path) -> bool:
    """Whether the source is a folder with a data set of this kind.

    Raises:
        DatasetError: the source is a single .tfrecord file.
    """
    if source.suffix == SUFFIX:
        raise DatasetError(
            f"{source}: name its folder, which must hold {META} too; splits=[NAME] (--split NAME) selects a single file"
        )
    return source.is_dir() and any(source.glob(f"*{SUFFIX}"))


def convert_deepmind(
    source: Path,
    out: Path,
    *,
    splits: Sequence[str] | None = None,
    limit: int | None = None,
    every: int = 1,
    progress: ShowProgress = True,
) -> dict[str, int]:
    """Import a folder with `meta.json` and `train.tfrecord`, `valid.tfrecord`, `test.tfrecord` as a dataset.

    The name of the folder becomes the family. The dataset is dynamic if `dt` is above 0, else quasi-static. The
    trajectories keep their order; only one of them is in memory at a time.

    Args:
        source: the folder.
        out: the dataset file; it is written whole or not at all.
        splits: the splits to import; by default all that have a file.
        limit: import only the first `limit` trajectories of each split (published results on deforming_plate train on
            the first 1,000 of 1,200).
        every: keep the frames 0, `every`, 2 `every`, ...; the time step grows accordingly.
        progress: as in `generate`; the text tells of each trajectory.

    Returns:
        The number of trajectories in each split.

    Raises:
        DatasetError: a file is wrong or something is missing in it; the text names the file and the record. Nothing is
            written then.
    """
    files = _split_files(source, splits)
    meta = read_meta(source / META)
    taken = {"source": str(source), "simulator": meta.simulator, "limit": limit, "every": every}
    facts = {
        "family": source.resolve().name,
        "integration": "dynamic" if meta.dt > 0 else "quasi_static",
        "stress_location": "node" if "stress" in meta.features else "none",
        "contact_radius": meta.collision_radius,
        "time_step": meta.dt * every,
        "generator": {"program": "ast_sim convert", **taken},
    }
    total = sum(count_records(path, limit) for path in files.values())
    with FittedWriter(out, **facts) as writer, Progress(total, "trajectories", progress) as bar:
        for split, path in files.items():
            for trajectory in read_trajectories(path, meta, limit, every):
                size = f"{counted(trajectory.num_frames, 'frame')} of {counted(trajectory.scene.num_nodes, 'node')}"
                writer.add(split, trajectory)
                bar.advance(f"{split}: {path.name} {writer.counts[split] - 1}, {size}")
                del trajectory  # to free its memory before the next one is read
    return writer.counts


def read_trajectories(path: Path, meta: Meta, limit: int | None = None, every: int = 1) -> Iterator[Trajectory]:
    """The first `limit` trajectories of a TFRecord file, with their frames 0, `every`, 2 `every`, ...

    An array that needs no conversion is a view of the record.

    Raises:
        DatasetError: the file is wrong; the text names the file and the record.
    """
    # By `map` the record has no name here, so its memory is free before the next one is read.
    return map(
        lambda payload, index: _trajectory(payload, meta, path, index, every),
        islice(read_records(path), limit),
        count(),
    )


def _split_files(source: Path, splits: Sequence[str] | None) -> dict[str, Path]:
    paths = {split: source / f"{split}{SUFFIX}" for split in SPLITS}
    files = {split: path for split, path in paths.items() if (path.is_file() if splits is None else split in splits)}
    if not files:
        raise DatasetError(f"{source}: holds none of {', '.join(path.name for path in paths.values())}")
    missing = next((path for path in files.values() if not path.is_file()), None)
    if missing is not None:
        raise DatasetError(f"{missing}: there is no such file")
    return files


class _Record:
    """A trajectory as it is stored; `where` is the file and the record, for messages."""

    def __init__(self, payload: bytes, meta: Meta, where: str) -> None:
        self.payload = payload
        self.meta = meta
        self.where = where
        counts = [LENGTH + name for name, feature in meta.features.items() if feature.kind == "dynamic_varlen"]
        self.spans = find_values(payload, [*meta.features, *counts], where)
        for name in (*meta.features, *counts):
            if name not in self.spans:
                raise DatasetError(f"{where}: has no feature {name}, which {META} lists")

    def array(self, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """A feature as a view of the payload."""
        values = memoryview(self.payload)[slice(*self.spans[name])]
        try:
            return np.frombuffer(values, dtype).reshape(shape)
        except (ValueError, OverflowError) as error:
            raise DatasetError(
                f"{self.where}: the feature {name} has {counted(len(values), 'byte')}; {META} says {dtype.name}"
                f" {list(shape)}, a multiple of {abs(math.prod(shape)) * dtype.itemsize} bytes"
            ) from error

    def frames(self, name: str) -> np.ndarray:
        """A feature as [T, rows, columns]; a static one as [1, rows, columns]."""
        feature = self.meta.features[name]
        length = self.meta.trajectory_length
        array = self.array(name, feature.shape, feature.dtype)
        if feature.kind != "dynamic_varlen":
            return array
        counts = self.array(LENGTH + name, (length,), np.dtype("<i4"))
        if counts.min() < 0 or counts.sum(dtype=np.int64) != len(array):
            raise DatasetError(
                f"{self.where}: {LENGTH}{name} does not add up to the {counted(len(array), 'row')} of {name}"
            )
        if (counts != counts[0]).any():
            frame = int(np.argmax(counts != counts[0]))
            self._fail_changing(
                f"{name} has {counted(counts[0], 'row')} in frame 0 and {counts[frame]} in frame {frame}"
            )
        return array.reshape(length, counts[0], array.shape[1])

    def constant(self, name: str) -> np.ndarray:
        """A feature that is static, or the same in all frames, as [rows, columns]."""
        frames = self.frames(name)
        for frame in range(1, len(frames)):
            if not np.array_equal(frames[frame], frames[0], equal_nan=True):
                self._fail_changing(f"{name} in frame {frame} differs from frame 0")
        return frames[0]

    def _fail_changing(self, what: str) -> None:
        raise DatasetError(
            f"{self.where}: {what}: the mesh changes, but a scene of ast_sim has one mesh for all frames; data"
            " sets that are remeshed (flag_dynamic, sphere_dynamic, *_sizing) cannot be converted"
        )


def _trajectory(payload: bytes, meta: Meta, path: Path, index: int, every: int) -> Trajectory:
    where = f"{path}: record {index}"
    record = _Record(payload, meta, where)
    position = _floats(record.frames("world_pos")[::every])
    stress = _floats(record.frames("stress")[::every]) if "stress" in meta.features else None
    scene = _scene(
        _integers(record.constant("cells"), np.int32, f"{where}: cells"),
        _integers(record.constant("node_type")[:, 0], np.uint8, f"{where}: node_type"),
        _floats(record.constant("mesh_pos")),
        position[0],
        where,
    )
    attributes = {"status": "complete", "source": path.name, "index": index}
    return Trajectory(scene, position, stress, attributes, stress_location="node")


def _scene(elements: np.ndarray, node_type: np.ndarray, mesh_pos: np.ndarray, first: np.ndarray, where: str) -> Scene:
    """The scene. Its bodies are the connected parts of the mesh.

    A `mesh_pos` [N, 3] is the rest position. A `mesh_pos` [N, 2] (cloth) gives the positions of the nodes in the flat,
    unstretched sheet. Then the rest position is (u, v, 0): edges have their true length at rest, but displacements from
    rest say nothing about the motion in space. A body whose nodes are all prescribed, such as the sphere of
    sphere_simple, is rigid: its rest position is its position in the first frame, and its `mesh_pos` is not read.
    """
    nodes = len(first)
    require_array(where, "mesh_pos", mesh_pos, np.float32, (nodes, None))
    scene = Scene(np.zeros((nodes, 3), np.float32), elements, node_type, np.zeros(nodes, np.int32))
    scene.check(where)  # before its parts are searched
    body = connected_parts(elements, nodes)
    if mesh_pos.shape[1] == 3:
        return replace(scene, rest_position=mesh_pos, body=body)
    deforming = np.isin(body, body[~scene.prescribed])
    flat = np.pad(mesh_pos, ((0, 0), (0, 1)))
    return replace(scene, rest_position=np.where(deforming[:, None], flat, first), body=body)


def _floats(array: np.ndarray) -> np.ndarray:
    """The array as contiguous float32, copied only if needed. A number that is too large becomes infinite; later checks
    find it."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)


def _integers(array: np.ndarray, dtype: type, where: str) -> np.ndarray:
    limits = np.iinfo(dtype)
    for extreme in (array.min(initial=0), array.max(initial=0)):
        if not limits.min <= extreme <= limits.max:
            raise DatasetError(f"{where} holds {extreme}; must be from {limits.min} to {limits.max}")
    return np.ascontiguousarray(array, dtype)
