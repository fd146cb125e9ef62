"""Frames of several scenes, predicted together as one ragged batch."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, State
from ast_sim.batches.graph import Graph
from ast_sim.inference.effort import FIRST_CALL, Effort
from ast_sim.models.simulator import Simulator


class Start(NamedTuple):
    """What a frame of a scene is predicted from.

    Attributes:
        name: for messages.
        graph, state: of the scene.
        prescribed_position: [N, 3], the positions of the prescribed nodes in the frame. Other rows are not read.
    """

    name: str
    graph: Graph
    state: State
    prescribed_position: Tensor


class PredictedFrame(NamedTuple):
    """A frame of a scene.

    Attributes:
        positions: [N, 3] after each call.
        fields: [N or E, *] by name, after the last call.
        latent: [D], the mean of what the network made of it in the first call; None: the model does not tell.
        seconds: its share of the wall seconds.
    """

    positions: list[Tensor]
    fields: dict[str, Tensor]
    latent: np.ndarray | None
    seconds: float


def predict_frames(model: Simulator, starts: Sequence[Start], effort: Effort = FIRST_CALL) -> list[PredictedFrame]:
    """Predict the frames by one call, then by the corrections of the effort, each of which corrects the answer before
    it. Fields on elements are predicted by the last call only."""
    began = time.perf_counter()
    names, graphs, states, prescribed_position = zip(*starts, strict=True)
    graph = Graph.concatenate(graphs)
    prescribed_position = torch.cat(prescribed_position)
    batch = Batch.build(graph, State.concatenate(states), prescribed_position, list(names))
    sizes = graph.node_offsets.diff().tolist()
    positions = []
    predictions = []
    for call in range(effort.corrections + 1):
        last_call = call == effort.corrections
        position, prediction = model.advance(replace(batch, wants_elements=last_call), prescribed_position)
        positions.append(position.split(sizes))
        predictions.append(prediction)
        batch = replace(batch, position=position, proximity=None)
    first, last = predictions[0], predictions[-1]
    rows = {"node": sizes, "element": graph.element_offsets.diff().tolist()}
    places = {output.name: output.location for output in model.config.data.outputs}
    parts = {name: values.split(rows[places[name]]) for name, values in last.fields.items()}
    of_starts = [{name: part[row] for name, part in parts.items()} for row in range(len(starts))]
    latents = [None] * len(starts) if first.latent is None else list(first.latent.means().numpy())
    seconds = (time.perf_counter() - began) / len(starts)
    return [
        PredictedFrame(after_each_call, fields, latent, seconds)
        for *after_each_call, fields, latent in zip(*positions, of_starts, latents, strict=True)
    ]
