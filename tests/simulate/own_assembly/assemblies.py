"""Small assemblies for tests: blocks of structured tetrahedra, so that no mesh generator is needed."""

from pathlib import Path

import meshio
import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.parts import rectilinear

SPEC = """
unit = "mm"
frames = 3
contact_distance = 0.05
order = 1

[parameters]
travel = [0.5, 1.5]

[parts.block]
file = "block.vtu"
young = [1e6, 2e6]
poisson = 0.3
fixed = "zmin"

[parts.punch]
file = "punch.vtu"
rigid = true
move = { translation = [0, 0, '-travel'] }
"""

# A strip that is held at one end, and a rigid roller that comes down on the other.
STRIP = """
unit = "mm"
frames = 3
contact_distance = 0.02
{settings}
[parameters]
down = [1, 2]
[parts.strip]
file = "strip.vtu"
young = 1e9
poisson = 0.3
fixed = "xmin"
[parts.roller]
file = "roller.vtu"
rigid = true
move = {{ translation = [0, 0, "-0.2 - down"] }}
"""


def box(low, high, cells):
    lines = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, cells, strict=True)]
    return rectilinear(lines)


def write_box(path: Path, low, high, cells, scale: float = 1.0, shift=(0.0, 0.0, 0.0)) -> None:
    """A box as a mesh file, with the point field `rim` and the group `corner`."""
    position, elements = box(low, high, cells)
    rim = (position[:, 0] == position[:, 0].min()).astype(float)
    sets = {"corner": np.flatnonzero((position[:, :2] <= position[:, :2].min(axis=0) + 2.6).all(axis=1))}
    points = scale * (position + np.array(shift))
    point_data = {} if path.suffix == ".inp" else {"rim": rim}
    meshio.Mesh(points, {"tetra": elements}, point_data, point_sets=sets).write(path)


def write_assembly(folder: Path, spec: str = SPEC, scale: float = 1.0, shift=(0.0, 0.0, 0.0)) -> Path:
    """The specification and its parts: a block of 10 x 10 x 5 and a punch 0.2 above it."""
    write_box(folder / "block.vtu", (0, 0, 0), (10, 10, 5), (4, 4, 2), scale, shift)
    write_box(folder / "punch.vtu", (3, 3, 5.2), (7, 7, 8), (2, 2, 2), scale, shift)
    path = folder / "SPEC.toml"
    path.write_text(spec)
    return path


def case_of(path: Path, **given) -> SolidCase:
    """What is solved for a specification with these parameters."""
    spec = read_spec(path)
    return assembly.scene_of(spec, completed(spec.parameters, given), None, spec.frames).case
