"""Generate a dataset with many processes, on one machine or a cluster, in a way that survives a kill.

`OUT.parts/` holds every finished sample, and the frames so far of long unfinished samples. A run with the same settings
goes on from there. When all samples are present, they are merged in order into the dataset file, and the folder is
removed. If a dataset shall have more scenes, its samples are laid into the folder again, and only the others are made.
The settings alone determine the bytes of the dataset. The number of workers and interruptions do not change them. The
solver's seconds are stored in a file beside the dataset (`ast_sim.dataset.solver_seconds`).
"""

from __future__ import annotations

import contextlib
import fcntl
import glob
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

from ast_sim.dataset.layout import SPLITS
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import Seconds, read_seconds, seconds_path, write_seconds
from ast_sim.dataset.writer import DatasetWriter, FittedWriter
from ast_sim.mechanics.contact_and_friction import self_test
from ast_sim.simulate.families.known_families import family_module
from ast_sim.simulate.jobs import cluster, pool
from ast_sim.simulate.jobs.display import SceneProgress
from ast_sim.simulate.jobs.manifest import Manifest, Watch
from ast_sim.simulate.jobs.recipe import check_parts, checked_recipe, difference, recorded
from ast_sim.simulate.jobs.samples import (
    Recipe,
    Sample,
    load_sample,
    pack_sample,
    sample_name,
    sample_path,
    store_sample,
)
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.argument_checks import file_name, require_bool
from ast_sim.support.disk import output_file, replacing
from ast_sim.support.errors import AstSimError, ConfigError, DatasetError, SimulationError, counted
from ast_sim.support.progress import ShowProgress, require_progress
from ast_sim.support.toml_settings import require_range, required_whole, whole

MOST_WORKERS = 64  # or two for each core: each takes 0.3 GB
MOST_SCENES = 1_000_000  # names of samples have six digits


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
    *,
    train: int = 100,
    valid: int | None = None,
    test: int | None = None,
    calibration: int = 0,
    seed: int = 0,
    nodes: int | None = None,
    frames: int | None = None,
    keep: Sequence[int] | None = None,
    order: int | None = None,
    workers: int | None = None,
    solver: str | None = None,
    parts: str | os.PathLike[str] | None = None,
    spec: str | os.PathLike[str] | None = None,
    patient: bool = False,
    scheduler: str | None = None,
    progress: ShowProgress = True,
) -> Generated:
    """Generate a dataset file of simulated scenes.

    Args:
        family, out: scene family, such as "deforming_plate"; dataset file. One with these settings gets what it lacks.
        train, valid, test, calibration: scenes of each split. `valid` and `test` are a tenth of `train` if None.
        seed: of all random draws. A sample depends only on the seed, its split, its index and the settings.
        nodes, frames: about how many nodes and how many frames a scene has; None: as the family or specification has.
        keep: ascending numbers of the frames to solve, straight from one to the next, and store; all frames if None.
        order: of the tetrahedra, 1 (four nodes) or 2 (ten nodes), for families that have this option; 1 if None.
        workers, scheduler: number of processes, by default one per core; or the address of a Dask scheduler instead.
        solver: "own" or "calculix", for families of solids; if None, "own", but "calculix" if a part is elastoplastic.
        parts: a file or folder of parts (STEP, STL, meshes), for families that squeeze parts; None: drawn ones.
        spec: the specification of an assembly (TOML), for the family "assembly".
        patient: solve every scene to its last frame. Else a scene ends before a frame of over 500 Newton iterations.
        progress: True: a bar on a terminal, lines elsewhere; False: nothing; or a function of (done, total, text).

    Raises:
        AstSimError: `out` is no place for a file, in use or damaged; the disk is too small; a file cannot be written.
        ConfigError: a setting is invalid, `out` was made with other settings, or the scheduler cannot be reached.
        SimulationError: samples failed: the same call goes on from there.
        MissingExtra: a package that the family, the solver or the scheduler needs is not installed.
    """
    module = family_module(family)
    require_progress(progress)
    counts = checked_counts(train, valid, test, calibration)
    workers = checked_workers(workers, scheduler)
    recipe = checked_recipe(module, family, seed, nodes, frames, solver, parts, patient, keep, spec, order)
    output_file(out := file_name(out, "out"))
    settings = recorded(recipe)
    folder = out.with_name(out.name + ".parts")
    if out.exists() and not _grows(out, settings, counts):
        return _existing(out, folder, settings, counts)
    _check_start(out, folder, sum(counts.values()), recipe, module)
    with _locked(folder, settings):
        _unpack(out, folder)
        samples = _samples(counts)
        _make(samples, folder, recipe, workers, scheduler, progress, _notes(recipe, settings))
        opened = _writer(out, recipe, module, {**settings, "counts": counts})
        return Generated(out, counts, _merge(out, folder, samples, opened))


def _writer(out: Path, recipe: Recipe, module: ModuleType, generator: dict[str, Any]) -> DatasetWriter:
    """A writer for the dataset; the domain of an assembly follows from its positions."""
    for leftover in out.parent.glob(f".{glob.escape(out.name)}.*.tmp"):  # of a merge that was killed
        leftover.unlink(missing_ok=True)
    if recipe.spec is None:
        return DatasetWriter(out, replace(module.INFO, generator=generator))
    return FittedWriter(out, **module.info(read_spec(recipe.spec)), generator=generator)


def _frames(recipe: Recipe, module: ModuleType) -> int:
    """How many frames of a scene are stored."""
    return (recipe.frames or module.FRAMES) if recipe.keep is None else 1 + len(recipe.keep)


def _notes(recipe: Recipe, settings: dict[str, Any]) -> list[str]:
    """What a user should know before the run takes hours."""
    yielding = () if recipe.spec is None else read_spec(recipe.spec).yielding
    if yielding:
        return [f"{', '.join(yielding)}: elastoplastic, so CalculiX solves these scenes, each with one thread"]
    if settings.get("mesher") == "structured":
        line = 'pip install "ast_sim[cad]"'
        return [f"gmsh is not installed, so parts are blocks, cylinders and plates; for CAD-like parts: {line}"]
    return []


def _make(
    samples: list[Sample],
    folder: Path,
    recipe: Recipe,
    workers: int,
    scheduler: str | None,
    progress: ShowProgress,
    notes: list[str],
) -> None:
    """Make the samples that the folder lacks."""
    present = {sample for sample in samples if _is_readable(sample_path(folder, *sample))}
    missing = [sample for sample in samples if sample not in present]
    manifest = Manifest(folder, samples, present)
    with (
        contextlib.closing(manifest),
        SceneProgress(len(samples), "scenes", progress, done=len(present)) as bar,
    ):
        for note in (*notes, *(f"{name} failed before: {why}" for name, why in manifest.failures.items())):
            bar.line(note)
        watch = Watch(manifest, bar)
        if missing and scheduler is not None:
            cluster.run_all(missing, folder, recipe, scheduler, watch)
        elif missing:
            pool.run_all(missing, folder, recipe, workers, watch)
    if watch.failures:
        listing = "; ".join(f"{sample_name(*sample)}: {text}" for sample, text in list(watch.failures.items())[:3])
        raise SimulationError(
            f"{len(watch.failures)} of {counted(len(samples), 'sample')} failed ({listing}). The others are kept in"
            f" {folder}: the same command goes on from there"
        )


def checked_workers(workers: int | None, scheduler: str | None) -> int:
    """The number of processes; one per available core if None."""
    if workers is not None and scheduler is not None:
        raise ConfigError("workers run on this machine, but a scheduler has its own workers: give one of them")
    (workers,) = whole(1, workers=workers)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # not on macOS
    require_range("workers", workers, 1, max(MOST_WORKERS, 2 * cores))
    return workers or cores


def checked_counts(train: int, valid: int | None, test: int | None, calibration: int = 0) -> dict[str, int]:
    """The number of scenes of each split; a tenth of `train` where None.

    Raises:
        ConfigError: one is no whole number, all are 0, or there are too many.
    """
    train, calibration = required_whole(train=train, calibration=calibration)
    valid, test = (-(-train // 10) if count is None else count for count in whole(valid=valid, test=test))
    counts = {"train": train, "valid": valid, "test": test, "calibration": calibration}
    if min(counts.values()) < 0 or sum(counts.values()) == 0:
        raise ConfigError(f"counts must be at least 0 and not all 0, got {counts}")
    if sum(counts.values()) > MOST_SCENES:
        raise ConfigError(f"{sum(counts.values()):,} scenes are too many for one dataset: at most {MOST_SCENES:,}")
    return counts


def _check_start(out: Path, made: Path, scenes: int, recipe: Recipe, module: ModuleType) -> None:
    """Refuse broken parts, and what cannot fit on the disk: positions and stress take four float32 a node and frame.
    Where the folder `made` is there, this was checked before."""
    require_bool(patient=recipe.patient)
    self_test()
    if made.exists():
        return
    check_parts(recipe)
    nodes = recipe.nodes or 1
    frames = _frames(recipe, module)
    folder = next(parent for parent in out.absolute().parents if parent.exists())
    least = 16 * scenes * nodes * frames
    free = shutil.disk_usage(folder).free
    if least > free:
        raise AstSimError(
            f"{counted(scenes, 'scene needs', 'scenes need')} more than {least / 1e9:,.3f} GB, but {folder} has"
            f" {free / 1e9:,.3f} GB: make fewer or smaller scenes, or choose another disk"
        )


def _grows(out: Path, settings: dict[str, Any], counts: dict[str, int]) -> bool:
    """Whether the dataset was made with these settings and has fewer scenes in a split, and more in none."""
    with Dataset(out) as dataset:
        before = dataset.splits
        same = not difference(dataset.info.generator, settings)
    return same and before != counts and all(before[split] <= counts[split] for split in SPLITS)


def _samples(counts: dict[str, int]) -> list[Sample]:
    """The samples of a dataset, in order."""
    return [(split, index) for split in SPLITS for index in range(counts[split])]


def _unpack(out: Path, folder: Path) -> None:
    """Lay the samples of a dataset that is there into the parts folder, as they lay there before they were merged."""
    if not out.exists():
        return
    with Dataset(out) as dataset:
        known = read_seconds(dataset).samples
        seconds = json.loads(seconds_path(out).read_text(encoding="utf-8"))["samples"] if known else {}
        for sample in _samples(dataset.splits):
            path = sample_path(folder, *sample)
            if not _is_readable(path):
                split, index = sample
                trajectory = dataset[split][index]
                store_sample(path, pack_sample(trajectory, seconds.get(sample_name(*sample), {})))


def _existing(out: Path, folder: Path, settings: dict[str, Any], counts: dict[str, int]) -> Generated:
    with Dataset(out) as dataset:
        differs = difference({**dataset.info.generator, "counts": dataset.splits}, {**settings, "counts": counts})
        if differs:
            raise ConfigError(f"{out} exists and holds other data ({differs}): remove it or choose another name")
        names = _samples(dataset.splits)
        truncated = [sample_name(*sample) for sample in names if dataset.attributes(*sample)["status"] == "truncated"]
    if set(folder.glob("*.npz")) <= {sample_path(folder, *sample) for sample in names}:  # else it is about to grow
        if folder.exists():  # a kill came after the dataset was written and before its parts were removed
            with _locked(folder, settings):
                _remove(folder)
        _remove(folder)
    return Generated(out, counts, truncated)


@contextlib.contextmanager
def _locked(folder: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Hold the parts folder, so that one process at a time uses it. It is new or was made with these settings."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / "lock", "w")  # noqa: SIM115 (closed below, also on an error)
    except OSError as error:
        raise AstSimError(f"{folder} cannot be written: {error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise AstSimError(f"{folder} is in use by another process that generates the same file") from None
        path = folder / "settings.json"
        if path.exists():
            differs = difference(_read_settings(path), settings)
            if differs:
                raise ConfigError(
                    f"{folder} holds samples of other settings ({differs}): give its settings, or remove the folder"
                )
        else:
            try:
                with replacing(path) as temporary:
                    temporary.write_text(json.dumps(settings))
            except OSError as error:
                raise AstSimError(f"{path} cannot be written: {error}") from error
        for leftover in folder.glob(".*"):  # files that a killed process had not finished
            leftover.unlink(missing_ok=True)
        yield


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise DatasetError(f"{path} is damaged ({error}): remove the folder") from error


def _remove(folder: Path) -> None:
    """Remove the parts folder in one step, so that samples never lie there without their settings."""
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


def _merge(out: Path, folder: Path, samples: list[Sample], opened: DatasetWriter) -> list[str]:
    """Write the seconds and then the dataset, and remove the folder; return the names of the truncated samples."""
    truncated = []
    seconds: dict[str, Seconds] = {}
    with opened as writer:
        for sample in samples:
            trajectory, taken = load_sample(sample_path(folder, *sample))
            writer.add(sample[0], trajectory)
            if taken:
                seconds[sample_name(*sample)] = taken
            if trajectory.attributes["status"] == "truncated":
                truncated.append(sample_name(*sample))
        write_seconds(out, writer.info.generator, seconds)
    _remove(folder)
    return truncated
