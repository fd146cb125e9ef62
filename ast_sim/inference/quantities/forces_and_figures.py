"""What an engineer asks of an answer: the forces on its bodies from outside, the permanent set, figures of each frame.

A model may predict the nodal reactions of its data. They are summed over the prescribed nodes, since free nodes have
none. Otherwise, and after Newton steps, forces follow from the positions, if the law of the material is known and
elastic: small errors of the network's positions make large ones in these forces, and Newton steps remove them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.inference.quantities.frames_of_answers import time_of
from ast_sim.material import Material
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.permanent_set import PermanentSet, permanent_sets, yielding_bodies
from ast_sim.named_field import PLASTIC_STRAIN, REACTION
from ast_sim.number_arrays import plain_array, three_numbers
from ast_sim.support.errors import AstSimError, ConfigError, SimulationError, counted, warn
from ast_sim.view import sweep_files
from ast_sim.view.files import make_folder

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer


STIFFER = (
    "the run learned from elements of a higher order by their corners only (--corners, corners=True), which are stiffer"
)


class BodyForce(NamedTuple):
    """What acts on the prescribed nodes of a body in one frame.

    Attributes:
        frame: the number of the frame in the motion of the question.
        time: in seconds; None: it is not known.
        body: the number of the body.
        force: [3] in newton.
        torque: [3] in newton metres, about the mean position of the nodes of the body in this frame.
    """

    frame: int
    time: float | None
    body: int
    force: np.ndarray
    torque: np.ndarray


def force_on(answer: Answer, nodes: np.ndarray | Sequence[int] | None) -> np.ndarray:
    """[S, 3]: the force in newton on prescribed nodes, by default `answer.driven`; errors as in `Answer.reaction`."""
    if answer.info is None or (nodes is None and answer.driven is None):
        raise ConfigError(f"{answer.name} has no reaction: no prescribed node moves, or the answer is of no run")
    _tell_if_stiffer(answer)
    if nodes is None:
        assert answer.driven is not None
        return _newton(answer, answer.driven).sum(axis=1)
    chosen = _prescribed(answer, nodes)
    bodies = np.unique(answer.scene.body[chosen]).tolist()
    parts = [_on_body(answer, body, chosen & (answer.scene.body == body)) for body in bodies]
    return np.sum([shares.sum(axis=1) for shares in parts], axis=0)


def is_stiffer(answer: Answer) -> bool:
    """Whether no force of an answer is promised; see `STIFFER`."""
    return answer.info is not None and answer.info.corners_only


def _tell_if_stiffer(answer: Answer) -> None:
    if is_stiffer(answer):
        warn(f"the force is not the one of the simulations: {STIFFER}. Convert them with all nodes of their elements")


def _prescribed(answer: Answer, nodes: np.ndarray | Sequence[int]) -> np.ndarray:
    """[N] bool: nodes that are given as such, or by their numbers; raise ConfigError unless all are prescribed."""
    scene = answer.scene
    given = plain_array(answer.name, "nodes", nodes)
    wrong_mask = given.dtype == bool and given.shape != (scene.num_nodes,)
    if wrong_mask or given.ndim != 1 or given.dtype.kind not in "biu":
        raise ConfigError(
            f"{answer.name}: nodes holds {given.dtype} in the shape {list(given.shape)}; must be [{scene.num_nodes}]"
            " bool, or numbers of nodes"
        )
    numbers = np.flatnonzero(given) if given.dtype == bool else given
    outside = (numbers < 0) | (numbers >= scene.num_nodes)
    if outside.any() or not len(numbers):
        told = f"there is no node {numbers[outside][0]}" if len(numbers) else "nodes names none"
        raise ConfigError(f"{answer.name}: {told}; the scene has {counted(scene.num_nodes, 'node')}")
    free = np.unique(numbers[~scene.prescribed[numbers]])
    if len(free):
        are = counted(len(free), "node of the wanted force is", "nodes of the wanted force are")
        raise ConfigError(
            f"{answer.name}: {are} free, the first is node {free[0]}: nothing from outside acts on free nodes. Name"
            f" some of the {counted(int(scene.prescribed.sum()), 'prescribed node')} (scene.prescribed)"
        )
    chosen = np.zeros(scene.num_nodes, bool)
    chosen[numbers] = True
    return chosen


def _on_body(answer: Answer, body: int, nodes: np.ndarray) -> np.ndarray:
    """[S, N, 3]: the shares of prescribed nodes [N] bool of a body in the force on them, in newton."""
    own = answer.scene.prescribed & (answer.scene.body == body)
    left_out = int(own.sum() - nodes.sum())
    if left_out and body in answer.scene.rigid_bodies and REACTION not in answer.fields:
        are = counted(left_out, "node", "nodes")
        raise ConfigError(
            f"{answer.name}: body {body} is rigid, so positions show the force on all of it alone: {are} of"
            f" {own.sum():,} left out; name all of them, or predict reactions (state=['reaction'])"
        )
    return _newton(answer, Driven(body, nodes, answer.position[:, nodes].astype(np.float64)))


def forces_on_bodies(answer: Answer) -> list[BodyForce]:
    """The force and the torque on each body that has prescribed nodes, frame by frame; errors as in
    `Answer.reaction`."""
    scene = answer.scene
    if answer.info is None:
        raise ConfigError(f"{answer.name} has no reaction: the answer is of no run")
    _tell_if_stiffer(answer)
    metres = LENGTH_UNITS[answer.info.length_unit]
    rows = []
    for body in np.unique(scene.body[scene.prescribed]).tolist():
        own = scene.body == body
        shares = _on_body(answer, body, scene.prescribed & own)
        position = answer.position.astype(np.float64)
        arms = metres * (position - position[:, own].mean(axis=1, keepdims=True))
        torques = np.cross(arms, shares).sum(axis=1)
        times = [time_of(answer, number) for number in answer.frames]
        forces = zip(answer.frames, times, shares.sum(axis=1), torques, strict=True)
        rows += [BodyForce(frame, time, body, force, torque) for frame, time, force, torque in forces]
    return sorted(rows, key=lambda row: (answer.frames.index(row.frame), row.body))


def sets_of_answer(answer: Answer) -> list[PermanentSet]:
    """See `Answer.permanent_set`."""
    moves_on = answer.given > 1  # by inertia, whatever the prescribed nodes do
    if answer.driven is None or moves_on or not answer.frames:
        return []
    last = max(answer.frames)
    row = answer.frames.index(last)
    strain = answer.fields.get(PLASTIC_STRAIN)
    yielding = yielding_bodies(
        answer.scene,
        Material() if answer.law is None else answer.law.material,
        None if strain is None else strain.select([row]),
    )
    return permanent_sets(answer.scene, yielding, answer.driven, answer.position[row], last)


def told_sets(answer: Answer) -> list[str]:
    """The permanent set of each body as a sentence."""
    unit = "" if answer.info is None else f" {answer.info.length_unit}"
    return [
        f"permanent set of body {one.body}: {one.largest:.3g}{unit} at most, {one.mean:.3g}{unit} on average over its"
        f" free nodes (frame {one.frame})"
        for one in answer.permanent_set()
    ]


def write_forces(path: Path, forces: list[BodyForce], sets: list[PermanentSet]) -> None:
    """Write a table (.csv) with a row for each frame and body; errors as in `Answer.save_forces`.

    A permanent set stands in the row of its frame and body. A body without prescribed nodes has no other row."""
    if path.suffix != ".csv":
        raise AstSimError(f"{path}: the name of a table of forces must end in .csv")
    rows: dict[tuple[int, int], dict[str, float | None]] = {}
    for one in forces:
        row = rows[one.frame, one.body] = {"frame": one.frame, "time": one.time, "body": one.body}
        for name, values in (("force", one.force), ("torque", one.torque)):
            row |= {f"{name}_{axis}": float(value) for axis, value in zip("xyz", values, strict=True)}
    for left in sets:
        row = rows.setdefault((left.frame, left.body), {"frame": left.frame, "body": left.body})
        row |= {"permanent_set": left.largest, "mean_permanent_set": left.mean}
    make_folder(path.parent)
    sweep_files.write_table(path, list(rows.values()))


def write_figures(path: Path, answer: Answer) -> None:
    """Write `Answer.figures` as a table (.csv), a row for each frame, with places relative to the answer's origin, and
    the notes on the scene in each row: the table is read without the warnings."""
    origin = answer.source.get("origin")
    figures = answer.figures(origin if isinstance(origin, list) else [0.0, 0.0, 0.0])
    notes = {"notes": "; ".join(answer.notes)} if answer.notes else {}
    rows = [{"frame": frame, **row, **notes} for frame, row in zip(answer.frames, figures, strict=True)]
    sweep_files.write_table(path, rows)


def figures_of(answer: Answer, origin: Sequence[float]) -> list[dict[str, float]]:
    """See `Answer.figures`."""
    scene = answer.scene
    rows = []
    shift = three_numbers(answer.name, "origin", origin)
    try:
        forces = answer.reaction()
    except ConfigError:  # a figure that this scene has not
        forces = None
    computed = sorted(number for number in answer.frames if number >= answer.given)
    last_steps = dict(zip(computed, answer.last_steps, strict=False))
    sets = answer.permanent_set()
    for frame, position in enumerate(answer.position):
        travel = np.linalg.norm((position - scene.rest_position)[scene.prescribed], axis=1)
        row = {"travel_of_nodes": float(travel.max(initial=0.0))}
        if forces is not None:
            row |= {"reaction": float(np.linalg.norm(forces[frame]))}
            row |= {f"reaction_{axis}": float(force) for axis, force in zip("xyz", forces[frame], strict=True)}
        if answer.stress is not None:
            stress = answer.stress[frame, :, 0]
            worst = int(np.where(scene.deforming(answer.stress_location or "node"), stress, -np.inf).argmax())
            nodes = scene.elements[worst] if answer.stress_location == "element" else [worst]
            place = position[nodes].mean(axis=0) + shift
            row |= {"largest_stress": float(stress[worst])}
            row |= {f"stress_at_{axis}": float(x) for axis, x in zip("xyz", place, strict=True)}
        for name, one in answer.fields.items():
            if name != REACTION:
                values = one.values[frame]
                size = values if values.shape[1] == 1 else np.linalg.norm(values, axis=1)
                row |= {f"largest_{name}": float(size.max())}
        if sets and answer.frames[frame] == sets[0].frame:
            row |= {"permanent_set": max(one.largest for one in sets)}
        if answer.frames[frame] in last_steps:
            row |= {"last_newton_step": last_steps[answer.frames[frame]]}
        rows.append(row)
    return rows


def _newton(answer: Answer, driven: Driven) -> np.ndarray:
    """[S, N, 3] in newton: the shares of the nodes in the force on the prescribed nodes `driven`."""
    if REACTION in answer.fields:  # after Newton steps there are none
        return np.where(driven.nodes[:, None], answer.fields[REACTION].values, 0).astype(np.float64)
    try:
        law = _elastic_law(answer)
    except (ConfigError, SimulationError) as error:
        raise ConfigError(f"{answer.name} has no reaction: {error}") from error
    from ast_sim.mechanics.reaction import Reaction

    assert answer.info is not None and answer.law is not None
    reaction = Reaction(answer.scene, driven, law, answer.law.contact_forces(answer.scene))
    shares = [reaction.shares(position) for position in answer.position]
    if reaction.unseen:
        warn(
            f"{answer.name}: body {driven.body} touches held nodes where no free node shows how hard. What it presses"
            " straight into them strains nothing, and is missing in its force: a model that predicts reactions"
            " (state=['reaction'], --state reaction) has it"
        )
    if reaction.rough:
        warn(
            f"{answer.name}: body {driven.body} has contact near held nodes. Its force may be a tenth off, because"
            ' ipctk is not installed, which finds all that touches: pip install "ast_sim[simulate]"'
        )
    return LENGTH_UNITS[answer.info.length_unit] ** 2 * np.array(shares).reshape(-1, answer.scene.num_nodes, 3)


def _elastic_law(answer: Answer) -> NeoHookean:
    """The law of each element, if the scene has one from which the force follows."""
    if answer.info is None or answer.law is None:
        raise ConfigError("the answer is of no run")
    if answer.info.integration == "dynamic":
        raise ConfigError("it has inertia; the reaction is a force at equilibrium")
    if answer.scene.elements.shape[1] == 3:
        raise ConfigError("its elements are triangles; it needs tetrahedra")
    return answer.law.of_elements(answer.scene)
