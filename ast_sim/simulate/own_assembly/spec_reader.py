"""Reading the specification of an assembly from a TOML file; docs/reference/assembly.md explains every key."""

from __future__ import annotations

import os
import tomllib
from itertools import chain
from pathlib import Path
from typing import Any

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.importers.frames_in_file import is_of_known_kind
from ast_sim.importers.places import Place, parse_places
from ast_sim.simulate.own_assembly.assembly_spec import (
    CAD_ENDINGS,
    SCRIPT_ENDINGS,
    STL_ENDING,
    AssemblySpec,
    Finer,
    Move,
    PartSpec,
)
from ast_sim.simulate.own_assembly.expressions import FUNCTIONS, Expression
from ast_sim.simulate.own_assembly.parameters import Parameter, parameter, plain, require_solvable
from ast_sim.simulate.own_assembly.spec_table import Table, VectorExpression
from ast_sim.support.argument_checks import file_name
from ast_sim.support.disk import read_text
from ast_sim.support.errors import ConfigError, nearest_name

DEFAULT_FRAMES = 6
DEFAULT_ORDER = 2  # linear tetrahedra are several times too stiff where a part bends, and where rubber is pressed
ELASTIC, ELASTOPLASTIC = "neo_hookean", "elastoplastic"  # the laws that a part may have
# How keys begin that other programs have, and what to do instead.
INSTEAD = {
    ("force", "load", "pressure", "traction", "torque", "moment"): (
        "forces cannot be prescribed, only motions: give a move whose travel is a range, and read off at which travel"
        " the answers have this reaction"
    ),
    ("gravity", "acceleration", "velocity", "density", "mass"): (
        "scenes are quasi-static, without weight or inertia: leave it out, and give motions by move"
    ),
    ("tie", "glue", "bond", "weld"): (
        "parts cannot be glued to each other. One that is glued to a much stiffer one, as rubber to metal, moves with"
        " it: make the stiffer one rigid, and give the nodes of the other at the joint its move (or fixed), such as"
        " move = { where = 'zmin', translation = ... }. Parts of one material are glued as one part of one mesh"
    ),
    ("symmetry",): (
        "nodes stand still in all directions or in none, so half a part cannot slide in its plane of symmetry: simulate"
        " the whole part"
    ),
    ("temperature", "thermal", "expansion"): "there is no heat in these scenes: leave it out",
}


def read_spec(path: str | os.PathLike[str]) -> AssemblySpec:
    """Read and check a specification. No part is read yet.

    Raises:
        ConfigError: the file is missing or no TOML, a key is unknown or missing, a value does not fit, or a file is
            missing that it names.
    """
    path = file_name(path, "spec")
    try:
        spec = parse_spec(path, read_text(path))
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{path}: the specification cannot be read: {reason}") from error
    try:
        _check_files(spec)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return spec


def parse_spec(path: Path, text: str) -> AssemblySpec:
    """The specification with this text; its files need not be there.

    Raises:
        ConfigError: as in `read_spec`.
    """
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: the specification cannot be read: {error}") from error
    try:
        return _spec(path.resolve(), text, Table(values, ""))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _spec(path: Path, text: str, table: Table) -> AssemblySpec:
    _refuse_other_words(table)
    unit, frames, order = table.text("unit"), table.take("frames", DEFAULT_FRAMES), table.take("order", DEFAULT_ORDER)
    if unit not in LENGTH_UNITS:
        told = "is missing" if unit is None else f"is {unit!r}"
        raise ConfigError(f"unit {told}; say in which unit lengths are: {', '.join(LENGTH_UNITS)}")
    if not isinstance(frames, int) or isinstance(frames, bool) or frames < 2:
        raise ConfigError(f"frames is {frames!r}; must be a whole number of at least 2")
    if order not in (1, 2) or isinstance(order, bool):
        raise ConfigError(f"order is {order!r}; must be 2 (tetrahedra of ten nodes) or 1 (of four nodes)")
    named = Table(table.take("parameters", {}), "parameters")
    parameters: dict[str, Parameter] = {}
    for name in named.values:
        if not name.isidentifier() or name in FUNCTIONS:
            raise ConfigError(f"the parameter {name!r} needs another name, of letters, digits and _")
        parameters[name] = parameter(name, named.take(name))
    if "friction" in parameters and "friction" in table.values:
        raise ConfigError("friction stands beside the parameters and among them: leave one out")
    free = dict(parameters)
    if "friction" not in parameters:
        parameters["friction"] = parameter("friction", table.take("friction", 0.0), free)
    parts = tuple(_part(name, value, free, parameters) for name, value in _parts(table).items())
    distance = table.take("contact_distance")
    if distance is not None and not (_is_number(distance) and distance > 0):
        raise ConfigError(f"contact_distance is {distance!r}; must be a number above 0")
    table.known = plain(free)
    pairs = dict(_pair(row, [part.name for part in parts]) for row in table.tables("contact"))
    table.done()
    spec = AssemblySpec(path, text, unit, frames, int(order), distance, pairs, parameters, parts)
    _check_used(spec, free)
    return spec


def _parts(table: Table) -> dict[str, Any]:
    parts = Table(table.take("parts", {}), "parts").values
    if len(parts) < 2:
        raise ConfigError(f"an assembly has two parts or more, [parts.NAME]; here {len(parts)}")
    for name in parts:
        if not name.isidentifier():
            raise ConfigError(f"the part {name!r} needs a name of letters, digits and _")
    return parts


def _part(name: str, values: Any, free: dict[str, Parameter], parameters: dict[str, Parameter]) -> PartSpec:
    """A part; its quantities are added to the parameters."""
    table = Table(values, f"parts.{name}", plain(free))
    _refuse_other_words(table)
    rigid, files = table.flag("rigid"), table.take("file")
    files = [files] if isinstance(files, str) else files
    if not isinstance(files, list) or not files or not all(isinstance(file, str) for file in files):
        raise ConfigError(f"{table.key('file')} is {files!r}; must be the name of a file, or of each variant")
    if len(files) > 1:
        parameters[f"{name}.file"] = Parameter(f"{name}.file", choices=tuple(files))
    for quantity in ("young", "poisson"):
        given = table.take(quantity)
        if rigid and given is not None:
            raise ConfigError(
                f"{table.key(quantity)}: a rigid part has no {quantity}: leave it out, or leave out rigid"
            )
        if not rigid:
            if given is None:
                raise ConfigError(f"{table.key(quantity)} is missing; say what {name} is made of, or that it is rigid")
            _add_material(parameters, f"{name}.{quantity}", given, free)
    arguments = Table(table.take("arguments", {}), table.key("arguments"), plain(free))
    scale = table.take("scale", 1.0)
    if not (_is_number(scale) and scale > 0):
        raise ConfigError(f"{table.key('scale')} is {scale!r}; must be a number above 0")
    part = PartSpec(
        name,
        tuple(files),
        _solid(table),
        {key: expression for key in arguments.values if (expression := arguments.number(key)) is not None},
        float(scale),
        table.number("size"),
        tuple(_finer(row) for row in table.tables("finer")),
        rigid,
        _hardening(table, rigid),
        table.flag("self_contact"),
        _places(table, "fixed"),
        _moves(table, rigid),
        _placement(table),
    )
    table.done()
    return part


def _hardening(table: Table, rigid: bool) -> tuple[tuple[Expression, Expression], ...]:
    """The rows of the table of a part that yields; empty if it does not."""
    law, rows = table.text("law"), table.pairs("hardening")
    if law not in (None, ELASTIC, ELASTOPLASTIC):
        raise ConfigError(f"{table.key('law')} is {law!r}; must be {ELASTOPLASTIC}, or {ELASTIC} (if left out)")
    if rigid and law is not None:
        raise ConfigError(f"{table.key('law')}: a rigid part has no law: leave it out, or leave out rigid")
    if (law == ELASTOPLASTIC) != bool(rows):
        raise ConfigError(
            f"{table.key('hardening')}: rows of true stress in pascal and plastic strain, such as [['yield_stress', 0],"
            f" ['yield_stress + 2e8', 0.2]], go with law = '{ELASTOPLASTIC}', and only with it"
        )
    return rows


def _solid(table: Table) -> str | int | None:
    solid = table.take("solid")
    if solid is not None and (isinstance(solid, bool) or not isinstance(solid, str | int)):
        raise ConfigError(f"{table.key('solid')} is {solid!r}; must be the name of a solid, or its number from 1")
    return solid


def _add_material(parameters: dict[str, Parameter], name: str, given: Any, free: dict[str, Parameter]) -> None:
    made = parameter(name, given, free)
    if made.formula is None:
        require_solvable(name, made.low, made.high)
    parameters[name] = made


def _moves(table: Table, rigid: bool) -> tuple[Move, ...]:
    rows = table.tables("move")
    if rigid and len(rows) > 1:
        raise ConfigError(f"{table.key('move')}: a rigid part moves as a whole, so it has one move; here {len(rows)}")
    return tuple(_move(row, rigid) for row in rows)


def _refuse_other_words(table: Table) -> None:
    for name in table.values:
        for words, instead in INSTEAD.items():
            if name.lower().startswith(words):
                raise ConfigError(f"{table.key(name)}: {instead}")


def _move(table: Table, rigid: bool) -> Move:
    _refuse_other_words(table)
    where = _places(table, "where")
    if rigid and where:
        raise ConfigError(f"{table.key('where')}: a rigid part moves as a whole: leave it out")
    if not rigid and not where:
        raise ConfigError(f"{table.key('where')} is missing; say which nodes move, for example where = 'zmax'")
    path, rotation = table.path("translation"), table.number("rotation")
    if path is None and rotation is None:
        raise ConfigError(f"{table.place} needs a translation, a rotation or both")
    return _rigid_motion(table, where, path)


def _rigid_motion(table: Table, places: tuple[Place, ...], path: tuple[VectorExpression, ...] | None) -> Move:
    axis, point = table.vector("axis", [0, 0, 1]), table.vector("point", [0, 0, 0])
    rotation = table.number("rotation", 0)
    still = Table({"still": [0, 0, 0]}, table.place).path("still")
    table.done()
    assert axis is not None and point is not None and rotation is not None and still is not None
    return Move(table.place, places, path or still, rotation, axis, point)


def _placement(table: Table) -> Move:
    """How a part stands: turned by `tilt`, then moved by `offset`."""
    offset = table.vector("offset", [0, 0, 0])
    tilt = Table(table.take("tilt", {}), table.key("tilt"), table.known)
    assert offset is not None
    return _rigid_motion(tilt, (), (offset,))


def _finer(table: Table) -> Finer:
    low, high, size = table.vector("low"), table.vector("high"), table.number("size")
    table.done()
    if low is None or high is None or size is None:
        raise ConfigError(f"{table.place} needs low and high, two corners of a box, and size")
    return Finer(low, high, size)


def _places(table: Table, name: str) -> tuple[Place, ...]:
    text = table.text(name)
    try:
        return () if text is None else tuple(parse_places(text))
    except ValueError as error:
        raise ConfigError(
            f"{table.key(name)} = {text!r} cannot be read at {str(error)!r}; write for example 'zmin', 'xmin,xmax',"
            " 'z<=2', '0<x<5 and y>1', 'field=NAME', 'group=NAME' or 'group=\"A and B\"'"
        ) from error


def _pair(table: Table, names: list[str]) -> tuple[tuple[int, int], Expression]:
    pair, friction = table.take("parts"), table.number("friction")
    if not isinstance(pair, list) or len(pair) != 2:
        raise ConfigError(f"{table.key('parts')} is {pair!r}; must name two parts")
    for name in pair:
        if name not in names:
            raise ConfigError(f"{table.key('parts')}: there is no part {name!r}{nearest_name(str(name), names)}")
    if friction is None:
        raise ConfigError(f"{table.key('friction')} is missing")
    table.done()
    first, second = sorted(names.index(name) for name in pair)
    return (first, second), friction


def _check_used(spec: AssemblySpec, free: dict[str, Parameter]) -> None:
    """Refuse a parameter that nothing depends on: it is a slip of the pen."""
    used: set[str] = set()
    for part in spec.parts:
        numbers = [*part.arguments.values(), *filter(None, [part.size]), *chain.from_iterable(part.hardening)]
        numbers += [one for finer in part.finer for one in (*finer.low, *finer.high, finer.size)]
        for move in (*part.moves, part.placement):
            numbers += [*(one for corner in move.path for one in corner), move.rotation, *move.axis, *move.point]
        used |= {name for one in numbers for name in one.names}
    formulas = [one.formula for one in spec.parameters.values() if one.formula is not None]
    used |= {name for one in (*formulas, *spec.pair_friction.values()) for name in one.names} | {"friction"}
    idle = [name for name in free if name not in used]
    if idle:
        raise ConfigError(f"nothing depends on the parameter {idle[0]!r}: use it, or leave it out")


def _check_files(spec: AssemblySpec) -> None:
    for part in spec.parts:
        for name in part.files:
            path = spec.file(name)
            suffix = path.suffix.lower()
            if suffix not in (*CAD_ENDINGS, *SCRIPT_ENDINGS) and not is_of_known_kind(path):
                raise ConfigError(f"parts.{part.name}.file: {name} is no STEP, IGES, BREP, STL, mesh, .geo or .py file")
            if not path.is_file():
                raise ConfigError(f"parts.{part.name}.file: there is no file {path}")
            meshed = suffix in (*CAD_ENDINGS, *SCRIPT_ENDINGS, STL_ENDING)
            if meshed and part.size is None and not (part.rigid and suffix == STL_ENDING):
                raise ConfigError(f"parts.{part.name}.size is missing; {name} must be meshed: give the element length")
            if not meshed and part.size is not None:
                raise ConfigError(f"parts.{part.name}.size: {name} is a mesh already, and stays as it is: leave it out")
            if part.solid is not None and suffix not in (*CAD_ENDINGS, STL_ENDING):
                raise ConfigError(f"parts.{part.name}.solid: {name} is no CAD or STL file: leave it out")
            if part.arguments and suffix not in SCRIPT_ENDINGS:
                raise ConfigError(f"parts.{part.name}.arguments: {name} is no script (.py, .geo) that takes any")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
