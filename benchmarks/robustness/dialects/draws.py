"""The dialects: which program writes them, and what is drawn for each."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ast_sim.importers.series import FieldNames
from benchmarks.robustness.dialects import deck_dialects, other_programs, vtk_dialects
from benchmarks.robustness.dialects.comparison import Case
from benchmarks.robustness.dialects.random_simulation import Body, Simulation, bend_edges, draw_simulation

LINEAR = ("tetra", "tetra", "hexahedron", "wedge", "pyramid")
ALL = (*LINEAR, "tetra10", "tetra10", "hexahedron20", "wedge15", "pyramid13")
OF_MESHIO = tuple(kind for kind in ALL if kind not in ("wedge15", "pyramid13"))
NO_PYRAMID13 = tuple(kind for kind in ALL if kind != "pyramid13")

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
    """A simulation, and its files in a dialect. A second stream of random numbers draws what concerns the nodes in the
    middles of edges, and leaves the other draws as they are."""
    dialect, rng, second = DIALECTS[name], np.random.default_rng(seed), np.random.default_rng([seed, 10])
    simulation = draw_simulation(rng, dialect.kinds, int(rng.integers(2, 5)))
    simulation.corners_only = bool(second.random() < 0.3)
    bend_edges(second, simulation)
    simulation.defects = {defect for defect in dialect.defects if rng.random() < 0.2}
    if not any(kind.startswith("tetra") for kind in simulation.kinds):
        simulation.defects.discard("inside out")
    if all(len(cells) == 1 for _, _, cells in simulation.blocks):
        simulation.defects.discard("order")
    return simulation, dialect.write(rng, simulation, folder)


def draws_of_fenics(python: str, folder: Path, count: int, seed: int) -> Iterator[tuple[str, Simulation, Case]]:
    """(dialect, simulation, files) of what both generations of FEniCS write, at most `count`. They crash in one
    process, so each has its own."""
    script = Path(__file__).with_name("fenics_files.py")
    for share, writer in enumerate(("dolfin", "dolfinx")):
        wanted = (count + share) // 2
        meshes = wanted // 2 + 1  # each gives two or three files
        subprocess.run(
            [python, str(script), writer, str(folder / writer), str(meshes), str(seed)], check=True, capture_output=True
        )
        cases = [one for number in range(meshes) for one in _of_fenics(folder / writer / str(number))]
        for simulation, case in cases[:wanted]:
            yield f"FEniCS, {writer}, {case.path.name}", simulation, case


def _of_fenics(folder: Path) -> Iterator[tuple[Simulation, Case]]:
    """What FEniCS was told to write, with each of its files."""
    truth = np.load(folder / "truth.npz")
    points, cells = truth["points"], truth["cells"].astype(np.int64)
    body = Body(points, [("tetra" if cells.shape[1] == 4 else "hexahedron", cells)], False)
    displacement, fixed = truth["displacement"], points[:, 0] < 1e-9
    names = FieldNames("U", handle="0:xmin")
    for path in sorted(folder.glob("*")):
        if path.name in ("all.pvd", "all.xdmf", "mesh.xdmf"):
            simulation = Simulation([body], displacement, np.zeros(displacement.shape[:2]), truth["times"], fixed)
            corners = points[cells]
            if cells.shape[1] == 4 and (np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0).any():
                simulation.defects.add("inside out")
            if path.suffix == ".pvd" and any(map(_lists_twice, folder.glob("*.pvtu"))):
                simulation.defects |= {"twice", "unstitched"}
            series = path.stem == "all"
            yield simulation, Case(path, names if series else None, times=series)


def _lists_twice(path: Path) -> bool:
    """Whether a .pvtu lists a piece twice, as dolfinx does where it writes two functions."""
    pieces = re.findall(r'<Piece Source="(.*?)"', path.read_text())
    return len(set(pieces)) < len(pieces)
