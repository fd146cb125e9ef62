"""What is written into a file of a simulation: its points and cells in the order of the file, and its defects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.robustness.dialects.random_simulation import Simulation

# Which two nodes change places so that a cell is inside out: two corners, and the nodes in the middle of their edges.
_TURNED = {"tetra": [0, 1, 3, 2], "tetra10": [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]}


@dataclass(frozen=True)
class FileContent:
    """Points and cells of a file.

    Attributes:
        points: [m, 3].
        blocks: (body, kind, [c, k] points) for each block.
        point_of: [m] the point of the simulation that each point is, -1 for none.
    """

    points: np.ndarray
    blocks: list[tuple[int, str, np.ndarray]]
    point_of: np.ndarray

    def values(self, of_simulation: np.ndarray) -> np.ndarray:
        """Values at the points of the simulation [n, ...], at the points of the file [m, ...]; 0 at points of none."""
        there = (self.point_of >= 0).reshape(-1, *[1] * (of_simulation.ndim - 1))
        return np.where(there, of_simulation[self.point_of], 0)

    def in_order(self, rng: np.random.Generator) -> FileContent:
        """The same with the cells of each block in another order."""

        def reordered(cells: np.ndarray) -> np.ndarray:
            other = cells[rng.permutation(len(cells))]
            return other if (other != cells).any() else np.roll(cells, 1, axis=0)

        return replace(self, blocks=[(body, kind, reordered(cells)) for body, kind, cells in self.blocks])

    def part(self, rows: list[np.ndarray]) -> FileContent:
        """Some cells of each block, with copies of their points."""
        chosen = [(body, kind, cells[r]) for (body, kind, cells), r in zip(self.blocks, rows, strict=True) if len(r)]
        used = np.unique(np.concatenate([cells.ravel() for _, _, cells in chosen]))
        blocks = [(body, kind, np.searchsorted(used, cells)) for body, kind, cells in chosen]
        return FileContent(self.points[used], blocks, self.point_of[used])


def content_of(rng: np.random.Generator, simulation: Simulation) -> FileContent:
    """What a file of the simulation holds: points in a random order, and the defects."""
    defects = simulation.defects
    points, blocks = simulation.points, simulation.blocks
    if "inside out" in defects:
        blocks = [(body, kind, _turned(rng, kind, cells)) for body, kind, cells in blocks]
    if "twice" in defects:
        blocks = [(b, k, np.concatenate([c, c[rng.integers(0, len(c), 1 + len(c) // 4)]])) for b, k, c in blocks]
    point_of = np.arange(len(points))
    if "unused" in defects:
        point_of = np.concatenate([point_of, np.full(int(rng.integers(1, 6)), -1)])
    if "unstitched" in defects:
        defects.discard("unused")
        point_of = np.concatenate([cells.ravel() for _, _, cells in blocks])
        ends = np.cumsum([0, *(cells.size for _, _, cells in blocks)])
        blocks = [
            (b, k, np.arange(start, start + c.size).reshape(c.shape))
            for (b, k, c), start in zip(blocks, ends, strict=False)
        ]
    order = rng.permutation(len(point_of)) if rng.random() < 0.7 else np.arange(len(point_of))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    point_of = point_of[order]
    lost = points.max(axis=0) + simulation.size * (1 + rng.random(3))
    written = np.where(point_of[:, None] >= 0, points[point_of], lost)
    return FileContent(written, [(body, kind, place[cells]) for body, kind, cells in blocks], point_of)


def cut_into_pieces(rng: np.random.Generator, content: FileContent, by_body: bool) -> list[list[np.ndarray]]:
    """The rows of each block that each of several pieces holds: a piece for each body, or slabs along x."""
    if by_body:
        bodies = sorted({body for body, _, _ in content.blocks})
        return [
            [np.arange(len(cells)) if owner == body else np.zeros(0, int) for owner, _, cells in content.blocks]
            for body in bodies
        ]
    pieces = int(rng.integers(2, 4))
    x = content.points[:, 0]
    edges = np.quantile(x, np.linspace(0, 1, pieces + 1)[1:-1])
    owner = [np.searchsorted(edges, x[cells].mean(axis=1)) for _, _, cells in content.blocks]
    rows = [[np.flatnonzero(one == piece) for one in owner] for piece in range(pieces)]
    return [one for one in rows if any(len(chosen) for chosen in one)]


def _turned(rng: np.random.Generator, kind: str, cells: np.ndarray) -> np.ndarray:
    if kind not in _TURNED:
        return cells
    wrong = rng.random(len(cells)) < 0.5
    wrong[0] |= not wrong.any()
    cells = cells.copy()
    cells[wrong] = cells[wrong][:, _TURNED[kind]]
    return cells
