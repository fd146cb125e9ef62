"""Random meshes and simulations in the dialects of many programs, and what comes back.

`python -m benchmarks.robustness.dialects --json benchmarks/results/dialects.json`. Again and again a dialect is taken
in turn, a simulation and a spelling are drawn, a program writes the files, and they are read as `convert` and `predict`
read them; `--corners` is drawn, too. The outcomes:

- `right`: what comes back is what was written: nodes, the middles of edges too, tetrahedra, volumes, surfaces, bodies,
  named groups, frames in their order, displacements, stresses, marks, times; a note tells of each defect that was
  mended and of each cell that was cut or lost nodes; and nothing else is told: no other note, no warning, and nothing
  looks wrong;
- `refused`: one line says why;
- `silent`: something else comes back, a defect is mended without a word, or something is told without a reason;
- `crash`: an exception that a user cannot act on, or an error of several lines.

FEniCS writes with a Python of its own: `--fenics /usr/bin/python3` with Debian's python3-dolfinx and python3-dolfin.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError
from ast_sim.support.provenance import provenance
from benchmarks.robustness.dialects.comparison import Case, Wrong, check
from benchmarks.robustness.dialects.draws import DIALECTS, draw, draws_of_fenics
from benchmarks.robustness.dialects.random_simulation import Simulation

OUTCOMES = ("right", "refused", "silent", "crash")
OF_FENICS = 14  # draws, one of which goes to FEniCS, if it is installed


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


class Tally:
    """The numbers of outcomes by dialect, every bad one in full, and the texts of refusals."""

    def __init__(self) -> None:
        self.counts: dict[str, Counter[str]] = {}
        self.bad: list[dict[str, Any]] = []
        self.refusals: Counter[str] = Counter()

    def count(self, dialect: str, seed: int, case: Case, simulation: Simulation) -> None:
        ended, text = outcome(case, simulation)
        self.counts.setdefault(dialect, Counter())[ended] += 1
        if ended == "refused":
            self.refusals[f"{dialect}: {text.split(': ', 1)[-1][:200]}"] += 1
        elif ended != "right":
            self.bad.append({"dialect": dialect, "seed": seed, "outcome": ended, "text": text})
            print(f"{dialect}, seed {seed}: {ended}: {text.strip().splitlines()[-1]}", flush=True)

    def result(self) -> dict[str, Any]:
        total = sum(self.counts.values(), Counter[str]())
        return {
            "draws": total.total(),
            "outcomes": {name: total[name] for name in OUTCOMES},
            "by dialect": {name: dict(outcomes) for name, outcomes in self.counts.items()},
            "programs": {name: dialect.program for name, dialect in DIALECTS.items()},
            "bad": self.bad,
            "refusals": dict(self.refusals.most_common()),
        }


def measure(draws: int, seed: int, folder: Path, fenics: str | None = None) -> dict[str, Any]:
    """Take the dialects in turn, `draws` times, and FEniCS's files at last; `fenics` is its Python."""
    tally = Tally()
    of_fenics = draws // OF_FENICS if fenics is not None else 0
    for number in range(draws - of_fenics):
        name = list(DIALECTS)[number % len(DIALECTS)]
        one = folder / "one"
        one.mkdir()
        simulation, case = draw(name, seed + number, one)
        tally.count(name, seed + number, case, simulation)
        shutil.rmtree(one)
    if fenics is not None:
        for name, simulation, case in draws_of_fenics(fenics, folder / "fenics", of_fenics, seed):
            tally.count(name, seed, case, simulation)
    return tally.result()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fenics", metavar="PYTHON", help="a Python with dolfinx and dolfin")
    parser.add_argument("--json", type=Path, help="file for the result")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measure(args.draws, args.seed, Path(folder), args.fenics)
    print(result["outcomes"], *(f"{name}: {one}" for name, one in result["by dialect"].items()), sep="\n")
    for text, number in result["refusals"].items():
        print(f"refused {number}: {text}")
    if args.json:
        write_json(
            args.json, {**provenance(" ".join(["python -m benchmarks.robustness.dialects", *sys.argv[1:]])), **result}
        )


if __name__ == "__main__":
    main()
