"""Prescribed motions: positions of obstacles and handles in each frame, or rigid motions of bodies."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ast_sim.number_arrays import nodes_of_body, real_numbers
from ast_sim.scene import Scene
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError, warn
from ast_sim.support.notebook_table import one_line
from ast_sim.support.toml_settings import whole

Vector = Sequence[float]

LARGEST = 1e15  # of the numbers of a rigid motion: squares and float32 hold what follows from it
ROUNDING = 1e-6  # shares of times, lengths and angles below this are rounding
MOST_BYTES = 1 << 30  # of the positions of a motion

_VECTOR = r"[^\s,]+,[^\s,]+,[^\s,]+"
_MOVE = re.compile(
    rf"(?P<body>[0-9]+)=(?P<path>{_VECTOR}( then {_VECTOR})*)?"
    rf" ?(rotate (?P<angle>\S+) about (?P<axis>{_VECTOR}) at (?P<point>{_VECTOR}))?"
)


@dataclass(frozen=True)
class RigidMotion:
    """How a body moves as a whole: x goes to R(s) (x - point) + point + d(s), where s runs from 0 to 1.

    The angle of the rotation R grows evenly with s. The displacement d follows straight lines from one waypoint to the
    next, at the same speed all the way. A waypoint may lie between two frames.

    Attributes:
        translation: the displacement at the end, three numbers in the scene's length unit; or a path, a list of such
            triples. Each triple is a displacement from the start, not from the waypoint before:
            ((0, 0, -1), (0, 0, 0)) goes down and comes back.
        rotation: the angle at the end in degrees. It may exceed 360. A positive angle is counter-clockwise if the axis
            points to the observer.
        axis, point: the direction of the axis of rotation (its length does not matter) and a point on the axis, in the
            undeformed scene. The translation moves the axis as well.

    Raises:
        ConfigError: a vector does not have three numbers, a number is not finite or above `LARGEST`, or the axis is
            zero.
    """

    translation: Vector | Sequence[Vector] = (0.0, 0.0, 0.0)
    rotation: float = 0.0
    axis: Vector = (0.0, 0.0, 1.0)
    point: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, wanted, shape in (
            ("translation", "three numbers or a list of triples, all finite and", (3,)),
            ("rotation", "one finite number of", ()),
            ("axis", "three numbers, not all zero, all finite and", (3,)),
            ("point", "three numbers, all finite and", (3,)),
        ):
            value = getattr(self, name)
            numbers = _numbers(value)
            is_path = name == "translation" and numbers.ndim == 2 and len(numbers) and numbers.shape[1:] == shape
            fits = numbers.shape == shape or is_path
            fits = fits and (name != "axis" or np.any(np.abs(numbers) > 1 / LARGEST))
            if not fits or not (np.abs(numbers) <= LARGEST).all():
                shown = repr(value) if isinstance(value, str) else value
                raise ConfigError(f"{name} of a motion must be {wanted} at most {LARGEST:g}, not {shown}")

    def at(self, s: float, points: np.ndarray) -> np.ndarray:
        """[n, 3] float64: the positions of the undeformed `points` [n, 3] at `s` in [0, 1]."""
        shares, corners = self._path()
        displacement = np.array([np.interp(s, shares, corners[:, axis]) for axis in range(3)])
        return (points - np.asarray(self.point)) @ self._rotated(s).T + self.point + displacement

    def corners(self) -> list[float]:
        """The values of s between 0 and 1 at which the path turns back or turns off."""
        shares, corners = self._path()
        directions = np.diff(corners, axis=0)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), np.finfo(float).tiny)
        turns = np.linalg.norm(np.diff(directions, axis=0), axis=1) > ROUNDING
        return shares[1:-1][turns].tolist()

    def notes(self, name: str, frames: Sequence[int], last: int) -> Iterator[str]:
        """What frames with these numbers do not show of the motion, which ends at `last`; a sentence each."""
        times = [last * s for s in self.corners() if last * s < frames[-1]]
        hidden = [time for time in times if np.abs(time - np.asarray(frames)).min() > last * ROUNDING]
        if hidden:
            where = ", ".join(f"{time:.4g}" for time in hidden)
            yield f"{name} turns at {where} of {last} frames, which no frame shows{self._better(hidden, last)}"
        turn = abs(self.rotation) * max(np.diff(frames)) / last
        if turn >= 180 * (1 - ROUNDING):
            enough = abs(self.rotation) / last < 180 * (1 - ROUNDING)
            more = "frames between" if enough else f"{int(turn / 180 * (1 + ROUNDING)) + 1} times as many frames"
            yield (
                f"{name} turns {turn:.4g} degrees from one frame to the next; positions, all that a model sees,"
                f" look like another turn: {'keep' if enough else 'take'} {more}"
            )

    def _better(self, hidden: Sequence[float], last: int) -> str:
        """What shows the corners at these times, as the end of a sentence: frames of the motion that are not stored, or
        the next number of frames with all corners."""
        whole = [round(time) for time in hidden]
        if all(abs(time - frame) <= last * ROUNDING for time, frame in zip(hidden, whole, strict=True)):
            return f": keep {'frame' if len(whole) == 1 else 'frames'} {', '.join(map(str, whole))}, too"
        for more in range(last, 20 * last):
            if all(abs(more * s - round(more * s)) <= more * ROUNDING for s in self.corners()):
                return f": with {more + 1} frames one does"
        return ""

    def largest_speed(self, points: np.ndarray) -> float:
        """The largest speed of the undeformed `points` [n, 3], as a length per unit of s."""
        angle = np.radians(abs(self.rotation))
        axis = np.asarray(self.axis) * (np.sign(self.rotation) / np.linalg.norm(self.axis))
        spin = angle * np.cross(axis, points - np.asarray(self.point))  # the rotation's velocity at s = 0
        turned = np.cross(axis, spin)
        square = np.zeros(len(points))
        for (a, start), (b, end) in pairwise(zip(*self._path(), strict=True)):
            velocity = (end - start) / (b - a)
            # |velocity + R(s) spin|^2, where velocity . R(s) spin = along cos(angle s) + across sin(angle s):
            along, across = spin @ velocity, turned @ velocity
            ends = [along * np.cos(angle * s) + across * np.sin(angle * s) for s in (a, b)]
            peak_inside = (np.arctan2(across, along) - angle * a) % (2 * np.pi) <= angle * (b - a)
            product = np.where(peak_inside, np.hypot(along, across), np.maximum(*ends))
            square = np.maximum(square, velocity @ velocity + (spin**2).sum(axis=1) + 2 * product)
        return float(np.sqrt(square.max(initial=0.0)))

    def _path(self) -> tuple[np.ndarray, np.ndarray]:
        """The values of s [K] at which the path has its corners, and the corners [K, 3], from the start to the end."""
        corners = np.concatenate([np.zeros((1, 3)), np.reshape(np.asarray(self.translation, np.float64), (-1, 3))])
        lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        if not lengths.any():
            return np.array([0.0, 1.0]), corners[:2]
        kept = np.concatenate([[True], lengths > 0])
        travelled = np.concatenate([[0.0], np.cumsum(lengths)])[kept]
        return travelled / travelled[-1], corners[kept]

    def _rotated(self, s: float) -> np.ndarray:
        """R(s) [3, 3]."""
        from scipy.spatial.transform import Rotation

        axis = np.asarray(self.axis) / np.linalg.norm(self.axis)
        return Rotation.from_rotvec(np.radians(self.rotation) * s * axis).as_matrix()


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of the prescribed nodes of a scene (obstacles and handles) over S frames.

    Attributes:
        position: [S, N, 3] float32, in the scene's length unit. The rows of free nodes are read only in frame 0, where
            the scene starts; in dynamic scenes also in frame 1, where equal positions mean a start without velocity.
    """

    position: np.ndarray

    def __repr__(self) -> str:
        frames, nodes = np.shape(self.position)[:2]
        return one_line("Motion", {"frames": frames, "nodes": f"{nodes:,}"})

    @classmethod
    def of_bodies(cls, scene: Scene, motions: Mapping[int, RigidMotion | Vector], frames: int) -> Motion:
        """Rigid motions from the first frame to the last. They move the prescribed nodes of the named bodies.

        Prescribed nodes of other bodies stand still. All free nodes start at rest, undeformed.

        Args:
            motions: the motion of each body by the number of the body; three numbers are a translation.
            frames: S, at least 2.

        A warning tells of a turn that no frame shows.

        Raises:
            ConfigError: `frames` is below 2, or the positions would take more than `MOST_BYTES`; there is no such body,
                or the body has no prescribed node.
        """
        require_type("scene", scene, Scene, "a Scene")
        require_type("motions", motions, Mapping, "the motion of each body by its number, such as {1: (0, 0, -0.01)}")
        (frames,) = whole(frames=frames)
        if frames is None or frames < 2:
            raise ConfigError(f"a motion needs at least 2 frames, not {frames}")
        needed = frames * scene.rest_position.nbytes
        if needed > MOST_BYTES:
            raise ConfigError(
                f"a motion of {frames:,} frames would take {needed / 1e9:,.3g} GB: give a shorter motion, or fewer"
                " frames with num_frames"
            )
        position = np.repeat(scene.rest_position[None], frames, axis=0)
        for body, (nodes, motion) in zip(motions, _moved(scene, motions), strict=True):
            for note in motion.notes(f"the motion of body {body}", range(frames), frames - 1):
                warn(note)
            start = scene.rest_position[nodes].astype(np.float64)
            for frame in range(1, frames):
                position[frame, nodes] = motion.at(frame / (frames - 1), start)
        return cls(position)

    @classmethod
    def of_positions(cls, scene: Scene, position: np.ndarray) -> Motion:
        """A motion from positions of all nodes [S, N, 3], or of the P prescribed nodes [S, P, 3] in ascending order.

        With [S, P, 3] the free nodes start at rest, undeformed.

        Raises:
            ConfigError: the shape is another one, or a number is not finite.
            DatasetError: these are no numbers.
        """
        position = real_numbers("the motion", "position", position)
        p = int(scene.prescribed.sum())
        if position.ndim == 3 and position.shape[1:] == (p, 3) and p < scene.num_nodes:
            whole = np.repeat(scene.rest_position[None], len(position), axis=0)
            whole[:, scene.prescribed] = position
            position = whole
        motion = cls(position)
        motion.check(scene)
        return motion

    @property
    def num_frames(self) -> int:
        return len(self.position)

    def check(self, scene: Scene) -> None:
        """Raise ConfigError unless the shape fits `scene`, there are two or more frames, and all numbers are finite."""
        require_type("position of a motion", self.position, np.ndarray, "an array; Motion.of_positions takes lists")
        n = scene.num_nodes
        p = int(scene.prescribed.sum())
        shape = self.position.shape
        if len(shape) != 3 or shape[1:] != (n, 3) or shape[0] < 2:
            raise ConfigError(
                f"the motion has the shape {list(shape)}, must be [frames, {n} nodes, 3] or [frames, {p} prescribed"
                " nodes, 3] with at least 2 frames"
            )
        finite = np.isfinite(self.position).all(axis=2)
        if not finite.all():
            frame, node = np.argwhere(~finite)[0]
            numbers = self.position[frame, node].tolist()
            raise ConfigError(f"the motion is not finite in frame {frame} at node {node}: {numbers}")

    def from_rest(self, scene: Scene) -> Motion:
        """This motion, with the scene at rest before it if prescribed nodes have left their places in frame 0."""
        away = self.position[0, scene.prescribed] != scene.rest_position[scene.prescribed]
        return Motion(np.concatenate([scene.rest_position[None], self.position])) if away.any() else self

    def increments(self, scene: Scene) -> list[float]:
        """S - 1 numbers: the largest displacement of a prescribed node from one frame to the next."""
        return [_largest(after - before) for before, after in pairwise(self._prescribed(scene))]

    def travel(self, scene: Scene) -> float:
        """The largest distance of a prescribed node from its position in frame 0."""
        start, *moved = self._prescribed(scene)
        return max(_largest(after - start) for after in moved)

    def farthest(self, scene: Scene) -> float:
        """The largest distance of a prescribed node from its place at rest."""
        return max(map(_largest, self._prescribed(scene) - scene.rest_position[scene.prescribed]), default=0.0)

    def extent(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """[3] and [3]: the lowest and the highest displacement of a prescribed node from its position in frame 0, along
        x, y and z. Frame 0 counts, so the lowest is at most 0."""
        prescribed = self._prescribed(scene)
        if not prescribed.size:
            return np.zeros(3), np.zeros(3)
        moved = prescribed - prescribed[0]
        return moved.min(axis=(0, 1)), moved.max(axis=(0, 1))

    def _prescribed(self, scene: Scene) -> np.ndarray:
        return self.position[:, scene.prescribed].astype(np.float64)


def frames_for(scene: Scene, motions: Mapping[int, RigidMotion | Vector], increment: float) -> int:
    """The smallest number of frames, at least 2, so that no prescribed node moves farther than `increment` per frame.

    The length of a node's path counts, so a body that moves and comes back has moved.

    Raises:
        ConfigError: the increment is not above 0; or as in `Motion.of_bodies`.
    """
    if not (np.isfinite(increment) and increment > 0):
        raise ConfigError(f"the increment of a frame must be above 0, not {increment}")
    speeds = [motion.largest_speed(scene.rest_position[nodes]) for nodes, motion in _moved(scene, motions)]
    # Positions are float32: a path that is longer only by rounding needs no further frame.
    return 1 + max(1, int(np.ceil(max(speeds, default=0.0) / increment * (1 - 1e-6))))


def parse_move(text: str) -> tuple[int, RigidMotion]:
    """The body and the motion of `BODY=X,Y,Z [then X,Y,Z ...] [rotate DEGREES about X,Y,Z at X,Y,Z]`.

    BODY is the number of a body. The triples before `rotate` are the translation: its end, or the waypoints of a path;
    each is a displacement from the start. `about` gives the direction of the axis, `at` a point on the axis. The
    translation or the rotation may be left out:

        1=0,0,-0.01                             a translation
        1=0,0,-0.01 then 0.02,0,-0.01           down, then sideways
        1=rotate 30 about 0,0,1 at 0,0,0.1      a rotation
        1=0,0,-0.01 rotate 30 about 0,0,1 at 0,0,0.1

    Raises:
        ConfigError: the text has another form; the error gives examples.
    """
    match = _MOVE.fullmatch(re.sub(r"\s*([,=])\s*", r"\1", " ".join(text.split())))
    try:
        if match is None or not (match["path"] or match["angle"]):
            raise ValueError
        motion: dict = {}
        if match["path"]:
            motion["translation"] = tuple(_triple(part) for part in match["path"].split(" then "))
        if match["angle"]:
            motion["rotation"] = float(match["angle"])
            motion |= {key: _triple(match[key]) for key in ("axis", "point")}
    except ValueError as error:
        raise ConfigError(
            f"the motion {text!r} cannot be read; write it as '1=0,0,-0.01', as '1=0,0,-0.01 then 0.02,0,-0.01' or as"
            " '1=rotate 30 about 0,0,1 at 0,0,0.1'"
        ) from error
    return int(match["body"]), RigidMotion(**motion)


def _moved(scene: Scene, motions: Mapping[int, RigidMotion | Vector]) -> Iterator[tuple[np.ndarray, RigidMotion]]:
    """The prescribed nodes [N] bool and the motion of each body in `motions`."""
    for body, motion in motions.items():
        nodes = nodes_of_body(scene.body, body) & scene.prescribed
        if not nodes.any():
            raise ConfigError(
                f"body {body} has no prescribed node that could be moved; mark the body with"
                f" obstacles=[{body}] (--obstacle {body}) or nodes of it with clamps=['{body}:PLACE']"
                f" (--clamp {body}:PLACE)"
            )
        yield nodes, motion if isinstance(motion, RigidMotion) else RigidMotion(motion)


def _numbers(value: object) -> np.ndarray:
    """Real numbers as float64; NaN in place of what is none."""
    try:
        given = np.asarray(value)
        return given.astype(np.float64) if given.dtype.kind in "fiuO" else np.full(given.shape, np.nan)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # rows of different lengths, or what is no numbers
        return np.array(np.nan)


def _largest(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).max(initial=0.0)))


def _triple(text: str) -> tuple[float, ...]:
    return tuple(float(number) for number in text.split(","))
