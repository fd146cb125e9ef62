"""Stresses and moduli in another unit in one simulation than in others: where stress, strain and Young's modulus do not
go together.

In an elastic body the von Mises stress divided by the equivalent strain is about Young's modulus, in every element and
frame. A body that yields has less, down to a ten thousandth; a unit is a factor of a thousand or more in all elements
alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ast_sim.material import POISSON, YIELD_STRESS, YOUNG, listed_columns
from ast_sim.plausibility.findings import Finding, places
from ast_sim.scene import Trajectory

# At most this many frames and elements of a simulation are looked at, and at least this many numbers.
_FRAMES = 8
_ELEMENTS = 2000
_LEAST = 20

# Strains below this share of the largest one, or below this multiple of rounding, are left out.
_SMALL = 0.02
_ROUNDING = 100.0

# Stress, divided by strain and Young's modulus, of anything that is solid. It is at most about 1.5; fibres across which
# Young's modulus was taken have up to 50. Displacements in metres beside a mesh in millimetres make it a thousand.
_LEAST_RATIO = 1e-5
_MOST_RATIO = 100.0

# Between simulations: a factor that no yielding makes, and a factor for bodies that do not yield: in these, the
# logarithm of stress divided by strain varies by less than this share of the logarithm of strain.
_FACTOR = 1e5
_FACTOR_IF_ELASTIC = 100.0
_ELASTIC = 0.6
_SPREAD = 0.3  # of the logarithm of strain; with less, nothing is known of yielding

# The first yield stress as a share of Young's modulus.
_LEAST_YIELD = 1e-7
_MOST_YIELD = 1.0

_THOUSANDS = (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9)
_MOST_MATERIALS = 20
_USUAL = 3  # at least as many simulations, and three quarters of all, have the usual modulus


class Stiffness(NamedTuple):
    """Stress divided by strain, and by Young's modulus if it is known: what nine, five and one of ten numbers exceed;
    whether stress is in proportion to strain."""

    low: float
    middle: float
    high: float
    elastic: bool
    by_modulus: bool

    def times(self, usual: Stiffness) -> float:
        """How many times as stiff it is as a usual one; 1 if yielding, or another material, may explain it."""
        least = _FACTOR_IF_ELASTIC if self.elastic and usual.elastic else _FACTOR
        apart = max(self.low / usual.high, usual.low / self.high) > least
        return self.middle / usual.middle if apart else 1.0


def stiffness(trajectory: Trajectory) -> Stiffness | None:
    """None if there is no stress, too little strain, or a material whose modulus is not named."""
    scene = trajectory.scene
    stress = trajectory.stress
    columns = listed_columns(trajectory.attributes)
    flat = scene.elements.shape[1] == 3 and bool(np.ptp(trajectory.position[..., 2]) == 0)
    if stress is None or (scene.material is not None and YOUNG not in columns):
        return None
    if scene.elements.shape[1] == 3 and not flat:  # a shell bends, and its strain is not known
        return None
    corners = scene.elements[:, : 3 if flat else 4]
    whole = np.abs(np.linalg.det(_edges(scene.rest_position, corners))) > 0  # a flat element has no strain
    rows = _spread_over(np.flatnonzero(scene.deforming_elements & whole), _ELEMENTS)
    frames = _spread_over(np.arange(trajectory.num_frames), _FRAMES)
    corners = corners[rows]
    strain, rounding = _strains(scene.rest_position, trajectory.position[frames], corners)
    at = stress[frames][:, :, 0].astype(np.float64)
    at = at[:, rows] if trajectory.stress_at == "element" else at[:, corners].mean(axis=2)
    used = (at > 0) & (strain > max(_SMALL * strain.max(initial=0), _ROUNDING * rounding))
    if used.sum() < _LEAST:
        return None
    modulus = np.ones(len(rows))
    if scene.material is not None:
        modulus = scene.material[rows, columns.index(YOUNG)].astype(np.float64)
        used &= modulus > 0
    ratio = (at / np.where(used, strain * modulus, 1))[used]
    low, middle, high = np.quantile(ratio, (0.1, 0.5, 0.9)).tolist()
    spread = float(np.log(strain[used]).std())
    elastic = spread > _SPREAD and float(np.log(ratio).std()) < _ELASTIC * spread
    return Stiffness(low, middle, high, elastic, scene.material is not None)


def other_stress(known: Sequence[tuple[str, Stiffness]]) -> list[tuple[str, Finding]]:
    """Simulations by name whose stress does not go with strain and Young's modulus, by itself or beside the others."""
    told = []
    for name, one in known:
        if one.by_modulus and not _LEAST_RATIO < one.middle < _MOST_RATIO:
            meaning = (
                "it must be about 1, less where a body yields: is the stress, Young's modulus or the displacement in"
                " another unit?"
            )
            where = f"stress divided by strain and Young's modulus is {one.middle:.3g}"
            told.append((name, Finding("simulations whose stress does not go with their modulus", 1, where, meaning)))
    wrong = {name for name, _ in told}
    usual = _usual([one for name, one in known if name not in wrong])
    for name, one in known:
        if usual is None or name in wrong or one.times(usual) == 1:
            continue
        of_what = "strain and Young's modulus" if one.by_modulus else "strain"
        other = "is the stress or Young's modulus in another unit?"
        if not one.by_modulus:
            other = "is it in another unit? Or is the material another, and no column says so?"
        where = f"stress divided by {of_what} is {one.middle:.3g}, in most others {usual.middle:.3g}"
        meaning = f"their stress is some {one.times(usual):.1g} times the usual one at the same strain: {other}"
        told.append((name, Finding("simulations whose stress is another at the same strain", 1, where, meaning)))
    return told


def _usual(known: Sequence[Stiffness]) -> Stiffness | None:
    """The one in the middle."""
    return sorted(known, key=lambda one: one.middle)[(len(known) - 1) // 2] if known else None


class Moduli(NamedTuple):
    """The pairs of Young's modulus and Poisson's ratio of the bodies of a simulation, in ascending order."""

    pairs: tuple[tuple[float, float], ...]

    def thousands(self, usual: Moduli) -> float:
        """The power of a thousand by which all moduli are larger at equal ratios; 1 if they are not."""
        mine, theirs = np.array(self.pairs), np.array(usual.pairs)
        if mine.shape != theirs.shape or not len(mine) or not np.array_equal(mine[:, 1], theirs[:, 1]):
            return 1.0
        factors = (f for f in _THOUSANDS if np.allclose(mine[:, 0], f * theirs[:, 0], rtol=1e-5, atol=0))
        return next(factors, 1.0)


def moduli(trajectory: Trajectory) -> Moduli:
    """The moduli of the elements that deform; none if no column says them, or if they are too many for materials."""
    material = trajectory.scene.material
    columns = listed_columns(trajectory.attributes)
    if material is None or YOUNG not in columns or POISSON not in columns:
        return Moduli(())
    rows = material[trajectory.scene.deforming_elements][:, [columns.index(YOUNG), columns.index(POISSON)]]
    pairs = np.unique(rows, axis=0)
    return Moduli(tuple(map(tuple, pairs.tolist())) if len(pairs) <= _MOST_MATERIALS else ())


def other_moduli(known: Sequence[tuple[str, Moduli]]) -> list[tuple[str, Finding]]:
    """Simulations by name whose moduli have the digits of the usual ones, but are a power of a thousand larger or
    smaller, with no modulus between them."""
    counts = Counter(one for _, one in known if one.pairs)
    if not counts:
        return []
    usual, count = counts.most_common(1)[0]
    others = [(name, one, one.thousands(usual)) for name, one in known if one != usual]
    strays = [one for _, one, factor in others if factor == 1]
    if count < _USUAL or 4 * count < 3 * len(known) or strays or len({factor for _, _, factor in others}) > 1:
        return []
    what = "simulations whose Young's modulus may be in another unit"
    meaning = f"in most others it is {usual.pairs[0][0]:.6g}, with the same digits: is it in another unit?"
    return [(name, Finding(what, 1, f"it is {one.pairs[0][0]:.6g}", meaning)) for name, one, _ in others]


def yielding(trajectory: Trajectory) -> list[Finding]:
    """Elements whose yield stress cannot be one beside their Young's modulus."""
    material = trajectory.scene.material
    columns = listed_columns(trajectory.attributes)
    if material is None or YOUNG not in columns or YIELD_STRESS not in columns:
        return []
    young, limit = (material[:, columns.index(name)].astype(np.float64) for name in (YOUNG, YIELD_STRESS))
    share = limit / np.where(young > 0, young, np.inf)
    wrong = (limit > 0) & ~((share > _LEAST_YIELD) & (share < _MOST_YIELD))
    rows = np.flatnonzero(trajectory.scene.deforming_elements & wrong)
    if not len(rows):
        return []
    meaning = f"it is {share[rows[0]]:.3g} of Young's modulus: are both in one unit?"
    return [Finding("elements whose yield stress cannot be one", len(rows), places("elements", rows), meaning)]


def _spread_over(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))] if len(rows) else rows


def _strains(rest: np.ndarray, position: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, float]:
    """The equivalent logarithmic strain [S, E] of elements by their corners [E, k], which no turn changes, and how
    large rounding makes it."""
    edges = _edges(rest, corners)
    now = _edges(position, corners)
    gradient = np.linalg.solve(edges[None], now)  # transposed, which does not change its singular values
    stretch = np.linalg.svd(gradient, compute_uv=False)
    log = np.log(np.maximum(stretch, 1e-3))
    if log.shape[-1] == 2:
        log = np.concatenate([log, np.zeros((*log.shape[:-1], 1))], axis=-1)  # plane strain
    deviator = log - log.mean(axis=-1, keepdims=True)
    shortest = np.linalg.norm(edges, axis=2).min(axis=1).mean() if len(edges) else 1.0
    rounding = float(np.finfo(np.float32).eps * max(np.abs(position).max(), np.abs(rest).max()) / shortest)
    return np.sqrt(2 / 3 * (deviator**2).sum(axis=-1)), rounding


def _edges(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """[..., E, d, d]: the vectors between the corners [E, d + 1]; d is 2 in a plane z = constant."""
    return np.diff(points[..., corners, :].astype(np.float64), axis=-2)[..., : corners.shape[1] - 1]
