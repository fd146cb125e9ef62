"""Extremes: what the run that comes with the package makes of plates that no training had in mind.

`python -m benchmarks.robustness.extremes` asks for changed plates: moved, turned, scaled, of other meshes, with other
motions, with rounded weights, by one call and with Newton steps. The other models of the package are trained for a few
minutes and answer the same questions by one call. Where the right answer is known, the error stands beside it: by the
solver, or since the change must not change the answer. It writes benchmarks/results/extremes.json and
docs/results/extremes.md. Scenes and runs lie in `--folder`; a second call goes on with what is there.
"""

from __future__ import annotations

import argparse
import resource
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import ast_sim
from ast_sim.inference.quantities.relative_errors import rms
from ast_sim.support.disk import write_json, write_text
from ast_sim.support.errors import AstSimError
from ast_sim.support.provenance import provenance
from benchmarks.studies.phrases import table_head, table_line

RESULTS = Path(__file__).parents[1] / "results" / "extremes.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "extremes.md"
PLATES = {"train": 0, "valid": 0, "test": 1, "frames": 41, "keep": (24,), "seed": 7}
SIZES = (80, 100, 200, 400, 1600, 6400)
EFFORTS = {"one call": ast_sim.Effort(), "Newton steps": ast_sim.Effort(0, 10)}
OTHERS = {"transolver": "Transolver", "mgn": "MeshGraphNets", "bsms": "BSMS-GNN", "hcmt": "HCMT"}
TRAINING = {"family": "deforming_plate", "nodes": 400, "frames": 41, "keep": (14, 24, 34), "train": 200, "valid": 10}
STEPS = 400
MEMORY = 16 * 10**9  # bytes of address space that a question may take


@dataclass(frozen=True)
class Case:
    """A question.

    Attributes:
        group, title: what is extreme.
        scene, motion: as `Run.predict` takes them.
        right: [N, 3] the positions of the last frame that are right; None: they are not known.
        prepare: what is done to the model before.
    """

    group: str
    title: str
    scene: ast_sim.Scene
    motion: np.ndarray
    right: np.ndarray | None = None
    prepare: Callable[[ast_sim.Run], None] = lambda run: None


def _plate(folder: Path, nodes: int) -> ast_sim.Trajectory:
    data = ast_sim.generate("deforming_plate", folder / f"plate{nodes}.h5", nodes=nodes, progress=False, **PLATES)
    with ast_sim.Dataset(data.path) as dataset:
        return dataset["test"][0]


def _cases(folder: Path) -> Iterator[Case]:
    truth = _plate(folder, 400)
    scene, motion = truth.scene, truth.position
    yield Case("as it is", "a plate of 400 nodes", scene, motion, motion[-1])
    yield from _placed(scene, motion)
    for nodes in SIZES:
        if nodes != 400:
            other = _plate(folder, nodes)
            title = f"a plate of {other.scene.num_nodes:,} nodes"
            yield Case("mesh", title, other.scene, other.position, other.position[-1])
    yield Case("mesh", "1,000 times flatter: elements of aspect 1,000", *_scaled(scene, motion, (1, 1, 1e-3)))
    fine = ast_sim.Scene.join(
        ast_sim.plate((0.48, 0.32, 0.03), cells=(240, 160, 3)),
        ast_sim.box((-0.05, -0.05, 0.023), (0.05, 0.05, 0.123), cells=(2, 2, 2)),
    )
    title = f"a plate of {fine.num_nodes:,} nodes, held and pressed by nothing"
    yield Case("mesh", title, fine, np.repeat(fine.rest_position[None], 2, axis=0))
    yield from _moving(scene, motion)
    yield from _changed_scenes(scene, motion)
    yield Case("weights", "rounded to bfloat16", scene, motion, motion[-1], _rounded)


def _placed(scene: ast_sim.Scene, motion: np.ndarray) -> Iterator[Case]:
    """Changes that change an answer in the same way."""
    for distance in (1.0, 1e3, 1e6):
        shift = np.float32([distance, 0, 0])
        moved = replace(scene, rest_position=scene.rest_position + shift)
        yield Case("place", f"{distance:g} m from its place", moved, motion + shift, motion[-1] + shift)
    turn = np.float32([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = replace(scene, rest_position=scene.rest_position @ turn.T)
    yield Case("place", "turned by 90° in its plane", turned, motion @ turn.T, motion[-1] @ turn.T)
    over = np.float32([[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    below = replace(scene, rest_position=scene.rest_position @ over.T)
    yield Case("place", "turned over: pressed from below", below, motion @ over.T, motion[-1] @ over.T)
    for factor, text in ((1e3, "a plate 1,000 times as large"), (1e-3, "a plate 1,000 times as small")):
        size = (factor,) * 3
        yield Case("size", text, *_scaled(scene, motion, size), motion[-1] * np.float32(factor))


def _scaled(scene: ast_sim.Scene, motion: np.ndarray, size: Sequence[float]) -> tuple[ast_sim.Scene, np.ndarray]:
    factor = np.float32(size)
    return replace(scene, rest_position=scene.rest_position * factor), motion * factor


def _moving(scene: ast_sim.Scene, motion: np.ndarray) -> Iterator[Case]:
    """The same plate under other motions."""
    way = motion[-1] - motion[0]
    yield Case("motion", "nothing moves", scene, np.repeat(motion[:1], 2, axis=0), motion[0])
    yield Case("motion", "four times the travel", scene, np.stack([motion[0], motion[0] + 4 * way]))
    share = np.linspace(0, 1, 400, dtype=np.float32)[:, None, None]
    yield Case("motion", "400 frames in place of 41", scene, motion[0] + share * way, motion[-1])
    yield Case("motion", "one frame", scene, motion[:1])
    lost = motion.copy()
    lost[-1, np.flatnonzero(scene.prescribed)[0]] = np.nan
    yield Case("motion", "a position that is no number", scene, lost)


def _changed_scenes(scene: ast_sim.Scene, motion: np.ndarray) -> Iterator[Case]:
    """Scenes that lack something, or have too much."""
    kinds = scene.node_type
    held = np.full_like(kinds, ast_sim.NodeType.HANDLE)
    yield Case("scene", "all nodes prescribed", replace(scene, node_type=held), motion)
    free = np.where(kinds == ast_sim.NodeType.HANDLE, ast_sim.NodeType.NORMAL, kinds).astype(np.uint8)
    yield Case("scene", "nothing holds the plate", replace(scene, node_type=free), motion)
    inside_out = scene.elements.copy()
    inside_out[:, [2, 3]] = inside_out[:, [3, 2]]
    yield Case("scene", "elements inside out", replace(scene, elements=inside_out), motion, motion[-1])
    more = np.repeat(np.float32([[0, 0, 0.01]]), 5, axis=0)
    loose = ast_sim.Scene(
        np.concatenate([scene.rest_position, more]),
        scene.elements,
        np.concatenate([kinds, np.zeros(5, np.uint8)]),
        np.concatenate([scene.body, np.zeros(5, np.int32)]),
        scene.material,
    )
    longer = np.concatenate([motion, np.repeat(more[None], len(motion), axis=0)], axis=1)
    yield Case("scene", "five nodes of no element", loose, longer)
    alone = scene.body == 0
    elements = scene.elements[alone[scene.elements[:, 0]]]
    plate = ast_sim.Scene(scene.rest_position[alone], elements, kinds[alone], scene.body[alone])
    yield Case("scene", "no obstacle", plate, motion[:, alone])


def _rounded(run: ast_sim.Run) -> None:
    for values in run.model.parameters():
        values.data = values.data.bfloat16().to(values.dtype)


def _trained(model: str, folder: Path) -> Path:
    """The folder of a short training of another model."""
    data = ast_sim.generate(out=folder / "training.h5", test=0, **TRAINING, progress=False).path
    out = folder / f"run_{model}"
    return ast_sim.train(data, out, model=model, steps=STEPS, mirror=("x", "y"), resume=True, progress=False).path


@contextmanager
def _memory_limit(most: int) -> Iterator[None]:
    """In the block this process may take `most` bytes of address space."""
    usual, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (usual, hard))


def outcome_of(run: ast_sim.Run, case: Case, effort: ast_sim.Effort) -> dict[str, Any]:
    """What became of a question to a run that nothing has prepared yet."""
    case.prepare(run)
    began = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            answer = run.predict(case.scene, case.motion, frames=[-1], effort=effort, throw=False)
        except AstSimError as error:
            return {"outcome": "refused", "words": str(error)}
        except Exception as error:
            full = isinstance(error, MemoryError) or "can't allocate memory" in str(error)
            return {"outcome": "no memory" if full else "error", "words": f"{type(error).__name__}: {error}"}
    told = [str(one.message).partition(": ")[2] for one in caught]
    figures: dict[str, Any] = {"seconds": time.process_time() - began, "words": "; ".join(told)}
    if answer.failure is not None:
        return {**figures, "outcome": "failed", "words": answer.failure}
    check = answer.check()
    figures |= {"turned_over": check.turned_over.value, "depth": check.depth.value}
    free = ~case.scene.prescribed
    if case.right is not None:
        size = rms(case.right - case.motion[0], free)
        off = rms(answer.position[0] - case.right, free)
        figures["error" if size else "moved"] = off / size if size else off
    return {**figures, "outcome": "warned" if told else "answered"}


def page(results: dict[str, Any]) -> str:
    """The page of all cases."""
    lines = [_INTRODUCTION.format(processor=results["processor"], memory=MEMORY / 1e9).rstrip()]
    for group in dict.fromkeys(case["group"] for case in results["cases"]):
        lines += ["", f"## {group.capitalize()}", ""]
        lines += ["| question | by | outcome | error | turned over | depth | seconds | in words |"]
        lines += ["| --- | --- | --- | ---: | ---: | ---: | ---: | --- |"]
        for case in results["cases"]:
            if case["group"] == group:
                lines += [_line(case["title"], effort, case[effort]) for effort in EFFORTS]
    lines += ["", *_OTHERS.splitlines(), "", *table_head(["question", *OTHERS.values()], texts=1)]
    lines += [table_line([case["title"], *(_short(case[name]) for name in OTHERS)]) for case in results["cases"]]
    return "\n".join(lines) + "\n"


_INTRODUCTION = """# Extremes

Made by `python -m benchmarks.robustness.extremes` from `benchmarks/results/extremes.json`; do not edit.

The run of plates that comes with the package predicts the last frame of plates that are unlike its training, on an
{processor}. "Answered" is an answer without a word, "warned" an answer with a warning, "failed" an
answer that ends early and says why, "refused" a question that is not answered, "no memory" one that takes more than
{memory:.0f} GB, "error" a fault of ours. The error is relative to the displacement, where the right answer is known:
from the solver, or from the plate as it is, since the change should change nothing else. "Turned over" counts elements
of the plate that are inside out, "depth" is the deepest node inside another body, in metres. Seconds are processor time
of one question, the first of its kind.
"""


_OTHERS = f"""## Other models

The other models of the package, each after {STEPS} training steps on {TRAINING["train"]} plates of 400 nodes, by one
call. So their errors are large; the table is about what is answered, told and refused. What each says is in the JSON.
"""


def _short(row: dict[str, Any]) -> str:
    """An outcome with its error and the number of elements that are turned over."""
    error = None if row.get("error") is None else f"{100 * row['error']:.3g} %"
    turned = f"{row['turned_over']:.0f} turned over" if row.get("turned_over") else None
    return ", ".join(text for text in (row["outcome"], error, turned) if text)


def _line(title: str, effort: str, row: dict[str, Any]) -> str:
    error = "-" if row.get("error") is None else f"{100 * row['error']:.3g} %"
    error = f"moved by {row['moved']:.2g} m" if "moved" in row else error
    counts = "-" if row.get("turned_over") is None else f"{row['turned_over']:.0f}"
    depth = "-" if row.get("depth") is None else f"{row['depth']:.2g}"
    seconds = "-" if row.get("seconds") is None else f"{row['seconds']:.2g}"
    words = row["words"].replace("|", "\\|")
    return f"| {title} | {effort} | {row['outcome']} | {error} | {counts} | {depth} | {seconds} | {words} |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--folder", type=Path, default=Path("build/extremes"), help="scenes and runs (default: build/extremes)"
    )
    folder = parser.parse_args(arguments).folder
    import torch  # after ast_sim, which says how its threads wait

    torch.set_num_threads(1)
    others = {model: _trained(model, folder) for model in OTHERS}
    cases = []
    for case in _cases(folder):
        with _memory_limit(MEMORY):
            shipped = {
                name: outcome_of(ast_sim.example_run("plates"), case, effort) for name, effort in EFFORTS.items()
            }
            others_say = {name: outcome_of(ast_sim.Run(path), case, ast_sim.Effort()) for name, path in others.items()}
        outcomes = shipped | others_say
        cases.append({"group": case.group, "title": case.title, **outcomes})
        print(case.title, {name: row["outcome"] for name, row in outcomes.items()}, flush=True)
    efforts = {name: asdict(effort) for name, effort in EFFORTS.items()}
    results = {**provenance("python -m benchmarks.robustness.extremes"), "efforts": efforts, "cases": cases}
    write_json(RESULTS, results)
    write_text(PAGE, page(results))


if __name__ == "__main__":
    main()
