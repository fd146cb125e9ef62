"""The report of a dataset: moving scenes, histograms, yield, bounds and facts, on one page (`page`)."""

from __future__ import annotations

import functools
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import SolverSeconds, read_seconds
from ast_sim.support.errors import counted
from ast_sim.support.progress import Progress, ShowProgress
from ast_sim.view import page
from ast_sim.view.dataset_page import survey
from ast_sim.view.dataset_page.bounds import verdicts
from ast_sim.view.dataset_page.facts import dataset_facts
from ast_sim.view.dataset_page.histogram import histogram
from ast_sim.view.dataset_page.survey import SampleFigures
from ast_sim.view.encode import Boundary, Json, encode_scene, finite_json
from ast_sim.view.files import make_folder

PANELS = 12  # at most this many
SCENE_BYTES = (
    6_000_000  # limit for all panels together: large scenes first show fewer frames, then there are fewer panels
)
MIN_FRAMES, MAX_FRAMES = 12, 60  # frames of a panel
LISTED = 500  # a table lists at most this many samples


def write(path: str | os.PathLike[str], data: str | os.PathLike[str], progress: ShowProgress = True) -> None:
    """Write the report of a dataset file as one HTML file; its folder is made if it is not there.

    Every sample is read once, of which `progress` tells as in `generate`. The solver's seconds are taken from the file
    beside the dataset (`ast_sim.dataset.solver_seconds`) if there is one.

    Raises:
        DatasetError: the dataset cannot be read.
        AstSimError: the page cannot be written.
        MissingExtra: plotly is not installed.
    """
    path, data = Path(path), Path(data)
    with Dataset(data) as dataset:
        seconds = read_seconds(dataset)
        make_folder(path.parent)
        with Progress(sum(dataset.splits.values()), "scenes", progress) as bar:
            samples = []
            for sample in survey.survey(dataset, seconds):
                samples.append(sample)
                bar.advance(sample.name)
        content = page_data(dataset, samples, seconds)
    page.write(path, content, f"{dataset.info.family}: {data.name}")


def page_data(dataset: Dataset, samples: Sequence[SampleFigures], seconds: SolverSeconds) -> Json:
    """Everything that the page's scripts show, as JSON. `samples` and `seconds` belong to the dataset."""
    unit = dataset.info.length_unit
    ranked = sorted(samples, key=lambda sample: (sample.displacement, sample.name))
    checks = verdicts(samples, unit) if samples else []
    scenes, note = _scenes(dataset, ranked)
    return finite_json(
        {
            "kind": "dataset",
            "lead": _lead(dataset, samples),
            "footer": page.FOOTER,
            "units": {"displacement": unit, "stress": "Pa"},
            "runs": [],
            "splits": [split for split, count in dataset.splits.items() if count],
            "tiles": _tiles(samples, checks, unit),
            "scenes": scenes,
            "scenesNote": note,
            "histograms": histograms(samples, unit),
            "yields": _yields(samples),
            "checks": checks,
            "samples": _samples_table(ranked, unit),
            "facts": dataset_facts(dataset, samples, seconds),
        }
    )


def spread(count: int, wanted: int) -> list[int]:
    """`wanted` numbers at even steps from 0 to `count` - 1, both included; all of them if there are fewer.

    If one is wanted, it is the middle.
    """
    if wanted == 1:
        return [(count - 1) // 2]
    return np.unique(np.rint(np.linspace(0, count - 1, min(wanted, count))).astype(int)).tolist()


@dataclass(frozen=True)
class _Cost:
    """The bytes that a scene takes on the page: bytes of its surface, and bytes of each frame."""

    surface: int
    frame: int
    frames: int


def _cost(dataset: Dataset, sample: SampleFigures) -> _Cost:
    """Bytes in base64. The surface has three int32 a triangle and three float32 a node.

    A frame has three int16 a node, and one for each stress.
    """
    groups = Boundary(dataset.scene(sample.split, sample.index)).groups
    nodes = sum(len(nodes) for _, nodes, _ in groups.values())
    triangles = sum(len(triangles) for triangles, _, _ in groups.values())
    body, body_nodes, _ = groups["body"]
    stresses = {"none": 0, "node": len(body_nodes), "element": len(body)}[dataset.info.stress_location]
    return _Cost(16 * (triangles + nodes), 8 * (3 * nodes + stresses) // 3, sample.frames)


def choose_panels(cost: Callable[[int], _Cost], count: int) -> tuple[list[int], int]:
    """Which of `count` samples in order of rank are shown, and at most how many frames of each.

    As many panels as possible are shown, up to `PANELS`, so that they stay within `SCENE_BYTES` with `MIN_FRAMES`
    frames each. Then they get as many frames as fit, up to `MAX_FRAMES`. A single scene is shown however large it is,
    with at least two frames.
    """
    cost = functools.cache(cost)

    def total(chosen: Iterable[int], frames: int) -> int:
        return sum(c.surface + min(frames, c.frames) * c.frame for c in map(cost, chosen))

    chosen: list[int] = []
    for panels in range(min(PANELS, count), 0, -1):
        chosen = spread(count, panels)
        if total(chosen, MIN_FRAMES) <= SCENE_BYTES:
            break
    fitting = [frames for frames in range(2, MAX_FRAMES + 1) if total(chosen, frames) <= SCENE_BYTES]
    return chosen, max(fitting, default=2)


def _scenes(dataset: Dataset, ranked: Sequence[SampleFigures]) -> tuple[list[Json], str]:
    """The scenes of the panels, and a note: by which rule they were chosen and what they leave out."""
    if not ranked:
        return [], ""
    chosen, most = choose_panels(lambda index: _cost(dataset, ranked[index]), len(ranked))
    scenes = []
    for sample in (ranked[index] for index in chosen):
        trajectory = dataset.load(sample.split, sample.index)
        frames = np.array(spread(sample.frames, most))
        scenes.append(
            {
                "name": sample.name,
                "label": sample.name,
                "note": _scene_note(sample),
                "stopped": None if sample.complete else sample.frames - 1,
                "largest": {"displacement": sample.displacement, "stress": sample.stress},
                "peak": int(np.abs(frames - sample.peak).argmin()),
                **encode_scene(trajectory, frames),
            }
        )
    return scenes, _scenes_note(scenes, len(ranked))


def _scene_note(sample: SampleFigures) -> str:
    end = "" if sample.complete else f", stopped after frame {sample.frames - 1}"
    return f"{sample.nodes:,} nodes{end}"


def _scenes_note(scenes: Sequence[Json], count: int) -> str:
    if len(scenes) == count:
        rule = "All samples, from the least to the most displaced."
    elif len(scenes) == 1:
        rule = f"1 of {count} samples: the one whose largest displacement is the median."
    else:
        rule = (
            f"{len(scenes)} of {count:,} samples: in order of their largest displacement, at even steps from the least"
            " to the most displaced."
        )
    left_out = []
    if len(scenes) < min(count, PANELS):
        left_out.append("fewer scenes because they are large")
    if any(len(scene["frames"]) < scene["total"] for scene in scenes):
        most = max(len(scene["frames"]) for scene in scenes)
        left_out.append(f"at most {most} evenly spaced frames of each")
    return f"{rule} The panels show surfaces only{''.join(f', {text}' for text in left_out)}."


def histograms(samples: Sequence[SampleFigures], length_unit: str) -> list[Json]:
    """The charts of the page. A chart without figures says that it has none."""

    def chart(title: str, unit: str | None, values: Callable[[SampleFigures], Sequence[float]], counted: str) -> Json:
        by_split: dict[str, list[float]] = {}
        for sample in samples:
            by_split.setdefault(sample.split, []).extend(values(sample))
        return {
            "title": title,
            "what": "of a frame" if counted == "frames" else "of a sample",
            "unit": unit,
            "counted": counted,
            "recorded": sum(len(values(sample)) > 0 for sample in samples),
            **histogram(by_split, whole=unit is None),
        }

    def known(value: float | None) -> list[float]:
        return [] if value is None else [value]

    return [
        chart("Largest displacement", length_unit, lambda s: [s.displacement], "samples"),
        chart("Largest von Mises stress", "Pa", lambda s: known(s.stress), "samples"),
        chart("Largest contact area", f"{length_unit}²", lambda s: known(s.contact_area), "samples"),
        chart("Newton iterations", None, lambda s: s.iterations, "frames"),
        chart("Solver time", "s", lambda s: (s.seconds or [])[1:], "frames"),
        chart("Solver time", "s", lambda s: known(s.total_seconds), "samples"),
        chart("Nodes", None, lambda s: [s.nodes], "samples"),
        chart("Elements", None, lambda s: [s.elements], "samples"),
    ]


def _yields(samples: Sequence[SampleFigures]) -> Json:
    """How many samples are complete, by split, and why the others stopped."""
    stopped = [sample for sample in samples if not sample.complete]
    reasons = Counter(reason(sample) for sample in stopped)
    splits = {
        split: [sum(s.complete for s in samples if s.split == split), sum(s.split == split for s in samples)]
        for split in dict.fromkeys(sample.split for sample in samples)
    }
    return {
        "complete": len(samples) - len(stopped),
        "count": len(samples),
        "splits": splits,
        "reasons": [[text, count] for text, count in reasons.most_common(20)],
        "stopped": [
            [sample.name, sample.frames, str(sample.attributes.get("stopped_by", "not recorded"))]
            for sample in stopped[:LISTED]
        ],
        "left_out": max(0, len(stopped) - LISTED),
    }


def reason(sample: SampleFigures) -> str:
    """Why a sample stopped, without frame number and figures, so that equal reasons are counted together."""
    text = str(sample.attributes.get("stopped_by", "not recorded"))
    text = re.sub(r"^frame \d+: ", "", text)
    return re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "…", re.sub(r" \([^()]*\)", "", text))


def _lead(dataset: Dataset, samples: Sequence[SampleFigures]) -> str:
    if not samples:
        return f"{dataset.path.name} holds no samples."
    counts = ", ".join(f"{count:,} {split}" for split, count in dataset.splits.items() if count)
    return f"Simulated scenes of {dataset.path.name}: {counts}."


def _tiles(samples: Sequence[SampleFigures], checks: Sequence[Json], length_unit: str) -> list[Json]:
    """The figures that matter most, for the head of the page."""
    if not samples:
        return []
    complete = sum(sample.complete for sample in samples)
    nodes = [sample.nodes for sample in samples]
    known = [row for row in checks if row["passed"] is not None]
    failed = [row["title"] for row in known if not row["passed"]]
    tiles = [
        {"label": "Complete", "value": f"{_floor_percent(complete, len(samples))}", "suffix": " %",
         "detail": f"{complete:,} of {counted(len(samples), 'sample')}"},
        {"label": "Bounds kept", "value": f"{len(known) - len(failed)} of {len(known)}",
         "detail": f"broken: {', '.join(failed)}" if failed else f"{len(checks) - len(known)} not recorded"
         if len(known) < len(checks) else "by every sample"},
        {"label": "Nodes", "value": f"{np.median(nodes):,.0f}",
         "detail": f"median; {min(nodes):,} to {max(nodes):,}" if min(nodes) < max(nodes) else "in every sample"},
        _median_tile("Largest displacement", [s.displacement for s in samples], length_unit),
    ]  # fmt: skip
    stress = [sample.stress for sample in samples if sample.stress is not None]
    seconds = [sample.total_seconds for sample in samples if sample.total_seconds is not None]
    if stress:
        tiles.append(_median_tile("Largest stress", stress, "Pa"))
    if seconds:
        tiles.append(_median_tile("Time per sample", seconds, "s"))
    return tiles


def _median_tile(label: str, values: Sequence[float], unit: str) -> Json:
    """The median. The page adds the largest value, in the unit that fits."""
    return {"label": label, "value": float(np.median(values)), "unit": unit, "upTo": float(max(values))}


def _floor_percent(part: int, whole: int) -> str:
    """Percent with one digit, rounded down: 100 means all."""
    tenths = 1000 * part // whole
    return f"{tenths // 10}" if tenths % 10 == 0 else f"{tenths / 10:.1f}"


def _samples_table(ranked: Sequence[SampleFigures], length_unit: str) -> Json:
    """The figures of the samples, in ascending order of largest displacement. Of many samples, some at even steps."""
    shown = [ranked[index] for index in spread(len(ranked), LISTED)] if ranked else []

    def column(label: str, unit: str | None, value: Callable[[SampleFigures], Any]) -> Json:
        return {"label": label, "unit": unit, "values": [value(sample) for sample in shown]}

    columns = [
        column("Nodes", None, lambda s: s.nodes),
        column("Elements", None, lambda s: s.elements),
        column("Frames", None, lambda s: s.frames),
        column("Displacement", length_unit, lambda s: s.displacement),
        column("Stress", "Pa", lambda s: s.stress),
        column("Contact area", f"{length_unit}²", lambda s: s.contact_area),
        column("Iterations", None, lambda s: sum(map(int, s.iterations)) or None),
        column("Solver time", "s", lambda s: s.total_seconds),
    ]
    return {
        "names": [sample.name for sample in shown],
        "order": list(range(len(shown))),
        "count": len(ranked),
        "table": [c for c in columns if any(value is not None for value in c["values"])],
    }
