"""Where the parts of a scene come from: gmsh's grammar, structured shapes, or files of the user."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ast_sim.importers.formats.stl_file import BadSurface
from ast_sim.importers.frames_in_file import is_of_known_kind
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.order_of_files.left_out import no_pieces
from ast_sim.simulate.shapes.cad import gmsh_process, grammar
from ast_sim.simulate.shapes.cad.surface_mend import stl_surface
from ast_sim.simulate.shapes.mesh_check import SMALLEST_ANGLE, BadMesh, check_mesh, check_surface
from ast_sim.simulate.shapes.parts import Part, draw_structured
from ast_sim.support.errors import ConfigError, DatasetError, MissingExtra, warn

STEP_ENDINGS = (".step", ".stp")
STL_ENDING = ".stl"
TRIAL_NODES = 1000  # nodes of the mesh that checks a CAD file
_IGNORED = (".txt", ".md", ".json")  # notes that may lie beside the parts


class Mesher(Protocol):
    """Meshes two parts, any number of times."""

    def __call__(self, nodes: int, smallest_angle: float = SMALLEST_ANGLE) -> tuple[Part, Part]:
        """Meshes with about `nodes` nodes together and no dihedral angle below that one, in degrees.

        Raises:
            BadMesh, MeshingFailed: these parts cannot be used. Others may be.
        """
        ...


class PartSource(Protocol):
    """Gives pairs of parts."""

    @property
    def mesher(self) -> str:
        """Name and version of what makes the meshes."""
        ...

    def describe(self) -> dict[str, Any]:
        """All that the parts depend on except the random numbers, as JSON values."""
        ...

    def check(self) -> None:
        """Raise SimulationError if a part that may be drawn is broken; warnings tell what was not taken as it is."""

    def draw(self, rng: np.random.Generator) -> Mesher:
        """Two parts, ready to be meshed."""
        ...


def part_source(parts: Path | None = None) -> PartSource:
    """The source of parts for a file or folder of STEP, STL or mesh files.

    If `parts` is None, the source is gmsh's grammar, or structured parts where gmsh is not installed.

    Raises:
        ConfigError: the path does not exist or holds no such file.
        MissingExtra: STEP or STL files need gmsh, which is not installed.
    """
    if parts is not None:
        return FileParts(_files(Path(parts)))
    version = gmsh_process.gmsh_version()
    return StructuredParts() if version is None else GrammarParts(version)


@dataclass(frozen=True)
class GrammarParts:
    """Solids of the grammar in `ast_sim.simulate.shapes.cad.grammar`."""

    version: str

    @property
    def mesher(self) -> str:
        return f"gmsh {self.version}"

    def describe(self) -> dict[str, Any]:
        return {"mesher": self.mesher}

    def check(self) -> None:
        """Nothing to check: each part is checked when it is drawn."""

    def draw(self, rng: np.random.Generator) -> Mesher:
        name_a, steps_a = grammar.draw_solid(rng)
        name_b, steps_b = grammar.draw_solid(rng)
        requests, names = [{"solid": steps_a}, {"solid": steps_b}], [name_a, name_b]
        return lambda nodes, smallest_angle=SMALLEST_ANGLE: _checked(
            gmsh_process.mesh_parts(requests, names, nodes), smallest_angle
        )


@dataclass(frozen=True)
class StructuredParts:
    """Shapes that need no mesh generator."""

    mesher: str = "structured"

    def describe(self) -> dict[str, Any]:
        return {"mesher": self.mesher}

    def check(self) -> None:
        """Nothing to check: each part is checked when it is drawn."""

    def draw(self, rng: np.random.Generator) -> Mesher:
        shapes = [draw_structured(rng), draw_structured(rng)]
        return lambda nodes, smallest_angle=SMALLEST_ANGLE: _checked([s(nodes // 2) for s in shapes], smallest_angle)


@dataclass(frozen=True)
class FileParts:
    """Files of the user; each part is scaled to a diagonal of one. A single file is paired with itself."""

    files: tuple[Path, ...]

    @property
    def mesher(self) -> str:
        return f"gmsh {gmsh_process.gmsh_version()}" if any(map(_is_cad, self.files)) else "none"

    def describe(self) -> dict[str, Any]:
        return {"mesher": self.mesher, "parts": {path.name: _sha256(path) for path in self.files}}

    def check(self) -> None:
        for path in self.files:
            (part,) = _load([path], TRIAL_NODES)
            check_mesh(part.position, part.elements, path.name)
            notes = stl_surface(path).notes if path.suffix.lower() == STL_ENDING else part.notes
            if notes:
                warn(f"{path.name}: {'; '.join(notes)}")

    def draw(self, rng: np.random.Generator) -> Mesher:
        count = len(self.files)
        chosen = [0, 0] if count == 1 else rng.choice(count, 2, replace=False)
        files = [self.files[i] for i in chosen]
        return lambda nodes, smallest_angle=SMALLEST_ANGLE: _checked(_load(files, nodes), smallest_angle)


def _checked(parts: list[Part], smallest_angle: float) -> tuple[Part, Part]:
    for part in parts:
        check_mesh(part.position, part.elements, part.name, smallest_angle)
    first, second = parts
    return first, second


def _files(path: Path) -> tuple[Path, ...]:
    if not path.exists():
        raise ConfigError(f"{path} does not exist: give a STEP, STL or mesh file, or a folder of them")
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    if path.is_dir():
        files = [f for f in files if f.is_file() and not f.name.startswith(".") and f.suffix.lower() not in _IGNORED]
        files = no_pieces(files)
    if not files:
        raise ConfigError(f"{path} holds no files: give a STEP, STL or mesh file, or a folder of them")
    for file in files:
        if not _is_cad(file) and not is_of_known_kind(file):
            raise ConfigError(f"{file} is no STEP, STL or mesh file: files of the kind {file.suffix} are not read")
        if _is_cad(file) and gmsh_process.gmsh_version() is None:
            raise MissingExtra(f'gmsh is needed to mesh {file.name} but is not installed: pip install "ast_sim[cad]"')
    return tuple(files)


def _is_cad(path: Path) -> bool:
    return path.suffix.lower() in (*STEP_ENDINGS, STL_ENDING)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(paths: list[Path], nodes: int) -> list[Part]:
    """The parts of files. Meshes stay as they are.

    CAD files are meshed so that all parts together have about `nodes` nodes.

    Raises:
        BadMesh, MeshingFailed: the text names the file.
    """
    parts = {i: meshed_part(path) for i, path in enumerate(paths) if not _is_cad(path)}
    solids = [i for i in range(len(paths)) if i not in parts]
    if solids:
        left = nodes - sum(len(part.position) for part in parts.values())
        requests = [_request(paths[i]) for i in solids]
        names = [paths[i].name for i in solids]
        try:
            meshed = gmsh_process.mesh_parts(requests, names, max(left, nodes // 2))
        except gmsh_process.MeshingFailed as error:
            raise gmsh_process.MeshingFailed(f"{' or '.join(dict.fromkeys(names))}: {error}") from error
        parts |= dict(zip(solids, meshed, strict=True))
    return [parts[i] for i in range(len(paths))]


def _request(path: Path) -> dict[str, str]:
    if path.suffix.lower() in STEP_ENDINGS:
        return {"step": str(path.resolve())}
    try:
        surface = stl_surface(path)
    except BadSurface as error:
        raise BadMesh(f"{path.name}: {error}") from error
    check_surface(surface.position, surface.triangles, path.name)
    return {"stl": str(path.resolve())}


def meshed_part(path: Path) -> Part:
    """The tetrahedra of a mesh file, as scenes have them, scaled to a diagonal of one. Only the corners of quadratic
    tetrahedra are used.

    Raises:
        BadMesh: the file cannot be read or holds no tetrahedra.
    """
    try:
        mesh = read_mesh(path, corners=True)
    except DatasetError as error:
        raise BadMesh(str(error).replace(str(path), path.name, 1)) from error
    if mesh.elements.shape[1] == 3:
        raise BadMesh(f"{path.name}: it holds no tetrahedra, but {', '.join(mesh.source.counts())}")
    used, elements = np.unique(mesh.elements, return_inverse=True)
    position = mesh.points[used]
    elements = elements.reshape(-1, 4)
    check_mesh(position, elements, path.name)
    return Part(position / np.linalg.norm(np.ptp(position, axis=0)), elements, path.name, tuple(mesh.notes))
