"""Predicting scenes, by jumps or step by step. The motion of a new scene is completed, and it is moved into the model's
domain where it lies elsewhere.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence

import numpy as np

from ast_sim.importers.scene_mesh import SceneMesh
from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import FIRST_CALL, Effort
from ast_sim.inference.predicting.jump import jumps
from ast_sim.inference.predicting.question import Frames, Question, fields_of
from ast_sim.inference.predicting.rollout import rollouts
from ast_sim.mechanics.physics_check import turned_over
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.simulator import Simulator
from ast_sim.named_field import STRESS, require_fields
from ast_sim.number_arrays import ranges
from ast_sim.prescribed_motion import Motion, RigidMotion, Vector, frames_for
from ast_sim.runs.scope import Scope, spacing_of
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.errors import ConfigError, DatasetError
from ast_sim.support.progress import ShowProgress

LEAST_RESOLVED = 0.01  # of a mean edge: rounding of the positions may be as large
Motions = Motion | Mapping[int, RigidMotion | Vector] | np.ndarray


def answers(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort = FIRST_CALL,
    progress: ShowProgress = False,
) -> list[Answer]:
    """Predict the wanted frames of several scenes, by jumps or step by step as the model does; see `jumps` and
    `rollouts` for the arguments and errors."""
    began = time.perf_counter()
    if model.config.scheme.jumps:
        predicted = jumps(model, questions, effort, progress)
    else:
        effort.check(model.config)
        predicted = rollouts(model, questions, progress)
    each = (time.perf_counter() - began) / max(1, len(questions))
    return [dataclasses.replace(answer, seconds=each) for answer in predicted]


def new_question(
    config: ModelConfig,
    scope: Scope,
    scene: Scene | SceneMesh | Trajectory,
    motion: Motions | None,
    num_frames: int | None,
    name: str,
    frames: Frames | None,
    stress: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
) -> Question:
    """The question that the arguments of `Run.predict` ask; `scope` is what the model was trained on. Every question
    passes here, and what is unusual about it is noted, after the `notes` that are known already.

    Raises:
        ConfigError: the motion does not fit the scene, or the scene does not fit the model.
        DatasetError: an array has another dtype or shape, or holds numbers that are not finite.
    """
    if isinstance(scene, Trajectory):
        if not (motion is None and num_frames is None and stress is None):
            raise ConfigError(
                f"{name} has a motion, frames and a stress of its own; for others predict its scene (--move BODY=X,Y,Z)"
            )
        _require_whole(scene, config, scope, name)
        fields = fields_of(scene)
        motion = Motion(scene.position)
        scene = scene.scene
    else:
        scene = scene.scene if isinstance(scene, SceneMesh) else scene
        scene.check(name)
        motion = _completed(config, scope, scene, motion, num_frames, name)
        stress = _given_stress(config, scene, stress, name)
        fields = {} if stress is None else {STRESS: stress}
    scene.require_predictable(name)  # before anything is told of such a scene
    _require_material(config, scope, scene, name)
    _require_resolved(scene, name)
    notes = (*notes, *_loose(scene), *scope.notes(scene, motion, config.scheme.needs_each_frame))
    return Question(name, scene, motion.position, fields, movable=True, notes=notes).asking(frames)


def _require_resolved(scene: Scene, name: str) -> None:
    """Raise DatasetError if single precision does not tell the nodes apart where the scene lies."""
    farthest = np.abs(scene.rest_position).max()
    coarse = float(np.spacing(farthest))
    spacing = spacing_of(scene)
    if coarse > LEAST_RESOLVED * spacing:
        raise DatasetError(
            f"{name} lies {farthest:.3g} from the origin, where single precision keeps steps of {coarse:.2g}, and its"
            f" edges have a mean length of {spacing:.2g}: move it to the origin before its positions are rounded"
        )


def _loose(scene: Scene) -> list[str]:
    """A note if there are free nodes that belong to no element."""
    loose = ~scene.prescribed
    loose[scene.elements.ravel()] = False
    count = int(loose.sum())
    return [f"{count} free nodes belong to no element: what is predicted for them means nothing"] if count else []


def _require_whole(trajectory: Trajectory, config: ModelConfig, scope: Scope, name: str) -> None:
    """Raise ConfigError or DatasetError unless a trajectory has all frames of its motion, in the unit of the run, and a
    stress where the model predicts one, if any."""
    trajectory.check(name)
    if trajectory.numbers != tuple(range(trajectory.num_frames)):
        raise ConfigError(
            f"{name} has the frames {ranges(trajectory.numbers)} of a motion: a prediction needs all frames from 0 on;"
            " predict its scene with a motion"
        )
    if trajectory.length_unit not in (None, scope.length_unit):
        raise ConfigError(
            f"{name} has lengths in {trajectory.length_unit}, but the run was trained in {scope.length_unit}: read it"
            f" with Dataset(path, {scope.length_unit!r}) or Run.open"
        )
    place = trajectory.stress_at
    if place not in ("none", config.data.stress):
        needs = "predicts none" if config.data.stress == "none" else f"predicts it at each {config.data.stress}"
        raise ConfigError(f"{name} has a stress at each {place}, but the run {needs}: leave it out, or convert it")
    named = [one for one in config.data.fields if one[0] in trajectory.fields]  # those that are missing start at zero
    require_fields(name, trajectory.fields, named)


def _completed(
    config: ModelConfig, scope: Scope, scene: Scene, motion: Motions | None, frames: int | None, name: str
) -> Motion:
    """The motion of the prescribed nodes in every frame."""
    if motion is None or (isinstance(motion, Mapping) and not motion):
        raise ConfigError(f"{name}: say how its prescribed nodes move: {{BODY: (x, y, z)}} (--move BODY=X,Y,Z)")
    if isinstance(motion, Mapping):
        least = config.data.given_frames + 1
        if frames is None and not scope.usual_increment:
            raise ConfigError(f"{name}: nothing is moved in the training scenes: say how many frames (--num-frames)")
        if frames is None:
            frames = max(least, frames_for(scene, motion, scope.usual_increment))
        if frames < least:
            raise ConfigError(f"{name}: num_frames is {frames}; the run needs at least {least}")
        return Motion.of_bodies(scene, motion, frames)
    if frames is not None:
        raise ConfigError(f"{name}: its motion has frames already: leave out num_frames={frames}")
    if not isinstance(motion, Motion):
        return Motion.of_positions(scene, motion)
    motion.check(scene)
    return motion


def _given_stress(config: ModelConfig, scene: Scene, stress: np.ndarray | None, name: str) -> np.ndarray | None:
    """The stress of the given frames as float32.

    Raises:
        ConfigError: its shape is not that of the model's stress.
    """
    if stress is None:
        return None
    stress = np.asarray(stress, np.float32)
    rows = {"node": scene.num_nodes, "element": scene.num_elements}.get(config.data.stress)
    wanted = (config.data.given_frames, rows, 1)
    if stress.shape != wanted:
        needs = "predicts none" if rows is None else f"needs {list(wanted)}"
        raise ConfigError(f"{name}: the stress has the shape {list(stress.shape)}, but the run {needs}")
    return stress


def _require_material(config: ModelConfig, scope: Scope, scene: Scene, name: str) -> None:
    """Raise ConfigError unless the scene has as many material columns as the training scenes."""
    wanted = config.data.material_width
    given = 0 if scene.material is None else scene.material.shape[1]
    if given == wanted:
        return
    if not wanted:
        raise ConfigError(f"{name} has a material, but the run was trained without one: leave it out (--material)")
    ranges = ", ".join(f"{column} {low:.4g} to {high:.4g}" for column, (low, high) in scope.material_ranges.items())
    raise ConfigError(
        f"{name} has {given or 'no'} material columns, but the run was trained with {wanted} ({ranges}): give each"
        " body its numbers (--material BODY=NUMBER,...)"
    )


def in_domain(
    model: Simulator, questions: Sequence[Question], effort: Effort, progress: ShowProgress = False
) -> list[Answer]:
    """Predict scenes where they lie; those that may be moved and leave the domain in the middle of the domain."""
    shifts = [_way_into_domain(model.config, question) for question in questions]
    there = [q if shift is None else _moved_question(q, shift) for q, shift in zip(questions, shifts, strict=True)]
    predicted = zip(questions, shifts, answers(model, there, effort, progress), strict=True)
    return [answer if shift is None else _moved_back(question, answer, shift) for question, shift, answer in predicted]


def doubts(answer: Answer) -> list[str]:
    """What speaks against an answer, whatever the question was: Newton steps that have not converged, and elements of
    deforming bodies that are turned over."""
    told = []
    if answer.converged is False:
        told.append(
            f"the Newton steps have not converged: the last one has a size of {max(answer.last_steps):.2g}"
            " (Answer.last_steps)"
        )
    counts = (turned_over(answer.scene, position) for position in answer.position)
    first = next(((frame, count) for frame, count in zip(answer.frames, counts, strict=False) if count), None)
    if first is not None:
        told.append(f"{first[1]:.0f} elements are turned over in frame {first[0]}, which no body can do (Answer.check)")
    return told


def _moved_question(question: Question, shift: np.ndarray) -> Question:
    scene = dataclasses.replace(question.scene, rest_position=_moved(question.scene.rest_position, shift))
    return dataclasses.replace(question, scene=scene, prescribed_position=_moved(question.prescribed_position, shift))


def _moved_back(question: Question, answer: Answer, shift: np.ndarray) -> Answer:
    position = _moved(answer.position, -shift)
    given = question.prescribed_position[list(answer.frames)]
    # Given numbers stay what they are, to the last bit.
    known = question.scene.prescribed | ~answer.computed[:, None]
    position = np.where(known[:, :, None], given, position)
    return dataclasses.replace(answer, scene=question.scene, position=position)


def _way_into_domain(config: ModelConfig, question: Question) -> np.ndarray | None:
    """[3] float64: from the middle of the start and of all that is prescribed to the middle of the domain; None: both
    lie inside the domain, or the scene stays where it is."""
    position = question.prescribed_position
    known = np.concatenate([position[0], position[:, question.scene.prescribed].reshape(-1, 3)])
    known = known.T.astype(np.float64, order="C")  # rows are reduced faster
    lowest, highest = known.min(axis=1), known.max(axis=1)
    center = np.array(config.data.domain_center)
    inside = max((center - lowest).max(), (highest - center).max()) <= config.data.domain_half_width
    if inside or not question.movable:
        return None
    return center - (lowest + highest) / 2


def _moved(points: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Points [..., 3] float32, moved by `shift` [3] float64 and rounded once."""
    return (points.astype(np.float64) + shift).astype(np.float32)
