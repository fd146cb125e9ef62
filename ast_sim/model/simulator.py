"""What every learned simulator shares: normalised targets, the loss, prediction in physical units and integration."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ast_sim.data.batch import Batch, Target
from ast_sim.data.graph import Graph
from ast_sim.data.scene import Scene
from ast_sim.model.config import ModelConfig
from ast_sim.model.normalizer import FeatureNormalizer, Normalizer


@dataclass(frozen=True)
class Prediction:
    """motion [N, 3]: increment (time-conditioned: from the first frame on) or acceleration; stress [N or E, 1] at the
    next frame, if the scene has one."""

    motion: Tensor
    stress: Tensor | None


class Simulator(nn.Module):
    """Base of the models. A model implements `forward` (normalised outputs) and `observe` (its input statistics), and
    `graph` and `domain` where those here do not fit."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.motion_normalizer = Normalizer("vector")
        self.stress_normalizer = Normalizer("scalar") if config.stress != "none" else None

    def forward(self, batch: Batch) -> Prediction:
        raise NotImplementedError

    def observe(self, batch: Batch) -> None:
        raise NotImplementedError

    def graph(self, scene: Scene) -> Graph:
        """What the model needs of a scene at all times."""
        return Graph.from_scene(scene, element_nodes=False, surface=self.config.sees_surfaces)

    def domain(self, position: Tensor) -> int | None:
        """Which domain holds the positions [N, 3] of a scene, None if they are too far away for the model; scenes in
        different domains are not predicted together."""
        return 0

    def _stressed(self, batch: Batch) -> Tensor:
        """Rows whose stress counts: nodes that are no obstacle, or elements with no obstacle node."""
        return batch.graph.solid_elements if self.config.stress == "element" else batch.graph.solid_nodes

    @torch.no_grad()
    def fit_statistics(self, batches: Iterable[tuple[Batch, Target]]) -> None:
        """Fix the statistics of inputs and targets, in float64, from batches drawn as trained on (with noise)."""
        for batch, target in batches:
            self.observe(batch)
            self.motion_normalizer.observe(target.motion[batch.graph.normal_nodes])
            if self.stress_normalizer is not None:
                self.stress_normalizer.observe(target.stress[self._stressed(batch)])
        for module in self.modules():
            if isinstance(module, Normalizer | FeatureNormalizer):
                module.fix()

    def loss(
        self,
        prediction: Prediction,
        batch: Batch,
        target: Target,
        stress_weight: float = 0.01,
        share: Callable[[int], float] = lambda rows: 1.0,
    ) -> dict[str, Tensor]:
        """Mean squared errors of `self(batch)`, normalised: motion of NORMAL nodes, stress of everything but obstacles.

        Where the batch is a part of a larger one, `share` says how much of all rows (nodes or elements) its rows are:
        the losses of all parts then add up to that of the whole.

        Returns:
            "motion", "stress" (if there is one) and "loss" = motion + stress_weight * stress; "spread", the standard
            deviation of the predicted motion over the nodes: 0 means a dead decoder.
        """
        normal = batch.graph.normal_nodes
        motion = prediction.motion.index_select(0, normal)
        error = motion - self.motion_normalizer(target.motion.index_select(0, normal))
        part = share(len(normal))
        losses = {"motion": part * error.square().mean()}
        losses["loss"] = losses["motion"]
        losses["spread"] = part * motion.detach().std(dim=0).mean() if len(motion) > 1 else motion.new_ones(())
        if self.stress_normalizer is not None:
            rows = self._stressed(batch)
            stress = prediction.stress.index_select(0, rows)
            error = stress - self.stress_normalizer(target.stress.index_select(0, rows))
            losses["stress"] = share(len(rows)) * error.square().mean()
            losses["loss"] = losses["loss"] + stress_weight * losses["stress"]
        return losses

    @torch.no_grad()
    def residual(self, prediction: Prediction, batch: Batch, target: Target) -> Tensor:
        """[N, 3] how far `self(batch)` leads NORMAL nodes from the truth, in units of length; zero elsewhere."""
        error = self.motion_normalizer.inverse(prediction.motion) - target.motion
        return torch.zeros_like(error).index_copy_(0, batch.graph.normal_nodes, error[batch.graph.normal_nodes])

    @torch.inference_mode()
    def predict(self, batch: Batch) -> Prediction:
        """The outputs in physical units: lengths in the dataset's unit, stress in pascal."""
        prediction = self(batch)
        stress = self.stress_normalizer.inverse(prediction.stress) if self.stress_normalizer is not None else None
        return Prediction(self.motion_normalizer.inverse(prediction.motion), stress)

    def integrate(self, batch: Batch, motion: Tensor) -> Tensor:
        """[N, 3] next positions: p + v, or 2 p - p_previous + a; p is that of the first frame where each is predicted
        from it. Prescribed nodes are the caller's."""
        if self.config.dynamic:
            return 2 * batch.position - batch.previous_position + motion
        return batch.position + motion
