"""Any frame in one jump: errors at the asked frame, the time of an answer, and the solver at its best.

`python -m benchmarks.studies.jumps [ROW ...]` generates the scenes of each row, trains its runs and measures them on
the test scenes, which no training has seen. It writes benchmarks/results/jumps.json and docs/results/jumps.md. Data and
runs lie in `--folder`; a second call goes on with what is there. Everything runs on one thread.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import ast_sim
from ast_sim.inference.asked_frame import asked_frames
from ast_sim.runs.metrics import Metrics
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.provenance import provenance

RESULTS = Path(__file__).parents[1] / "results" / "jumps.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "jumps.md"
MORE_CALLS = 3  # calls beyond those of the validated best that the page shows
SHOWN_WORST = 5


@dataclass(frozen=True)
class Row:
    """Scenes, and a training on them.

    Attributes:
        title: what the page calls it.
        family, nodes, frames, train, valid, test: of the dataset; its name is that of the first row with these scenes.
        data: name of the dataset's file.
        steps: of the training.
        model: settings of the model, beyond the preset `tiny`.
        settings: settings of the training.
        rivals: in so many test scenes the solver is run.
    """

    title: str
    family: str
    data: str
    nodes: int
    train: int
    valid: int
    test: int
    steps: int
    frames: int | None = None
    model: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    rivals: int = 10


_PLATES = {"family": "deforming_plate", "frames": 41, "train": 200, "valid": 20, "test": 50}
_PARTS = {"family": "abcd", "data": "parts400", "nodes": 400, "train": 1500, "valid": 60, "test": 60}
_SHORT = {"mirror": ("x", "y"), "peak_rate": 2e-3, "validate_scenes": 20}
_MIRRORED = {**_SHORT, "validate_every": 1500, "checkpoint_every": 1500}
_TURNED = {**_MIRRORED, "mirror": ("x", "y", "z"), "validate_scenes": 60, "validate_every": 2000}
ROWS = {
    "plates400_short": Row(
        "Plates, 400 nodes, 3,000 steps", data="plates400", nodes=400, steps=3_000, settings=_SHORT, **_PLATES
    ),
    "plates400": Row(
        "Plates, 400 nodes, 12,000 steps", data="plates400", nodes=400, steps=12_000, settings=_MIRRORED, **_PLATES
    ),
    "plates400_long": Row(
        "Plates, 400 nodes, 45,000 steps", data="plates400", nodes=400, steps=45_000, settings=_MIRRORED, **_PLATES
    ),
    "plates400_walk": Row(
        "Plates, 400 nodes, step by step, 12,000", data="plates400", nodes=400, steps=12_000, model={"jumps": False},
        settings={**_MIRRORED, "peak_rate": 1e-3}, rivals=0, **_PLATES,
    ),
    "plates1300": Row("Plates, 1,300 nodes", data="plates1300", nodes=1300, steps=9_000, settings=_MIRRORED, **_PLATES),
    "parts400": Row("Pairs of parts, 400 nodes", steps=14_000, settings=_TURNED, rivals=5, **_PARTS),
}  # fmt: skip


def measured(row: Row, folder: Path) -> dict[str, Any]:
    """Generate, train and measure a row; what is there already is not made again."""
    data = ast_sim.generate(
        row.family, folder / f"{row.data}.h5", train=row.train, valid=row.valid, test=row.test, nodes=row.nodes,
        frames=row.frames, workers=1,
    ).path  # fmt: skip
    run = ast_sim.train(
        data, folder / f"run_{row.data}_{row.steps}{'_walk' if row.model else ''}", steps=row.steps, resume=True,
        model_settings=row.model, **row.settings,
    )  # fmt: skip
    with run.open(data) as dataset:
        found = asked_frames(run.model, dataset, "test", run.corrections, row.rivals)
        more = found["by_calls"]
        if run.settings.model.jumps:
            more = asked_frames(run.model, dataset, "test", run.corrections + MORE_CALLS)["by_calls"]
        known = asked_frames(run.model, dataset, "train", run.corrections)["relative_error"]
    seconds = [record["seconds"] for record in Metrics(run.path) if "loss" in record]
    return {
        **provenance(f"python -m benchmarks.studies.jumps {row.data}"),
        "row": asdict(row),
        "minutes": float(np.median(seconds)) * row.steps / 60,
        "corrections": run.corrections,
        "more_calls": more,
        "training_scenes": known,
        **found,
    }


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = {name: results[name] for name in ROWS if name in results}
    return "\n".join([_INTRODUCTION, *_table(shown), *(line for found in shown.values() for line in _section(found))])


_INTRODUCTION = """# Any frame in one jump

Made by `python -m benchmarks.studies.jumps` from `benchmarks/results/jumps.json`; do not edit.

The asked frame is the one in which a scene is deformed most. Its relative error is the root mean square of the error
over that of the displacement, on the free nodes; the table has the mean over the test scenes and its standard error.
"Training scenes" is the same on scenes of the training. "Minutes" are the steps times the median time of a step, on
one thread, beside other work. "Answer" is the time from the question to positions and stress, for a scene alone.

The solver goes straight from rest to the same frame, on one thread, in the number of load steps (1 or 2) that takes
least, at its own stop test; "cheapest" is the fastest of nine ways (looser stop tests, a longer range of contact,
meshes of a half and a quarter of the nodes) whose error is at most the model's, where there is one. "Times as
long" is the solver's time over that of the answers, in the same scenes.
"""


def _table(shown: dict[str, Any]) -> list[str]:
    head = ["scenes", "trained", "minutes", "corrections", "error", "training scenes", "answer", "solver", "cheapest"]
    lines = ["| " + " | ".join(head) + " |", "| --- | --- |" + " ---: |" * (len(head) - 2)]
    for found in shown.values():
        row, solver = found["row"], found["solver"]
        errors = [scene["relative_error"] for scene in found["scenes"] if scene["relative_error"] is not None]
        lines.append("| " + " | ".join([
            row["title"],
            f"{row['train']:,} scenes, {row['steps']:,} steps",
            f"{found['minutes']:.0f}",
            f"{found['corrections']}",
            f"{100 * np.mean(errors):.1f} ± {100 * np.std(errors) / len(errors) ** 0.5:.1f} %",
            f"{100 * found['training_scenes']:.1f} %",
            f"{1000 * found['seconds']:.0f} ms",
            "-" if solver is None else f"{1000 * solver['seconds']:.0f} ms, {solver['ratio']:.1f} times as long",
            "-" if solver is None or not solver["cheapest_scenes"]
            else f"{1000 * solver['cheapest_seconds']:.0f} ms, {solver['cheapest_ratio']:.1f} times as long",
        ]) + " |")  # fmt: skip
    return lines


def _section(found: dict[str, Any]) -> list[str]:
    after = ", ".join(f"{100 * error:.1f}" for error in found["more_calls"])
    ranked = sorted((s for s in found["scenes"] if s["relative_error"] is not None), key=lambda s: -s["relative_error"])
    errors = [100 * scene["relative_error"] for scene in ranked]
    worst = ", ".join(f"{scene['name']} {100 * scene['relative_error']:.0f} %" for scene in ranked[:SHOWN_WORST])
    lines = ["", f"## {found['row']['title']}", ""]
    if after:
        lines.append(f"Error after each call: {after} %.")
    lines.append(
        f"Over the scenes: a tenth below {np.quantile(errors, 0.1):.1f} %, the median {np.median(errors):.1f} %, a"
        f" tenth above {np.quantile(errors, 0.9):.1f} %. Worst: {worst}."
    )
    if found["stress_share"] is not None:
        lines.append(
            f"Stress: {found['stress_share']:.2f} of the error of the frame's true mean; the largest stress is"
            f" {100 * found['largest_stress']:.0f} % off."
        )
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)} (default: all)")
    parser.add_argument("--folder", type=Path, default=Path("build/jumps"), help="data and runs (default: build/jumps)")
    asked = parser.parse_args(arguments)
    unknown = set(asked.rows) - set(ROWS)
    if unknown:
        parser.error(f"there is no row {', '.join(sorted(unknown))}")
    import torch  # after ast_sim, which says how its threads wait

    torch.set_num_threads(1)
    os.environ["OMP_NUM_THREADS"] = "1"  # of the generator's and the solver's processes
    ast_sim.keep_memory()
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    for name in asked.rows or ROWS:
        results[name] = measured(ROWS[name], asked.folder)
        write_json(RESULTS, results)
        write_text(PAGE, page(results) + "\n")
        print(f"{name}: {100 * results[name]['relative_error']:.3g} %", flush=True)


if __name__ == "__main__":
    main()
