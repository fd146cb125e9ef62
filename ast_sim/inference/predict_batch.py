"""Frames of several scenes, predicted together as one ragged batch."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ast_sim.batches.batch_builder import Batch, State
from ast_sim.batches.graph import Graph
from ast_sim.models.simulator import Simulator


class Start(NamedTuple):
    """What a frame of a scene is predicted from.

    Attributes:
        name: for messages.
        graph, state: of the scene.
        prescribed: [N, 3], the positions of the prescribed nodes in the frame. Other rows are not read.
    """

    name: str
    graph: Graph
    state: State
    prescribed: Tensor


def predict_batch(
    model: Simulator, starts: Sequence[Start], calls: int = 1
) -> list[tuple[list[Tensor], dict[str, Tensor], float]]:
    """Predict the frames; each call corrects the answer of the one before. Fields on elements are predicted by the last
    call only.

    Returns:
        For each frame its positions [N, 3] after each call, its fields by name, and its share of the wall seconds.
    """
    began = time.perf_counter()
    names, graphs, states, prescribed = zip(*starts, strict=True)
    graph = Graph.concatenate(graphs)
    prescribed = torch.cat(prescribed)
    batch = Batch.build(graph, State.concatenate(states), prescribed, list(names))
    sizes = graph.node_offsets.diff().tolist()
    positions = []
    fields: dict[str, Tensor] = {}
    for call in range(1, calls + 1):
        position, fields = model.advance(replace(batch, wants_elements=call == calls), prescribed)
        positions.append(position.split(sizes))
        batch = replace(batch, position=position, proximity=None)
    rows = {"node": sizes, "element": graph.element_offsets.diff().tolist()}
    places = {output.name: output.location for output in model.config.data.outputs}
    parts = {name: values.split(rows[places[name]]) for name, values in fields.items()}
    of_starts = [{name: part[row] for name, part in parts.items()} for row in range(len(starts))]
    seconds = (time.perf_counter() - began) / len(starts)
    return [(way, end, seconds) for *way, end in zip(*positions, of_starts, strict=True)]
