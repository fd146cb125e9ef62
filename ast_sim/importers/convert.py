"""Making a dataset from the simulations of another program."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.layout import SPLITS
from ast_sim.dataset.writer import FittedWriter
from ast_sim.element_topology import CORNERS_ONLY
from ast_sim.importers.completeness import require_complete
from ast_sim.importers.deepmind import convert_deepmind, is_deepmind
from ast_sim.importers.frames_in_file import ONE_FRAME, WITH_FRAMES, holds_frames
from ast_sim.importers.job_files import decks_of, doubt_modulus, with_units
from ast_sim.importers.order_of_files.by_name import natural_order
from ast_sim.importers.order_of_files.frame_files import files_of_frames
from ast_sim.importers.order_of_files.left_out import left_out, no_pieces
from ast_sim.importers.order_of_files.listed import SERIES
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.material import listed_columns
from ast_sim.plausibility.across import AcrossSimulations
from ast_sim.plausibility.findings import Finding, refusal, told, wrong
from ast_sim.scene import Trajectory
from ast_sim.support.argument_checks import file_name, require_bool, require_type, several
from ast_sim.support.errors import ConfigError, DatasetError, LooksWrong, counted, nearest_name, warn
from ast_sim.support.progress import Progress, ShowProgress

SHARES = {"train": 0.8, "valid": 0.1, "test": 0.1}
EVEN = 0.05  # of a time step: explicit solvers write a frame after the step in which its time is reached

Splits = Mapping[str, float] | Mapping[str, Sequence[str]]


def convert(source: Path | str, out: Path | str, **options: Any) -> dict[str, int]:
    """Import simulations as a dataset: PVD, VTU and VTKHDF files, or a folder of a MeshGraphNets data set.

    Args:
        source, out: a file, or a folder of several; the dataset file, which is written whole or not at all.
        options: `names` (an `ast_sim.FieldNames`), `splits`, `calibration`, `seed`, `integration`, `contact_radius`,
            `time_step`, `length_unit`, `deck`, `corners`, `incomplete`, `strict` and `progress`, as in
            `convert_series`. For a folder of .tfrecord files: `splits`, `limit`, `every` and `progress`, as in
            `convert_deepmind`.

    Returns:
        The number of trajectories in each split.

    Raises:
        ConfigError: there is no such option for this source.
        DatasetError: a file is wrong or something is missing in it; the text names the file. Nothing is written then.
    """
    source = file_name(source, "source")
    if not source.exists():
        raise DatasetError(f"{source}: there is no such file or folder")
    require_bool(**{key: options[key] for key in ("corners", "incomplete", "strict") if key in options})
    read = convert_deepmind if is_deepmind(source) else convert_series
    known = [key for key in inspect.signature(read).parameters if key not in ("source", "out")]
    unknown = next((key for key in options if key not in known), None)
    if unknown is not None:
        raise ConfigError(f"{source}: there is no option {unknown}{nearest_name(unknown, known)}")
    return read(source, file_name(out, "out"), **options)


def convert_series(
    source: Path,
    out: Path,
    *,
    names: FieldNames | None = None,
    splits: Splits | None = None,
    calibration: int = 0,
    seed: int = 0,
    integration: str = "quasi_static",
    contact_radius: float = 0.0,
    time_step: float = 0.0,
    length_unit: str | None = None,
    deck: Path | str | None = None,
    corners: bool = False,
    incomplete: bool = False,
    strict: bool = False,
    progress: ShowProgress = True,
) -> dict[str, int]:
    """Import the simulations of other programs as a dataset.

    Args:
        source: one simulation (see `read_series`), or a folder of several; then their paths, without suffix, are names.
        out: the dataset file; it is written whole or not at all.
        names: the names of the fields.
        splits: for each split the names of its simulations (others are left out), or its share, drawn with `seed`.
            Shares add up to 1; each above 0 gets one simulation at least. The default is 0.8, 0.1, 0.1; it needs three.
        calibration: simulations that are drawn first for the split "calibration"; shares divide the others.
        integration, contact_radius, time_step, length_unit: as in `DatasetInfo`; no unit is "m", but a deck needs one.
        deck: the deck of CalculiX (`.inp`) whose results the source is; see `read_job` and `decks_of`.
        corners: take only the corners of second-order tetrahedra: no force of such a mesh is right.
        incomplete: accept simulations in which nothing moves, is prescribed or can be learnt.
        strict: refuse what looks wrong; see `ast_sim.plausibility`.
        progress: as in `generate`; the text tells of each simulation. What looks wrong is a warning.

    Returns:
        The number of trajectories in each split. Positions are relative to `generator["origin"]` of the dataset.

    Raises:
        DatasetError: a file is wrong or lacks something; the text names it. Nothing is written then.
    """
    names = FieldNames() if names is None else names
    require_type("names", names, FieldNames, "ast_sim.FieldNames(...)")
    series = find_series(source)
    decks = decks_of(source, series, deck, names)
    names = with_units(decks, names, length_unit)
    chosen = _assign(source, list(series), splits, calibration, seed)
    made_by = {"program": "ast_sim convert", "source": str(source), "names": asdict(names), "seed": seed}
    facts: dict[str, Any] = {"family": source.stem, "integration": integration, "length_unit": length_unit or "m"}
    facts |= {"generator": made_by, "contact_radius": contact_radius, "time_step": time_step, "stress_location": "none"}
    findings: list[tuple[str, Finding]] = []
    across = AcrossSimulations(dynamic=integration == "dynamic")
    with FittedWriter(out, **facts) as writer, Progress(len(chosen), "simulations", progress) as bar:
        for split, name, trajectory in _trajectories(series, decks, chosen, names, corners, incomplete, integration):
            _agree(writer, made_by, series[name], trajectory)
            findings += [(name, one) for one in across.look(name, trajectory)]
            writer.add(split, trajectory)
            bar.advance(_line(split, name, trajectory))
        findings += across.all_together()
        _tell(source, findings, strict)
    return writer.counts


def _agree(writer: FittedWriter, made_by: dict[str, Any], path: Path, trajectory: Trajectory) -> None:
    """The first simulation says where a stress lives; raise DatasetError if another one says otherwise. Warn of times
    that are not the time step's."""
    _doubt_time_step(path, trajectory, writer.info.time_step)
    if not any(writer.counts.values()):
        made_by |= _facts_of_the_first(trajectory)
        writer.info = replace(writer.info, stress_location=trajectory.stress_at)
    if CORNERS_ONLY in trajectory.attributes:
        made_by[CORNERS_ONLY] = True
    writer.info = replace(writer.info, generator=made_by)
    if trajectory.stress_at != writer.info.stress_location:
        raise DatasetError(
            f"{path}: the place of its stress is {trajectory.stress_at!r}, in the simulations before"
            f" {writer.info.stress_location!r}: write it in one place in all of them, or name no stress"
        )


def _tell(source: Path, findings: list[tuple[str, Finding]], strict: bool) -> None:
    """Warn of what looks wrong; refuse it if `strict`."""
    if strict and wrong(findings):
        raise DatasetError(f"{source}: {refusal(wrong(findings))}")
    for line in told(findings):
        warn(line, LooksWrong)


def _trajectories(
    series: Mapping[str, Path],
    decks: Mapping[str, Path],
    chosen: Sequence[tuple[str, str]],
    names: FieldNames,
    corners: bool,
    incomplete: bool,
    integration: str,
) -> Iterator[tuple[str, str, Trajectory]]:
    """The split, the name and the trajectory of each chosen simulation; all have the origin of the first."""
    origin = None
    for split, name in chosen:
        trajectory = read_series(series[name], names, origin, decks.get(name), corners)
        if name in decks:
            doubt_modulus(decks[name], trajectory, names.stress_unit or "Pa")
        if not incomplete:
            require_complete(series[name], trajectory, names, decks.get(name))
        if integration == "dynamic":
            _require_even_times(series[name], trajectory)
        if origin is None:
            origin = np.array(trajectory.attributes.get("origin", [0.0, 0.0, 0.0]))
        yield split, name, trajectory


def _require_even_times(source: Path, trajectory: Trajectory) -> None:
    """Raise DatasetError if known times are not evenly spaced: with inertia, positions stand for velocities."""
    steps = np.diff(trajectory.times or ())
    uneven = np.flatnonzero(np.abs(steps - np.median(steps)) > EVEN * np.median(steps)) if len(steps) else steps
    if len(uneven):
        first = int(uneven[0])
        raise DatasetError(
            f"{source}: from frame {first} to {first + 1} {steps[first]:.4g} s pass, from most frames to the next"
            f" {np.median(steps):.4g} s: with inertia all time steps must be equal"
        )


def _doubt_time_step(source: Path, trajectory: Trajectory, time_step: float) -> None:
    """Warn if the times in the files say another step from frame to frame; counts of frames, 0, 1, 2, say none."""
    steps = np.diff(trajectory.times or ())
    usual = float(np.median(steps)) if len(steps) else 0.0
    if time_step and len(steps) and abs(usual - time_step) > EVEN * time_step and (steps != 1).any():
        warn(
            f"{source}: by its files {usual:.4g} s pass from frame to frame, and time_step (--time-step) says"
            f" {time_step:.4g}: frames keep the times of the files; is another unit meant?"
        )


def _facts_of_the_first(trajectory: Trajectory) -> dict[str, Any]:
    """The origin of all simulations, and the names of the columns of their material."""
    columns = listed_columns(trajectory.attributes)
    origin = trajectory.attributes.get("origin", [0.0, 0.0, 0.0])
    return {"origin": origin, **({"material": columns} if columns else {})}


def _line(split: str, name: str, trajectory: Trajectory) -> str:
    """What was read of a simulation."""
    size = f"{counted(trajectory.num_frames, 'frame')} of {counted(trajectory.scene.num_nodes, 'node')}"
    notes = trajectory.attributes.get("notes")
    return f"{split}: {name}, {size}" + (f"; {notes}" if notes else "")


def find_series(source: Path) -> dict[str, Path]:
    """The simulations in a source by name, in natural order.

    Raises:
        DatasetError: there is no simulation, or two have the same name.
    """
    if not source.is_dir():
        return {source.stem: source}
    series: dict[str, Path] = {}
    for path in _series_in(source):
        name = path.relative_to(source).with_suffix("").as_posix() if path != source else source.name
        if name in series:
            raise DatasetError(f"{path}: is the simulation {name!r}, and so is {series[name].name}: move one elsewhere")
        series[name] = path
    if not series:
        known = ", ".join((".pvd", *WITH_FRAMES, *ONE_FRAME))
        raise DatasetError(f"{source}: neither the folder nor a folder in it holds files of results: {known}")
    return series


def _series_in(folder: Path) -> Iterator[Path]:
    """The simulations in a folder. If it holds files with all frames or .pvd files, only these count; else .series
    files, if there are any: both list files of frames. Files of Gmsh count if there is nothing else."""
    entries = sorted(folder.iterdir(), key=natural_order)
    files = [entry for entry in entries if entry.is_file() and not entry.name.startswith(".")]
    collections = no_pieces(entry for entry in files if entry.suffix.lower() == ".pvd" or holds_frames(entry))
    collections = collections or [entry for entry in files if entry.suffix.lower() == SERIES]
    if collections:
        for note in left_out(folder, collections):
            warn(f"{folder}: {note}")
        yield from collections
        return
    of_frames = files_of_frames(folder)
    meshes = all(file.suffix.lower() == ".msh" for file in of_frames)  # frames if nothing else is there
    if of_frames and not meshes:
        yield folder
        return
    inner = [series for entry in entries if entry.is_dir() and entry.name[0] != "." for series in _series_in(entry)]
    yield from inner or ([folder] if len(of_frames) > 1 else [])


def _assign(
    source: Path, names: list[str], splits: Splits | None, calibration: int, seed: int
) -> list[tuple[str, str]]:
    """(split, name) of every simulation that is imported, ordered by split."""
    rest = len(names) - calibration
    if splits is None and rest < len(SHARES):
        beside = f" beside {calibration} for calibration" if calibration else ""
        raise DatasetError(
            f"{source}: the splits {', '.join(SHARES)} need three simulations{beside}, found: {len(names)}; say"
            " where they go, for example splits={'train': 1} (--shares 1 0 0) to train on all, or splits={'test': 1}"
            " (--shares 0 0 1) to test on all"
        )
    splits = SHARES if splits is None else splits
    require_type("splits", splits, Mapping, "shares or names of simulations by split, such as {'train': 1}")
    unknown = next((split for split in splits if split not in SPLITS), None)
    if unknown is not None:
        raise DatasetError(f"there is no split {unknown!r}; use {', '.join(SPLITS)}")
    given = {split: splits.get(split, 0.0) for split in SPLITS}
    shares = {split: float(share) for split, share in given.items() if isinstance(share, int | float)}
    if len(shares) == len(given):
        lists = _draw(source, names, shares, calibration, seed)
    else:
        if calibration:
            raise DatasetError("splits lists names, so it lists the ones of calibration, too: leave calibration out")
        lists = {
            split: [] if isinstance(members, int | float) else several(split, members, "names")
            for split, members in given.items()
        }
        _require_known(source, names, lists)
    return [(split, name) for split in SPLITS for name in lists[split]]


def _draw(
    source: Path, names: list[str], shares: dict[str, float], calibration: int, seed: int
) -> dict[str, list[str]]:
    """Draw the names of each split at random; within a split they keep their order. A half is rounded up for train.
    Every share above 0 gets a simulation if there are enough."""
    if shares.pop("calibration"):
        raise DatasetError("calibration is a number of simulations, no share: calibration=10 or --calibration 10")
    if not 0 <= calibration < len(names):
        raise DatasetError(
            f"{source}: calibration is {calibration}; must be at least 0 and leave a simulation of {len(names)}"
        )
    if min(shares.values()) < 0 or not abs(sum(shares.values()) - 1) <= 1e-6:  # NaN is neither
        raise DatasetError(f"the shares of the splits must be at least 0 and add up to 1, not {shares}")
    order = np.random.default_rng(seed).permutation(len(names))
    rest = len(names) - calibration
    least = int(rest >= sum(share > 0 for share in shares.values()))
    ends = [0]
    total = 0.0
    for split in ("valid", "test"):
        total += shares[split]
        end = max(int(rest * total + 0.5 - 1e-9), ends[-1] + least * (shares[split] > 0))
        ends.append(min(end, rest - least * (shares["train"] > 0)))
    bounds = zip(("valid", "test", "train", "calibration"), [*ends, rest], [*ends[1:], rest, len(names)], strict=True)
    return {split: [names[i] for i in sorted(order[start:end])] for split, start, end in bounds}


def _require_known(source: Path, names: list[str], lists: dict[str, list[str]]) -> None:
    seen: dict[str, str] = {}
    for split, members in lists.items():
        for name in members:
            if name not in names:
                raise DatasetError(f"{source}: there is no simulation {name!r} for {split}{nearest_name(name, names)}")
            if name in seen:
                raise DatasetError(f"{source}: {name!r} is listed for {seen[name]} and again for {split}")
            seen[name] = split
    if not seen:
        raise DatasetError(f"{source}: no simulation is listed for any split")
