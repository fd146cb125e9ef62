"""What CalculiX wrote: values at nodes (.frd), stresses and the force on the driven nodes (.dat), increments (.sta).

Numbers stand in columns of fixed width without blanks between them, so a line is cut by position. CalculiX also writes
a frame that did not converge ("best guess"). `read_results` keeps only the frames that converged according to the .sta
file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ast_sim.support.errors import SimulationError

# A line of the .frd file: the columns of the node and of its values. The line starts with " -1".
FRD_NUMBER = slice(3, 13)
FRD_VALUES = 13
FRD_WIDTH = 12
# A line of the .dat file likewise: an element, its integration point (not read) and its six stresses.
DAT_ROW = 99
DAT_NUMBER = slice(0, 10)
DAT_VALUES = 14
DAT_WIDTH = 14
# Blocks of the .frd file and how many values a node has in them: displacement, force from outside, plastic strain.
FRD_BLOCKS = {"DISP": 3, "FORC": 3, "PE": 1}
# CalculiX writes xx, yy, zz, xy, xz, yz. These columns of it are xx, yy, zz, xy, yz, zx.
STRESS_ORDER = [0, 1, 2, 3, 5, 4]
# Frame k is at time k. The files have few digits: within some hundred frames, times differ from k by at most this.
TIME_TOLERANCE = 3e-4


@dataclass(frozen=True)
class Results:
    """The converged frames 1 to S of a run.

    Attributes:
        displacement: [S,N,3] metres; 0 at nodes of no element.
        stress: [S,E,6] Cauchy stress in pascal: xx, yy, zz, xy, yz, zx; the mean over the integration points.
        reaction: [S,3] force in newton on the driven nodes.
        iterations: [S] iterations of each frame, also of repeated increments.
        cutbacks: [S] increments of each frame that were repeated with a shorter length.
        nodal_forces: [S,N,3] newton, the forces from outside on each node; None: they were not requested.
        plastic_strain: [S,N,1] equivalent plastic strain, extrapolated to the nodes; None: it was not requested.
    """

    displacement: np.ndarray
    stress: np.ndarray
    reaction: np.ndarray
    iterations: np.ndarray
    cutbacks: np.ndarray
    nodal_forces: np.ndarray | None = None
    plastic_strain: np.ndarray | None = None

    @classmethod
    def none(cls, nodes: int, elements: int, yields: bool) -> Results:
        """The results of a job without a frame."""
        frames = np.zeros((0, nodes, 3)), np.zeros((0, elements, 6)), np.zeros((0, 3))
        counts = np.zeros(0, int), np.zeros(0, int)
        return cls(*frames, *counts, *((frames[0], frames[0][:, :, :1]) if yields else ()))


def read_results(
    folder: Path, job: str, frames: int, nodes: int, elements: int, points: int = 1, yields: bool = False
) -> Results:
    """Read the output of `job` in `folder`: the converged ones among frames 1 to `frames`. Elements have `points`
    integration points. Nodal forces and plastic strains are read if a material `yields`.

    Raises:
        SimulationError: a file is missing, cut off or not as CalculiX 2.20 writes it.
    """
    iterations, cutbacks = read_increments(folder / f"{job}.sta")
    count = min(len(iterations), frames)
    wanted = FRD_BLOCKS if yields else {"DISP": 3}
    nodal = {name: [] for name in wanted}
    for name, time, values in read_nodal(folder / f"{job}.frd", nodes, wanted):
        nodal[name].append((time, values))
    nodal = {
        name: np.reshape(_by_frame(folder / f"{job}.frd", blocks, count), (count, nodes, wanted[name]))
        for name, blocks in nodal.items()
    }
    tables = {"stresses": [], "total force": []}
    for kind, time, values in read_tables(folder / f"{job}.dat", elements, points):
        tables[kind].append((time, values))
    stress = _by_frame(folder / f"{job}.dat", tables["stresses"], count)
    reaction = _by_frame(folder / f"{job}.dat", tables["total force"], count)
    return Results(
        displacement=nodal["DISP"],
        stress=np.reshape(stress, (count, elements, 6)),
        reaction=np.reshape(reaction, (count, 3)),
        iterations=np.array(iterations[:count], int),
        cutbacks=np.array(cutbacks[:count], int),
        nodal_forces=nodal.get("FORC"),
        plastic_strain=nodal.get("PE"),
    )


def read_increments(path: Path) -> tuple[list[int], list[int]]:
    """Iterations and cutbacks of each frame that was reached, from the .sta file.

    A line holds step, increment, attempt ("U" behind it if it diverged), iterations, total time, step time, increment.
    A frame is a step of one unit of time.
    """
    iterations, cutbacks = [], []
    spent, cut = 0, 0
    for line in _text(path).splitlines()[2:]:
        words = line.replace("U", " U ").split()
        diverged = "U" in words
        try:
            tried = int(words[3 + diverged])
            time = float(words[5 + diverged])
        except (IndexError, ValueError) as error:
            raise SimulationError(f"{path}: not a line of increments: {line.strip()!r}") from error
        spent, cut = spent + tried, cut + diverged
        if not diverged and time == 1:
            iterations.append(spent)
            cutbacks.append(cut)
            spent, cut = 0, 0
    return iterations, cutbacks


def read_nodal(path: Path, nodes: int, wanted: Mapping[str, int]) -> Iterator[tuple[str, float, np.ndarray]]:
    """Name, time and values [N,k] of each block of the .frd file whose name is wanted; k stands with the name."""
    text = _text(path)
    for block in re.finditer(r"^  100CL +\S+ +(\S+) +(\d+) .*\n -4  (\S+) .*\n(?: -5 .*\n)+", text, re.MULTILINE):
        if block[3] not in wanted:
            continue
        row = FRD_VALUES + FRD_WIDTH * wanted[block[3]] + 1  # with the end of the line
        number, values = _rows(path, text, block.end(), int(block[2]), row, FRD_NUMBER, FRD_VALUES, FRD_WIDTH)
        yield block[3], _numbers(path, np.array(block[1])).item(), _place(path, number, values, nodes)


def read_tables(path: Path, elements: int, points: int) -> Iterator[tuple[str, float, np.ndarray]]:
    """Kind ("stresses" [E,6] or "total force" [3]), time and values of each table of the .dat file."""
    text = _text(path)
    for head in re.finditer(r"^ (stresses|total force) .* and time +(\S+)\n\n", text, re.MULTILINE):
        if head[1] == "stresses":
            rows = elements * points
            number, values = _rows(path, text, head.end(), rows, DAT_ROW, DAT_NUMBER, DAT_VALUES, DAT_WIDTH)
            values = _place(path, number, values[:, STRESS_ORDER], elements) / points
        else:
            values = _numbers(path, np.array(text[head.end() :].split("\n", 1)[0].split()))
        yield head[1], _numbers(path, np.array(head[2])).item(), values


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise SimulationError(f"cannot read what CalculiX wrote: {path}: {error}") from error


def _rows(
    path: Path, text: str, start: int, count: int, row: int, number: slice, first: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [count] and values [count,k] of `count` lines of `row` characters each from `start`."""
    lines = np.array([text[start : start + count * row]], dtype=f"S{count * row}").view("S1")
    if len(lines) < count * row or (lines.reshape(count, row)[:, -1] != b"\n").any():
        raise SimulationError(f"{path} is cut off, or not as CalculiX 2.20 writes it, at character {start}")
    lines = lines.reshape(count, row)
    columns = np.ascontiguousarray(lines[:, first:-1]).view(f"S{width}")
    numbers = _numbers(path, np.ascontiguousarray(lines[:, number]).view(f"S{number.stop - number.start}").ravel())
    return numbers.astype(int) - 1, _numbers(path, columns)


def _numbers(path: Path, words: np.ndarray) -> np.ndarray:
    """Fortran's numbers as float64. Fortran leaves out the E before an exponent of three digits."""
    words = words.astype(str)
    try:
        return words.astype(np.float64)
    except ValueError:
        pass
    try:
        mended = [re.sub(r"(\d)([+-]\d{3})$", r"\1E\2", word.strip()) for word in words.ravel()]
        return np.array(mended, np.float64).reshape(words.shape)
    except ValueError as error:
        raise SimulationError(f"{path}: {error}") from error


def _place(path: Path, number: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """[count,k]: the sum of the rows of values [n,k] with each number [n]."""
    if len(number) and (number.min() < 0 or number.max() >= count):
        raise SimulationError(f"{path} holds the number {number.max() + 1}; the mesh has 1 to {count}")
    placed = np.zeros((count, values.shape[1]))
    np.add.at(placed, number, values)
    return placed


def _by_frame(path: Path, blocks: Iterable[tuple[float, np.ndarray]], count: int) -> list[np.ndarray]:
    """The first block at each of the times 1 to `count`."""
    frames: dict[int, np.ndarray] = {}
    for time, values in blocks:
        frame = round(time)
        if abs(time - frame) <= TIME_TOLERANCE:
            frames.setdefault(frame, values)
    missing = [frame for frame in range(1, count + 1) if frame not in frames]
    if missing:
        raise SimulationError(f"{path} holds nothing for frame {missing[0]}, which converged")
    return [frames[frame] for frame in range(1, count + 1)]
