"""Generate a dataset with several worker processes, in a way that survives a kill.

Every finished sample lies in `OUT.parts/`; a run with the same settings goes on from there, and when all are present
they are merged in order into the dataset file and the folder is removed. The result does not depend on the number of
workers or on interruptions, except for the recorded seconds.
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.data.disk import replacing
from ast_sim.data.file import SPLITS, Dataset, DatasetInfo, DatasetWriter
from ast_sim.errors import SimulationError
from ast_sim.simulate.contact import self_test
from ast_sim.simulate.pool import run_all
from ast_sim.simulate.progress import Progress
from ast_sim.simulate.samples import Sample, family_module, load_sample, sample_name, sample_path

COUNTS = {"train": 100, "valid": 8, "test": 10}


@dataclass(frozen=True)
class Generated:
    """What `generate` did.

    Attributes:
        path: the dataset file.
        counts: number of samples of each split.
        truncated: names of the samples that stopped before their last frame.
    """

    path: Path
    counts: dict[str, int]
    truncated: list[str]


def generate(
    family: str,
    out: str | os.PathLike[str],
    counts: dict[str, int] | None = None,
    seed: int = 0,
    nodes: int | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Generated:
    """Generate a dataset file of simulated scenes.

    Args:
        family: scene family, such as "deforming_plate".
        out: the dataset file. If it exists and was made with the same settings, nothing is done.
        counts: samples of each split; `COUNTS` if None.
        seed: a sample depends on it, its split, its index and `nodes` alone.
        nodes: about how many nodes a scene has; the family's default if None.
        workers: number of processes; one per available core if None.
        progress: show a bar on a terminal, lines elsewhere.

    Raises:
        SimulationError: settings that cannot be, an `out` or parts folder of other settings or in use, failed samples.
            The finished samples are kept: the same call goes on from them.
        MissingExtra: ipctk is not installed.
    """
    module = family_module(family)
    self_test()
    counts = _checked_counts(COUNTS if counts is None else counts)
    nodes = module.DEFAULT_NODES if nodes is None else nodes
    workers = _available_cores() if workers is None else workers
    for name, value, least in (("seed", seed, 0), ("nodes", nodes, module.MINIMUM_NODES), ("workers", workers, 1)):
        if value < least:
            raise SimulationError(f"{name} is {value}; must be at least {least}")
    out = Path(out)
    settings = _settings(family, seed, nodes)
    if out.exists():
        return _existing(out, settings, counts)
    parts = out.with_name(out.name + ".parts")
    samples = [(split, index) for split in SPLITS for index in range(counts[split])]
    with _locked(parts, settings):
        missing = [sample for sample in samples if not _is_readable(sample_path(parts, *sample))]
        with Progress(len(samples), len(samples) - len(missing), "scenes", progress) as bar:
            failures = run_all(missing, parts, (family, str(seed), str(nodes)), workers, bar)
        if failures:
            listing = "; ".join(f"{sample_name(*sample)}: {text}" for sample, text in list(failures.items())[:3])
            raise SimulationError(
                f"{len(failures)} of {len(samples)} samples failed ({listing}). The others are kept in {parts}:"
                " the same command goes on from there"
            )
        truncated = _merge(out, parts, samples, replace(module.INFO, generator={**settings, "counts": counts}))
        shutil.rmtree(parts)
    return Generated(out, counts, truncated)


def _available_cores() -> int:
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _checked_counts(counts: dict[str, int]) -> dict[str, int]:
    unknown = set(counts) - set(SPLITS)
    if unknown:
        raise SimulationError(f"there is no split {sorted(unknown)[0]!r}; use {', '.join(SPLITS)}")
    counts = {split: counts.get(split, 0) for split in SPLITS}
    if min(counts.values()) < 0 or sum(counts.values()) == 0:
        raise SimulationError(f"counts must be at least 0 and not all 0, got {counts}")
    return counts


def _settings(family: str, seed: int, nodes: int) -> dict[str, Any]:
    """All that the arrays of a sample depend on, beside its split and index."""
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "ipctk")}
    return {
        "program": f"ast_sim {ast_sim.__version__}",
        "versions": versions,
        "family": family,
        "seed": seed,
        "nodes": nodes,
        "command": f"ast-sim generate {family} --seed {seed} --nodes {nodes}",
        "licence": "CC0-1.0",
    }


def _difference(found: dict[str, Any], wanted: dict[str, Any]) -> str:
    """The first setting that differs, in words; empty if none does."""
    for key, value in wanted.items():
        if found.get(key) != value:
            return f"{key} {found.get(key)} there, {value} here"
    return ""


def _existing(out: Path, settings: dict[str, Any], counts: dict[str, int]) -> Generated:
    with Dataset(out) as dataset:
        difference = _difference(dataset.info.generator, {**settings, "counts": counts})
        if difference:
            raise SimulationError(f"{out} exists and holds other data ({difference}): remove it or choose another name")
        names = [(split, index) for split in SPLITS for index in range(dataset.count(split))]
        truncated = [sample_name(*sample) for sample in names if dataset.attributes(*sample)["status"] == "truncated"]
    return Generated(out, counts, truncated)


@contextlib.contextmanager
def _locked(parts: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Hold the parts folder, made for these settings or found with them; one process at a time."""
    try:
        parts.mkdir(parents=True, exist_ok=True)
        lock = open(parts / "lock", "w")  # noqa: SIM115 (closed below, also on an error)
    except OSError as error:
        raise SimulationError(f"{parts} cannot be written: {error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SimulationError(f"{parts} is in use by another process that generates the same file") from None
        path = parts / "settings.json"
        if path.exists():
            difference = _difference(_read_settings(path), settings)
            if difference:
                raise SimulationError(
                    f"{parts} holds samples of other settings ({difference}): give those, or remove the folder"
                )
        else:
            try:
                with replacing(path) as temporary:
                    temporary.write_text(json.dumps(settings))
            except OSError as error:
                raise SimulationError(f"{path} cannot be written: {error}") from error
        yield


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise SimulationError(f"{path} is damaged ({error}): remove the folder") from error


def _is_readable(path: Path) -> bool:
    try:
        load_sample(path)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return False
    return True


def _merge(out: Path, parts: Path, samples: list[Sample], info: DatasetInfo) -> list[str]:
    truncated = []
    with DatasetWriter(out, info) as writer:
        for sample in samples:
            trajectory = load_sample(sample_path(parts, *sample))
            writer.add(sample[0], trajectory)
            if trajectory.attributes["status"] == "truncated":
                truncated.append(sample_name(*sample))
    return truncated
