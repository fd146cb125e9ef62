"""Cloth: membrane and bending energy of a sheet of triangles, flat at rest.

- Membrane: St. Venant-Kirchhoff on linear triangles. With F [3,2] the deformation gradient, E = (F^T F - I) / 2 and
  plane-stress Lame parameters mu, lambda in N/m (already times the thickness), the energy per rest area is
  mu E:E + lambda/2 (tr E)^2 and the second Piola-Kirchhoff stress S = 2 mu E + lambda tr(E) I.
- Bending: the quadratic hinges of Bergou et al. 2006 ("A quadratic bending model for inextensible surfaces"). Their
  Hessian is constant. With D the bending stiffness, they are scaled so that a cylinder of radius R has the energy
  D / (2 R^2) per area on a mesh without preferred directions (Seung and Nelson 1988).

Legend: N nodes, T triangles; component-first arrays as in `elasticity.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ast_sim.mechanics.linear_algebra.sparsity import Entries
from ast_sim.support.errors import SimulationError, counted

# The 45 entries (p, q), p <= q, of a triangle's symmetric 9 x 9 stiffness; p = 3 a + i for component i of node a.
_ROW, _COLUMN = np.triu_indices(9)
_SAME_COMPONENT = np.flatnonzero(_ROW % 3 == _COLUMN % 3)


@dataclass(frozen=True)
class ClothMaterial:
    """A homogeneous isotropic sheet.

    Attributes:
        stretch: membrane stiffness in N/m: Young's modulus times thickness.
        poisson: Poisson's ratio in the plane.
        bending: bending stiffness in N m.
        density: mass per area in kg/m^2.
        compression: ratio of the stiffness in compression to the stiffness in tension; 1 is St. Venant-Kirchhoff.
    """

    stretch: float
    poisson: float
    bending: float
    density: float
    compression: float = 1.0

    def __post_init__(self) -> None:
        for name in ("stretch", "density"):
            if not getattr(self, name) > 0:
                raise SimulationError(f"the cloth's {name} is {getattr(self, name)}: must be above 0")
        if not self.bending >= 0:
            raise SimulationError(f"the cloth's bending stiffness is {self.bending}: must be at least 0")
        if not -1 < self.poisson < 1:
            raise SimulationError(f"the cloth's Poisson's ratio is {self.poisson}: must lie between -1 and 1")
        if not 0 <= self.compression <= 1:
            raise SimulationError(f"the cloth's compression ratio is {self.compression}: must lie between 0 and 1")

    @property
    def mu(self) -> float:
        """Shear stiffness in N/m."""
        return self.stretch / (2 * (1 + self.poisson))

    @property
    def lam(self) -> float:
        """Lame's first parameter in plane stress, in N/m."""
        return self.stretch * self.poisson / (1 - self.poisson**2)


@dataclass(frozen=True)
class ClothState:
    """Positions [N,3], F [3,2,T], strains and stresses of the membrane, and the energy in joule."""

    position: np.ndarray
    F: np.ndarray
    membrane: MembraneState
    energy: float


class MembraneState:
    """Stress and tangent of the membrane at Green strains [3,T] (11, 22, 12).

    The energy density is c W + (1 - c) W_relaxed. W is the energy of St. Venant-Kirchhoff, c is the `compression` of
    the material, and W_relaxed is the tension field of W (Pipkin 1986). With the principal strains e1 >= e2, Poisson's
    ratio nu and the stretch stiffness Y, W_relaxed is

        W(e1, e2)    where e2 > -nu e1: taut,
        Y e1^2 / 2   where e2 <= -nu e1 and e1 > 0: wrinkled across the direction of e2,
        0            else: slack.

    W_relaxed is a convex function of the deformation gradient, so only the share c can make a stiffness indefinite.
    """

    def __init__(self, strain: np.ndarray, material: ClothMaterial) -> None:
        self.material = material
        mu = material.mu
        lam = material.lam
        nu = material.poisson
        share = material.compression
        e11, e22, e12 = strain
        pressure = lam * (e11 + e22)
        plain = np.stack([2 * mu * e11 + pressure, 2 * mu * e22 + pressure, 2 * mu * e12])
        density = 0.5 * (plain[0] * e11 + plain[1] * e22 + 2 * plain[2] * e12)
        mean = (e11 + e22) / 2
        radius = np.hypot((e11 - e22) / 2, e12)
        self._large = mean + radius
        self._small = mean - radius
        self._taut = self._small > -nu * self._large
        self._wrinkled = ~self._taut & (self._large > 0)
        # Double angle of the first principal direction: cosine and sine.
        cosine = np.divide((e11 - e22) / 2, radius, out=np.ones_like(radius), where=radius > 0)
        sine = np.divide(e12, radius, out=np.zeros_like(radius), where=radius > 0)
        self._direction = np.stack([(1 + cosine) / 2, (1 - cosine) / 2, sine / 2])  # n n^T: 11, 22, 12
        tension = np.where(self._wrinkled, material.stretch * self._large, 0)
        relaxed = np.where(self._taut, plain, tension * self._direction)
        self.stress = share * plain + (1 - share) * relaxed
        self.energy_density = share * density + (1 - share) * np.where(self._taut, density, tension * self._large / 2)

    def tangent(self) -> np.ndarray:
        """Derivative of the stress by the strain (11, 22, 2 x 12), [3,3,T] in N/m.

        Where the sheet is wrinkled, it is Y n n^T (x) n n^T plus the shear Y e1 / (2 (e1 - e2)), because n turns.
        """
        material = self.material
        mu = material.mu
        lam = material.lam
        plain = np.array([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
        weight = np.where(self._taut, 1.0, material.compression)
        result = plain[:, :, None] * weight
        at = np.flatnonzero(self._wrinkled)
        if material.compression < 1 and len(at):
            n11, n22, n12 = self._direction[:, at]
            large, small = self._large[at], self._small[at]
            stretch = (1 - material.compression) * material.stretch
            along = np.stack([n11, n22, n12])
            across = np.stack([-2 * n12, 2 * n12, n11 - n22])  # engineering shear in the principal frame
            result[:, :, at] += stretch * along[:, None] * along
            result[:, :, at] += stretch * large / (2 * (large - small)) * across[:, None] * across
        return result


class Cloth:
    """The `Potential` of a sheet of triangles [T,3] with rest positions [N,3]. Nodes of no triangle carry no force.

    Raises:
        SimulationError: a triangle has no rest area, or an edge belongs to more than two triangles.
    """

    def __init__(self, rest: np.ndarray, triangles: np.ndarray, material: ClothMaterial) -> None:
        self.material = material
        self.triangles = triangles
        self.num_nodes = len(rest)
        first, second = (rest[triangles[:, k]] - rest[triangles[:, 0]] for k in (1, 2))
        twice_area = np.linalg.norm(np.cross(first, second), axis=1)
        if not (twice_area > 0).all():
            worst = int(np.argmin(twice_area))
            raise SimulationError(f"triangle {worst} has the rest area {twice_area[worst] / 2:.3g}: must be positive")
        self.area = twice_area / 2
        # Rest edges in an orthonormal frame of the triangle: (length, 0) and (x, y); gradients are the inverse's rows.
        length = np.linalg.norm(first, axis=1)
        x, y = np.einsum("ti,ti->t", first, second) / length, twice_area / length
        zero = np.zeros_like(x)
        gradients = np.array([[1 / length, -x / (length * y)], [zero, 1 / y]])  # [node 1 or 2, direction, T]
        self.gradients = np.concatenate([-gradients.sum(0)[None], gradients])  # [3, 2, T]
        self._nodes = np.ascontiguousarray(triangles.T)
        self._dofs = (3 * self._nodes[:, None, :] + np.arange(3)[None, :, None]).reshape(9, -1)
        pairs = (_ROW // 3)[_SAME_COMPONENT], (_COLUMN // 3)[_SAME_COMPONENT]
        self._pair_gradients = tuple(self.gradients[:, i][pairs[0]] * self.area for i in (0, 1))
        self._pair_columns = tuple(self.gradients[:, i][pairs[1]] for i in (0, 1))
        self._bending = material.bending * bending_matrix(rest, triangles)
        upper = sparse.triu(self._bending).tocoo()
        self._bending_values = np.tile(upper.data, 3)
        self._bent_nodes = np.stack([upper.row, upper.col])

    @property
    def unit_force(self) -> float:
        """See `Potential`."""
        return self.material.stretch * float(np.mean(self.area * np.abs(self.gradients)))

    @property
    def unit_energy(self) -> float:
        """See `Potential`."""
        return self.material.stretch * float(self.area.sum())

    def jacobian(self, position: np.ndarray) -> np.ndarray:
        """Area of each triangle [T] at positions [N,3], divided by its area at rest."""
        first, second = (position[self._nodes[k]] - position[self._nodes[0]] for k in (1, 2))
        return np.linalg.norm(np.cross(first, second), axis=1) / (2 * self.area)

    def mass(self) -> np.ndarray:
        """Lumped mass [N] of each node in kg: a third of the mass of the triangles around the node."""
        weight = np.tile(self.material.density * self.area / 3, 3)
        return np.bincount(self._nodes.ravel(), weight, minlength=self.num_nodes)

    def evaluate(self, position: np.ndarray) -> ClothState:
        """See `Potential`."""
        x = position.T[:, self._nodes]  # [3, 3, T]: component, node
        F = np.einsum("iat,ajt->ijt", x, self.gradients)
        e11 = (np.einsum("it,it->t", F[:, 0], F[:, 0]) - 1) / 2
        e22 = (np.einsum("it,it->t", F[:, 1], F[:, 1]) - 1) / 2
        e12 = np.einsum("it,it->t", F[:, 0], F[:, 1]) / 2
        membrane = MembraneState(np.stack([e11, e22, e12]), self.material)
        bending = 0.5 * float(np.vdot(position, self._bending @ position))
        return ClothState(position, F, membrane, float(self.area @ membrane.energy_density) + bending)

    def _element_forces(self, state: ClothState) -> np.ndarray:
        """Derivative of each triangle's membrane energy by its nodes [3 nodes,3,T]: A F S grad N_a."""
        s11, s22, s12 = state.membrane.stress
        first = state.F[:, 0] * s11 + state.F[:, 1] * s12  # columns of F S, [3, T]
        second = state.F[:, 0] * s12 + state.F[:, 1] * s22
        weighted = self.gradients * self.area
        return weighted[:, 0, None] * first + weighted[:, 1, None] * second

    def gradient(self, state: ClothState) -> tuple[np.ndarray, float]:
        """See `Potential`."""
        forces = self._element_forces(state).reshape(9, -1)
        total = np.bincount(self._dofs.ravel(), forces.ravel(), minlength=3 * self.num_nodes)
        return total.reshape(-1, 3) + self._bending @ state.position, float(np.abs(forces).mean())

    def entries(self) -> tuple[Entries, Entries]:
        """See `Potential`: of the membrane, then of bending."""
        return Entries(self._nodes, _ROW, _COLUMN), Entries(self._bent_nodes, np.arange(3), np.arange(3, 6))

    def hessian(self, state: ClothState, project: bool = False) -> np.ndarray:
        """See `Potential`.

        A triangle's matrix is A (B^T C B + G (x) I). B is the derivative of the strain by the nodes, C the elastic
        matrix, and G_ab = grad N_a . S grad N_b. Only G can be indefinite; it is positive semi-definite where S is.

        Args:
            state: the state at the positions in question.
            project: replace S in G by its positive part. Each triangle's matrix is then positive semi-definite.
        """
        f1, f2 = state.F[:, 0], state.F[:, 1]  # [3, T]
        g1, g2 = self.gradients[:, 0, None], self.gradients[:, 1, None]  # [3, 1, T]
        B = np.stack([g1 * f1, g2 * f2, g2 * f1 + g1 * f2]).reshape(3, 9, -1)  # strains 11, 22, 2 x 12
        CB = np.einsum("xyt,ypt->xpt", state.membrane.tangent() * self.area, B)
        entries = B[0][_ROW] * CB[0][_COLUMN]
        entries += B[1][_ROW] * CB[1][_COLUMN]
        entries += B[2][_ROW] * CB[2][_COLUMN]
        s11, s22, s12 = positive_part(state.membrane.stress) if project else state.membrane.stress
        left1, left2 = self._pair_gradients
        right1, right2 = self._pair_columns
        entries[_SAME_COMPONENT] += left1 * (s11 * right1 + s12 * right2) + left2 * (s12 * right1 + s22 * right2)
        return np.concatenate([entries.ravel(), self._bending_values])


def positive_part(S: np.ndarray) -> np.ndarray:
    """Symmetric 2 x 2 matrices [3,T] (11, 22, 12) with their negative eigenvalues replaced by zero.

    With eigenvalues l1 >= l2 it is a S + b I, where a = (max(l1,0) - max(l2,0)) / (l1 - l2), b = max(l1,0) - a l1.
    """
    mean = (S[0] + S[1]) / 2
    radius = np.hypot((S[0] - S[1]) / 2, S[2])
    large, small = np.maximum(mean + radius, 0), np.maximum(mean - radius, 0)
    a = np.divide(large - small, 2 * radius, out=np.ones_like(mean), where=radius > 0)
    b = large - a * (mean + radius)
    return np.stack([a * S[0] + b, a * S[1] + b, a * S[2]])


def bending_matrix(rest: np.ndarray, triangles: np.ndarray) -> sparse.csr_matrix:
    """Q [N,N]: x^T Q x / 2 is half the integral of the squared mean curvature (the sum of both principal curvatures).

    Each inner edge x0 x1 with the opposite nodes x2, x3 adds K^T K / (A2 + A3). K is the edge's row of cotangents, and
    |K x| is the edge's length times the angle across it. K vanishes on affine maps of a flat sheet, so only curvature
    costs energy.
    The numerator of Bergou et al. is 3 K^T K. It makes a cylinder on equilateral triangles three times too stiff.

    Raises:
        SimulationError: an edge belongs to more than two triangles.
    """
    num_nodes = len(rest)
    tail, head, opposite = (np.concatenate([np.roll(triangles, -k, axis=1)[:, j] for k in range(3)]) for j in range(3))
    key = np.minimum(tail, head).astype(np.int64) * num_nodes + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    _, start, count = np.unique(key[order], return_index=True, return_counts=True)
    if (count > 2).any():
        one = order[start[np.argmax(count)]]
        raise SimulationError(
            f"edge {tail[one]}-{head[one]} belongs to {counted(count.max(), 'triangle')}: a sheet has at most 2"
        )
    left, right = order[start[count == 2]], order[start[count == 2] + 1]
    nodes = np.stack([tail[left], head[left], opposite[left], opposite[right]])  # [4, edges]
    x0, x1, x2, x3 = rest[nodes]

    def cotangent(at: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        a, b = one - at, other - at
        return np.einsum("ei,ei->e", a, b) / np.linalg.norm(np.cross(a, b), axis=1)

    c01, c02 = cotangent(x0, x1, x2), cotangent(x0, x1, x3)  # at the tail, between the edge and each side
    c03, c04 = cotangent(x1, x0, x2), cotangent(x1, x0, x3)  # at the head
    rows = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04])
    area = (np.linalg.norm(np.cross(x1 - x0, x2 - x0), axis=1) + np.linalg.norm(np.cross(x1 - x0, x3 - x0), axis=1)) / 2
    edge = np.broadcast_to(np.arange(len(left)), nodes.shape)
    K = sparse.csr_matrix((rows.ravel(), (edge.ravel(), nodes.ravel())), shape=(len(left), num_nodes))
    return (K.T @ sparse.diags(1 / area) @ K).tocsr()
