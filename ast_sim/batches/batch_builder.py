"""The input of a model. Training, validation, prediction and evaluation all build it here.

Legend: N nodes, E elements, B scenes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ast_sim.batches.graph import Graph
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.named_field import REACTION


@dataclass(frozen=True, eq=False)
class State:
    """The state of a scene from which a model predicts: the frame before, or the guess that a jump starts from.

    Attributes:
        position: [N, 3] float32, p_t, with noise in training. In a jump the prescribed nodes are where they will be.
        previous: [N, 3], p_{t-1}; None in a scene without inertia.
        stress: [N, 1] or [E, 1] at t, or None.
        source: [N, 3], the frame that was carried along to be this state; None where the load path does not
            count.
        history: [N, *], what is known of that frame at the nodes (`Graph.at_nodes`), or None.
    """

    position: Tensor
    previous: Tensor | None = None
    stress: Tensor | None = None
    source: Tensor | None = None
    history: Tensor | None = None

    @staticmethod
    def concatenate(states: Sequence[State]) -> State:
        """The states of several scenes as one."""
        return State(
            position=torch.cat([state.position for state in states]),
            previous=_joined([state.previous for state in states]),
            stress=_joined([state.stress for state in states]),
            source=_joined([state.source for state in states]),
            history=_joined([state.history for state in states]),
        )


@dataclass(frozen=True, eq=False)
class Batch:
    """The state of each scene, and the motion that is prescribed until the frame to predict.

    Attributes:
        graph: what does not change with time.
        position, previous_position, stress, source, history: as in `State`.
        boundary_motion: [N, 3], how far the prescribed nodes move from the state to the frame to predict; 0 elsewhere.
        names: for messages, one for each scene: "train/000012 frame 7".
        wants_elements: False: a model may leave out what it predicts on elements.
        proximity: [N, 5] of these positions, if it was computed ahead; None: a model that wants it computes it.
    """

    graph: Graph
    position: Tensor
    previous_position: Tensor | None
    boundary_motion: Tensor
    stress: Tensor | None
    names: list[str]
    wants_elements: bool = True
    proximity: Tensor | None = None
    source: Tensor | None = None
    history: Tensor | None = None

    @staticmethod
    def build(graph: Graph, state: State, prescribed_position: Tensor, names: list[str]) -> Batch:
        """The batch of one scene, or of several scenes whose arrays are concatenated.

        Args:
            prescribed_position: [N, 3], of the prescribed nodes in the frame to predict. Other rows are not read.
        """
        motion = torch.where(graph.prescribed[:, None], prescribed_position - state.position, 0.0)
        return Batch(
            graph=graph,
            position=state.position,
            previous_position=state.previous,
            boundary_motion=motion,
            stress=state.stress,
            names=names,
            source=state.source,
            history=state.history,
        )

    @staticmethod
    def concatenate(batches: Sequence[Batch]) -> Batch:
        """Several batches as one."""
        return Batch(
            graph=Graph.concatenate([batch.graph for batch in batches]),
            position=torch.cat([batch.position for batch in batches]),
            previous_position=_joined([batch.previous_position for batch in batches]),
            boundary_motion=torch.cat([batch.boundary_motion for batch in batches]),
            stress=_joined([batch.stress for batch in batches]),
            names=[name for batch in batches for name in batch.names],
            source=_joined([batch.source for batch in batches]),
            history=_joined([batch.history for batch in batches]),
        )

    def placed(self, placement: Placement) -> Batch:
        """The same scene, mirrored and moved."""
        previous = self.previous_position
        source = self.source
        return replace(
            self,
            graph=self.graph.placed(placement),
            position=placement.points(self.position),
            previous_position=None if previous is None else placement.points(previous),
            boundary_motion=placement.vectors(self.boundary_motion),
            proximity=None,
            source=None if source is None else placement.points(source),
        )


@dataclass(frozen=True, eq=False)
class Target:
    """What a model should predict for a batch.

    Attributes:
        motion: [N, 3], the increment from the state to the frame to predict. With inertia it is the acceleration
            p_{t+1} - 2 p_t + p_{t-1}. Both are corrected for the noise on p_t.
        fields: [N or E, *] in the frame to predict, by name: the stress, if there is one, and the named fields.
    """

    motion: Tensor
    fields: dict[str, Tensor]

    @staticmethod
    def concatenate(targets: Sequence[Target]) -> Target:
        """Several targets as one."""
        joined = {name: torch.cat([target.fields[name] for target in targets]) for name in targets[0].fields}
        return Target(torch.cat([target.motion for target in targets]), joined)

    def placed(self, placement: Placement) -> Target:
        """The target of the same scene, mirrored and moved. Reactions are vectors; other fields do not change."""
        placed = dict(self.fields)
        if REACTION in placed:
            placed[REACTION] = placement.vectors(placed[REACTION])
        return Target(placement.vectors(self.motion), placed)


def _joined(parts: Sequence[Tensor | None]) -> Tensor | None:
    """The parts of all scenes, concatenated; None unless all scenes have one."""
    known = [part for part in parts if part is not None]
    return torch.cat(known) if len(known) == len(parts) else None
