"""What the meshes of the examples get wrong in the force: the largest force on the tool, on finer meshes, too.

`python -m benchmarks.studies.example_meshes [ROW ...]` solves the first scenes of `examples/bumper` and
`examples/snap_hook` on the meshes of the specification and on meshes of shorter elements, each frame after the other
from rest. It writes benchmarks/results/example_meshes.json and the page of this name in docs/results. Everything runs
on one thread, and seconds are processor time. The metal clip has its finer meshes in docs/results/clip.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time
from typing import Any

from ast_sim.mechanics.case import SolidCase
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import values_of
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.errors import SimulationError
from ast_sim.support.provenance import provenance
from benchmarks.studies.phrases import table_head, table_line
from benchmarks.studies.rows import study_rows

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "example_meshes.json"
PAGE = ROOT / "docs" / "results" / "example_meshes.md"
SCENES = 3
FIRST = (0, 0)  # the seed and the number of the split: the scenes of `ast-sim generate assembly SPEC.toml`


@dataclass(frozen=True)
class Row:
    """An example and its finer meshes.

    Attributes:
        title: what the page calls it.
        spec: its specification.
        relative: the lengths of the elements of the finer meshes, as shares of those in the specification.
    """

    title: str
    spec: Path
    relative: tuple[float, ...]


@dataclass(frozen=True)
class Solved:
    """A scene on one mesh.

    Attributes:
        relative: the length of the elements, as a share of the specification's.
        nodes: of all parts.
        force: the largest on the tool over the frames, in newton.
        seconds: of processor time.
    """

    relative: float
    nodes: int
    force: float
    seconds: float


ROWS = {
    "bumper": Row("Bumper", ROOT / "examples" / "bumper" / "SPEC.toml", (2 / 3,)),
    "snap_hook": Row("Snap hook", ROOT / "examples" / "snap_hook" / "SPEC.toml", (2 / 3, 1 / 2)),
}


def measured(name: str, _folder: Path) -> dict[str, Any]:
    """Solve the first scenes of a row on each of its meshes."""
    row = ROWS[name]
    spec = read_spec(row.spec)
    scenes = []
    for index in range(SCENES):
        own = assembly.draw_scene(spec, (*FIRST, index), None, spec.frames).case
        values = values_of(own.attributes)
        finer = [assembly.resized(spec, values, None, spec.frames, relative) for relative in row.relative]
        cases = zip((1.0, *row.relative), (own, *finer), strict=True)
        scenes.append([asdict(_solved(case, relative, spec.unit)) for relative, case in cases])
    return {
        **provenance(f"python -m benchmarks.studies.example_meshes {name}"),
        "title": row.title,
        "scenes": scenes,
    }


def _solved(case: SolidCase, relative: float, unit: str) -> Solved:
    began = process_time()
    truth = assembly.in_newton(assembly.solve(case), unit)
    if truth.attributes["status"] != "complete":
        raise SimulationError(str(truth.attributes["stopped_by"]))
    return Solved(relative, case.scene.num_nodes, max(truth.attributes["reaction"]), process_time() - began)


_INTRODUCTION = f"""# The meshes of the examples

Made by `python -m benchmarks.studies.example_meshes` from `benchmarks/results/example_meshes.json`; do not edit.

The first {SCENES} scenes of each example are solved on the mesh of its specification and on meshes of shorter elements.
"Off" says how far the largest force on the tool lies from the one on the finest mesh of the table. This is the error of
the simulations: a model learns it with the rest. The metal clip stands on [a page of its own](clip.md).
"""


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    lines = [_INTRODUCTION, *table_head(["example", "scene", "elements", "nodes", "largest force", "off", "solver"], 1)]
    for name in (name for name in ROWS if name in results):
        for index, scene in enumerate(results[name]["scenes"]):
            meshes = [Solved(**mesh) for mesh in scene]
            for mesh in meshes:
                off = "-" if mesh is meshes[-1] else f"{100 * (mesh.force / meshes[-1].force - 1):+.1f} %"
                cells = [f"{mesh.relative:.2f}", f"{mesh.nodes:,}", f"{mesh.force:.4g} N", off, f"{mesh.seconds:.3g} s"]
                lines.append(table_line([results[name]["title"], f"{index}", *cells]))
    return "\n".join(lines)


def largest_off(result: dict[str, Any]) -> float:
    """How far the force on the mesh of the specification is off at most, as a share of the one on the finest mesh."""
    return max(abs(scene[0]["force"] / scene[-1]["force"] - 1) for scene in result["scenes"])


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(result: dict[str, Any]) -> str:
    return f"the force is at most {100 * largest_off(result):.1f} % off"


if __name__ == "__main__":
    main()
