"""A still picture: truth and prediction of one scene at the frame of largest displacement.

This module projects and sorts triangles, and matplotlib's Agg draws them. VTK would shade better, but to draw without a
window its wheels need the system's EGL or Mesa libraries, which a bare server lacks.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ast_sim.element_topology import unit_normals
from ast_sim.scene import Trajectory
from ast_sim.scene_summary import EYE, LIGHT
from ast_sim.support.disk import replacing
from ast_sim.support.errors import AstSimError, printable, require
from ast_sim.view.encode import finite_frames
from ast_sim.view.fields import is_planar, require_same_scene, surface_owners
from ast_sim.view.files import explained
from ast_sim.view.tables import TITLES

OBSTACLE_COLOR = (0.47, 0.51, 0.56, 0.38)
MESH_COLOR = (0.05, 0.08, 0.12, 0.5)
INK = "#16202c"
PARTS = 4  # each side of a triangle is cut into this many, so that colours change within it
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))
PREFIXED = {"m": PREFIXES, "Pa": PREFIXES[:4]}  # other units ("mm", "in") are shown as they are


def write(
    path: str | os.PathLike[str], truth: Trajectory, prediction: Trajectory, model: str, length_unit: str = "m"
) -> None:
    """Write a PNG of the truth beside the prediction, coloured by von Mises stress (Pa) or else by displacement.

    `model` is the name under which the model is registered, such as "ast"; the picture names it.

    The picture shows the frame where the truth moves farthest, among the frames that the prediction has. Both sides
    share the colour scale. It ends where 1 % of the truth's triangles lie above it.

    Raises:
        AstSimError: the prediction is of another scene or has no frame, or the file cannot be written.
        MissingExtra: matplotlib is not installed.
    """
    path = Path(path)
    require_same_scene(truth.scene, prediction.scene)
    frames = finite_frames(prediction)
    if frames == 0:
        raise AstSimError("the prediction has no frame that could be drawn")
    truth = truth.select(prediction.numbers)
    frame = farthest(truth.select(truth.numbers[:frames]))
    figure = _figure(truth, prediction, frame, model, length_unit)
    with explained(path), replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=144)


def plot(trajectory: Trajectory, row: int, title: str, length_unit: str = "m"):
    """A matplotlib figure of one frame, the one in this row of the positions, coloured as in `write`.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    return _panels([trajectory], [title], row, length_unit)


def farthest(trajectory: Trajectory) -> int:
    """The row of the frame in which a deforming node is farthest from its place at rest."""
    moved = np.linalg.norm(trajectory.position - trajectory.scene.rest_position, axis=2)
    return int(moved[:, trajectory.scene.deforming_nodes].max(axis=1, initial=0.0).argmax())


def _figure(truth: Trajectory, prediction: Trajectory, frame: int, model: str, length_unit: str):
    names = ["Truth (finite elements)", f"Prediction ({TITLES.get(model, model)})"]
    return _panels([truth, prediction], names, frame, length_unit)


def _panels(sides: Sequence[Trajectory], names: Sequence[str], row: int, length_unit: str):
    """The sides beside one another, on the colour scale of the first, which is seen whole."""
    figures, agg, cm, colors = require(
        "view", "matplotlib.figure", "matplotlib.backends.backend_agg", "matplotlib.cm", "matplotlib.colors"
    )
    width = 1 / len(sides)
    figure = figures.Figure(figsize=(5 * len(sides), 4), facecolor="white")
    agg.FigureCanvasAgg(figure)
    first = sides[0]
    by_stress = first.stress is not None and all(side.stress_at == first.stress_at for side in sides)
    label, unit = ("von Mises stress", "Pa") if by_stress else ("Displacement", length_unit)
    values = [_corner_values(side, row, side.stress if by_stress else None) for side in sides]
    view = View(first)
    body = values[0][~view.obstacle]
    upper = float(np.quantile(body, 0.99)) if body.size else 0.0
    upper = upper or float(values[0].max(initial=0.0)) or 1.0
    prefixes = PREFIXED.get(unit, ((1.0, ""),))
    scale, prefix = next(((s, p) for s, p in prefixes if upper >= s), prefixes[-1])
    color_map = cm.ScalarMappable(colors.Normalize(0, upper / scale), "plasma" if by_stress else "viridis")
    for column, (side, name) in enumerate(zip(sides, names, strict=True)):
        axes = figure.add_axes((width * (column + 0.02), 0.18, 0.96 * width, 0.73))
        _draw(axes, view, side.position[row], color_map, values[column] / scale)
        title = figure.text(width * (column + 0.5), 0.93, printable(name), fontsize=12.5, fontweight="bold", color=INK)
        title.set(ha="center", parse_math=False)  # a name may hold any character
    place = figure.add_axes((0.5 - 0.4 * width, 0.125, 0.8 * width, 0.028))
    bar = figure.colorbar(color_map, cax=place, orientation="horizontal", extend="max")
    bar.set_label(f"{label} ({prefix}{unit}), frame {first.numbers[row]}", color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=INK, length=2)
    return figure


class View:
    """A perspective camera on a scene, fitted to the box of the deforming bodies. Truth and prediction share it."""

    def __init__(self, truth: Trajectory) -> None:
        low, high = truth.position.min(axis=(0, 1)).astype(float), truth.position.max(axis=(0, 1)).astype(float)
        self.center = (low + high) / 2
        self.size = max(float(np.linalg.norm(high - low)), 1e-9)
        self.planar = is_planar(truth.scene)
        self.closed = truth.scene.elements.shape[1] != 3
        self.triangles = truth.scene.surface()
        self.obstacle = ~truth.scene.deforming_elements[surface_owners(truth.scene, self.triangles)]
        forward = np.array([0.0, 0.0, -1.0]) if self.planar else -EYE / np.linalg.norm(EYE)
        up = np.array([0.0, 1.0, 0.0]) if self.planar else np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(right, forward), forward])

    def project(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Picture coordinates [..., 2] and distance from the eye [...] of points [..., 3]."""
        local = (position - self.center) / self.size @ self.axes.T
        distance = local[..., 2] + (1e3 if self.planar else 2 * np.linalg.norm(EYE))
        return local[..., :2] / distance[..., None], distance


def _corner_values(trajectory: Trajectory, frame: int, stress: np.ndarray | None) -> np.ndarray:
    """[F, 3]: the stress at the corners of the surface triangles; without a stress, the displacement."""
    scene = trajectory.scene
    surface = scene.surface()
    if stress is None:
        return np.linalg.norm(trajectory.position[frame] - scene.rest_position, axis=1)[surface]
    values = stress[frame, :, 0]
    if trajectory.stress_at == "node":
        return values[surface]
    return np.repeat(values[surface_owners(scene, surface), None], 3, axis=1)


def _draw(axes, view: View, position: np.ndarray, color_map, values: np.ndarray) -> None:
    """Draw the triangles that face the eye, from far to near; each as small triangles with its edges on top."""
    from matplotlib.collections import PolyCollection

    corners = position[view.triangles].astype(float)
    flat, distance = view.project(corners)
    side = flat[:, 1:] - flat[:, :1]
    facing = side[:, 0, 0] * side[:, 1, 1] - side[:, 0, 1] * side[:, 1, 0] > 0
    shown = facing if view.closed else np.ones(len(facing), dtype=bool)
    shading = shade(corners)
    weights = _subdivision()
    polygons, faces, edges = [], [], []
    for triangle in sorted(np.flatnonzero(shown), key=lambda t: -distance[t].mean()):
        if view.obstacle[triangle]:
            polygons.append(flat[triangle])
            faces.append(OBSTACLE_COLOR)
            edges.append((0, 0, 0, 0))
            continue
        color = color_map.to_rgba((weights @ values[triangle]).mean(axis=1))
        color[:, :3] *= shading[triangle]
        polygons += [*(weights @ flat[triangle]), flat[triangle]]
        faces += [*color, (0, 0, 0, 0)]
        edges += [*color, MESH_COLOR]
    axes.add_collection(PolyCollection(polygons, facecolors=faces, edgecolors=edges, linewidths=0.4))
    every, _ = view.project(position)
    low, high = every.min(axis=0), every.max(axis=0)
    middle, reach = (low + high) / 2, 0.53 * (high - low)
    axes.set_xlim(middle[0] - reach[0], middle[0] + reach[0])
    axes.set_ylim(middle[1] - reach[1], middle[1] + reach[1])
    axes.set_aspect("equal")
    axes.axis("off")


def shade(corners: np.ndarray) -> np.ndarray:
    """[F]: Lambert's law with so much ambient light that colours can still be compared with the scale."""
    return 0.74 + 0.26 * np.minimum(np.abs(unit_normals(corners) @ LIGHT), 1)


def _subdivision() -> np.ndarray:
    """[PARTS^2, 3, 3]: the barycentric coordinates of the corners of the small triangles within a triangle."""
    grid = {(i, j): np.array([PARTS - i - j, i, j]) / PARTS for i in range(PARTS + 1) for j in range(PARTS + 1 - i)}
    small = []
    for i, j in grid:
        if (i + 1, j) in grid and (i, j + 1) in grid:
            small.append([grid[i, j], grid[i + 1, j], grid[i, j + 1]])
        if (i + 1, j + 1) in grid:
            small.append([grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]])
    return np.array(small)
