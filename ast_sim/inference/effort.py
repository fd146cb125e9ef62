"""How much is computed for an answer: one dial from the fastest answer to an exact one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ast_sim.mechanics.elements.material import NeoHookean
from ast_sim.mechanics.linearised_contact import CLEARANCE, NewtonSteps
from ast_sim.models.model_config import ModelConfig
from ast_sim.scene import Scene
from ast_sim.support.errors import ConfigError

GOOD = 0.02  # a relative error that most users call exact
GOOD_STRESS = 0.1  # the same of the stress, relative to the error of its mean
MOST_NEWTON_STEPS = 10  # by default; they end earlier where one is small
AGAIN = 2  # a frame in which so many Newton steps did not end is begun anew with so many more corrections
WORTH = 0.05  # a correction or a Newton step must lower an error that is not good by this share


class Effort(NamedTuple):
    """What follows the first call of a model that jumps.

    Attributes:
        corrections: so many further calls of the model correct its answer.
        newton_steps: at most so many Newton steps of the solver then lead towards equilibrium. They end when a step is
            at most `STILL`. Where `MOST_NEWTON_STEPS` or more do not end, they begin anew after more corrections.
    """

    corrections: int = 0
    newton_steps: int = 0

    @property
    def text(self) -> str:
        """Such as "2 corrections, up to 1 Newton step"."""
        found = [(self.corrections, "correction"), (self.newton_steps, "Newton step")]
        told = [f"{n} {what}{'' if n == 1 else 's'}" for n, what in found if n or what == "correction"]
        return ", up to ".join(told)

    def check(self, config: ModelConfig) -> None:
        """Raise ConfigError if a number is negative or the model cannot do so."""
        for key, count in self._asdict().items():
            if count < 0:
                raise ConfigError(f"{key} is {count}; it must be at least 0")
            if count and not config.jumps:
                raise ConfigError(f"{key} is {count}; it needs a run that jumps, and this one does not")
        if self.newton_steps and not knows_material(config):
            raise ConfigError(
                f"newton_steps is {self.newton_steps}; they need tetrahedra and their material: the training"
                " scenes have no columns of Young's modulus and Poisson's ratio, and no solver recorded them"
            )


FIRST_CALL = Effort()


def knows_material(config: ModelConfig) -> bool:
    """Whether Young's modulus and Poisson's ratio are known for the scenes of a model that jumps."""
    known = config.material_width == 2 or config.young > 0 or friction_is_drawn(config)
    return bool(config.jumps and config.tetrahedra and known)


def friction_is_drawn(config: ModelConfig) -> bool:
    """Whether the third column of the material is friction, as in assemblies whose scenes differ in it."""
    return config.material_width == 3 and config.contact_range > 0


def newton_steps(config: ModelConfig, scene: Scene) -> NewtonSteps:
    """The Newton steps of a scene, in the material and with the contact of the training scenes.

    Raises:
        SimulationError: the constants of the material are not allowed, or an element has no volume.
    """
    friction = config.friction
    if scene.material is not None and (config.material_width == 2 or friction_is_drawn(config)):
        young, poisson, *drawn = scene.material.astype(np.float64).T
        friction = max((float(column.max()) for column in drawn), default=friction)
        rigid = ~scene.deforming_nodes[scene.elements].any(axis=1)
        material = NeoHookean(np.where(rigid, 1.0, young), np.where(rigid, 0.0, poisson))
    else:
        material = NeoHookean(config.young, config.poisson)
    return NewtonSteps(scene, material, CLEARANCE * config.contact_range, friction)


def cheapest_good(found: np.ndarray) -> Effort:
    """The default effort of a run: Newton steps until one is small, or none, since scenes differ in how many they need.

    Stress tells more than the displacement: it follows from strains, and a step that leaves single elements distorted
    hardly moves their nodes.

    Args:
        found: [4, C, K], means over validation scenes after c corrections and up to k Newton steps: the relative errors
            of the displacement and of the stress (NaN where there is none), how many Newton steps were made, and the
            share of the scenes in which they did not end.

    Returns:
        Of the efforts whose errors are good, or nearly the smallest of all, those whose Newton steps did not end in the
        fewest scenes; of these the one with the fewest corrections and Newton steps together. If no effort has both
        errors so, that of the displacement decides. The first call alone if no error is known.
    """
    if np.isnan(found[0]).all():
        return FIRST_CALL
    ends = sorted({0, found.shape[2] - 1})
    errors, stress, steps, unsettled = found[:, :, ends]
    accurate = errors <= max(GOOD, (1 + WORTH) * np.nanmin(errors))
    least = np.inf if np.isnan(stress).all() else max(GOOD_STRESS, (1 + WORTH) * np.nanmin(stress))
    both = accurate & ~(stress > least)
    good = both if both.any() else accurate
    settled = good & (unsettled <= unsettled[good].min())
    total = np.where(settled, np.arange(len(errors))[:, None] + steps, np.inf)
    corrections, column = np.unravel_index(total.argmin(), total.shape)
    return Effort(int(corrections), ends[column])
