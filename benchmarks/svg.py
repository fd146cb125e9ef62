"""Pictures as SVG. The same figures give the same bytes."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "ast_sim"

from matplotlib import pyplot  # noqa: E402 (the backend has to be chosen before)
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402


def axes_of_picture(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of these sizes in inches and its axes."""
    return pyplot.subplots(figsize=(width, height), layout="constrained")


def save(figure: Figure, axes: Axes, file: Path) -> None:
    """Finish the picture with a grid and a legend and write it."""
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, metadata={"Date": None})
    pyplot.close(figure)
