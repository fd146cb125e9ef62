"""Where a training scene is put: its laws hold in mirror images of it and elsewhere in space, too.

Mirrored along three axes, one simulation stands for up to eight. Moved, it meets the cells of the octree anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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

    def points(self, p: np.ndarray) -> np.ndarray:
        """[N, 3] -> [N, 3]; the same bits where nothing is mirrored or moved."""
        return self.sign * p + ((1 - self.sign) * self.center + self.shift)

    def vectors(self, v: np.ndarray) -> np.ndarray:
        """[N, 3] -> [N, 3], or [N, 4] -> [N, 4] with lengths in the last column, which stay."""
        return v * np.append(self.sign, np.float32(1))[: v.shape[1]]

    def triangles(self, nodes: np.ndarray) -> np.ndarray:
        """[F, 3] -> [F, 3], so that they are counter-clockwise again seen from outside."""
        return nodes if self.sign.prod() > 0 else nodes[:, [0, 2, 1]]
