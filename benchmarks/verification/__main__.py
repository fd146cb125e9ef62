"""Solves problems with known answers and writes docs/results/verification.md: expected, computed, error, tolerance.

`python -m benchmarks.verification` solves all problems. `python -m benchmarks.verification hertz elastica` solves these
two and keeps the results of the others. Figures are kept in benchmarks/results/verification.json, pictures in
docs/results/verification. The command fails if a row is not within its tolerance.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

from ast_sim.support.provenance import provenance
from benchmarks.verification import (
    bending,
    cloth,
    contact,
    derivatives,
    dynamics,
    elasticity,
    friction,
    indentation,
    locking,
)
from benchmarks.verification.problem import Outcome, Problem

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"
DOCUMENT, PICTURES = PAGES / "verification.md", PAGES / "verification"
RECORDS = ROOT / "benchmarks" / "results" / "verification.json"

THEMES = {
    "Derivatives": derivatives.PROBLEMS,
    "Elasticity": elasticity.PROBLEMS,
    "Bending": bending.PROBLEMS,
    "Second-order elements": locking.PROBLEMS,
    "Contact": contact.PROBLEMS + indentation.PROBLEMS,
    "Friction": friction.PROBLEMS,
    "Dynamics": dynamics.PROBLEMS + cloth.PROBLEMS,
}
PROBLEMS: dict[str, Problem] = {problem.name: problem for theme in THEMES.values() for problem in theme}

INTRODUCTION = """# Verification

Problems with known answers, solved by the solver that makes the datasets: its energies, its contact and its Newton
iteration, unchanged. Written by `python -m benchmarks.verification`; problems that take seconds run with the tests.

How to read a row: *error* is the difference to the expected value, relative to it, or absolute where the quantity says
what it is relative to. *Tolerance* is not chosen after the fact but follows from what is written beside it: the order
of the discretisation and its size, rounding, the stop test of the solver, the distance dhat at which contact begins to
act, or the accuracy of the closed form itself. "Extrapolated" is Richardson's limit of a sequence of meshes with the
order that they show; its uncertainty is how far that limit moves if the theoretical order is taken instead.

Elements are linear tetrahedra but for the theme *Second-order elements*, the law is Ciarlet's
psi = mu/2 (tr C - 3) + lambda/4 (J^2 - 1) - (mu + lambda/2) ln J, and contact is a barrier (IPC) that acts below dhat.

What a user should conclude:

- The equations are the right ones: what a mesh represents exactly is found to rounding, and every sequence of meshes
  tends to the closed form. What is left on one mesh is its discretisation, and that is not small.
- A part that bends is too stiff by about 5 / n^2 with n elements over its thickness (*Cantilever*): the plates and
  fins of the datasets, with two to four, are much stiffer than real ones, and so is every solver on the same mesh.
- Second-order tetrahedra, which assemblies have, bend as they should with one element over the thickness, and press
  rubber as CalculiX's best elements do (*A thin strip*, *A bonded rubber pad*).
- The force of a contact is too large while few elements lie across it: see *Hertz* for the share.
- Surfaces in contact stay a little less than dhat apart; forces change by the share that dhat has in the indentation.
- Meshes that do not match transmit a uniform pressure to half a per cent; Coulomb's law holds to 1e-4.
"""


def record(problem: Problem, outcome: Outcome, seconds: float, command: str) -> dict:
    """What is kept of a solved problem: its rows, curves and remarks, and where they were made."""
    pictures = {
        name: {
            **{key: value for key, value in asdict(picture).items() if key != "curves"},
            "curves": [
                {"label": curve.label, "x": [float(v) for v in curve.x], "y": [float(v) for v in curve.y]}
                for curve in picture.curves
            ],
        }
        for name, picture in outcome.pictures.items()
    }
    made = provenance(command)
    made["versions"]["ipctk"] = version("ipctk")
    return {
        "made": made,
        "seconds": round(seconds, 1),
        "rows": [{**asdict(row), "holds": row.holds} for row in outcome.rows],
        "remarks": outcome.remarks,
        "pictures": pictures,
    }


def number(value: float | None, unit: str) -> str:
    """A figure for the table."""
    return "-" if value is None else f"{value:.6g} {unit}".strip()


def section(problem: Problem, record: dict) -> list[str]:
    """The lines of a problem in the document."""
    lines = [f"### {problem.title}", "", problem.text, ""]
    lines += ["| quantity | expected | computed | error | tolerance | holds | tolerance from |"]
    lines += ["| --- | ---: | ---: | ---: | ---: | --- | --- |"]
    for row in record["rows"]:
        expected, computed = (number(row[key], row["unit"]) for key in ("expected", "computed"))
        holds = "yes" if row["holds"] else "**NO**"
        lines.append(
            f"| {row['quantity']} | {expected} | {computed} | {row['error']:.1e} | {row['tolerance']:.1e} | {holds} |"
            f" {row['source']} |".replace("<", "&lt;")
        )
    lines += ["", *(f"{remark}\n" for remark in record["remarks"])]
    lines += [
        f"![{picture['title']}](verification/{problem.name}_{name}.svg)\n"
        for name, picture in record["pictures"].items()
    ]
    return lines


def document(records: dict[str, dict]) -> str:
    """docs/results/verification.md of the problems found."""
    rows = [row for problem in records.values() for row in problem["rows"]]
    failed = [row for row in rows if not row["holds"]]
    made = {(entry["made"]["commit"] or "?")[:10] for entry in records.values()}
    last = list(records.values())[-1]["made"]
    processors: dict[str, list[str]] = {}
    for name, entry in records.items():
        processors.setdefault(entry["made"]["processor"], []).append(f"`{name}`")
    usual = max(processors, key=lambda one: len(processors[one]))
    others = "".join(f" ({', '.join(names)}: {one})" for one, names in processors.items() if one != usual)
    seconds = sum(entry["seconds"] for entry in records.values())
    versions = ", ".join(f"{name} {number}" for name, number in last["versions"].items())
    missing = [f"`{name}`" for name in PROBLEMS if name not in records]
    unsolved = [f"Not solved yet at this state: {', '.join(missing)}.", ""] if missing else []
    lines = [
        INTRODUCTION,
        f"{len(rows) - len(failed)} of {len(rows)} rows hold. Made at commit {', '.join(sorted(made))} on"
        f" {usual}{others}, one thread; {versions}; {seconds:.0f} s in all.",
        "",
        *unsolved,
    ]
    for theme, problems in THEMES.items():
        known = [problem for problem in problems if problem.name in records]
        if known:
            lines += [f"## {theme}", ""]
        for problem in known:
            lines += section(problem, records[problem.name])
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    from benchmarks.verification.pictures import draw  # needs matplotlib, which the tests of the problems do not

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", choices=[[], *PROBLEMS], help=f"only these: {', '.join(PROBLEMS)}")
    names = parser.parse_args().problems or list(PROBLEMS)
    command = " ".join(["python -m benchmarks.verification", *sys.argv[1:]])
    known = json.loads(RECORDS.read_text()) if RECORDS.exists() else {}
    RECORDS.parent.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in names:
        problem, started = PROBLEMS[name], perf_counter()
        outcome = problem.solve()
        known[name] = record(problem, outcome, perf_counter() - started, command)
        for picture_name, picture in outcome.pictures.items():
            draw(picture, PICTURES / f"{name}_{picture_name}.svg")
        for row in outcome.rows:
            print(
                f"{'holds' if row.holds else 'FAILS'}  {name}: {row.quantity}: {row.error:.1e} of {row.tolerance:.1e}"
            )
        failed += [row for row in outcome.rows if not row.holds]
        known = {key: known[key] for key in PROBLEMS if key in known}
        # After every problem, so that a run that is cut off leaves what it found.
        RECORDS.write_text(json.dumps(known, indent=1) + "\n")
        DOCUMENT.write_text(document(known), encoding="utf-8")
    if failed:
        sys.exit(f"{len(failed)} rows are not within their tolerance")


if __name__ == "__main__":
    main()
