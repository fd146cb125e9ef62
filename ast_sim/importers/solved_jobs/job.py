"""What a deck says of its job beside the mesh: prescribed nodes, rigid bodies, materials, the ends of its steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.importers.decks.deck_content import read_deck
from ast_sim.importers.decks.deck_mesh import mesh_of_deck
from ast_sim.importers.decks.deck_numbers import real, refuse_decimal_commas, tokens, whole
from ast_sim.importers.decks.deck_parts import Deck
from ast_sim.importers.decks.keyword_lines import Keyword, Line
from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.solved_jobs.job_materials import MATERIAL_KEYWORDS, material_columns
from ast_sim.importers.solved_jobs.job_temperatures import rows_of_target
from ast_sim.number_arrays import connected_parts
from ast_sim.scene import NodeType
from ast_sim.support.errors import DatasetError, counted

# Directions 1 to 3 are displacements, 4 to 6 turns.
_DIRECTIONS = 6
_NAMED = {
    "ENCASTRE": (1, 2, 3, 4, 5, 6),
    "PINNED": (1, 2, 3),
    "XSYMM": (1, 5, 6),
    "YSYMM": (2, 4, 6),
    "ZSYMM": (3, 4, 5),
    "XASYMM": (2, 3, 4),
    "YASYMM": (1, 3, 5),
    "ZASYMM": (1, 2, 6),
}

# With these options of *BOUNDARY the values come from other results or from a subroutine.
_FROM_ELSEWHERE = {"SUBMODEL", "USER"}
_PLAIN = {"OP", "INPUT"}  # with no others the value in a line is the displacement at the end of the step

# Elements in a plane, whose nodes go nowhere along z.
_PLANE = ("CPE", "CPS", "CPEG", "CAX", "CGAX")

# What acts on nodes and is in no scene.
_LOADS = {"CLOAD", "DLOAD", "DSLOAD", "TEMPERATURE", "DFLUX", "CFLUX", "FILM", "RADIATE", "PRE-TENSIONSECTION"}
_CONSTRAINTS = {
    *("EQUATION", "MPC", "COUPLING", "KINEMATIC", "DISTRIBUTING", "DISTRIBUTINGCOUPLING", "TIE", "CYCLICSYMMETRYMODEL"),
}
_PROCEDURES = {
    *("STATIC", "DYNAMIC", "VISCO", "HEATTRANSFER"),
    *("COUPLEDTEMPERATURE-DISPLACEMENT", "UNCOUPLEDTEMPERATURE-DISPLACEMENT"),
}
_OUTPUT = {"NODEFILE", "NODEOUTPUT"}
_READ = {"AMPLITUDE", "BOUNDARY", "RIGIDBODY", "STEP", "ENDSTEP", *_PROCEDURES, *MATERIAL_KEYWORDS}


@dataclass(frozen=True, eq=False)
class Job:
    """A deck that was solved.

    Attributes:
        mesh: its mesh; the points are numbered by `same_point` as the nodes of the deck are.
        node_type: [n] numbers of `NodeType` at the points.
        materials: columns by name, [c] for each block: `young`, `poisson`, and `yield_stress` if something is plastic.
            Empty if some element has no isotropic elastic material.
        ends: the times at which the steps end.
        starts_with: what is there at rest beside a temperature, such as STRESS; see *INITIAL CONDITIONS.
        adjusting: keywords that let CalculiX move nodes onto a surface before the first increment.
        prescribed: for each step [n, 3] the displacements that *BOUNDARY gives the points at its end; NaN where it
            gives none.
    """

    mesh: SourceMesh
    node_type: np.ndarray
    materials: dict[str, list[np.ndarray]]
    ends: tuple[float, ...]
    starts_with: tuple[str, ...] = ()
    adjusting: tuple[str, ...] = ()
    prescribed: tuple[np.ndarray, ...] = ()


@dataclass(eq=False)
class _Conditions:
    """Which directions of which points [n, 6] are prescribed now, in some step, and in all; which points [n] are
    prescribed to move or to turn, belong to a rigid body that is prescribed, or have axes of their own (*TRANSFORM).
    `values` [n, 6] are the displacements that are prescribed now, NaN where none is or the deck does not say it;
    `at_ends` the ones of each step so far."""

    now: np.ndarray
    sometimes: np.ndarray
    always: np.ndarray
    moved: np.ndarray
    turned: np.ndarray
    rigid: np.ndarray
    own_axes: np.ndarray
    values: np.ndarray
    at_ends: list[np.ndarray] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def end_step(self) -> None:
        self.sometimes |= self.now
        self.always &= self.now
        self.at_ends.append(np.where(self.own_axes[:, None] | ~self.now[:, :3], np.nan, self.values[:, :3]))


def read_job(path: Path) -> Job:
    """The job of a deck of CalculiX.

    Nodes are prescribed if *BOUNDARY holds them in all directions or moves them in one, or if they belong to a
    *RIGID BODY whose reference node is prescribed. They are obstacles where a whole body is prescribed in all
    directions, else handles. How they move is in the results, so *AMPLITUDE is not needed.

    Raises:
        DatasetError: a line cannot be read, the deck has parts and instances, or its results are no positions of
            frames; the text names the file and the line.
    """
    deck = read_deck(path)
    if deck.parts:
        raise DatasetError(
            f"{path}: has parts and instances, which CalculiX does not know: its results are of another deck"
        )
    _require_plain_results(deck)
    mesh = mesh_of_deck(deck, _READ)
    conditions = _conditions(deck, mesh)
    materials, more = material_columns(deck, mesh)
    mesh.notes.extend([*conditions.notes, *more, *_not_in_a_scene(deck)])
    starts_with = [_initial(keyword) for keyword in deck.keywords if keyword.name == "INITIALCONDITIONS"]
    if "VELOCITY" in starts_with:
        mesh.notes.append(
            "nodes move at the start (*INITIAL CONDITIONS): in the frame at rest they stand where they are"
        )
    types = _node_type(mesh, conditions)
    prescribed = tuple(conditions.at_ends)
    return Job(mesh, types, materials, _ends(deck), tuple(starts_with), _adjusting(deck), prescribed)


def _adjusting(deck: Deck) -> tuple[str, ...]:
    """*TIE moves nodes unless it says ADJUST=NO, *CONTACT PAIR if it says ADJUST=."""
    names = [
        f"*{keyword.name}" if keyword.name == "TIE" else "*CONTACT PAIR"
        for keyword in deck.keywords
        if (keyword.name == "TIE" and keyword.options.get("ADJUST", "").upper() != "NO")
        or (keyword.name == "CONTACTPAIR" and "ADJUST" in keyword.options)
    ]
    return tuple(dict.fromkeys(names))


def _initial(keyword: Keyword) -> str:
    """What *INITIAL CONDITIONS gives: STRESS, PLASTICSTRAIN, TEMPERATURE and others."""
    return keyword.options.get("TYPE", "").replace(" ", "").upper()


def _require_plain_results(deck: Deck) -> None:
    """Check that displacements are written along x, y and z, and from rest, and that no element comes or goes."""
    turned = any(keyword.name == "TRANSFORM" for keyword in deck.keywords)
    for keyword in deck.keywords:
        if turned and keyword.name in _OUTPUT and keyword.options.get("GLOBAL", "").upper() == "NO":
            raise keyword.error("GLOBAL=NO writes displacements along the axes of *TRANSFORM: leave it out")
        if keyword.name == "MODELCHANGE" and "CONTACT" not in keyword.options.get("TYPE", "").upper():
            raise keyword.error("elements come or go during the job, but all frames of a scene have the same ones")
        if keyword.name == "STEP" and "PERTURBATION" in keyword.options:
            raise keyword.error(
                "PERTURBATION gives displacements from the step before, which are no frames of a motion"
            )


def _conditions(deck: Deck, mesh: SourceMesh) -> _Conditions:
    shape = (len(mesh.points), _DIRECTIONS)
    free = np.zeros(shape, bool)
    moved, turned, rigid, own_axes = (free[:, 0].copy() for _ in range(4))
    values = np.full(shape, np.nan)
    state = _Conditions(free.copy(), free.copy(), np.ones(shape, bool), moved, turned, rigid, own_axes, values)
    renewed = False
    for keyword in deck.keywords:
        if keyword.name == "BOUNDARY":
            if keyword.options.get("OP", "").upper() == "NEW" and not renewed:
                state.now[:] = False
                renewed = True
            for line in keyword.data:
                _prescribe(keyword, line, state, mesh)
        elif keyword.name == "STEP":
            renewed = False
        elif keyword.name == "ENDSTEP":
            state.end_step()
        elif keyword.name == "TRANSFORM":
            state.own_axes[rows_of_target(keyword, keyword.required("NSET"), mesh)] = True
    for keyword in deck.keywords:
        if keyword.name == "RIGIDBODY":
            _rigid_body(keyword, state, mesh)
    partly = (state.sometimes & ~state.always)[:, :3].any(axis=1)
    if partly.any():
        state.notes.append(
            f"{counted(partly.sum(), 'node is', 'nodes are')} prescribed in some steps only: they count as prescribed"
            " in all"
        )
    return state


def _prescribe(keyword: Keyword, line: Line, state: _Conditions, mesh: SourceMesh) -> None:
    """A data line of *BOUNDARY: `node or set, first direction, last direction, value`, or `node or set, ENCASTRE`."""
    refuse_decimal_commas(line, 4, "a target, two directions and a value")
    target, first, last, value = [*tokens(line), "", "", "", ""][:4]
    rows = rows_of_target(keyword, target, mesh)
    if first.upper() in _NAMED:
        held = np.ix_(rows, np.array(_NAMED[first.upper()]) - 1)
        state.now[held] = True
        state.values[held] = 0
        return
    lowest = whole(first, line)
    highest = whole(last, line) if last else lowest
    if not 1 <= lowest <= highest:
        raise DatasetError(f"{line.place}: holds the directions {lowest} to {highest}; the first is 1")
    for direction in range(lowest, min(highest, _DIRECTIONS) + 1):
        state.now[rows, direction - 1] = True
        state.values[rows, direction - 1] = real(value, line) if keyword.options.keys() <= _PLAIN else np.nan
    if real(value, line) != 0 or keyword.options.keys() & _FROM_ELSEWHERE:
        state.moved[rows] |= lowest <= 3
        state.turned[rows] |= 3 < lowest <= _DIRECTIONS


def _rigid_body(keyword: Keyword, state: _Conditions, mesh: SourceMesh) -> None:
    """The nodes of a *RIGID BODY are prescribed as its reference node is; in CalculiX a second node has the turns. A
    node that is not named CalculiX makes itself: it is free."""
    name = next((keyword.options[key] for key in ("NSET", "ELSET", "TIENSET", "PINNSET") if key in keyword.options), "")
    nodes = rows_of_target(keyword, name, mesh)
    reference = keyword.options.get("REFNODE")
    at = np.zeros(0, np.int64) if reference is None else rows_of_target(keyword, reference, mesh)
    turns = state.sometimes[at, 3:].any(axis=0)
    is_turned = state.turned[at].any()
    own_axes = state.own_axes[at].any()
    if "ROTNODE" in keyword.options:
        turning = rows_of_target(keyword, keyword.options["ROTNODE"], mesh)
        turns |= state.sometimes[turning, :3].any(axis=0)
        is_turned |= state.moved[turning].any()
        own_axes |= state.own_axes[turning].any()
    shifts = state.sometimes[at, :3].any(axis=0)
    if not shifts.any() and not is_turned:
        state.notes.append(f"the rigid body {name} is prescribed nowhere: its nodes count as free")
        return
    state.rigid[nodes] = True
    if not (shifts.all() and turns.all()):
        axes = [
            *(f"along {axis}" for axis in np.array([*"xyz"])[~shifts]),
            *(f"about {a}" for a in np.array([*"xyz"])[~turns]),
        ]
        free = f"{', '.join(axes)}{' of *TRANSFORM' if own_axes else ''}"
        state.notes.append(f"the rigid body {name} is free {free}: this motion is taken from the results")


def _node_type(mesh: SourceMesh, conditions: _Conditions) -> np.ndarray:
    """[n] uint8: see `read_job`. For a whole body the nodes count that a scene keeps: the corners, and the middles of
    the edges of tetrahedra."""
    held = conditions.sometimes[:, :3].copy()
    if all(block.label.startswith(_PLANE) for block in mesh.blocks):
        held[:, 2] |= held[:, :2].any(axis=1)
    prescribed = held.all(axis=1) | conditions.moved | conditions.rigid
    kept, may_be_soft = (np.zeros(len(mesh.points), bool) for _ in range(2))
    pairs = [np.zeros((0, 2), np.int64)]
    for block in mesh.blocks:
        if block.dimension == max(one.dimension for one in mesh.blocks):  # shells beside solids become obstacles
            may_be_soft[block.nodes] = True
        kept[block.nodes if block.kind == "tetra10" else block.corners] = True
        rest = block.nodes[:, 1:]
        pairs.append(np.stack([np.repeat(block.nodes[:, 0], rest.shape[1]), rest.ravel()], axis=1))
    body = connected_parts(np.concatenate(pairs), len(mesh.points))
    whole = kept & ~np.isin(body, body[kept & ~prescribed])
    partly = kept & prescribed & ~conditions.rigid & ~held.all(axis=1)
    soft = whole & np.isin(body, np.intersect1d(body[partly], body[may_be_soft]))
    types = np.where(prescribed, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    types[whole & ~soft] = NodeType.OBSTACLE
    turned = kept & conditions.turned & ~prescribed
    sliding = kept & conditions.sometimes.any(axis=1) & ~prescribed & ~turned
    mesh.notes.extend(_free_all_the_same(sliding, turned))
    mesh.notes.extend(_moved_in_part(held, partly, conditions.own_axes))
    if soft.any():
        mesh.notes.append(
            f"{counted(len(np.unique(body[soft])), 'body has', 'bodies have')} prescribed nodes only, some of them free"
            f" along an axis: {counted(soft.sum(), 'node is a handle', 'nodes are handles')} there, not of a rigid tool"
            " (as FieldNames(obstacle=NAME) or --obstacle NAME makes it), and at most a stress is predicted"
        )
    return types


def _free_all_the_same(sliding: np.ndarray, turned: np.ndarray) -> Iterator[str]:
    """Notes on nodes [n] that are held in some directions, and on shell nodes [n] that are turned."""
    if sliding.any():
        yield (
            f"{counted(sliding.sum(), 'node is', 'nodes are')} held in some directions only (symmetry, sliding): they"
            " count as free"
        )
    if turned.any():
        yield (
            f"{counted(turned.sum(), 'node is', 'nodes are')} turned (directions 4 to 6 of *BOUNDARY): turns of nodes"
            " are in no scene, so they count as free"
        )


def _moved_in_part(held: np.ndarray, partly: np.ndarray, own_axes: np.ndarray) -> Iterator[str]:
    """A note for each set of axes along which nodes are free that are moved along another one.

    Args:
        held: [n, 3] the directions that are prescribed; `partly` [n] says at which nodes this is not all of them.
        own_axes: [n] the nodes whose directions are the ones of *TRANSFORM.
    """
    for pattern in np.unique(np.column_stack([held, own_axes])[partly], axis=0):
        nodes = partly & (held == pattern[:3]).all(axis=1) & (own_axes == pattern[3])
        free = " and ".join(np.array([*"xyz"])[~pattern[:3]])
        yield (
            f"{counted(nodes.sum(), 'node is', 'nodes are')} moved, but free along {free}"
            f"{' of *TRANSFORM' if pattern[3] else ''}: this motion is taken from the results, and a question must give"
            " it"
        )


def _ends(deck: Deck) -> tuple[float, ...]:
    """The sums of the periods of the steps, which stand second in the data line of *STATIC or *DYNAMIC, else 1. A step
    may begin at a time of its own."""
    ends: list[float] = []
    for keyword in deck.keywords:
        if keyword.name in _PROCEDURES:
            line = keyword.data[0] if keyword.data else None
            entries = tokens(line) if line is not None else []
            period = real(entries[1], line) if line is not None and len(entries) > 1 and entries[1] else 1.0
            start = keyword.options.get("TOTALTIMEATSTART")
            before = real(start, keyword.line) if start else ends[-1] if ends else 0.0
            ends.append(period + before)
    return tuple(ends)


def _not_in_a_scene(deck: Deck) -> list[str]:
    names = {keyword.name for keyword in deck.keywords}
    notes = []
    if "AMPLITUDE" in names:
        notes.append("*AMPLITUDE is not computed: nodes move as in the results")
    if names & _LOADS:
        notes.append(
            f"loads are not part of a scene and must be equal in all of them: {', '.join(sorted(names & _LOADS))}"
        )
    if names & _CONSTRAINTS:
        listed = ", ".join(sorted(names & _CONSTRAINTS))
        notes.append(
            f"constraints are not read: {listed}; mark nodes that they move by FieldNames(handle=NAME)"
            " or FieldNames(obstacle=NAME) (--handle NAME, --obstacle NAME)"
        )
    return notes
