"""A still picture of scenes before they are solved: the bodies at rest, what stands still, what moves and where to."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ast_sim.scene import Scene, Trajectory
from ast_sim.support.disk import replacing
from ast_sim.support.errors import require
from ast_sim.view.files import explained
from ast_sim.view.picture import INK, MESH_COLOR, View, shade

COLUMNS = 2
BODY_COLORS = ("#4c8bc9", "#e0a03c", "#5aa876", "#b07cc6", "#c96a5a", "#7f8c99")
GHOST = (0.85, 0.2, 0.15, 0.10)  # where a moving body goes
STILL, MOVING = "#16202c", "#d5301f"
ARROWS = 12  # of a scene


def write(
    path: str | os.PathLike[str], shown: Sequence[tuple[Scene, np.ndarray]], titles: Sequence[str], unit: str
) -> None:
    """Write a PNG with a panel for each scene of tetrahedra.

    Args:
        path: the file.
        shown: scenes with the positions [N,3] of their prescribed nodes in the last frame; other rows are not read.
        titles: a line above each panel.
        unit: unit of length, for the scale.

    Raises:
        AstSimError: the file cannot be written.
        MissingExtra: matplotlib is not installed.
    """
    path = Path(path)
    figures, agg = require("view", "matplotlib.figure", "matplotlib.backends.backend_agg")
    rows = -(-len(shown) // COLUMNS)
    figure = figures.Figure(figsize=(5.5 * COLUMNS, 4.6 * rows), facecolor="white")
    agg.FigureCanvasAgg(figure)
    for number, ((scene, last), title) in enumerate(zip(shown, titles, strict=True)):
        axes = figure.add_subplot(rows, COLUMNS, number + 1)
        _draw(axes, scene, np.where(scene.prescribed[:, None], last, scene.rest_position))
        size = np.ptp(scene.rest_position, axis=0)
        wrapped = title.replace(", ", ",\n", 1) if len(title) > 60 else title
        told = f"{wrapped}\n{size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} {unit}"
        axes.set_title(told, fontsize=8, color=INK, parse_math=False)  # names of parts may hold any character
    figure.text(0.5, 0.01, "black: stands still    red: moves, and where to", ha="center", fontsize=9, color=INK)
    figure.subplots_adjust(0.01, 0.05, 0.99, 0.92, 0.03, 0.18)
    with explained(path), replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def _draw(axes, scene: Scene, last: np.ndarray) -> None:
    """The surfaces from far to near, then the prescribed nodes, then arrows along their paths."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgb

    rest = scene.rest_position.astype(float)
    view = View(Trajectory(scene, np.stack([rest, last]).astype(np.float32)))
    moved = np.linalg.norm(last - rest, axis=1) > 1e-9 * view.size
    ghosts = view.triangles[moved[view.triangles].all(axis=1)]
    corners = np.concatenate([rest[view.triangles], last[ghosts]])
    body = scene.body[view.triangles[:, 0]]
    solid = np.array([to_rgb(BODY_COLORS[number % len(BODY_COLORS)]) for number in body])
    colors = np.column_stack([solid * shade(rest[view.triangles])[:, None], np.full(len(body), 0.75)])
    colors = np.concatenate([colors, np.tile(GHOST, (len(ghosts), 1))])
    edges = np.concatenate([np.tile(MESH_COLOR, (len(body), 1)), np.tile((*GHOST[:3], 0.25), (len(ghosts), 1))])
    flat, distance = view.project(corners)
    order = np.argsort(-distance.mean(axis=1), kind="stable")
    axes.add_collection(
        PolyCollection(list(flat[order]), facecolors=colors[order], edgecolors=edges[order], linewidths=0.3)
    )
    still = scene.prescribed & ~moved
    for nodes, color in ((still, STILL), (scene.prescribed & moved, MOVING)):
        dots, _ = view.project(rest[nodes])
        axes.plot(dots[:, 0], dots[:, 1], ".", color=color, markersize=1.5)
    driven = np.flatnonzero(moved & scene.prescribed)
    for node in driven[:: max(1, len(driven) // ARROWS)]:
        (start, end), _ = view.project(np.stack([rest[node], last[node]]))
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": MOVING, "lw": 0.9})
    every, _ = view.project(corners.reshape(-1, 3))
    low, high = every.min(axis=0), every.max(axis=0)
    reach = 0.03 * (high - low).max()
    axes.set_xlim(low[0] - reach, high[0] + reach)
    axes.set_ylim(low[1] - reach, high[1] + reach)
    axes.set_aspect("equal")
    axes.axis("off")
