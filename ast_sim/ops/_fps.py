"""Farthest point sampling: it chooses a few cells such that every other cell is near one of them.

Legend: B scenes, C cells, S samples.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops.library import Kernel, Op
from ast_sim.ops.spec import Given, Sizes

EXTENT = 1 << 21  # below this difference of coordinates, squared distances are exact in float64


def _check_extent(name: str, sizes: Sizes, given: Given) -> None:
    offsets = given["offsets"].tolist()
    for scene in range(len(offsets) - 1):
        points = given["coordinates"][offsets[scene] : offsets[scene + 1]].long()
        if len(points) and (points.amax(0) - points.amin(0)).max() >= EXTENT:
            raise ValueError(f"{name}: coordinates of scene {scene} differ by 2^21 or more")


def _sample_scene(points: Tensor, num: int) -> Tensor:
    distance = torch.full_like(points[:, 0], torch.iinfo(torch.int64).max)
    picks = [torch.zeros_like(distance[0])]
    while len(picks) < num:
        distance = torch.minimum(distance, (points - points[picks[-1]]).square().sum(1))
        distance[picks[-1]] = -1
        picks.append(distance.argmax())
    return torch.stack(picks)


def _sample_reference(coordinates: Tensor, offsets: Tensor, num: int) -> list[Tensor]:
    picks = [offsets[:0]]
    for begin, end in zip(offsets.tolist(), offsets[1:].tolist(), strict=False):
        points = coordinates[begin:end].long()
        few = end - begin <= num
        picks.append(begin + (torch.arange(end - begin, device=points.device) if few else _sample_scene(points, num)))
    return [torch.cat(picks), F.pad(offsets.diff().clamp(max=num).cumsum(0), (1, 0))]


_sample = Op(
    Kernel(
        "farthest_point_sample",
        "coordinates[C,3] int32, offsets[B+1] offsets(C), num integer(1,9223372036854775807)"
        " -> indices[S] int64, out_offsets[B+1] int64",
        _check_extent,
    ),
    _sample_reference,
)


def farthest_point_sample(coordinates: Tensor, offsets: Tensor, num: int) -> tuple[Tensor, Tensor]:
    """Exact greedy farthest point sampling of each scene.

    The first sample is the scene's first point. Each further sample is the point that is farthest from all samples so
    far. Of equally far points the one with the lowest index is taken. If all points left coincide with samples, the
    lowest unused index follows. A scene with at most `num` points gives all of them in order. Distances are exact.

    Args:
        coordinates: [C, 3] int32. Sampling is fast if successive points lie near each other, as in Morton order.
        offsets: [B + 1] int64, from 0 to C; the points of scene b are offsets[b]:offsets[b + 1].
        num: the most samples of a scene, at least 1.

    Returns:
        The rows of the samples in coordinates, [S] int64, and the offsets of each scene's samples, [B + 1] int64.

    Raises:
        ValueError: num < 1, the offsets are not as above, or the coordinates of a scene differ by 2^21 or more.
    """
    if num < 1:
        raise ValueError(f"farthest_point_sample: num must be at least 1, not {num}")
    indices, out_offsets = _sample(coordinates, offsets, num)
    return indices, out_offsets
