"""What the specification of an assembly says: parts, what holds and moves them, contact and drawn parameters."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.importers.places import Place
from ast_sim.prescribed_motion import RigidMotion
from ast_sim.simulate.own_assembly.expressions import Expression
from ast_sim.simulate.own_assembly.parameters import Parameter, Values
from ast_sim.simulate.own_assembly.spec_table import VectorExpression
from ast_sim.support.errors import ConfigError

STEP_ENDINGS = (".step", ".stp")
IGES_ENDINGS = (".iges", ".igs")
CAD_ENDINGS = (*STEP_ENDINGS, *IGES_ENDINGS, ".brep")
SCRIPT_ENDINGS = (".py", ".geo")
STL_ENDING = ".stl"
FUNCTION = "make"  # of a script, if none is named


@dataclass(frozen=True)
class Move:
    """A rigid motion whose numbers may depend on parameters; see `RigidMotion`.

    Attributes:
        key: where it stands in the specification.
        places: the moved nodes; empty: the whole part.
        path: the waypoints of the translation.
        rotation, axis, point: of the rotation.
    """

    key: str
    places: tuple[Place, ...]
    path: tuple[VectorExpression, ...]
    rotation: Expression
    axis: VectorExpression
    point: VectorExpression

    def motion(self, values: Values) -> RigidMotion:
        """The motion for these values.

        Raises:
            ConfigError: a number cannot be computed, or the axis is zero.
        """

        def vector(of: VectorExpression) -> tuple[float, float, float]:
            x, y, z = (one(values) for one in of)
            return x, y, z

        try:
            path = tuple(map(vector, self.path))
            return RigidMotion(path, self.rotation(values), vector(self.axis), vector(self.point))
        except ConfigError as error:
            raise ConfigError(f"{error}" if str(error).startswith(self.key) else f"{self.key}: {error}") from error


@dataclass(frozen=True)
class Finer:
    """A box in which elements are smaller: its lower and its upper corner, and the size."""

    low: VectorExpression
    high: VectorExpression
    size: Expression


@dataclass(frozen=True)
class PartSpec:
    """A part of the assembly.

    Attributes:
        name: its name.
        files: its variants, as they stand in the specification. A script may be followed by `:FUNCTION`.
        solid: which solid of a file that holds several: its name, or its number from 1; None: the file holds one.
        arguments: what a script is called with.
        scale: lengths of the file are multiplied by this.
        size: length of the elements; None: the mesh or the surface of the file is used as it is.
        finer: where elements are smaller.
        rigid: whether it is a rigid tool.
        hardening: of a part that yields: rows of true stress in pascal and plastic strain; empty: it is elastic.
        self_contact: whether it may touch itself.
        fixed: nodes that stand still.
        moves: nodes that move; of a rigid part, all.
        placement: how the part stands, relative to the coordinates of its file.
    """

    name: str
    files: tuple[str, ...]
    solid: str | int | None
    arguments: dict[str, Expression]
    scale: float
    size: Expression | None
    finer: tuple[Finer, ...]
    rigid: bool
    hardening: tuple[tuple[Expression, Expression], ...]
    self_contact: bool
    fixed: tuple[Place, ...]
    moves: tuple[Move, ...]
    placement: Move


@dataclass(frozen=True)
class AssemblySpec:
    """A specification.

    Attributes:
        path, text: its file and what stands in it.
        unit: unit of all lengths.
        frames: frames of a scene; the first is at rest.
        order: of the elements: 2 for tetrahedra of ten nodes, 1 for tetrahedra of four.
        contact_distance: distance below which surfaces repel each other; None: it follows from the size.
        pair_friction: friction between two parts, by their numbers; all others have the parameter `friction`.
        parameters: all parameters by name.
        parts: the parts; a part and its body have the same number.
    """

    path: Path
    text: str
    unit: str
    frames: int
    order: int
    contact_distance: float | None
    pair_friction: dict[tuple[int, int], Expression]
    parameters: dict[str, Parameter]
    parts: tuple[PartSpec, ...]

    @property
    def yielding(self) -> tuple[str, ...]:
        """The names of the parts that yield; only CalculiX solves them."""
        return tuple(part.name for part in self.parts if part.hardening)

    def file(self, name: str) -> Path:
        """The path of a file that the specification names."""
        return self.path.parent / script_and_function(name)[0]

    def describe(self) -> dict[str, Any]:
        """The content of the specification and of all its files, as JSON values."""
        files = sorted({script_and_function(name)[0] for part in self.parts for name in part.files})
        return {"name": self.path.name, "text": self.text, "files": {name: _sha256(self.file(name)) for name in files}}


def script_and_function(name: str) -> tuple[str, str]:
    """The name of a file, and the function if it is a Python script: `hook.py:slot`."""
    script, colon, function = name.rpartition(".py:")
    return (f"{script}.py", function) if colon else (name, FUNCTION)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
