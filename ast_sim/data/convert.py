"""A dataset from the results of other programs."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from ast_sim.data.domain import Domain
from ast_sim.data.file import DatasetWriter
from ast_sim.data.layout import SPLITS, DatasetInfo
from ast_sim.data.series import FieldNames, natural_order, read_series
from ast_sim.errors import DatasetError

SHARES = {"train": 0.8, "valid": 0.1, "test": 0.1}

Splits = Mapping[str, float] | Mapping[str, Sequence[str]]


def convert(
    source: Path | str,
    out: Path | str,
    *,
    names: FieldNames | None = None,
    splits: Splits | None = None,
    seed: int = 0,
    integration: str = "quasi_static",
    contact_radius: float = 0.0,
    time_step: float = 0.0,
    length_unit: str = "m",
    progress: Callable[[str], None] = lambda line: None,
) -> dict[str, int]:
    """Import simulations as a dataset file.

    Args:
        source: a `.pvd` file or a folder of `.vtu` files is one simulation; a folder of `.pvd` files, or of folders of
            either kind, is one simulation each, named by its path within the source without the suffix.
        out: the dataset file; it appears whole or not at all.
        names: what the fields are called, if not as in `FieldNames`.
        splits: for each of "train", "valid", "test" the names of its simulations (others are left out), or its share
            of all (the shares add up to 1), which are then drawn at random by `seed`; by default 0.8, 0.1, 0.1.
        integration, contact_radius, time_step, length_unit: as in `DatasetInfo`.
        progress: is told each simulation that was imported.

    Returns:
        The number of trajectories in each split.

    Raises:
        DatasetError: naming the file and what is wrong or missing in it; nothing is written then.
    """
    source, names = Path(source), names or FieldNames()
    found = find_series(source)
    chosen = _assign(source, list(found), SHARES if splits is None else splits, seed)
    info = DatasetInfo(
        family=source.stem,
        integration=integration,
        stress_location="none",
        domain_center=(0.0, 0.0, 0.0),
        domain_half_width=1.0,
        contact_radius=contact_radius,
        time_step=time_step,
        length_unit=length_unit,
        generator={"program": "ast_sim convert", "source": str(source), "names": asdict(names), "seed": seed},
    )
    domain = Domain()
    with DatasetWriter(out, info) as writer:
        for index, (split, name) in enumerate(chosen):
            trajectory, place = read_series(found[name], names)
            if index == 0:
                writer.info = replace(info, stress_location=place)
            writer.add(split, trajectory)
            domain.add(trajectory.position)
            progress(f"{split}: {name}, {trajectory.num_frames} frames of {trajectory.scene.num_nodes} nodes")
        writer.info = replace(writer.info, domain_center=domain.center, domain_half_width=domain.half_width)
    return {split: sum(s == split for s, _ in chosen) for split in SPLITS}


def find_series(source: Path) -> dict[str, Path]:
    """The simulations in a source by name, in natural order.

    Raises:
        DatasetError: there is none.
    """
    if not source.is_dir():
        return {source.stem: source}
    found = {
        path.relative_to(source).with_suffix("").as_posix() if path != source else source.name: path
        for path in _series_in(source)
    }
    if not found:
        raise DatasetError(f"{source}: neither it nor a folder in it holds .pvd or .vtu files, nor it .tfrecord files")
    return found


def _series_in(folder: Path) -> Iterator[Path]:
    """Collections before single files: a folder with a .pvd file keeps the .vtu files of it, often in folders."""
    entries = sorted(folder.iterdir(), key=natural_order)
    collections = [entry for entry in entries if entry.suffix == ".pvd"]
    if collections:
        yield from collections
    elif any(entry.suffix == ".vtu" for entry in entries):
        yield folder
    else:
        for entry in entries:
            if entry.is_dir() and not entry.name.startswith("."):
                yield from _series_in(entry)


def _assign(source: Path, names: list[str], splits: Splits, seed: int) -> list[tuple[str, str]]:
    """(split, name) of every simulation that is imported, split by split."""
    unknown = next((split for split in splits if split not in SPLITS), None)
    if unknown is not None:
        raise DatasetError(f"there is no split {unknown!r}; use {', '.join(SPLITS)}")
    if all(isinstance(share, (int, float)) for share in splits.values()):
        lists = _draw(names, {split: float(splits.get(split, 0.0)) for split in SPLITS}, seed)
    else:
        lists = {split: list(splits.get(split, [])) for split in SPLITS}
        _require_known(source, names, lists)
    return [(split, name) for split in SPLITS for name in lists[split]]


def _draw(names: list[str], shares: dict[str, float], seed: int) -> dict[str, list[str]]:
    """Shares of the names at random, each in the order of the names; halves are rounded in favour of training."""
    if min(shares.values()) < 0 or abs(sum(shares.values()) - 1) > 1e-6:
        raise DatasetError(f"the shares of the splits must be at least 0 and add up to 1, not {shares}")
    order = np.random.default_rng(seed).permutation(len(names))
    drawn, start, share = {}, 0, 0.0
    for split in ("valid", "test", "train"):
        share += shares[split]
        end = int(len(names) * share + 0.5 - 1e-9) if split != "train" else len(names)
        drawn[split] = [names[i] for i in sorted(order[start:end])]
        start = end
    return drawn


def _require_known(source: Path, names: list[str], lists: dict[str, list[str]]) -> None:
    seen: dict[str, str] = {}
    for split, members in lists.items():
        for name in members:
            if name not in names:
                nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)[0]
                raise DatasetError(f"{source}: there is no simulation {name!r} for {split}; the nearest is {nearest!r}")
            if name in seen:
                raise DatasetError(f"{source}: {name!r} is listed for {seen[name]} and again for {split}")
            seen[name] = split
    if not seen:
        raise DatasetError(f"{source}: no simulation is listed for any split")
