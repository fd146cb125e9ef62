"""How fast MeshGraphNets data become a dataset: `python -m benchmarks.simulation.convert --json FILE`.

Makes a `train.tfrecord` like the one of deforming_plate: 400 frames, as many nodes, tetrahedra, nodal stress. The file
is warm when it is read. Three things are timed:

- reading its records (frames and checksums);
- reading its trajectories (also the features, the bodies, and every check);
- the whole conversion (also the dataset file, which is synced to the disk at its end).

Rates are bytes of the file per second, by the clock and by the processor's time. On a machine that others use too, only
the processor's time tells the cost.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from scipy.spatial import Delaunay

from ast_sim.importers.deepmind import convert_deepmind, read_trajectories
from ast_sim.importers.deepmind_meta import read_meta
from ast_sim.importers.tfrecord import masked_crc
from ast_sim.importers.tfrecord import read_records as records_of
from ast_sim.support.provenance import provenance

TARGET = 200.0  # MB/s of the whole conversion
FRAMES = 400
NODES = (672, 2189)  # the least and the most of deforming_plate
FEATURES = {
    "cells": ("static", 4, "int32"),
    "node_type": ("static", 1, "int32"),
    "mesh_pos": ("static", 3, "float32"),
    "world_pos": ("dynamic", 3, "float32"),
    "stress": ("dynamic", 1, "float32"),
}


def make(folder: Path, megabytes: int) -> Path:
    """Write `meta.json` and `train.tfrecord` of about `megabytes` megabytes; returns the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    features = {
        name: {"type": kind, "shape": [FRAMES if kind == "dynamic" else 1, -1, width], "dtype": dtype}
        for name, (kind, width, dtype) in FEATURES.items()
    }
    meta = {"simulator": "random", "dt": 0, "collision_radius": 0.03, "features": features}
    text = json.dumps({**meta, "field_names": list(features), "trajectory_length": FRAMES})
    (folder / "meta.json").write_text(text)
    generator, path = np.random.default_rng(0), folder / "train.tfrecord"
    with open(path, "wb") as file:
        while file.tell() < megabytes * 1e6:
            payload = example(trajectory(generator))
            length = struct.pack("<Q", len(payload))
            checksums = [struct.pack("<I", masked_crc(data)) for data in (length, payload)]
            file.write(length + checksums[0] + payload + checksums[1])
    return path


def trajectory(generator: np.random.Generator) -> dict[str, np.ndarray]:
    """Points in a plate of 0.5 by 0.5 by 0.05 m that drift apart, some of them held, some an obstacle."""
    count = int(generator.integers(*NODES, endpoint=True) * generator.uniform(0.75, 1))
    rest = (generator.random((max(count, NODES[0]), 3)) * [0.5, 0.5, 0.05]).astype(np.float32)
    drift = generator.standard_normal(rest.shape).astype(np.float32) * np.float32(0.01)
    frames = np.linspace(0, 1, FRAMES, dtype=np.float32)[:, None, None]
    return {
        "cells": Delaunay(rest).simplices.astype(np.int32),
        "node_type": generator.choice(np.array([0, 1, 3], np.int32), len(rest), p=[0.8, 0.15, 0.05]),
        "mesh_pos": rest,
        "world_pos": rest + frames * drift,
        "stress": frames * generator.random((len(rest), 1), np.float32) * np.float32(1e6),
    }


def example(arrays: dict[str, np.ndarray]) -> bytes:
    """A `tf.train.Example` with a bytes feature for each array."""

    def field(number: int, content: bytes) -> bytes:
        header, size = bytearray([number << 3 | 2]), len(content)
        while size >= 0x80:
            header.append(size & 0x7F | 0x80)
            size >>= 7
        return bytes([*header, size]) + content

    def entry(name: str, array: np.ndarray) -> bytes:
        return field(1, field(1, name.encode()) + field(2, field(1, field(1, array.tobytes()))))

    return field(1, b"".join(entry(name, array) for name, array in arrays.items()))


def read_records(path: Path) -> None:
    for record in records_of(path):
        del record


def read_checked(path: Path) -> None:
    for one in read_trajectories(path, read_meta(path.parent / "meta.json")):
        one.check(str(path), "node")
        del one


def convert(path: Path) -> None:
    convert_deepmind(path.parent, path.parent.parent / "converted.h5")


STAGES: dict[str, Callable[[Path], None]] = {
    "reading records": read_records,
    "reading trajectories": read_checked,
    "whole conversion": convert,
}


def measure(path: Path, repeats: int) -> dict[str, dict[str, Any]]:
    """For each stage the rates of all repeats in MB/s, by both times; the stages take turns."""
    rates: dict[str, dict[str, list[float]]] = {name: {"clock": [], "processor": []} for name in STAGES}
    for stage in STAGES.values():
        stage(path)  # the file and the modules are warm
    for _ in range(repeats):
        for name, stage in STAGES.items():
            clock, processor = time.perf_counter(), time.process_time()
            stage(path)
            for kind, seconds in (
                ("clock", time.perf_counter() - clock),
                ("processor", time.process_time() - processor),
            ):
                rates[name][kind].append(path.stat().st_size / 1e6 / seconds)
    return {
        name: {
            kind: {"median": statistics.median(samples), "best": max(samples), "samples": samples}
            for kind, samples in kinds.items()
        }
        for name, kinds in rates.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--megabytes", type=int, default=300, help="size of the file (%(default)s)")
    parser.add_argument("--repeats", type=int, default=7, help="samples of each stage (%(default)s)")
    parser.add_argument("--folder", type=Path, default=Path("build/convert"), help="for the files (%(default)s)")
    arguments = parser.parse_args()
    path = make(arguments.folder / "plates", arguments.megabytes)
    size = path.stat().st_size
    stages = measure(path, arguments.repeats)
    for name, kinds in stages.items():
        texts = [f"{kind} {one['median']:.0f} MB/s (best {one['best']:.0f})" for kind, one in kinds.items()]
        print(f"{name}: {', '.join(texts)}")
    reached = {kind: one["median"] >= TARGET for kind, one in stages["whole conversion"].items()}
    for kind, yes in reached.items():
        print(f"target of {TARGET:.0f} MB/s by the {kind}: {'reached' if yes else 'NOT reached'}")
    shutil.rmtree(arguments.folder)
    if arguments.json is not None:
        record = {
            **provenance(" ".join(["python -m benchmarks.simulation.convert", *sys.argv[1:]])),
            "crc32c": google_crc32c.implementation,
            "bytes": size,
            "target_megabytes_per_second": TARGET,
            "reached": reached,
            "stages": stages,
        }
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
