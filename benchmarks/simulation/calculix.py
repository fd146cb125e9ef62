"""Compares the bundled solver with CalculiX on drawn pairs of parts.

`python -m benchmarks.simulation.calculix --json FILE` solves the family `abcd` at a crush of 0.2 with both solvers. For
each seed it writes how much their displacements, stresses and reactions differ.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.scene import NodeType, Trajectory
from ast_sim.simulate.calculix import solve as calculix
from ast_sim.simulate.families import abcd

CRUSH = 0.2
# What the two solvers must agree in, at the last frame.
MOST_DISPLACEMENT = 0.05
LEAST_CORRELATION = 0.97
MOST_RATIO = 0.05
# Attributes of a solution that are written down.
RECORDED = ("status", "stopped_by", "solver", "young", "poisson", "friction", "dhat", "kappa", "contact_stiffness")


def compare(case: SolidCase, ours: Trajectory, referee: Trajectory) -> dict[str, float | int | list[float]]:
    """How far two solutions of a case are apart in the frames that both have.

    Returns:
        `frames` compared; at the last of them the L2 norm over the free nodes of the difference of the positions
        relative to the norm of the referee's displacements (`displacement`; `displacement_all` over all frames at once;
        `displacement_by_frame` for each frame but the first: where solutions part at an instability), the correlation
        of the von Mises stresses of the deforming elements, or nodes (`stress_correlation`), the ratio of the means of
        these stresses (`mean_stress_ratio`) and of the reactions (`reaction_ratio`), ours by the referee's.
    """
    frames = min(ours.num_frames, referee.num_frames)
    free = case.scene.node_type == NodeType.NORMAL
    deforming = case.scene.deforming(case.stress_location)
    difference = (ours.position[:frames].astype(float) - referee.position[:frames])[:, free]
    moved = (referee.position[:frames].astype(float) - case.scene.rest_position)[:, free]
    stresses = [solution.stress[frames - 1, deforming, 0].astype(float) for solution in (ours, referee)]
    reactions = [solution.attributes["reaction"][frames - 1] for solution in (ours, referee)]
    by_frame = np.linalg.norm(difference[1:], axis=(1, 2)) / np.linalg.norm(moved[1:], axis=(1, 2))
    return {
        "frames": frames,
        "displacement": float(by_frame[-1]),
        "displacement_all": float(np.linalg.norm(difference) / np.linalg.norm(moved)),
        "displacement_by_frame": by_frame.tolist(),
        "stress_correlation": float(np.corrcoef(stresses)[0, 1]),
        "mean_stress_ratio": float(stresses[0].mean() / stresses[1].mean()),
        "reaction_ratio": float(reactions[0] / reactions[1]),
    }


def agrees(figures: dict) -> bool:
    """Whether the figures of `compare` are within what is asked for."""
    return bool(
        figures["displacement"] <= MOST_DISPLACEMENT
        and figures["stress_correlation"] >= LEAST_CORRELATION
        and abs(figures["mean_stress_ratio"] - 1) <= MOST_RATIO
        and abs(figures["reaction_ratio"] - 1) <= MOST_RATIO
    )


def with_crush(case: SolidCase, crush: float) -> SolidCase:
    """A case of `abcd` squeezed by another share of its height than the drawn one: the same way, scaled."""
    drawn, air = case.attributes["crush"], 2 * case.contact.dhat
    travel = float(np.linalg.norm(case.prescribed_position[-1] - case.prescribed_position[0], axis=1).max())
    factor = ((travel - air) * crush / drawn + air) / travel
    targets = case.prescribed_position[0] + factor * (case.prescribed_position - case.prescribed_position[0])
    return replace(case, prescribed_position=targets, attributes={**case.attributes, "crush": crush})


def measure(seed: int, nodes: int) -> dict:
    """Solve one seed with both solvers."""
    case = with_crush(abcd.draw(np.random.default_rng(seed), nodes), CRUSH)
    record = {"seed": seed, "nodes": case.scene.num_nodes, "tetrahedra": case.scene.num_elements}
    solutions = []
    for name, solve in (("ours", abcd.solve), ("calculix", calculix.quasi_static)):
        started = perf_counter()
        solution = solve(case)
        record[name] = {
            "seconds": perf_counter() - started,
            "frames": solution.num_frames,
            "iterations": sum(solution.attributes["newton_iterations"]),
            **{key: solution.attributes[key] for key in RECORDED if key in solution.attributes},
        }
        solutions.append(solution)
    figures = compare(case, *solutions)
    complete = all(solution.attributes["status"] == "complete" for solution in solutions)
    return {**record, **figures, "reached": complete and agrees(figures)}


def line_of(record: dict) -> str:
    text = f"seed {record['seed']}, {record['nodes']} nodes:"
    text += f" displacement {record['displacement']:.2%}, stress correlation {record['stress_correlation']:.4f},"
    text += f" mean stress x {record['mean_stress_ratio']:.4f}, reaction x {record['reaction_ratio']:.4f}"
    for name in ("ours", "calculix"):
        solved = record[name]
        text += f"; {name} {solved['seconds']:.1f} s, {solved['iterations']} iterations"
        if "stopped_by" in solved:
            text += f", stopped in {solved['stopped_by']}"
    return text + f"; target {'reached' if record['reached'] else 'NOT reached'}"


def main() -> None:
    from ast_sim.support.provenance import provenance  # imports torch, which `compare` does without

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write all figures here")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4], help="(0 1 2 3 4)")
    parser.add_argument("--nodes", type=int, default=abcd.DEFAULT_NODES, help="about how many (%(default)s)")
    arguments = parser.parse_args()
    header = {
        **provenance(" ".join(["python -m benchmarks.simulation.calculix", *sys.argv[1:]])),
        "crush": CRUSH,
        "targets": {
            "displacement at most": MOST_DISPLACEMENT,
            "stress_correlation at least": LEAST_CORRELATION,
            "ratios within": MOST_RATIO,
        },
    }
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    records: list[dict] = []
    for seed in arguments.seeds:
        records.append(measure(seed, arguments.nodes))
        print(line_of(records[-1]), flush=True)
        # After every seed, so that a run that is cut off leaves what it found.
        arguments.json.write_text(json.dumps({**header, "records": records}, indent=1) + "\n")


if __name__ == "__main__":
    main()
