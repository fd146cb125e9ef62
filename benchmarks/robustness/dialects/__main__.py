"""Random meshes and simulations in the dialects of many programs, and what comes back.

`python -m benchmarks.robustness.dialects --json benchmarks/results/dialects.json`. Again and again a dialect is taken
in turn, a simulation and a spelling are drawn, a program writes the files, and they are read as `convert` and `predict`
read them. The outcomes:

- `right`: what comes back is what was written: nodes, tetrahedra, volumes, surfaces, bodies, named groups, frames in
  their order, displacements, stresses, marks, times; and a note tells of each defect that was mended;
- `refused`: one line says why;
- `silent`: something else comes back, or a defect is mended without a word;
- `crash`: an exception that a user cannot act on, or an error of several lines.

FEniCS writes with a Python of its own (`--fenics /usr/bin/python3`; Debian: python3-dolfinx, python3-dolfin).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ast_sim.importers.series import FieldNames
from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError
from ast_sim.support.provenance import provenance
from benchmarks.robustness.dialects import comparison, deck_dialects, other_programs, vtk_dialects
from benchmarks.robustness.dialects.comparison import Case, Wrong, check
from benchmarks.robustness.dialects.random_simulation import Body, Simulation, draw_simulation

LINEAR = ("tetra", "tetra", "hexahedron", "wedge", "pyramid")
ALL = (*LINEAR, "tetra10", "tetra10", "hexahedron20", "wedge15", "pyramid13")
OF_MESHIO = tuple(kind for kind in ALL if kind not in ("wedge15", "pyramid13"))
NO_PYRAMID13 = tuple(kind for kind in ALL if kind != "pyramid13")
OUTCOMES = ("right", "refused", "silent", "crash")

Write = Callable[[np.random.Generator, Simulation, Path], Case]


class Dialect(NamedTuple):
    """Files of one kind: the program that writes them, the kinds of cells, the defects that they may have."""

    program: str
    write: Write
    kinds: tuple[str, ...]
    defects: tuple[str, ...] = ("inside out", "twice", "unused")


IN_SERIES = ("inside out", "twice", "unused", "unstitched", "order")
DIALECTS = {
    "VTU series of VTK": Dialect("VTK", vtk_dialects.vtu_series, ALL, IN_SERIES),
    "PVD and VTU of VTK": Dialect("VTK", vtk_dialects.pvd_series, ALL, ("inside out", "twice")),
    "pieces, PVTU": Dialect("VTK", vtk_dialects.pieces_series, ALL, ("inside out", "twice")),
    "legacy series of VTK": Dialect("VTK", vtk_dialects.legacy_series, ALL, ("inside out", "twice", "unused")),
    "Exodus and VTKHDF of VTK": Dialect("VTK", vtk_dialects.all_frames, ALL, ("inside out", "twice", "unused")),
    "blocks and VTKHDF of VTK": Dialect("VTK", vtk_dialects.blocks_mesh, ALL, ("inside out", "twice")),
    "decks": Dialect("own text", deck_dialects.deck_mesh, NO_PYRAMID13, ("inside out", "unused")),
    "decks, too": Dialect("own text", deck_dialects.deck_mesh, ("tetra", "tetra10"), ("inside out", "unused")),
    "Gmsh": Dialect("Gmsh", other_programs.gmsh_mesh, NO_PYRAMID13, ("inside out", "twice")),
    "series of meshio": Dialect("meshio", other_programs.meshio_series, OF_MESHIO, IN_SERIES),
    "XDMF of meshio": Dialect("meshio", other_programs.xdmf_series, LINEAR, ("inside out", "unused")),
    "meshes of meshio": Dialect("meshio", other_programs.meshio_mesh, OF_MESHIO, ("inside out", "unused")),
    "results of CalculiX": Dialect(
        "CalculiX", other_programs.calculix_series, ("tetra", "tetra10", "hexahedron", "hexahedron20", "wedge"), ()
    ),
}


def draw(name: str, seed: int, folder: Path) -> tuple[Simulation, Case]:
    """A simulation, and its files in a dialect."""
    dialect, rng = DIALECTS[name], np.random.default_rng(seed)
    simulation = draw_simulation(rng, dialect.kinds, int(rng.integers(2, 5)))
    simulation.defects = {defect for defect in dialect.defects if rng.random() < 0.2}
    if not any(kind.startswith("tetra") for kind in simulation.kinds):
        simulation.defects.discard("inside out")
    return simulation, dialect.write(rng, simulation, folder)


def of_fenics(folder: Path) -> tuple[Simulation, list[Case]]:
    """What FEniCS was told to write, and its files."""
    truth = np.load(folder / "truth.npz")
    points, cells = truth["points"], truth["cells"].astype(np.int64)
    kind = "tetra" if cells.shape[1] == 4 else "hexahedron"
    fixed = points[:, 0] < 1e-9
    shape = truth["displacement"].shape[:2]
    body = Body(points, [(kind, cells)], False)
    simulation = Simulation([body], truth["displacement"], np.zeros(shape), truth["times"], fixed)
    cases = [Case(path) for path in sorted(folder.glob("mesh.xdmf"))]
    cases += [Case(path, FieldNames("U", handle="0:xmin"), times=True) for path in sorted(folder.glob("all.*")) if path.suffix in (".pvd", ".xdmf")]
    return simulation, cases


def outcome(case: Case, simulation: Simulation) -> tuple[str, str]:
    """The outcome of a case, and what was said or what is wrong."""
    try:
        check(case, simulation)
    except Wrong as error:
        return "silent", str(error)
    except AstSimError as error:
        return ("refused" if "\n" not in str(error) else "crash"), str(error)
    except Exception:
        return "crash", traceback.format_exc()
    return "right", ""


def measure(draws: int, seed: int, folder: Path, fenics: str | None) -> dict[str, Any]:
    """The numbers of outcomes by dialect, every bad one in full, and the texts of refusals."""
    counts: dict[str, Counter[str]] = {}
    bad, refusals = [], Counter[str]()

    def count(name: str, number: int, case: Case, simulation: Simulation) -> None:
        found, text = outcome(case, simulation)
        counts.setdefault(name, Counter())[found] += 1
        if found == "refused":
            refusals[f"{name}: {text.replace(str(folder), '').split(': ', 1)[-1][:200]}"] += 1
        elif found != "right":
            bad.append({"dialect": name, "seed": seed + number, "outcome": found, "text": text})
            print(f"{name}, seed {seed + number}: {found}: {text.strip().splitlines()[-1]}", flush=True)

    of_programs = draws if fenics is None else draws * 13 // 14
    for number in range(of_programs):
        name = list(DIALECTS)[number % len(DIALECTS)]
        one = folder / "one"
        one.mkdir()
        simulation, case = draw(name, seed + number, one)
        count(name, number, case, simulation)
        shutil.rmtree(one)
    if fenics is not None:
        script = Path(comparison.__file__).with_name("fenics_files.py")
        wanted = draws - of_programs
        subprocess.run([fenics, str(script), str(folder / "fenics"), str(wanted), str(seed)], check=True)
        done = 0
        for number in range(wanted):
            simulation, cases = of_fenics(folder / "fenics" / str(number))
            for case in cases[: wanted - done]:
                count(f"FEniCS, {case.path.name}", number, case, simulation)
                done += 1
    total = sum(counts.values(), Counter())
    return {
        "draws": total.total(),
        "outcomes": {name: total[name] for name in OUTCOMES},
        "by dialect": {name: dict(found) for name, found in counts.items()},
        "programs": {name: dialect.program for name, dialect in DIALECTS.items()},
        "bad": bad,
        "refusals": dict(refusals.most_common()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fenics", metavar="PYTHON", help="a Python with dolfinx and dolfin")
    parser.add_argument("--dialect", help="this one alone")
    parser.add_argument("--json", type=Path, help="file for the result")
    args = parser.parse_args()
    if args.dialect:
        for name in set(DIALECTS) - {args.dialect}:
            del DIALECTS[name]
    with tempfile.TemporaryDirectory() as folder:
        found = measure(args.draws, args.seed, Path(folder), args.fenics)
    print(found["outcomes"], *(f"{name}: {one}" for name, one in found["by dialect"].items()), sep="\n")
    for text, number in found["refusals"].items():
        print(f"refused {number}: {text}")
    if args.json:
        write_json(args.json, {**provenance(" ".join(["python -m benchmarks.robustness.dialects", *sys.argv[1:]])), **found})


if __name__ == "__main__":
    main()
