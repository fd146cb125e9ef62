"""Mirrored and moved copies of training scenes: the laws of mechanics hold for them as well.

Mirrored along three axes, one simulation gives up to eight. A moved scene is cut into other cells of the octree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Placement:
    """The reflection and translation p -> c + s (p - c) + d.

    Attributes:
        sign: [3] float32, s: -1 along the axes that are mirrored, else 1.
        center: [3] float32, c.
        shift: [3] float32, d.
    """

    sign: np.ndarray
    center: np.ndarray
    shift: np.ndarray

    @property
    def is_identity(self) -> bool:
        return bool((self.sign > 0).all() and not self.shift.any())

    def points(self, p: Tensor) -> Tensor:
        """[N, 3] -> [N, 3]; the bits do not change if nothing is mirrored or moved."""
        offset = (1 - self.sign) * self.center + self.shift
        return torch.from_numpy(self.sign) * p + torch.from_numpy(offset)

    def vectors(self, v: Tensor) -> Tensor:
        """[N, 3] -> [N, 3], or [N, 4] -> [N, 4] if the last column holds lengths, which do not change."""
        return v * torch.from_numpy(np.append(self.sign, np.float32(1)))[: v.shape[1]]

    def triangles(self, nodes: Tensor) -> Tensor:
        """[F, 3] -> [F, 3], so that they are counter-clockwise seen from outside again."""
        return nodes if self.sign.prod() > 0 else nodes[:, [0, 2, 1]]
