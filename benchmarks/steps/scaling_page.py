"""Writes the section of docs/results/study.md on mesh size, from the file of `python -m benchmarks.steps.scaling`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ast_sim.view.tables import TITLES
from benchmarks.svg import axes_of_picture, save

Record = dict[str, Any]


def section(results: dict[str, Any]) -> str:
    """What was measured, a table of times and one of memory, and why models were given up."""
    threads, limit = results["threads"], results["memory_limit_bytes"] / 1e9
    records = results["records"]
    lines = ["## By the size of the mesh", ""]
    lines += [
        "A training step on one scene of two blocks of tetrahedra, models as the AST paper has them (Transolver as its"
        f" authors do), {threads} threads, at most {limit:.0f} GB; commit {(results['commit'] or '?')[:10]},"
        f" {results['processor']}.",
        "",
        "Seconds a training step (the least of three):",
        "",
        *_table(records, lambda record: record["seconds"]["min"]),
        "",
        "Peak memory of the process, GB:",
        "",
        *_table(records, lambda record: record["peak_resident_bytes"] / 1e9),
        "",
    ]
    failed = [record for record in records if "failed" in record]
    lines += [f"- {TITLES[one['model']]} at {one['nodes']:,} nodes: {_reason(one['failed'])}" for one in failed]
    return "\n".join([*lines, *([""] if failed else []), "![Time and memory by size](study/scaling.svg)", ""])


def _reason(failed: str) -> str:
    return "out of memory" if "can't allocate memory" in failed else failed


def _table(records: list[Record], value: Callable[[Record], float]) -> list[str]:
    """A row a size, a column a model: the value, "failed", or nothing where a model was no longer tried."""
    models = list(dict.fromkeys(record["model"] for record in records))
    lines = [f"| nodes | {' | '.join(TITLES[model] for model in models)} |", f"| ---: |{' ---: |' * len(models)}"]
    for nodes in dict.fromkeys(record["nodes"] for record in records):
        of_size = {record["model"]: record for record in records if record["nodes"] == nodes}
        cells = [_cell(of_size.get(model), value) for model in models]
        lines.append(f"| {nodes:,} | {' | '.join(cells)} |")
    return lines


def _cell(record: Record | None, value: Callable[[Record], float]) -> str:
    if record is None:
        return ""
    return "failed" if "failed" in record else f"{value(record):.3g}"


def draw(results: dict[str, Any], file: Path) -> None:
    """Seconds and gigabytes over nodes, both axes logarithmic, a line a model; memory is dashed."""
    figure, axes = axes_of_picture(7.2, 4.4)
    beside = axes.twinx()
    for number, (model, title) in enumerate(TITLES.items()):
        records = [record for record in results["records"] if record["model"] == model and "failed" not in record]
        nodes = [record["nodes"] for record in records]
        axes.plot(nodes, [record["seconds"]["min"] for record in records], "o-", color=f"C{number}", label=title)
        beside.plot(nodes, [record["peak_resident_bytes"] / 1e9 for record in records], ".--", color=f"C{number}")
    axes.set(xlabel="nodes", ylabel="seconds a training step", xscale="log", yscale="log")
    beside.set(ylabel="peak memory, GB (dashed)", yscale="log")
    save(figure, axes, file)
