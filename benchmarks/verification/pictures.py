"""Draws the pictures of the verification."""

from __future__ import annotations

from pathlib import Path

from benchmarks.svg import axes_of_picture, save
from benchmarks.verification.problem import Picture


def draw(picture: Picture, file: Path) -> None:
    """Write the picture to `file`, an SVG."""
    figure, axes = axes_of_picture(6.4, 4.2)
    for curve in picture.curves:
        axes.plot(curve.x, curve.y, curve.style, label=curve.label or None, markersize=4, linewidth=1.2)
    if picture.logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
    if picture.equal:
        axes.set_aspect("equal")
    axes.set(title=picture.title, xlabel=picture.x, ylabel=picture.y)
    save(figure, axes, file)
