"""Meshes and series that Gmsh, meshio and CalculiX write."""

from __future__ import annotations

import contextlib
import subprocess
from dataclasses import replace
from pathlib import Path

import gmsh
import meshio
import numpy as np

from ast_sim.importers.series import FieldNames
from benchmarks.robustness.dialects.comparison import Case
from benchmarks.robustness.dialects.deck_dialects import TYPES
from benchmarks.robustness.dialects.file_content import FileContent, content_of
from benchmarks.robustness.dialects.random_simulation import Simulation
from benchmarks.robustness.dialects.told import told_of_order
from benchmarks.robustness.dialects.vtk_dialects import NAMES, frame_names

# Gmsh's types of elements, and where the nodes of its order stand in VTK's.
_GMSH = {"tetra": 4, "hexahedron": 5, "wedge": 6, "pyramid": 7, "tetra10": 11, "hexahedron20": 17, "wedge15": 18}
_GMSH_ORDER = {
    "tetra10": [0, 1, 2, 3, 4, 5, 6, 7, 9, 8],
    "hexahedron20": [0, 1, 2, 3, 4, 5, 6, 7, 8, 11, 16, 9, 17, 10, 18, 19, 12, 15, 13, 14],
    "wedge15": [0, 1, 2, 3, 4, 5, 6, 8, 12, 7, 13, 14, 9, 11, 10],
}
# The kinds that Gmsh does not leave out of files of other formats.
_PLAIN = {"tetra", "hexahedron"}
_GMSH_WRITES = {".inp": _PLAIN | {"wedge"}, ".vtk": _PLAIN | {"wedge"}, ".med": _PLAIN | {"wedge"}, ".mesh": _PLAIN}
_HEADING = ("ignored keywords: HEADING",)  # of a deck
_GROUP_NAMES = ["body {}", "pad and tool {}", "a, b {}", "Körper_{}", "B{}"]


def gmsh_mesh(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """Gmsh's own formats of both versions, as text and binary, and what it writes for Abaqus, VTK and Medit."""
    content = content_of(rng, simulation)
    ending = str(rng.choice([".msh", ".msh", ".msh", ".inp", ".vtk", ".mesh", ".med"]))
    if not simulation.kinds <= _GMSH_WRITES.get(ending, simulation.kinds):
        ending = ".msh"
    version, pattern = float(rng.choice([2.2, 4.1])), str(rng.choice(_GROUP_NAMES))
    groups = _model(rng, content, pattern)
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", int(rng.random() < 0.5))
    gmsh.option.setNumber("Mesh.SaveAll", 0)
    path = folder / f"mesh{ending}"
    gmsh.write(str(path))
    simulation.defects.discard("unused")
    if version == 4.1 or ending != ".msh":
        simulation.defects.discard("twice")
    if ending == ".med":
        simulation.defects.discard("inside out")  # Gmsh turns such tetrahedra over as it writes
    return Case(path, groups=groups if ending == ".msh" else {}, told=_HEADING if ending == ".inp" else ())


def _model(rng: np.random.Generator, content: FileContent, pattern: str) -> dict[str, np.ndarray]:
    """The mesh as Gmsh's model, a volume and a physical group for each body; an element twice is in two groups."""
    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
    gmsh.clear()
    gmsh.model.add("mesh")
    groups, element = {}, 1
    bodies = sorted({body for body, _, _ in content.blocks})
    for body in bodies:
        gmsh.model.addDiscreteEntity(3, body + 1)
    numbers = 1 + rng.permutation(3 * len(content.points))[: len(content.points)]
    for body in bodies:
        own = [(kind, cells) for owner, kind, cells in content.blocks if owner == body]
        used = np.unique(np.concatenate([cells.ravel() for _, cells in own]))
        gmsh.model.mesh.addNodes(3, body + 1, numbers[used].tolist(), content.points[used].ravel().tolist())
        for kind, cells in own:
            ordered = cells[:, _GMSH_ORDER[kind]] if kind in _GMSH_ORDER else cells
            once = np.unique(np.sort(cells, axis=1), axis=0, return_index=True)[1]
            rows = ordered[np.sort(once)]
            tags = element + np.arange(len(rows))
            gmsh.model.mesh.addElementsByType(body + 1, _GMSH[kind], tags.tolist(), numbers[rows].ravel().tolist())
            element += len(rows)
        name = pattern.format(body)
        gmsh.model.addPhysicalGroup(3, [body + 1], body + 1, name)
        groups[name] = content.point_of[used]
    if any(len(np.unique(np.sort(c, axis=1), axis=0)) < len(c) for _, _, c in content.blocks):
        gmsh.model.addPhysicalGroup(3, [body + 1 for body in bodies], 77, "everything")
        groups["everything"] = np.concatenate([groups[pattern.format(body)] for body in bodies])
    return groups


def _mesh(content: FileContent, simulation: Simulation, frame: int, moved: bool) -> meshio.Mesh:
    shift = content.values(simulation.displacement[frame])
    fields = {
        "U": shift,
        "S": content.values(simulation.stress[frame]),
        "tool": content.values(simulation.tool).astype(np.int32),
        "fixed": content.values(simulation.fixed).astype(np.float64),
    }
    cells = [(kind, nodes) for _, kind, nodes in content.blocks]
    return meshio.Mesh(content.points + (shift if moved else 0), cells, point_data=fields)


def meshio_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A folder of VTU or legacy files that meshio writes."""
    content, moved = content_of(rng, simulation), bool(rng.random() < 0.3)
    legacy = rng.random() < 0.4
    (folder / "series").mkdir()
    names = frame_names(rng, simulation, ".vtk" if legacy else ".vtu")
    for frame, name in enumerate(names):
        shown = content.in_order(rng) if "order" in simulation.defects and frame else content
        mesh, path = _mesh(shown, simulation, frame, moved), folder / "series" / name
        if legacy:
            kind = "vtk42" if rng.random() < 0.5 else "vtk51"
            mesh.write(path, file_format=kind, binary=bool(rng.random() < 0.5))
        elif rng.random() < 0.3:
            mesh.write(path, file_format="vtu", binary=False)
        else:
            mesh.write(path, file_format="vtu", compression=rng.choice([None, "zlib", "lzma"]))
    return Case(folder / "series", NAMES, told=told_of_order(names, False))


def xdmf_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """An XDMF file with all frames."""
    content = content_of(rng, simulation)
    path = folder / "all.xdmf"
    kind = str(rng.choice(["HDF", "XML", "Binary"]))
    # It writes the file of the numbers into the folder in which it is started.
    with contextlib.chdir(folder), meshio.xdmf.TimeSeriesWriter(path, data_format=kind) as writer:
        mesh = _mesh(content, simulation, 0, False)
        writer.write_points_cells(mesh.points, mesh.cells)
        for frame, time in enumerate(simulation.times):
            writer.write_data(float(time), point_data=_mesh(content, simulation, frame, False).point_data)
    return Case(path, NAMES, times=True)


def meshio_mesh(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """A mesh in one of the formats of meshio."""
    content = content_of(rng, simulation)
    mesh = _mesh(content, simulation, 0, False)
    mesh.point_data = {}
    choices = {".vtu": "vtu", ".inp": "abaqus", ".xdmf": "xdmf"}
    choices |= {".msh": str(rng.choice(["gmsh", "gmsh22"]))}
    if simulation.kinds <= {"tetra", "hexahedron"}:
        choices |= {".mesh": "medit", ".med": "med", ".bdf": "nastran"}
    ending = str(rng.choice(list(choices)))
    path = folder / f"mesh{ending}"
    try:
        mesh.write(path, file_format=choices[ending])
    except (meshio.WriteError, KeyError, AssertionError):  # it does not write these cells or numbers there
        path = folder / "mesh.vtu"
        mesh.write(path)
    return Case(path, told=_HEADING if path.suffix == ".inp" else ())


def calculix_series(rng: np.random.Generator, simulation: Simulation, folder: Path) -> Case:
    """What CalculiX makes of a deck in which every node is moved as the simulation says, a step for each frame."""
    simulation.defects.clear()
    content = content_of(rng, simulation)
    simulation.displacement[0] += 0.01 * simulation.displacement[-1]
    simulation.times = np.arange(1.0, len(simulation.times) + 1)
    lines = ["*NODE"]
    lines += [f"{number + 1},{x:.12g},{y:.12g},{z:.12g}" for number, (x, y, z) in enumerate(content.points)]
    element = 1
    for body, kind, cells in content.blocks:
        lines.append(f"*ELEMENT, TYPE={TYPES[kind][0]}, ELSET=B{body}")
        for row in cells:
            entries = [str(element), *map(str, row + 1)]
            lines += [",".join(entries[:16]) + ("," if len(entries) > 16 else "")]
            lines += [",".join(entries[16:])] if len(entries) > 16 else []
            element += 1
        lines += [f"*SOLID SECTION, ELSET=B{body}, MATERIAL=M"]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "1000.,0.3"]
    binary = rng.random() < 0.5
    for displacement in simulation.displacement:
        moves = content.values(displacement)
        lines += ["*STEP", "*STATIC", "*BOUNDARY"]
        lines += [f"{node + 1},{axis + 1},{axis + 1},{move:.9g}" for (node, axis), move in np.ndenumerate(moves)]
        lines += ["*NODE OUTPUT" if binary else "*NODE FILE", "U", "*END STEP"]
    (folder / "job.inp").write_text("\n".join(lines) + "\n")
    subprocess.run(["ccx", "job"], cwd=folder, check=True, capture_output=True, timeout=60)
    bodies = sorted({body for body, _, _ in content.blocks})
    nodes = simulation.nodes
    lowest = [np.argmax(np.isin(content.point_of, nodes[simulation.body_of_point[nodes] == b])) for b in bodies]
    number = dict(zip(np.argsort(lowest).tolist(), range(len(bodies)), strict=True))
    tools = [body for body in bodies if simulation.bodies[body].tool]
    simulation.fixed = (simulation.body_of_point == 0) & _at_low_x(simulation)
    names = FieldNames("DISP", None, None, f"{number[tools[0]]}:all" if tools else None, f"{number[0]}:xmin")
    return Case(folder / "job.frd", replace(names), times=True)


def _at_low_x(simulation: Simulation) -> np.ndarray:
    x = simulation.points[:, 0]
    low = x[simulation.body_of_point == 0].min()
    return x <= low + 1e-6 * simulation.size
