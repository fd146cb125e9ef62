"""What all learned simulators share: normalised targets, the loss, prediction in physical units, and integration."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ast_sim.batches.batch_builder import Batch, Target
from ast_sim.batches.graph import Graph
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.torch_settings import tensors_on_cpu, usual_settings
from ast_sim.dataset.reader import Dataset
from ast_sim.element_topology import LOCAL_EDGES
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.model_config import ModelConfig
from ast_sim.models.normalizer import Normalizer
from ast_sim.named_field import REACTION, STRESS, Output
from ast_sim.scene import Scene
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError
from ast_sim.support.toml_settings import known

Use = Callable[[Normalizer, Tensor], Any]  # what becomes of the values of an input: normalised, or observed

FIELD = "field "  # stands before the name of a named field among the losses

_CPU_ONLY = "models run on the CPU only"


class Latent(NamedTuple):
    """What a network makes of the B scenes of a batch before it decodes.

    Attributes:
        values: [R, D], rows of all scenes: tokens of AST, nodes of the other models.
        offsets: [B + 1], where the rows of each scene begin and end.
    """

    values: Tensor
    offsets: Tensor

    def means(self) -> Tensor:
        """[B, D] float64: the mean over the rows of each scene, which the other scenes do not change."""
        return torch.stack([rows.double().mean(dim=0) for rows in self.values.split(self.offsets.diff().tolist())])


@dataclass(frozen=True)
class Prediction:
    """What a model predicts for a batch.

    Attributes:
        motion: [N, 3], the increment from the state to the predicted frame, or the acceleration with inertia.
        fields: [N or E, *] in the predicted frame, by name: the stress, if there is one, and the named fields.
        latent: what it was decoded from, by which a scene is compared with others; None: the model does not tell.
    """

    motion: Tensor
    fields: dict[str, Tensor]
    latent: Latent | None = None

    @staticmethod
    def of(
        data: DataFacts, on_nodes: Tensor, on_elements: Tensor | None = None, latent: Latent | None = None
    ) -> Prediction:
        """From the columns of all outputs at the nodes, motion first, and of all outputs at the elements, in the order
        of `data.outputs`; without `on_elements` the latter are left out."""
        fields = {}
        ends = {"node": 3, "element": 0}
        for output in data.outputs:
            columns = on_nodes if output.location == "node" else on_elements
            start = ends[output.location]
            ends[output.location] = start + output.columns
            if columns is not None:
                fields[output.name] = columns[:, start : start + output.columns]
        return Prediction(on_nodes[:, :3], fields, latent)


class Simulator(nn.Module):
    """Base class of the models. They run on the CPU and refuse any other device.

    A model implements `forward`, which returns normalised outputs, and `inputs_of`, which gives the inputs of its
    network, or overrides `observe` instead. It overrides `graph` and `domain` if they do not fit.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.motion_normalizer = Normalizer("vector")
        self.strain_normalizer = Normalizer("vector")
        self.stress_normalizer = Normalizer("scalar") if config.data.stress != "none" else None
        # The components of a field with several columns share one scale, like the components of a vector.
        self.field_normalizers = nn.ModuleList(
            Normalizer("scalar" if columns == 1 else "vector") for _, _, columns, _ in config.data.fields
        )
        reactions = any(name == REACTION for name, *_ in config.data.fields)
        self.force_normalizer = Normalizer("vector") if reactions else None

    @property
    def num_parameters(self) -> int:
        """The number of weights."""
        return sum(weights.numel() for weights in self.parameters())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Simulator:
        try:
            device = fn(torch.empty(0, device="cpu")).device
        except (AssertionError, RuntimeError) as error:  # torch has no such device here
            raise ConfigError(f"{_CPU_ONLY}: {str(error).splitlines()[0]}") from None
        _require_cpu("the model", device)
        return super()._apply(fn, recurse)

    def __call__(self, batch: Batch) -> Prediction:
        _require_cpu("the batch", batch.position.device)
        with tensors_on_cpu():
            return super().__call__(batch)

    def forward(self, batch: Batch) -> Prediction:
        raise NotImplementedError

    def inputs_of(self, batch: Batch, use: Use = Normalizer.__call__) -> Any:
        """All inputs of the network, normalised, or what `use` makes of a normalizer and the values that it is for."""
        raise NotImplementedError

    def observe(self, batch: Batch) -> None:
        """Add the batch to the statistics of the inputs."""
        self.inputs_of(batch, Normalizer.observe)

    def graph(self, scene: Scene) -> Graph:
        """What the model needs to know of a scene that does not change with time."""
        return Graph.from_scene(scene, element_nodes=False, **self.config.graph_parts)

    def remarks(self) -> list[str]:
        """What a user should know of the batches that were observed, as lines."""
        return []

    def domain(self, position: Tensor) -> int | None:
        """The number of the domain that holds the positions [N, 3] of a scene. None: they are too far away for the
        model. Scenes in different domains are not predicted together."""
        return 0

    def pairs(self, dataset: Dataset, split: str = "train", *, batch_size: int = 1, **options: Any) -> PairSampler:
        """The frame pairs of a split in batches that fit this model, for a DataLoader of torch or by number:

        pairs = model.pairs(dataset)
        loader = DataLoader(pairs, batch_size=4, shuffle=True, collate_fn=pairs.collate)
        batch, target = model.pairs(dataset, batch_size=4).batch(step)

        Args:
            batch_size: of `batch`; a DataLoader has its own.
            options: seed (0 by default), noise (0), gamma (1), mirror, shift, scenes and part, as of `PairSampler`.

        Raises:
            ConfigError: `dataset` is no open dataset.
            DatasetError: the split has no pair of frames.
        """
        require_type("dataset", dataset, Dataset, "an open ast_sim.Dataset")
        options = {"seed": 0, "noise": 0.0, "gamma": 1.0, **options, "batch_size": batch_size}
        of_model = {"make_graph": self.graph, "scheme": self.config.scheme, "fields": self.config.data.fields}
        return PairSampler(dataset, split, **of_model, **options)

    @property
    def _outputs(self) -> Iterator[tuple[Output, Normalizer]]:
        """What is predicted beside the motion, each with its normalizer."""
        normalizers = (self.stress_normalizer, *self.field_normalizers)
        return zip(self.config.data.outputs, (one for one in normalizers if isinstance(one, Normalizer)), strict=True)

    def _counting(self, output: Output, batch: Batch) -> Tensor:
        """[N or E] bool: where an output counts: at the nodes or elements that deform; of reactions at the prescribed
        nodes, since no other node has any."""
        graph = batch.graph
        if output.name == REACTION:
            return graph.prescribed
        return graph.deforming_elements if output.location == "element" else graph.deforming_nodes

    def _normalised(self, output: Output, normalizer: Normalizer, values: Tensor, batch: Batch) -> Tensor:
        """What the network should say for these values [N or E, *].

        The reactions r of the nodes of a body add up to the force F on it. Small errors that are alike at many nodes
        would make it wrong. So the mean of what the network says is F, and the deviations from the mean are the
        deviations of r, each with its own scale.
        """
        if self.force_normalizer is None or output.name != REACTION:
            return normalizer(values)
        force, count = batch.graph.body_sums(values)
        return (normalizer(values - force / count) + self.force_normalizer(force)).float()

    def _physical(self, output: Output, normalizer: Normalizer, said: Tensor, batch: Batch) -> Tensor:
        """The inverse of `_normalised`."""
        if self.force_normalizer is None or output.name != REACTION:
            return normalizer.inverse(said)
        total, count = batch.graph.body_sums(said)
        mean = total / count
        return (normalizer.inverse(said - mean) + self.force_normalizer.inverse(mean) / count).float()

    @tensors_on_cpu()
    @torch.no_grad()
    def fit_statistics(self, batches: Iterable[tuple[Batch, Target]]) -> None:
        """Fix the statistics of inputs and targets, in float64, from batches as in training, with noise."""
        for batch, target in batches:
            self.observe(batch)
            self.motion_normalizer.observe(target.motion[batch.graph.normal_nodes])
            self.strain_normalizer.observe(_strains(batch.graph, target.motion).flatten(0, 1))
            for output, normalizer in self._outputs:
                counting = self._counting(output, batch)
                values = target.fields[output.name]
                if self.force_normalizer is not None and output.name == REACTION:
                    sums, count = batch.graph.body_sums(values)
                    self.force_normalizer.observe(sums[counting])
                    values = values - sums / count
                normalizer.observe(values[counting])
        for module in self.modules():
            if isinstance(module, Normalizer):
                module.fix()

    @tensors_on_cpu()
    def loss(
        self,
        prediction: Prediction,
        batch: Batch,
        target: Target,
        stress_weight: float = 0.01,
        share: Callable[[int], float] = lambda rows: 1.0,
        weights: Tensor | None = None,
        strain_weight: float = 0.0,
    ) -> dict[str, Tensor]:
        """Mean squared errors of normalised outputs: motion of NORMAL nodes, stress and fields of what deforms.

        The error of the motion may also count by its differences along the edges of deforming elements, over their
        lengths. Forces and stresses follow from these.

        If the batch is part of a larger one, `share` returns the share of its rows (nodes or elements) in all rows. The
        losses of all parts then add up to the loss of the larger batch.

        Args:
            prediction: `self(batch)`.
            weights: [B], how much the squared error of the motion of each scene counts; None: 1.
            strain_weight: of the differences along edges.

        Returns:
            "motion", "strain" (if it has a weight), "stress" (if there is one), "field NAME" of each named field, and
            "loss" = motion + strain_weight * strain + stress_weight * (stress + fields). "spread" is the standard
            deviation of the predicted motion over the nodes: if it is 0, the decoder is dead.
        """
        normal = batch.graph.normal_nodes
        motion = prediction.motion.index_select(0, normal)
        error = motion - self.motion_normalizer(target.motion.index_select(0, normal))
        if weights is not None:
            of_nodes = weights.sqrt().repeat_interleave(batch.graph.node_offsets.diff())
            error = error * of_nodes.index_select(0, normal)[:, None]
        part = share(len(normal))
        losses = {"motion": part * error.square().mean()}
        losses["loss"] = losses["motion"]
        if strain_weight:
            wrong = torch.zeros_like(target.motion).index_copy(0, normal, error) * self.motion_normalizer.scale
            strains = _strains(batch.graph, wrong) / self.strain_normalizer.scale
            losses["strain"] = share(len(strains)) * strains.square().mean()
            losses["loss"] = losses["loss"] + strain_weight * losses["strain"]
        losses["spread"] = part * motion.detach().std(dim=0).mean() if len(motion) > 1 else motion.new_ones(())
        for output, normalizer in self._outputs:
            rows = self._counting(output, batch).nonzero()[:, 0]
            if output.name not in prediction.fields:
                raise ConfigError(
                    f"model.state: the model {self.config.name} does not predict {output.name}: leave it out"
                )
            predicted = prediction.fields[output.name].index_select(0, rows)
            wanted = self._normalised(output, normalizer, target.fields[output.name], batch)
            error = predicted - wanted.index_select(0, rows)
            key = output.name if output.name == STRESS else f"{FIELD}{output.name}"
            losses[key] = share(len(rows)) * error.square().mean()
            losses["loss"] = losses["loss"] + stress_weight * losses[key]
        return losses

    @torch.no_grad()
    def residual(self, prediction: Prediction, batch: Batch, target: Target) -> Tensor:
        """[N, 3]: predicted minus target motion of NORMAL nodes, in the unit of length; 0 elsewhere."""
        error = self.motion_normalizer.inverse(prediction.motion) - target.motion
        return torch.zeros_like(error).index_copy_(0, batch.graph.normal_nodes, error[batch.graph.normal_nodes])

    @contextmanager
    def predicting(self) -> Iterator[None]:
        """Predict in here: without gradients and dropout. Afterwards the module trains again if it did."""
        training = self.training
        if training:  # each of its modules is told, so only if it must be
            self.eval()
        try:
            with usual_settings(), torch.inference_mode():
                yield
        finally:
            if training:
                self.train()

    @torch.inference_mode()
    def predict(self, batch: Batch) -> Prediction:
        """The outputs in physical units: motion in the dataset's unit of length, stress in pascal, named fields in
        theirs. Named fields are 0 where they have no meaning: on rigid bodies, reactions at free nodes."""
        prediction = self(batch)
        fields = {}
        for output, normalizer in self._outputs:
            if output.name in prediction.fields:
                values = self._physical(output, normalizer, prediction.fields[output.name], batch)
                if output.name != STRESS:
                    values = torch.where(self._counting(output, batch)[:, None], values, 0)
                fields[output.name] = values
        return Prediction(self.motion_normalizer.inverse(prediction.motion), fields, prediction.latent)

    def integrate(self, batch: Batch, motion: Tensor) -> Tensor:
        """[N, 3]: positions in the predicted frame, p + v, or 2 p - p_previous + a with inertia."""
        if self.config.data.planar:
            motion = motion * motion.new_tensor([1, 1, 0])
        if self.config.data.dynamic:
            return 2 * batch.position - known(batch.previous_position) + motion
        return batch.position + motion

    def advance(self, batch: Batch, prescribed_position: Tensor) -> tuple[Tensor, Prediction]:
        """The positions [N, 3] in the predicted frame, and the prediction. Prescribed nodes are at
        `prescribed_position` [N, 3]."""
        prediction = self.predict(batch)
        position = self.integrate(batch, prediction.motion)
        return torch.where(batch.graph.prescribed[:, None], prescribed_position, position), prediction


def _strains(graph: Graph, motion: Tensor) -> Tensor:
    """[E, K, 3]: the differences of a motion [N, 3] along the K edges of each deforming element, over their lengths at
    rest; 0 along an edge without length."""
    nodes = graph.elements[graph.deforming_elements]
    first, second = torch.tensor(LOCAL_EDGES[nodes.shape[1]], device="cpu").T

    def along_edges(values: Tensor) -> Tensor:
        at_nodes = values.index_select(0, nodes.flatten()).view(*nodes.shape, 3)
        return at_nodes[:, first] - at_nodes[:, second]

    lengths = along_edges(graph.rest_position).norm(dim=2, keepdim=True)
    return along_edges(motion) * torch.where(lengths > 0, 1 / lengths, 0)


def _require_cpu(what: str, device: torch.device) -> None:
    if device.type != "cpu":
        raise ConfigError(f"{_CPU_ONLY}: {what} cannot be on {device}; leave it on the CPU")
