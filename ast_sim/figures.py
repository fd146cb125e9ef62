"""What an evaluation of a run measures, as typed records that are written as JSON.

Errors are root mean square errors of a `quantity` ("displacement" in the unit of length, "stress" in pascal, or a named
field in its unit) that a `predictor` made ("model", or a trivial one such as "hold_still") over a `horizon`
("one_step": each frame from the true frame before it; "rollout_50", "rollout_all": the first 50 frames, all frames from
the given ones) on some `nodes` ("normal", "all"; for the stress and named fields "deforming", for reactions
"prescribed").
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

from ast_sim.named_field import REACTION
from ast_sim.support.errors import ConfigError, nearest_name
from ast_sim.support.notebook_table import one_line


def main_nodes(quantity: str) -> str:
    """Where the errors of a quantity are shown first."""
    return {"displacement": "normal", REACTION: "prescribed"}.get(quantity, "deforming")


@dataclass(frozen=True)
class SceneError:
    """The error of one scene; None: the prediction failed."""

    quantity: str
    predictor: str
    horizon: str
    nodes: str
    rmse: float | None


@dataclass(frozen=True)
class MeanError:
    """The error over all scenes in the two conventions of `ast_sim.inference.evaluation.measures`; None: a prediction
    failed."""

    quantity: str
    predictor: str
    horizon: str
    nodes: str
    rmse_sequence: float | None
    rmse_pooled: float | None


@dataclass(frozen=True)
class SceneFigures:
    """One scene.

    Attributes:
        name, nodes, frames: its name and size.
        errors: of the model and of trivial predictors.
        model_seconds_per_step: wall seconds of the prediction over the number of predicted frames; None: it failed.
        solver_seconds_per_step: the same of the solver that made the scene; None: not recorded.
        failure: why the prediction failed; None: it did not.
    """

    name: str
    nodes: int
    frames: int
    errors: tuple[SceneError, ...]
    model_seconds_per_step: float | None
    solver_seconds_per_step: float | None
    failure: str | None

    def error(self, quantity: str, predictor: str = "model", horizon: str = "rollout_all") -> float | None:
        """The error on the main nodes of the quantity; None: it failed or is not known."""
        row = _row(self.errors, quantity, predictor, horizon, main_nodes(quantity))
        return None if row is None else row.rmse

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `Figures.to_json` gave of a scene."""
        errors = tuple(SceneError(*place, rmse) for place, rmse in _leaves(values["errors"]))
        return cls(**{**values, "errors": errors})


@dataclass(frozen=True)
class VariantFigures:
    """What a variant of the solver took for a frame, in seconds on one thread; with `failure` there is nothing else."""

    seconds: float | None = None
    setup_seconds: float | None = None
    relative_error: float | None = None
    load_steps: int | None = None
    newton_iterations: int | None = None
    failure: str | None = None


@dataclass(frozen=True)
class SolverFigures:
    """What the solver took for a frame of one scene.

    Attributes:
        seconds: at its own stop test; None: it did not converge.
        cheapest: the name of its fastest variant that is at least as accurate as the model; None: there is none.
        cheapest_seconds: of that variant.
        variants: the figures of all variants, by name.
    """

    seconds: float | None
    cheapest: str | None
    cheapest_seconds: float | None
    variants: Mapping[str, VariantFigures]

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `dataclasses.asdict` gave."""
        return cls(**{**values, "variants": {name: VariantFigures(**one) for name, one in values["variants"].items()}})


@dataclass(frozen=True)
class DeepestFrame:
    """The deepest frame of a scene, predicted alone and on one thread.

    Attributes:
        name, nodes: of the scene.
        frame: its number.
        displacement: root mean square of the displacement of the free nodes in this frame.
        relative_error: the error of the displacement over the displacement; None: the prediction failed.
        after_calls: the relative error after each call of a model that jumps; empty for another.
        after_newton_steps: the same after each Newton step; the last one again where fewer were needed. Empty where
            none was wanted, or one failed.
        seconds: processor time of the answer.
        last_step: the size of the last Newton step; None without.
        stress_share: the error of the stress over the error of the frame's true mean.
        largest_stress: the relative error of the largest stress.
        solver: None: it was not run.
    """

    name: str
    nodes: int
    frame: int
    displacement: float
    relative_error: float | None
    after_calls: tuple[float, ...]
    after_newton_steps: tuple[float, ...]
    seconds: float
    last_step: float | None
    stress_share: float | None
    largest_stress: float | None
    solver: SolverFigures | None = None

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `dataclasses.asdict` gave."""
        solver = None if values["solver"] is None else SolverFigures.from_json(values["solver"])
        return cls(**{**values, **_after_each(values), "solver": solver})


@dataclass(frozen=True)
class Beside:
    """The model beside the solver: medians over the scenes in which both have an answer.

    Attributes:
        scenes: how many scenes.
        seconds, model_seconds: medians of the solver and of the model.
        ratio: the median over the scenes of the solver's time over the model's.
    """

    scenes: int
    seconds: float
    model_seconds: float
    ratio: float


@dataclass(frozen=True)
class DeepestFrames:
    """The deepest frames of all scenes.

    Attributes:
        scenes: each scene.
        relative_error, stress_share, largest_stress, after_calls, after_newton_steps: means over the scenes that did
            not fail.
        seconds: the median of the answers' seconds.
        not_converged: the number of scenes whose Newton steps have not converged.
        solver: beside the solver at its own stop test; None: it was not run.
        cheapest: beside its fastest variant that is at least as accurate; None: likewise.
        no_solver: why the solver was not run; None: it was, or `solver_scenes` is 0.
    """

    scenes: tuple[DeepestFrame, ...]
    relative_error: float | None
    stress_share: float | None
    largest_stress: float | None
    after_calls: tuple[float, ...]
    after_newton_steps: tuple[float, ...]
    seconds: float | None
    not_converged: int
    solver: Beside | None
    cheapest: Beside | None
    no_solver: str | None

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `dataclasses.asdict` gave."""
        scenes = tuple(DeepestFrame.from_json(scene) for scene in values["scenes"])
        beside = {key: None if values[key] is None else Beside(**values[key]) for key in ("solver", "cheapest")}
        return cls(**{**values, **_after_each(values), **beside, "scenes": scenes})


@dataclass(frozen=True)
class Figures:
    """What an evaluation measured.

    Attributes:
        scenes: each scene.
        errors: over all scenes.
        failures: how many predictions failed.
        jumps: whether the model predicts each frame from the first one; it has no errors of "one_step" then.
        effort: what follows the first call of such a model: `corrections`, `newton_steps`, `solved`.
        deepest: the deepest frames.
        speedup: the solver's recorded time for all frames over the model's, both on one thread; None: not known.
        length_unit, stress_unit: of the errors.
        field_units: of the errors of each named field.
        threads: of the model.
        origin: the run, the data, the command, the processor and the like.
    """

    scenes: tuple[SceneFigures, ...]
    errors: tuple[MeanError, ...]
    failures: int
    jumps: bool
    effort: Mapping[str, Any]
    deepest: DeepestFrames
    speedup: float | None
    length_unit: str
    stress_unit: str
    threads: int
    field_units: Mapping[str, str] = field(default_factory=dict)
    origin: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        facts = {"scenes": f"{len(self.scenes):,}", "failures": self.failures}
        for row in self.errors:
            if (row.predictor, row.horizon, row.nodes) == ("model", "rollout_all", main_nodes(row.quantity)):
                error = "none" if row.rmse_sequence is None else f"{row.rmse_sequence:.4g} {self.unit(row.quantity)}"
                facts[f"{row.quantity} error"] = error
        return one_line("Figures", facts)

    def error(
        self, quantity: str, predictor: str = "model", horizon: str = "rollout_all", nodes: str | None = None
    ) -> MeanError | None:
        """The error over all scenes; None: the predictor has none of this quantity. `nodes`: the main ones if None.

        Raises:
            ConfigError: a name is not known; the text names the nearest.
        """
        return _row(self.errors, quantity, predictor, horizon, nodes or main_nodes(quantity))

    def unit(self, quantity: str) -> str:
        """The unit of a quantity's errors.

        Raises:
            ConfigError: the quantity is not known.
        """
        units = {"displacement": self.length_unit, "stress": self.stress_unit, **self.field_units}
        if quantity not in units:
            raise ConfigError(f"there is no quantity {quantity!r}{nearest_name(quantity, units)}")
        return units[quantity]

    def relative(self, quantity: str) -> float | None:
        """The model's error of the stress or of a named field over all frames and scenes, over the root mean square of
        the truth, which is the error of the prediction 0; None: a prediction failed, or the truth is 0."""
        model, zero = self.error(quantity), self.error(quantity, f"{quantity}_zero")
        if model is None or zero is None or model.rmse_pooled is None or not zero.rmse_pooled:
            return None
        return model.rmse_pooled / zero.rmse_pooled

    def to_json(self) -> dict[str, Any]:
        """Dictionaries, lists, texts and numbers. Errors stand by quantity, predictor, horizon and nodes."""
        scenes = [{**asdict(scene), "errors": _nested(scene.errors)} for scene in self.scenes]
        return {**asdict(self), "scenes": scenes, "errors": _nested(self.errors)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `to_json` gave."""
        scenes = tuple(SceneFigures.from_json(scene) for scene in values["scenes"])
        errors = tuple(MeanError(*place, **error) for place, error in _leaves(values["errors"]))
        deepest = DeepestFrames.from_json(values["deepest"])
        return cls(**{**values, "scenes": scenes, "errors": errors, "deepest": deepest})


def _row(rows: Sequence[Any], quantity: str, predictor: str, horizon: str, nodes: str) -> Any:
    quantities = dict.fromkeys(["displacement", "stress", *(row.quantity for row in rows)])
    trivial = [f"{name}_{kind}" for name in quantities for kind in ("zero", "constant", "frame_mean")]
    known = {
        "quantity": quantities,
        "predictor": ["model", "hold_still", "repeat_last", *trivial, *(row.predictor for row in rows)],
        "horizon": ["one_step", "rollout_50", "rollout_all"],
        "place of nodes": ["normal", "all", "deforming", "prescribed"],
    }
    wanted = (quantity, predictor, horizon, nodes)
    for name, (what, names) in zip(wanted, known.items(), strict=True):
        if name not in names:
            raise ConfigError(f"there is no {what} {name!r}{nearest_name(name, names)}")
    return next((row for row in rows if (row.quantity, row.predictor, row.horizon, row.nodes) == wanted), None)


def _nested(rows: Sequence[SceneError] | Sequence[MeanError]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for row in rows:
        place = table.setdefault(row.quantity, {}).setdefault(row.predictor, {}).setdefault(row.horizon, {})
        if isinstance(row, SceneError):
            place[row.nodes] = row.rmse
        else:
            place[row.nodes] = {"rmse_sequence": row.rmse_sequence, "rmse_pooled": row.rmse_pooled}
    return table


def _leaves(table: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str, str, str], Any]]:
    """Each error of a table that `_nested` made, with its quantity, predictor, horizon and nodes."""
    for quantity, predictors in table.items():
        for predictor, horizons in predictors.items():
            for horizon, places in horizons.items():
                for nodes, error in places.items():
                    yield (quantity, predictor, horizon, nodes), error


def _after_each(values: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    return {key: tuple(values[key]) for key in ("after_calls", "after_newton_steps")}
