"""Generate a dataset with many processes, on one machine or a cluster, in a way that survives a kill.

Every finished sample lies in `OUT.parts/`, and the frames so far of long ones that are not; a run with the same
settings goes on from there, and when all are present they are merged in order into the dataset file and the folder is
removed. The bytes of the dataset follow from the settings: not from the number of workers, nor from interruptions. The
seconds that the solver took lie beside it (`ast_sim.data.seconds`).
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ast_sim.data.disk import replacing
from ast_sim.data.file import SPLITS, Dataset, DatasetInfo, DatasetWriter
from ast_sim.data.seconds import Seconds, write_seconds
from ast_sim.errors import SimulationError
from ast_sim.simulate import cluster, pool
from ast_sim.simulate.contact import self_test
from ast_sim.simulate.families import family_module
from ast_sim.simulate.manifest import Manifest, Watch
from ast_sim.simulate.progress import Progress
from ast_sim.simulate.samples import Recipe, Sample, load_sample, sample_name, sample_path
from ast_sim.simulate.settings import check_parts, checked_recipe, difference, recorded

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
    frames: int | None = None,
    workers: int | None = None,
    solver: str | None = None,
    parts: str | os.PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: bool = True,
) -> Generated:
    """Generate a dataset file of simulated scenes.

    Args:
        family: scene family, such as "deforming_plate".
        out: the dataset file. If it exists and was made with the same settings, nothing is done.
        counts: samples of each split; `COUNTS` if None.
        seed: a sample depends on it, its split, its index and the family's settings alone.
        nodes: about how many nodes a scene has; the family's default if None.
        frames: frames of a scene, for families that leave the choice; the family's default if None.
        workers: number of processes; one per available core if None.
        solver: "own" or "calculix", for families of solids; "own" if None.
        parts: a file or folder of parts (STEP, STL, meshes), for families that squeeze parts; own shapes if None.
        scheduler: address of a Dask scheduler whose workers make the samples, in place of processes here.
        progress: show a bar on a terminal, lines elsewhere.

    Raises:
        SimulationError: settings that cannot be, an `out` or parts folder of other settings or in use, failed samples.
            The finished samples are kept: the same call goes on from them.
        MissingExtra: what the family, solver or scheduler needs is not installed.
    """
    module = family_module(family)
    self_test()
    counts = _checked_counts(COUNTS if counts is None else counts)
    recipe = checked_recipe(module, family, seed, nodes, frames, solver, parts)
    if workers is not None and scheduler is not None:
        raise SimulationError("workers are processes on this machine, a scheduler has its own: give one of them")
    workers = _available_cores() if workers is None else workers
    if workers < 1:
        raise SimulationError(f"workers is {workers}; must be at least 1")
    out, settings = Path(out), recorded(recipe)
    folder = out.with_name(out.name + ".parts")
    if out.exists():
        return _existing(out, folder, settings, counts)
    if not folder.exists():
        check_parts(recipe)
    samples = [(split, index) for split in SPLITS for index in range(counts[split])]
    with _locked(folder, settings):
        _make(samples, folder, recipe, workers, scheduler, progress, _notes(settings))
        info = replace(module.INFO, generator={**settings, "counts": counts})
        truncated = _merge(out, folder, samples, info)
        _remove(folder)
    return Generated(out, counts, truncated)


def _notes(settings: dict[str, Any]) -> list[str]:
    """What a user should know before hours are spent."""
    if settings.get("mesher") == "structured":
        line = 'pip install "ast_sim[cad]"'
        return [f"gmsh is not installed: parts are blocks, cylinders and plates; for CAD-like ones {line}"]
    return []


def _make(
    samples: list[Sample],
    folder: Path,
    recipe: Recipe,
    workers: int,
    scheduler: str | None,
    progress: bool,
    notes: list[str],
) -> None:
    """Make the samples that are not in the folder."""
    present = {sample for sample in samples if _is_readable(sample_path(folder, *sample))}
    missing = [sample for sample in samples if sample not in present]
    manifest = Manifest(folder, samples, present)
    with contextlib.closing(manifest), Progress(len(samples), len(present), "scenes", progress) as bar:
        for note in (*notes, *(f"{name} failed before: {why}" for name, why in manifest.failures.items())):
            bar.note(note)
        watch = Watch(manifest, bar)
        if missing and scheduler is None:
            pool.run_all(missing, folder, recipe, workers, watch)
        elif missing:
            cluster.run_all(missing, folder, recipe, scheduler, watch)
    if watch.failures:
        listing = "; ".join(f"{sample_name(*sample)}: {text}" for sample, text in list(watch.failures.items())[:3])
        raise SimulationError(
            f"{len(watch.failures)} of {len(samples)} samples failed ({listing}). The others are kept in {folder}:"
            " the same command goes on from there"
        )


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


def _existing(out: Path, folder: Path, settings: dict[str, Any], counts: dict[str, int]) -> Generated:
    with Dataset(out) as dataset:
        differs = difference(dataset.info.generator, {**settings, "counts": counts})
        if differs:
            raise SimulationError(f"{out} exists and holds other data ({differs}): remove it or choose another name")
        names = [(split, index) for split in SPLITS for index in range(dataset.count(split))]
        truncated = [sample_name(*sample) for sample in names if dataset.attributes(*sample)["status"] == "truncated"]
    if folder.exists():  # a kill came between the dataset and the end of its parts
        with _locked(folder, settings):
            _remove(folder)
    _remove(folder)
    return Generated(out, counts, truncated)


@contextlib.contextmanager
def _locked(folder: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Hold the parts folder, made for these settings or found with them; one process at a time."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / "lock", "w")  # noqa: SIM115 (closed below, also on an error)
    except OSError as error:
        raise SimulationError(f"{folder} cannot be written: {error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SimulationError(f"{folder} is in use by another process that generates the same file") from None
        path = folder / "settings.json"
        if path.exists():
            differs = difference(_read_settings(path), settings)
            if differs:
                raise SimulationError(
                    f"{folder} holds samples of other settings ({differs}): give those, or remove the folder"
                )
        else:
            try:
                with replacing(path) as temporary:
                    temporary.write_text(json.dumps(settings))
            except OSError as error:
                raise SimulationError(f"{path} cannot be written: {error}") from error
        for leftover in folder.glob(".*"):  # what a killed process was about to write
            leftover.unlink(missing_ok=True)
        yield


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise SimulationError(f"{path} is damaged ({error}): remove the folder") from error


def _remove(folder: Path) -> None:
    """Remove the parts folder at one instant: never are there samples without the settings that they are of."""
    removed = folder.with_name(f".{folder.name}.removed")
    shutil.rmtree(removed, ignore_errors=True)
    with contextlib.suppress(FileNotFoundError):
        os.replace(folder, removed)
        shutil.rmtree(removed)


def _is_readable(path: Path) -> bool:
    try:
        load_sample(path)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return False
    return True


def _merge(out: Path, folder: Path, samples: list[Sample], info: DatasetInfo) -> list[str]:
    """Write the dataset, and its seconds before it; returns the truncated samples."""
    truncated = []
    seconds: dict[str, Seconds] = {}
    for end in ("*.tmp", "seconds.json.*"):
        for leftover in out.parent.glob(f".{glob.escape(out.name)}.{end}"):  # of a merge that was killed
            leftover.unlink(missing_ok=True)
    with DatasetWriter(out, info) as writer:
        for sample in samples:
            trajectory, seconds[sample_name(*sample)] = load_sample(sample_path(folder, *sample))
            writer.add(sample[0], trajectory)
            if trajectory.attributes["status"] == "truncated":
                truncated.append(sample_name(*sample))
        write_seconds(out, info.generator, seconds)
    return truncated
