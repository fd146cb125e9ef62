"""How far to trust an answer: split conformal prediction, by scene.

Frames and nodes of one scene depend on each other, so the scene is what is exchangeable. The score of a calibration
scene is the largest error in any frame, over the scale of that frame (`band`). Let q be the ceil((n + 1) LEVEL)-th
smallest of n scores. Then in a fresh scene of the same kind the errors of all frames lie within q times the scale, with
a probability of at least LEVEL, whatever the model is (Vovk, Gammerman, Shafer 2005; Angelopoulos, Bates 2023, section
1), but for the small change of the typical size by one scene. It holds on average over calibrations and fresh scenes,
and for each quantity alone. The calibration scenes must not have trained or chosen the model; so nothing needs to be
crossed, and n scores are enough from the n on for which the rank is at most n.

How the scores are measured: `inference/calibrate.py`. What errors the answers keep, and which effort is enough for a
wanted one: `kept_errors`. Whether a scene is like the calibration scenes: `familiarity`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from ast_sim.inference.effort import Effort
from ast_sim.inference.promises.familiarity import Familiarity
from ast_sim.inference.promises.kept_errors import DISPLACEMENT, KEPT, KeptErrors
from ast_sim.inference.quantities.band import LEVEL, Band
from ast_sim.number_arrays import percent
from ast_sim.prescribed_motion import Motion
from ast_sim.runs.scope import LEEWAY, spacing_of
from ast_sim.scene import Scene
from ast_sim.support.errors import counted, warn

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer


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
        farthest: (lowest, highest) distance by which prescribed nodes leave their places at rest in these scenes.
        kept: the errors of these scenes after each effort.
        familiarity: these scenes as the network sees them; None: the model does not tell.
    """

    scenes: int
    efforts: tuple[Effort, ...]
    quantiles: Mapping[str, tuple[float, ...]]
    typical: Mapping[str, float]
    spacing: tuple[float, float]
    farthest: tuple[float, float]
    kept: KeptErrors = field(default_factory=KeptErrors, repr=False)
    familiarity: Familiarity | None = field(default=None, repr=False)

    @property
    def text(self) -> str:
        """The bands and the kept errors in words."""
        told = f"bands by {counted(self.scenes, 'scene')}: with {100 * LEVEL:g} % the errors of all frames lie within"
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

    def by_quantity(self) -> dict[str, Any]:
        """The bands and the kept errors in words, by quantity and effort."""
        bands = {}
        for quantity, quantiles in self.quantiles.items():
            added = f"times its size plus {self.typical[quantity]:.3g}"
            widths = zip(quantiles, self.efforts, strict=True)
            bands[quantity] = {one.text: f"{width:.3g} {added}" for width, one in widths if math.isfinite(width)}
        kept = {}
        for quantity in self.kept.errors:
            bounds = zip(self.kept.bounds(quantity), self.kept.efforts, strict=True)
            kept[quantity] = {one.text: percent(bound) for bound, one in bounds if math.isfinite(bound)}
        return {
            "scenes": self.scenes,
            f"band of {100 * LEVEL:g} %": bands,
            f"largest error in {100 * KEPT:g} % of scenes": kept,
        }

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
            "farthest": list(self.farthest),
            "kept": self.kept.to_json(),
            "familiarity": familiarity,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
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
            _range(values["spacing"]),
            _range(values["farthest"]),
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
            warn(f"{path} {told}")
            return None

    def unlike(self, scene: Scene, farthest: float) -> str:
        """Why the calibration scenes say nothing of a scene in which prescribed nodes move so far; empty if they do."""
        for value, (low, high), text in (
            (spacing_of(scene), self.spacing, "the mesh edges are {:.3g} long"),
            (farthest, (0.0, self.farthest[1]), "prescribed nodes move up to {:.3g} from their places at rest"),
        ):
            if not (1 - LEEWAY) * low <= value <= (1 + LEEWAY) * high:
                limits = f"{low:.3g} to {high:.3g}" if low else f"{high:.3g} at most"
                return f"{text.format(value)}, in the calibration scenes {limits}"
        return ""

    def unlike_errors(self, scene: Scene, farthest: float) -> str:
        """Why the kept errors, which are shares of the displacement in the deepest frames, say nothing; as `unlike`."""
        least = self.farthest[0]
        if farthest >= (1 - LEEWAY) * least:
            return self.unlike(scene, farthest)
        return (
            f"prescribed nodes move up to {farthest:.3g} from their places at rest in the wanted frames, in the"
            f" calibration scenes {least:.3g} or more; of a smaller displacement the error may be a larger share"
        )

    def compared(self, answer: Answer) -> tuple[float | None, tuple[str, ...]]:
        """The p-value of the scene of an answer, None if it is not known, and a note if the scene is unlike these."""
        p_value = None if self.familiarity is None else self.familiarity.p_value(answer)
        return p_value, () if self.familiarity is None or p_value is None else self.familiarity.notes(p_value)

    def bands(self, answer: Answer, effort: Effort, notes: Sequence[str]) -> dict[str, Band]:
        """The band of each quantity; none where nothing is known: for a scene with `notes`, which are warnings already,
        and with a warning that says why, with another effort, on another mesh, or where nodes are moved farther."""
        if notes:
            return {}
        why = self.unlike(answer.scene, Motion(answer.position).farthest(answer.scene))
        if effort not in self.efforts:
            known = counted(len(self.efforts), "effort")
            why = f"the run was calibrated with {known} (run.calibration.efforts), but not with {effort.text}"
        elif math.isinf(self._widths(effort)[DISPLACEMENT]):
            why = f"too many calibration scenes failed with {effort.text}"
        if why:
            warn(f"{answer.name}: no band: {why}")
            return {}
        return {quantity: Band(width, self.typical[quantity]) for quantity, width in self._widths(effort).items()}

    def _widths(self, effort: Effort) -> dict[str, float]:
        """The quantile of each quantity."""
        number = self.efforts.index(effort)
        return {quantity: widths[number] for quantity, widths in self.quantiles.items()}


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = values
    return low, high
