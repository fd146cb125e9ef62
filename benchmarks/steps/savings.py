"""What is not computed unless a question requires it, and what it would take: one table, each line measured.

`python -m benchmarks.steps.savings [--repeats N]` asks the run of plates that comes with the package for a new plate of
400 nodes, with and without each piece of work, in turns, on one thread. It writes benchmarks/results/savings.json and
docs/results/savings.md. Times are processor time, which other work on the machine disturbs less.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.provenance import provenance
from benchmarks.steps import predictions
from benchmarks.steps.before_after import median_ratio

RESULTS = Path(__file__).parents[1] / "results" / "savings.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "savings.md"
PLATES = {**predictions.PLATES, "nodes": 400}
TRAVELS = tuple(-0.002 * (number + 1) for number in range(20))  # metres, of as many questions about one plate
CALL, NEWTON, EXACT = ast_sim.Effort(), ast_sim.Effort(newton_steps=1), ast_sim.Effort.exact()
Answers = ast_sim.Answer | list[ast_sim.Answer]


@dataclass(frozen=True)
class Saving:
    """Two ways to answer, of which the first computes more.

    Attributes:
        text: what the second does without.
        more, less: each answers once.
    """

    text: str
    more: Callable[[], Answers]
    less: Callable[[], Answers]


def savings(run: ast_sim.Run, scene: ast_sim.Scene) -> list[Saving]:
    """All that is left out, by what a question requires."""

    def answer(effort: ast_sim.Effort, frames: list[int] | None = None) -> Callable[[], Answers]:
        motion = {1: (0, 0, -0.02)}
        return lambda: run.predict(scene, motion, num_frames=41, frames=frames, effort=effort, progress=False)

    def each(effort: ast_sim.Effort, alone: bool) -> Callable[[], list[ast_sim.Answer]]:
        motions = [{1: (0, 0, travel)} for travel in TRAVELS]
        if alone:
            return lambda: [
                run.predict(copy.copy(scene), one, frames=[-1], effort=effort, progress=False) for one in motions
            ]
        return lambda: run.predict_motions(scene, motions, frames=[-1], effort=effort, progress=False)

    many = f"{len(TRAVELS)} questions about one mesh"
    return [
        Saving("frames that are not wanted: 39 of 40, by one call", answer(CALL), answer(CALL, [-1])),
        Saving("the same, with a Newton step each", answer(NEWTON), answer(NEWTON, [-1])),
        Saving("a Newton step and all that it needs: one call instead", answer(NEWTON, [-1]), answer(CALL, [-1])),
        Saving("the solver's own stop test: one Newton step instead", answer(EXACT, [-1]), answer(NEWTON, [-1])),
        Saving(f"{many} as if it were as many, by one call: as one batch instead", each(CALL, True), each(CALL, False)),
        Saving("the same, with a Newton step each", each(NEWTON, True), each(NEWTON, False)),
    ]


def measured(saving: Saving, repeats: int) -> dict[str, Any]:
    """Milliseconds of both ways, in turns."""
    milliseconds: dict[str, list[float]] = {"more": [], "less": []}
    saving.more(), saving.less()
    for _ in range(repeats):
        for name, samples in milliseconds.items():
            began = time.process_time()
            getattr(saving, name)()
            samples.append(1e3 * (time.process_time() - began))
    return {"text": saving.text, "milliseconds": milliseconds}


def page(results: dict[str, Any]) -> str:
    lines = [
        "# What is not computed",
        "",
        "Made by `python -m benchmarks.steps.savings` from `benchmarks/results/savings.json`; do not edit.",
        "",
        "An answer computes only what the question requires. The table shows the time of a question with each piece",
        "of work and without it: a new plate of 400 nodes, by the run of plates that comes with the package, on one",
        f"thread of an {results['processor']}. Times are processor time: the least and, in brackets, the median.",
        "",
        "| what is left out | with it | without it | saved |",
        "| --- | ---: | ---: | ---: |",
    ]
    for row in results["rows"]:
        more, less = (row["milliseconds"][name] for name in ("more", "less"))
        saved = 1 - median_ratio(less, more)
        lines.append(f"| {row['text']} | {_milliseconds(more)} | {_milliseconds(less)} | {100 * saved:.0f} % |")
    return "\n".join(lines)


def _milliseconds(samples: Sequence[float]) -> str:
    return f"{min(samples):.3g} ({statistics.median(samples):.3g}) ms"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=10, help="samples of each question (default: %(default)s)")
    parser.add_argument("--page", action="store_true", help="write the page from the results that are there")
    options = parser.parse_args(arguments)
    if not options.page:
        import torch  # after ast_sim, which says how its threads wait

        torch.set_num_threads(1)
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Newton steps that are meant to be few
            path = ast_sim.generate("deforming_plate", Path(folder) / "plate.h5", progress=False, **PLATES).path
            with ast_sim.Dataset(path) as data:
                scene = data["test"][0].scene
            rows = [measured(one, options.repeats) for one in savings(ast_sim.example_run("plates"), scene)]
        write_json(RESULTS, {**provenance("python -m benchmarks.steps.savings"), "rows": rows})
    write_text(PAGE, page(json.loads(RESULTS.read_text(encoding="utf-8"))) + "\n")


if __name__ == "__main__":
    main()
