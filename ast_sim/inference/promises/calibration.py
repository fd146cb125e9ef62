"""How far to trust an answer: split conformal prediction, by scene.

Frames and nodes of one scene depend on each other, so the scene is what is exchangeable. The score of a calibration
scene is the largest error in any frame, over the scale of that frame (`band`). Let q be the ceil((n + 1) LEVEL)-th
smallest of n scores. Then in a fresh scene of the same kind the errors of all frames lie within q times the scale, with
a probability of at least LEVEL, whatever the model is (Vovk, Gammerman, Shafer 2005; Angelopoulos, Bates 2023, section
1), but for the small change of the typical size by one scene. It holds on average over calibrations and fresh scenes,
and for each quantity alone. The calibration scenes must not have trained or chosen the model; so nothing needs to be
crossed, and n scores are enough from the n on for which the rank is at most n.

What errors the answers keep, and which effort is enough for a wanted one: `kept_errors`. Whether a scene is like the
calibration scenes: `familiarity`.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from ast_sim.inference.effort import Effort, choices
from ast_sim.inference.promises.familiarity import Familiarity
from ast_sim.inference.promises.kept_errors import KEPT, KeptErrors
from ast_sim.inference.quantities.band import LEVEL, Band, Comparison, compared
from ast_sim.inference.quantities.relative_errors import moves
from ast_sim.number_arrays import percent
from ast_sim.runs.scope import LEEWAY, spacing_of
from ast_sim.scene import Scene, Trajectory
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Progress, ShowProgress

if TYPE_CHECKING:
    from ast_sim.dataset.reader import Dataset
    from ast_sim.inference.answer import Answer
    from ast_sim.inference.trained_run import Run

DISPLACEMENT = "displacement"  # the quantity that every scene has
FEWEST = math.ceil(LEVEL / (1 - LEVEL) - 1e-9)  # scenes with which the rank of the quantile is at most their number


@dataclass(frozen=True)
class Calibration:
    """What the calibration scenes say of the answers of a run.

    Attributes:
        scenes: the number of calibration scenes.
        efforts: the efforts that have a band, from the cheapest to the dearest.
        quantiles: q of each quantity and effort, the width of the band over the scale; infinite where too many
            predictions failed.
        typical: of each quantity, the root mean square of its true sizes in these scenes.
        spacing: (lowest, highest) mean length of the mesh edges of the deforming bodies in these scenes.
        kept: the errors of these scenes after each effort.
        familiarity: these scenes as the network sees them; None: the model does not tell.
    """

    scenes: int
    efforts: tuple[Effort, ...]
    quantiles: Mapping[str, tuple[float, ...]]
    typical: Mapping[str, float]
    spacing: tuple[float, float]
    kept: KeptErrors = field(default_factory=KeptErrors, repr=False)
    familiarity: Familiarity | None = field(default=None, repr=False)

    @property
    def text(self) -> str:
        """The bands and the kept errors in words."""
        told = f"bands by {self.scenes} scenes: with {100 * LEVEL:g} % the errors of all frames lie within"
        for quantity, quantiles in self.quantiles.items():
            widths = zip(quantiles, self.efforts, strict=True)
            known = [f"{width:.3g} with {effort.text}" for width, effort in widths if math.isfinite(width)]
            told += f"\n{quantity}: its size plus {self.typical[quantity]:.3g}, times {'; '.join(known)}"
        return told + self._kept

    @property
    def _kept(self) -> str:
        """The errors that efforts keep, in words."""
        told = ""
        for quantity in self.kept.errors:
            bounds = zip(self.kept.bounds(quantity), self.kept.efforts, strict=True)
            known = [f"{percent(bound)} with {effort.text}" for bound, effort in bounds if math.isfinite(bound)]
            if known:
                told += f"\n{quantity}: error at the deepest frame in {100 * KEPT:g} % of scenes: {'; '.join(known)}"
        return told

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        familiarity = None if self.familiarity is None else self.familiarity.to_json()
        return {
            "scenes": self.scenes,
            "efforts": [asdict(effort) for effort in self.efforts],
            "quantiles": {
                quantity: [width if math.isfinite(width) else None for width in widths]
                for quantity, widths in self.quantiles.items()
            },
            "typical": dict(self.typical),
            "spacing": list(self.spacing),
            "kept": self.kept.to_json(),
            "familiarity": familiarity,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        low, high = values["spacing"]
        known = values["familiarity"]
        typical = values["typical"]
        return cls(
            values["scenes"],
            tuple(Effort(**one) for one in values["efforts"]),
            {
                quantity: tuple(math.inf if width is None else width for width in widths)
                for quantity, widths in values["quantiles"].items()
            },
            typical,
            (low, high),
            KeptErrors.from_json(values["kept"]),
            None if known is None else Familiarity.from_json(known),
        )

    @classmethod
    def of_run(cls, path: Path, answers: Mapping[str, Any]) -> Self | None:
        """The calibration among what is known of the answers of a run; None, and a warning, if another version of this
        program has made it."""
        if "calibration" not in answers:
            return None
        try:
            return cls.from_json(answers["calibration"])
        except (KeyError, TypeError):
            told = "was calibrated by another version of ast_sim, which does not count: ast-sim calibrate RUN DATA"
            warnings.warn(f"{path} {told}", stacklevel=3)
            return None

    def unlike(self, scene: Scene, notes: Sequence[str]) -> str:
        """Why the calibration scenes say nothing of a scene with `notes`; empty if they do."""
        spacing = spacing_of(scene)
        low, high = self.spacing
        if notes:
            return "the scene is unlike the scenes that the run knows"
        if not (1 - LEEWAY) * low <= spacing <= (1 + LEEWAY) * high:
            return f"the mesh edges are {spacing:.3g} long, in the calibration scenes {low:.3g} to {high:.3g}"
        return ""

    def compared(self, answer: Answer) -> tuple[float | None, tuple[str, ...]]:
        """The p-value of the scene of an answer, None if it is not known, and a note if the scene is unlike these."""
        p_value = None if self.familiarity is None else self.familiarity.p_value(answer)
        return p_value, () if self.familiarity is None or p_value is None else self.familiarity.notes(p_value)

    def bands(self, answer: Answer, effort: Effort, notes: Sequence[str]) -> dict[str, Band]:
        """The band of each quantity; none where nothing is known: for a scene with `notes`, which are warnings already;
        and with a warning that says why, with another effort and on another mesh."""
        if notes:
            return {}
        why = self.unlike(answer.scene, ())
        if effort not in self.efforts:
            why = f"the run was calibrated with {'; '.join(one.text for one in self.efforts)}"
        elif math.isinf(self._widths(effort)[DISPLACEMENT]):
            why = f"too many calibration scenes failed with {effort.text}"
        if why:
            warnings.warn(f"{answer.name}: no band: {why}", stacklevel=4)
            return {}
        return {quantity: Band(width, self.typical[quantity]) for quantity, width in self._widths(effort).items()}

    def _widths(self, effort: Effort) -> dict[str, float]:
        """The quantile of each quantity."""
        number = self.efforts.index(effort)
        return {quantity: widths[number] for quantity, widths in self.quantiles.items()}


def quantile(scores: Sequence[float]) -> float:
    """The ceil((n + 1) LEVEL)-th smallest of n scores; n is at least `FEWEST`."""
    return sorted(scores)[math.ceil((len(scores) + 1) * LEVEL - 1e-9) - 1]


def calibrate(
    run: Run,
    data: str | os.PathLike[str] | Dataset | None = None,
    split: str = "calibration",
    *,
    progress: ShowProgress = True,
) -> Calibration:
    """Measure how far the answers of a run are from the truth, after its default effort and each effort among which one
    is chosen for a wanted error; then answers with these efforts have a band.

    The scenes must be new to the run: they have neither trained nor chosen it. Scenes outside the ranges of the
    training do not count, since no band is given there; neither do scenes without motion. A warning says how many. The
    folder of a run keeps the result beside its best checkpoint, and `Run.save` takes it along.

    Args:
        run: the run. A file is not changed: only this object knows the band, and a file that `run.save` writes of it.
        data: a dataset, its path or open; by default the one that the run was trained on.
        split: whose scenes are predicted.
        progress: as in `generate`.

    Raises:
        ConfigError: the split has trained or chosen the run, there are fewer than 19 scenes, or too many fail.
    """
    require_runs(run)
    with run.open(data) as dataset:
        require_new_scenes(run, dataset, split)
        before, run.calibration = run.calibration, None  # it has no say in which scenes count
        try:
            result, left_out = _measured(run, dataset, split, progress)
        except BaseException:
            run.calibration = before
            raise
    run.calibration = result
    if left_out:
        told = f"{len(left_out)} scenes lie outside the training or do not move, the first is {left_out[0]}"
        warnings.warn(f"{told}: they do not count", stacklevel=2)
    run.folder.keep_calibration(result.to_json())
    if run.path.is_file():
        warnings.warn(f"{run.path} is a file, which is not changed: Run.save writes one with the band", stacklevel=2)
    return result


def require_runs(*runs: Any) -> None:
    """Raise ConfigError unless these are trained runs."""
    from ast_sim import Run  # by its public name: it imports this module

    for run in runs:
        require_type("a run", run, Run, "a Run, such as ast_sim.Run(folder)")


def require_new_scenes(run: Run, dataset: Dataset, split: str) -> None:
    """Raise ConfigError if the scenes of a split have trained or chosen the run. A copy of its dataset is known."""
    if split in ("train", "valid") and (
        Path(run.settings.data).resolve() == dataset.path.resolve()
        or run.folder.origin.get("data") == dataset.fingerprint()
    ):
        raise ConfigError(f"the scenes of {split} have trained or chosen the run: take other scenes")


class _Measured(NamedTuple):
    """A calibration scene.

    Attributes:
        comparisons: of the quantities in all frames, for each effort with a band; None where the prediction failed.
        errors: of the deepest frame, for each effort among which one is chosen; None where the prediction failed.
        spacing: as `Calibration` has it.
        latents: [frames, D]; None: the model does not tell.
    """

    comparisons: list[dict[str, Comparison] | None]
    errors: list[dict[str, float] | None]
    spacing: float
    latents: np.ndarray | None


def _measured(run: Run, dataset: Dataset, split: str, progress: ShowProgress) -> tuple[Calibration, list[str]]:
    """The calibration by the scenes of a split, and the names of the scenes that do not count."""
    to_choose = choices(run.settings.model, run.settings.train.corrections)
    efforts = to_choose if run.effort in to_choose else (*to_choose, run.effort)
    scenes: list[_Measured] = []
    left_out: list[str] = []
    fields = [name for name, *_ in run.settings.model.data.fields]
    with Progress(dataset.count(split), "scenes", progress) as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted here
        for index in range(dataset.count(split)):
            name = f"{split}/{index:06d}"
            one = _measured_scene(run, dataset.load(split, index, fields), name, efforts, to_choose)
            bar.advance(name)
            if one is None:
                left_out.append(name)
            else:
                scenes.append(one)
    if len(scenes) < FEWEST:
        raise ConfigError(
            f"a band of {100 * LEVEL:g} % needs at least {FEWEST} calibration scenes, and there are {len(scenes)}: make"
            " more with generate(..., calibration=N) (--calibration N)"
        )
    quantiles, typical = _quantiles([one.comparisons for one in scenes])
    spacings = [one.spacing for one in scenes]
    latents = [one.latents for one in scenes if one.latents is not None]
    familiarity = Familiarity.of(latents) if len(latents) >= FEWEST else None
    kept = _kept_errors(to_choose, [list(of_effort) for of_effort in zip(*(one.errors for one in scenes), strict=True)])
    reach = (min(spacings), max(spacings))
    return Calibration(len(scenes), efforts, quantiles, typical, reach, kept, familiarity), left_out


def _quantiles(
    scenes: Sequence[Sequence[Mapping[str, Comparison] | None]],
) -> tuple[dict[str, tuple[float, ...]], dict[str, float]]:
    """The quantiles of each quantity, one for each effort, and the typical sizes, from the comparisons by scene.

    Raises:
        ConfigError: with each effort too many predictions failed.
    """
    known = [one for scene in scenes for one in scene if one is not None]
    quantiles: dict[str, tuple[float, ...]] = {}
    typical: dict[str, float] = {}
    for quantity in known[0] if known else ():
        if not all(quantity in one for one in known):
            continue
        sizes = np.concatenate([one[quantity].true_sizes for one in known])
        typical[quantity] = float(np.sqrt(np.square(sizes).mean()))
        quantiles[quantity] = tuple(
            quantile([math.inf if one is None else one[quantity].score(typical[quantity]) for one in of_effort])
            for of_effort in zip(*scenes, strict=True)
        )
    if all(map(math.isinf, quantiles.get(DISPLACEMENT, ()))):
        failed = min(of_effort.count(None) for of_effort in zip(*scenes, strict=True))
        raise ConfigError(f"{failed} of {len(scenes)} predictions failed: no band holds")
    return quantiles, typical


def _measured_scene(
    run: Run, truth: Trajectory, name: str, efforts: Sequence[Effort], to_choose: Sequence[Effort]
) -> _Measured | None:
    """A calibration scene; None: nothing moves in it, or it lies outside the training."""
    if not moves(truth):
        return None
    answers = [run.predict(truth, effort=effort, throw=False, name=name, progress=False) for effort in efforts]
    if answers[0].notes:
        return None
    comparisons = [None if one.failure is not None else compared(one, truth) for one in answers]
    deepest = deepest_frame(truth)
    alone = [
        run.predict(truth, frames=deepest, effort=effort, throw=False, name=name, progress=False)
        for effort in to_choose
    ]
    errors = [None if one.failure is not None else one.errors(truth) for one in alone]
    latents = np.stack(list(answers[0].latents.values())) if answers[0].latents else None
    return _Measured(comparisons, errors, spacing_of(truth.scene), latents)


def _kept_errors(efforts: Sequence[Effort], errors: Sequence[Sequence[Mapping[str, float] | None]]) -> KeptErrors:
    """The errors by quantity, effort and scene; None, where the prediction failed, is infinite."""
    known = [one for of_scenes in errors for one in of_scenes if one is not None]
    shared = [quantity for quantity in (known[0] if known else ()) if all(quantity in one for one in known)]
    by_quantity = {
        quantity: tuple(tuple(math.inf if one is None else one[quantity] for one in of_scenes) for of_scenes in errors)
        for quantity in shared
    }
    return KeptErrors(tuple(efforts), by_quantity)
