"""Bodies with equal meshes that change their places from one frame to the next: the points of one stand where the
points of another stood. Programs that number points by where they lie, or as their processes deliver them, write such
frames.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ast_sim.plausibility.findings import Finding, places
from ast_sim.scene import Scene

# How far the way between two equal bodies may have changed, as a share of how far it would have if they had changed
# their places: the first if they stand as before, the second if they do not.
_KEPT = 0.8
_CHANGED = 0.25


def nearest_bodies(now: np.ndarray, then: np.ndarray) -> list[int] | None:
    """Which of the equal bodies now [k, d] is each one of then [k, d], by the places of their nodes; None if that is
    not clear."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist, pdist

    order = linear_sum_assignment(cdist(then, now, "sqeuclidean"))[1]
    now = now[order]
    alike = (order == np.arange(len(order))).all()
    clear = pdist(now - then) <= (_KEPT if alike else _CHANGED) * pdist(now + then)
    return order.tolist() if clear.all() else None


def change_places(scene: Scene, position: np.ndarray) -> list[Finding]:
    """Frames [S, N, 3] in which bodies with equal meshes lie where others of them lay in the frame before."""
    frames: set[int] = set()
    for bodies in _equal_bodies(scene):
        at = position[:, bodies].astype(np.float64)
        for frame in range(1, len(position)):
            if _may_have_changed(at[frame], at[frame - 1]):
                now, then = (at[index].reshape(len(bodies), -1) for index in (frame, frame - 1))
                order = nearest_bodies(now, then)
                if order is not None and order != list(range(len(bodies))):
                    frames.add(frame)
    if not frames:
        return []
    meaning = (
        "a body lies where another with an equal mesh lay in the frame before: are the points numbered otherwise in"
        " these frames? Write them in one order"
    )
    where = places("frames", np.array(sorted(frames)))
    return [Finding("frames in which bodies change their places", len(frames), where, meaning)]


def _equal_bodies(scene: Scene) -> Iterator[np.ndarray]:
    """[bodies, nodes]: the nodes of two bodies or more whose meshes are equal, with their nodes in one order."""
    kinds: dict[tuple[int, bytes], list[np.ndarray]] = {}
    local = np.empty(scene.num_nodes, np.int64)
    nodes_by_body = _rows_by_number(scene.body)
    elements_by_body = _rows_by_number(scene.body[scene.elements[:, 0]])
    for number, nodes in nodes_by_body.items():
        local[nodes] = np.arange(len(nodes))
        elements = local[scene.elements[elements_by_body.get(number, nodes[:0])]]
        kinds.setdefault((len(nodes), elements.tobytes()), []).append(nodes)
    yield from (np.stack(bodies) for bodies in kinds.values() if len(bodies) > 1)


def _rows_by_number(numbers: np.ndarray) -> dict[int, np.ndarray]:
    """The rows of each number, ascending."""
    order = np.argsort(numbers, kind="stable")
    known, starts = np.unique(numbers[order], return_index=True)
    return dict(zip(known.tolist(), np.split(order, starts[1:]), strict=True))


def _may_have_changed(now: np.ndarray, then: np.ndarray) -> bool:
    """Whether the centre of a body [k, n, 3] lies nearer to where another's was than to where its own was."""
    from scipy.spatial import KDTree

    nearest = KDTree(then.mean(axis=1)).query(now.mean(axis=1))[1]
    return not np.array_equal(nearest, np.arange(len(now)))
