"""Draws the pictures of the verification as SVG, the same bytes for the same figures."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "ast_sim"

from matplotlib import pyplot  # noqa: E402 (the backend has to be chosen before)

from benchmarks.verification_problem import Picture  # noqa: E402


def draw(picture: Picture, file: Path) -> None:
    """Write the picture to `file`, an SVG."""
    figure, axes = pyplot.subplots(figsize=(6.4, 4.2), layout="constrained")
    for curve in picture.curves:
        axes.plot(curve.x, curve.y, curve.style, label=curve.label or None, markersize=4, linewidth=1.2)
    if picture.logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
    if picture.equal:
        axes.set_aspect("equal")
    axes.set(title=picture.title, xlabel=picture.x, ylabel=picture.y)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, metadata={"Date": None})
    pyplot.close(figure)
