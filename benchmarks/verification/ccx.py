"""Small strains by CalculiX, with its own elements C3D4, C3D10 and C3D20R: the other opinion on bending and rubber.

Nodes are numbered from 0 here and from 1 in the decks. Legend: N nodes, E elements.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ast_sim.simulate.calculix.program import find_ccx

# Corners of a hexahedron, then the ends of the edges whose middles follow, in the order of C3D20R.
_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


@dataclass(frozen=True, eq=False)
class Problem:
    """A body with held components, forces and one material; the strains are small.

    Attributes:
        rest: [N,3].
        elements: [E,4], [E,10] or [E,20].
        young, poisson: of the material.
        held: [N,3] bool, components whose displacement is given.
        moved: [N,3] their displacement.
        force: [N,3] on the nodes.
    """

    rest: np.ndarray
    elements: np.ndarray
    young: float
    poisson: float
    held: np.ndarray
    moved: np.ndarray
    force: np.ndarray


def by_calculix(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """The displacements [N,3] and the reactions [N,3], where components are held."""
    with tempfile.TemporaryDirectory(prefix="ast_sim-") as folder:
        (Path(folder) / "job.inp").write_text("\n".join(_deck(problem)) + "\n", encoding="ascii")
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "CCX_NPROC_EQUATION_SOLVER": "1"}
        subprocess.run([find_ccx(), "-i", "job"], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        lines = (Path(folder) / "job.dat").read_text(encoding="ascii").splitlines()
    rows = np.array([[float(word) for word in line.split()] for line in lines if line.strip()[:1].isdigit()])
    results = rows.reshape(2, len(problem.rest), 4)
    assert (results[:, :, 0] == np.arange(1, len(problem.rest) + 1)).all()
    return results[0, :, 1:], np.where(problem.held, results[1, :, 1:], 0)


def _deck(problem: Problem) -> list[str]:
    kind = {4: "C3D4", 10: "C3D10", 20: "C3D20R"}[problem.elements.shape[1]]
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{n}, {x:.12e}, {y:.12e}, {z:.12e}" for n, (x, y, z) in enumerate(problem.rest, start=1)]
    lines.append(f"*ELEMENT, TYPE={kind}, ELSET=BODY")
    for number, nodes in enumerate(problem.elements + 1, start=1):
        words = [str(number), *map(str, nodes)]
        lines += [
            ", ".join(words[:11]) + "," * (len(words) > 11),
            *([", ".join(words[11:])] if len(words) > 11 else []),
        ]
    lines += ["*MATERIAL, NAME=ELASTIC", "*ELASTIC", f"{problem.young:.12e}, {problem.poisson:.12e}"]
    lines += ["*SOLID SECTION, ELSET=BODY, MATERIAL=ELASTIC", "*STEP", "*STATIC", "*BOUNDARY"]
    for node, axis in np.argwhere(problem.held):
        lines.append(f"{node + 1}, {axis + 1}, {axis + 1}, {problem.moved[node, axis]:.12e}")
    if problem.force.any():
        lines.append("*CLOAD")
        lines += [
            f"{node + 1}, {axis + 1}, {problem.force[node, axis]:.12e}" for node, axis in np.argwhere(problem.force)
        ]
    return [*lines, "*NODE PRINT, NSET=ALL", "U", "*NODE PRINT, NSET=ALL", "RF", "*END STEP"]


def hexahedra(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A grid of 20-node hexahedra [E,20]: coordinates [N,3], whole at corners and half at middles of edges."""
    corner = np.array(_CORNERS)
    local = np.concatenate([2 * corner, [corner[a] + corner[b] for a, b in _EDGES]])
    twice = 2 * np.stack(np.unravel_index(np.arange(np.prod(cells)), cells), axis=1)[:, None] + local  # [E, 20, 3]
    used, elements = np.unique(twice.reshape(-1, 3), axis=0, return_inverse=True)
    return used / 2, elements.reshape(-1, 20)
