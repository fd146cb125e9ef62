"""The question that the arguments of a prediction ask: the motion is completed, and all is checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ast_sim.importers.scene_mesh import SceneMesh
from ast_sim.inference.predicting.question import Question, WantedFrames, fields_of
from ast_sim.models.model_config import ModelConfig
from ast_sim.named_field import STRESS, require_fields
from ast_sim.number_arrays import real_numbers, require_finite, require_whole_motion
from ast_sim.plausibility.topology import no_scene
from ast_sim.prescribed_motion import Motion, RigidMotion, Vector, frames_for
from ast_sim.runs.scope import Scope, spacing_of
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.argument_checks import in_short, require_line, require_type, several
from ast_sim.support.errors import ConfigError, DatasetError, counted
from ast_sim.support.toml_settings import whole

LEAST_RESOLVED = 0.01  # of a mean edge: rounding of the positions may be as large
_AT_REST: WeakKeyDictionary[Scene, list[str]] = WeakKeyDictionary()  # what looks wrong in the scenes that are in use
Motions = Motion | Mapping[int, RigidMotion | Vector] | np.ndarray


def new_question(
    config: ModelConfig,
    scope: Scope,
    scene: Scene | SceneMesh | Trajectory,
    motion: Motions | None,
    num_frames: int | None,
    name: str,
    frames: WantedFrames | None,
    stress: np.ndarray | None = None,
    notes: tuple[str, ...] = (),
) -> Question:
    """The question that the arguments of `Run.predict` ask; `scope` is what the model was trained on. Every question
    passes here, and what is unusual about it is noted, after the `notes` that are known already.

    Raises:
        ConfigError: the motion does not fit the scene, or the scene does not fit the model.
        DatasetError: an array has another dtype or shape, or holds numbers that are not finite.
    """
    require_line("name", name)
    if isinstance(scene, Trajectory):
        if not (motion is None and num_frames is None and stress is None):
            raise ConfigError(
                f"{name} has a motion, frames and a stress of its own; for others predict its scene:"
                " motion={BODY: (x, y, z)} (--move BODY=X,Y,Z)"
            )
        _require_whole(scene, config, scope, name)
        fields = fields_of(scene)
        times = scene.times
        motion = Motion(scene.position)
        scene = scene.scene
    else:
        scene = scene.scene if isinstance(scene, SceneMesh) else scene
        require_type("scene", scene, Scene, "a Scene, a Trajectory or what read_scene returns")
        scene.check(name)
        motion = _completed(config, scope, scene, motion, num_frames, name)
        stress = _given_stress(config, scene, stress, name)
        fields = {} if stress is None else {STRESS: stress}
        times = None
    _require_resolved(scene, motion, name)  # else a mesh that was rounded flat is said to need a repair
    scene.require_predictable(name)  # before anything is told of such a scene
    _require_material(config, scope, scene, name)
    notes = (
        *notes,
        *_loose(scene),
        *doubts_at_rest(scene),
        *scope.notes(scene, motion, config.scheme.needs_each_frame),
    )
    question = Question(name, scene, motion.position, fields, notes=notes, times=times)
    return question.asking(frames)


def scenes_of(scenes: Any, names: Any) -> list[tuple[Scene, Motions, str]]:
    """Each scene with its motion and its name, from the arguments of `Run.predict_scenes`.

    Raises:
        ConfigError: these are no pairs, or there is another number of names.
    """
    pairs = several("scenes", scenes, "pairs of a scene and a motion")
    for pair in pairs:
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ConfigError(f"one of scenes is {in_short(pair)}; it must be a pair of a scene and a motion")
    numbered = [f"scene {number}" for number in range(len(pairs))]
    called = numbered if names is None else several("names", names, "texts, one for each scene")
    if len(called) != len(pairs):
        raise ConfigError(f"there are {counted(len(called), 'name')} for {counted(len(pairs), 'scene')}")
    return [(scene, motion, name) for (scene, motion), name in zip(pairs, called, strict=True)]


def _require_resolved(scene: Scene, motion: Motion, name: str) -> None:
    """Raise DatasetError if single precision does not tell the nodes apart where the scene lies, or moves."""
    spacing = spacing_of(scene)
    for positions, what, advice in (
        (scene.rest_position, "lies", "move it to the origin before its positions are rounded"),
        (motion.position[:, scene.prescribed], "moves to places", "give a shorter motion"),
    ):
        farthest = np.abs(positions).max(initial=0.0)
        coarse = float(np.spacing(farthest))
        if coarse > LEAST_RESOLVED * spacing > 0:
            raise DatasetError(
                f"{name} {what} {farthest:.3g} from the origin, where single precision keeps steps of {coarse:.2g}, and"
                f" its edges have a mean length of {spacing:.2g}: {advice}"
            )


def _loose(scene: Scene) -> list[str]:
    """A note if there are free nodes that belong to no element."""
    loose = ~scene.prescribed
    loose[scene.elements.ravel()] = False
    count = int(loose.sum())
    if not count:
        return []
    told = counted(count, "free node belongs", "free nodes belong")
    return [f"{told} to no element: what is predicted for them means nothing"]


def doubts_at_rest(scene: Scene) -> list[str]:
    """Notes if bodies lie in each other at rest, or a mesh folds over itself; looked at once for each scene."""
    if scene not in _AT_REST:
        _AT_REST[scene] = [str(finding) for finding in no_scene(scene)]
    return _AT_REST[scene]


def _require_whole(trajectory: Trajectory, config: ModelConfig, scope: Scope, name: str) -> None:
    """Raise ConfigError or DatasetError unless a trajectory has all frames of its motion, in the unit of the run, and a
    stress where the model predicts one, if any."""
    trajectory.check(name)
    require_whole_motion(name, trajectory.numbers, "predict its scene with a motion")
    if trajectory.length_unit not in (None, scope.length_unit):
        raise ConfigError(
            f"{name} has lengths in {trajectory.length_unit}, but the run was trained in {scope.length_unit}: read it"
            f" with Dataset(path, {scope.length_unit!r}) or Run.open"
        )
    place = trajectory.stress_at
    if place not in ("none", config.data.stress):
        needs = "predicts none" if config.data.stress == "none" else f"predicts it at each {config.data.stress}"
        raise ConfigError(f"{name} has a stress at each {place}, but the run {needs}: leave it out, or convert it")
    named = [one for one in config.data.fields if one[0] in trajectory.fields]  # missing ones start at zero
    require_fields(name, trajectory.fields, named)


def _completed(
    config: ModelConfig, scope: Scope, scene: Scene, motion: Motions | None, frames: int | None, name: str
) -> Motion:
    """The motion of the prescribed nodes in every frame."""
    if motion is None or (isinstance(motion, Mapping) and not motion):
        raise ConfigError(f"{name}: say how its prescribed nodes move: motion={{BODY: (x, y, z)}} (--move BODY=X,Y,Z)")
    (frames,) = whole(num_frames=frames)
    if isinstance(motion, Mapping):
        least = config.data.given_frames + 1
        if frames is None and not scope.usual_increment:
            raise ConfigError(
                f"{name}: nothing is moved in the training scenes: say how many frames, num_frames=N (--num-frames N)"
            )
        if frames is None:
            frames = max(least, frames_for(scene, motion, scope.usual_increment))
        if frames < least:
            raise ConfigError(f"{name}: num_frames is {frames}; the run needs at least {least}")
        return Motion.of_bodies(scene, motion, frames)
    if isinstance(motion, Motion):
        motion.check(scene)
    else:
        motion = Motion.of_positions(scene, motion)
    if frames is not None:
        raise ConfigError(f"{name}: its motion has frames already: leave out num_frames={frames}")
    return motion


def _given_stress(config: ModelConfig, scene: Scene, stress: np.ndarray | None, name: str) -> np.ndarray | None:
    """The stress of the given frames as float32.

    Raises:
        ConfigError: its shape is not the shape of the model's stress.
        DatasetError: these are no finite numbers.
    """
    if stress is None:
        return None
    stress = real_numbers(name, "stress", stress)
    rows = {"node": scene.num_nodes, "element": scene.num_elements}.get(config.data.stress)
    wanted = (config.data.given_frames, rows, 1)
    if stress.shape != wanted:
        needs = "predicts none" if rows is None else f"needs {list(wanted)}"
        raise ConfigError(f"{name}: the stress has the shape {list(stress.shape)}, but the run {needs}")
    require_finite(name, "stress", config.data.stress, stress)
    return stress


def _require_material(config: ModelConfig, scope: Scope, scene: Scene, name: str) -> None:
    """Raise ConfigError unless the scene has as many material columns as the training scenes, or DatasetError if they
    hold what no material has."""
    wanted = config.data.material_width
    given = 0 if scene.material is None else scene.material.shape[1]
    if given == wanted:
        if given:
            config.data.material.require_possible(name, scene.material, ~scene.rigid_elements)
        return
    if not wanted:
        raise ConfigError(
            f"{name} has a material, but the run was trained without one: leave out materials= (--material)"
        )
    ranges = ", ".join(f"{column} {low:.4g} to {high:.4g}" for column, (low, high) in scope.material_ranges.items())
    raise ConfigError(
        f"{name} has {given or 'no'} material columns, but the run was trained with {wanted} ({ranges}): give each"
        " body its numbers: materials={BODY: (NUMBER, ...)} (--material BODY=NUMBER,...)"
    )
