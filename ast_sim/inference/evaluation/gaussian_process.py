"""A Gaussian process beside a run: what follows from the training scenes without a network.

A scene is described by the parameters that a specification has drawn; without a specification, where all scenes share
one mesh, by the principal components of where its prescribed nodes are in the frame, and of its material.
Of the displacement, where all scenes share one mesh, of the force and of the largest stress, a process predicts the
coefficients of the proper orthogonal modes (POD) of the training scenes.
"""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import torch

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.inference.evaluation.deepest_frames import deepest_predicted
from ast_sim.inference.predicting.question import Question, fields_of
from ast_sim.inference.quantities.relative_errors import judging_fields, moves, relative_distance
from ast_sim.models.simulator import Simulator
from ast_sim.scene import Scene, Trajectory
from ast_sim.simulate.own_assembly.parameters import Values, values_of
from ast_sim.support.errors import ConfigError, MissingExtra, counted, require
from ast_sim.trade_figures import Setting, Side

PROCESS = "Gaussian process"  # the name of its column
FOLDS = 5  # of the cross-validation that chooses a scale
MOST_SCENES = 200  # of the training; a fit takes time with the cube of their number
FEWEST_SCENES = 2 * FOLDS
REST = 1e-3  # what the modes leave of the root of the sum of squares
MOST_MODES = 10
Regression = Callable[[np.ndarray], np.ndarray]  # values of points [m, f]


def features(drawn: Sequence[Mapping[str, Any]], known: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """[n, f]: the parameters as a Gaussian process takes them. Numbers are scaled by the `known` ones; of a text, such
    as the name of a variant, each value has a column; what never varies has none."""
    columns = []
    for name in known[0]:
        values = [one[name] for one in known]
        if isinstance(values[0], str):
            columns += [[float(one[name] == value) for one in drawn] for value in sorted(set(values))]
        elif np.ptp(values) > 0:
            columns.append([(one[name] - np.mean(values)) / np.std(values) for one in drawn])
    return np.array(columns).reshape(len(columns), len(drawn)).T


def gaussian_process(x: np.ndarray, y: np.ndarray) -> Regression:
    """What a Gaussian process makes of the points x [n, f] with values y [n].

    The kernel is a squared exponential with a length for each feature, and white noise; maximum likelihood chooses. It
    models y or, of values above 0, log y, whichever has the lower median relative error in a cross-validation.
    """
    scales: list[tuple[Callable, Callable]] = [(np.asarray, np.asarray)]
    if np.all(y > 0):
        scales.append((np.log, np.exp))
    fold = np.arange(len(x)) % FOLDS
    errors = []
    for scale, back in scales if len(scales) > 1 else ():
        guess = np.empty_like(y)
        for part in range(FOLDS):
            guess[fold == part] = back(_fitted(x[fold != part], scale(y[fold != part])).predict(x[fold == part]))
        errors.append(np.median(np.abs(guess / y - 1)))
    scale, back = scales[int(np.argmin(errors)) if errors else 0]
    process = _fitted(x, scale(y))
    return lambda points: back(process.predict(points))


def modal_process(x: np.ndarray, y: np.ndarray) -> Regression:
    """The same of values [n, d]: a process for each coefficient of their modes."""
    left, size, modes = np.linalg.svd(y.astype(np.float64), full_matrices=False)
    rest = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1])  # of all modes from one on
    kept = min(MOST_MODES, max(1, int(np.sum(rest > REST * rest[0]))))
    sign = np.where(left.mean(axis=0) < 0, -1, 1)  # so that the first coefficient, mostly, is positive
    laws = [gaussian_process(x, coefficient) for coefficient in (left * size * sign).T[:kept]]
    shapes = (sign[:, None] * modes)[:kept]
    return lambda points: np.stack([law(points) for law in laws], axis=1) @ shapes


def _fitted(x: np.ndarray, y: np.ndarray) -> Any:
    processes, kernels = require("compare", "sklearn.gaussian_process", "sklearn.gaussian_process.kernels")
    lengths = kernels.RBF(np.full(x.shape[1], 2.0), (0.1, 1e3))
    kernel = kernels.ConstantKernel(1.0, (1e-2, 1e3)) * lengths + kernels.WhiteKernel(1e-3, (1e-8, 1.0))
    process = processes.GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length at its bound, or a search that ends early: the best of three counts
        return process.fit(x, y)


class DeepestTruth(NamedTuple):
    """The deepest frame of a simulated scene.

    Attributes:
        scene: the scene.
        values: the parameters that were drawn; empty without a specification.
        prescribed: [P, 3], where the prescribed nodes are.
        sizes: what is predicted, by quantity: displacements of the free nodes, force, largest stress.
    """

    scene: Scene
    values: Values
    prescribed: np.ndarray
    sizes: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, model: Simulator, info: DatasetInfo, truth: Trajectory) -> DeepestTruth:
        frame = deepest_predicted(model, truth)
        scene = truth.scene
        position = truth.position[frame]
        fields = {name: torch.tensor(rows[frame]) for name, rows in fields_of(truth).items()}
        known = {frame: (torch.tensor(position), fields)}
        answer = replace(Question.of(truth, "truth", [frame]).answer(model.config, known, [], None, {}), info=info)
        sizes = {"displacement": (position - truth.position[0])[~scene.prescribed].ravel()}
        with contextlib.suppress(ConfigError):  # a figure that this scene has not
            sizes["reaction"] = answer.reaction()[-1]
        if answer.stress is not None:
            sizes["stress"] = answer.stress[-1][scene.deforming(model.config.data.stress)].max(axis=0)
        return cls(scene, values_of(truth.attributes), position[scene.prescribed], sizes)


@dataclass(frozen=True)
class ProcessFigures:
    """What a Gaussian process gave for the scenes of a split.

    Attributes:
        name: what it has learned from.
        errors: the relative error of each scene, by quantity; without quantities that it does not give.
        seconds: processor time of each prediction.
        missing: why it gives nothing, or no displacement; empty if it does.
    """

    name: str = ""
    errors: Mapping[str, Sequence[float]] = field(default_factory=dict)
    seconds: Sequence[float] = ()
    missing: str = ""

    def sides(self, quantity: str) -> tuple[Side, ...]:
        """It as one side with one setting; none where it gives nothing at all."""
        if not self.errors:
            return ()
        errors = self.errors.get(quantity, [math.inf] * len(self.seconds))
        return (Side(PROCESS, (Setting(self.name, tuple(errors), tuple(self.seconds)),)),)

    def why_not(self, quantity: str) -> str:
        """Why it does not give the quantity; empty if it does."""
        return "" if quantity in self.errors else self.missing or f"a training scene has no {quantity}"


def process_beside(
    model: Simulator, dataset: Dataset, split: str, indices: Sequence[int], tell: Callable[[str], None]
) -> ProcessFigures:
    """Let a process learn the training scenes of a dataset and predict scenes of a split at their deepest frames.

    Args:
        model: what knows the kind of the data.
        tell: takes a line before the process learns, which may take minutes.
    """
    try:
        require("compare", "sklearn")
        known = list(islice(_complete(model, dataset), MOST_SCENES))
        wanted = [_sample(model, dataset, split, index) for index in indices]
        return _learned(known, wanted, tell)
    except (ConfigError, MissingExtra) as error:
        return ProcessFigures(missing=str(error))


def _learned(
    known: Sequence[DeepestTruth], wanted: Sequence[DeepestTruth], tell: Callable[[str], None]
) -> ProcessFigures:
    """What a process gives for the samples `wanted`, after it has learned from the `known` ones.

    Raises:
        ConfigError: it does not apply; the text says why.
    """
    if len(known) < FEWEST_SCENES:
        raise ConfigError(f"it needs at least {FEWEST_SCENES} training scenes, and the dataset has {len(known)}")
    one_mesh = all(_same_mesh(known[0].scene, one.scene) for one in (*known, *wanted))
    if not known[0].values and not one_mesh:
        raise ConfigError("each scene has a mesh of its own, and no specification has drawn parameters")
    x = _points(known, known)
    if not x.shape[1]:
        raise ConfigError("nothing that describes a scene differs in the training scenes")
    shared = (quantity for quantity in known[0].sizes if all(quantity in one.sizes for one in (*known, *wanted)))
    quantities = [quantity for quantity in shared if one_mesh or quantity != "displacement"]
    tell(f"a Gaussian process learns {', '.join(quantities)} of {counted(len(known), 'training scene')}")
    laws = {one: modal_process(x, np.stack([sample.sizes[one] for sample in known])) for one in quantities}
    errors: dict[str, list[float]] = {quantity: [] for quantity in quantities}
    seconds = []
    for sample, point in zip(wanted, _points(wanted, known), strict=True):
        began = time.process_time()
        predicted = {quantity: law(point[None])[0] for quantity, law in laws.items()}
        seconds.append(time.process_time() - began)
        for quantity, values in predicted.items():
            errors[quantity].append(relative_distance(values, sample.sizes[quantity]))
    missing = "" if one_mesh else "each scene has a mesh of its own"
    return ProcessFigures(f"{len(known)} training scenes, {x.shape[1]} inputs", errors, seconds, missing)


def _complete(model: Simulator, dataset: Dataset) -> Iterator[DeepestTruth]:
    """The training scenes that move and were simulated to their end."""
    for index in dataset.with_frames("train", model.config.data.given_frames + 1):
        truth = dataset.load("train", index)
        if moves(truth) and truth.attributes.get("status", "complete") == "complete":
            yield _sample(model, dataset, "train", index)


def _sample(model: Simulator, dataset: Dataset, split: str, index: int) -> DeepestTruth:
    fields = judging_fields(model.config)
    return DeepestTruth.of(model, dataset.info, dataset.load(split, index, fields))


def _same_mesh(one: Scene, other: Scene) -> bool:
    """Whether the elements and the places at rest of what is free are the same."""
    same = np.array_equal(one.elements, other.elements) and np.array_equal(one.prescribed, other.prescribed)
    return same and np.array_equal(one.rest_position[~one.prescribed], other.rest_position[~other.prescribed])


def _points(samples: Sequence[DeepestTruth], known: Sequence[DeepestTruth]) -> np.ndarray:
    """[n, f]: the samples as points, by parameters or principal components of the known ones."""
    if known[0].values:
        return features([one.values for one in samples], [one.values for one in known])
    parts = [_components([one.prescribed.ravel() for one in samples], [one.prescribed.ravel() for one in known])]
    materials = [[one.scene.material for one in some if one.scene.material is not None] for some in (samples, known)]
    if materials[1]:
        ours, theirs = (np.moveaxis(np.stack(some), 2, 0) for some in materials)
        parts += [_components(*columns) for columns in zip(ours, theirs, strict=True)]
    return np.concatenate(parts, axis=1)


def _components(rows: Sequence[np.ndarray], known: Sequence[np.ndarray]) -> np.ndarray:
    """[n, f]: rows by the principal components of the known rows, of which each has a deviation of 1."""
    base = np.stack(known).astype(np.float64)
    middle = base.mean(axis=0)
    _, size, modes = np.linalg.svd(base - middle, full_matrices=False)
    kept = min(MOST_MODES, int(np.sum(size > REST * np.linalg.norm(base))))
    return (np.stack(rows) - middle) @ modes[:kept].T / (size[:kept] / np.sqrt(len(base)))
