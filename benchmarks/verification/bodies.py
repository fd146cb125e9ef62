"""Bodies and loads of the verification problems: meshes, rollers, dead loads, and equilibrium by the product's solver.

`Rollers` and `DeadLoad` satisfy the solver's interface of a potential and wrap another potential. The unchanged solver
of the product therefore finds every equilibrium.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.linear_algebra.sparsity import Entries, entry_dofs
from ast_sim.mechanics.solver import Newton, SolverSettings
from ast_sim.scene import Scene
from ast_sim.simulate.shapes import mesh


@dataclass(frozen=True)
class WrappedState:
    """State of the wrapped potential with the energy of both; `position` is the one asked for."""

    inner: Any
    position: np.ndarray
    energy: float


class Rollers:
    """Holds single components of nodes at given values, exactly.

    The wrapped potential sees `value` in place of a held component; the component itself is a degree of freedom of its
    own with the energy k/2 (x - value)^2, which leaves it at its value. Nothing is penalised: k only scales a
    decoupled equation.

    Args:
        potential: the wrapped one.
        held: [N,3] bool.
        value: [N,3] metres, used where held; it may be changed between load steps.
        stiffness: k in newton a metre.
    """

    def __init__(self, potential, held: np.ndarray, value: np.ndarray, stiffness: float) -> None:
        self.potential, self.held, self.value, self.stiffness = potential, held, np.array(value, float), stiffness
        rows, columns = entry_dofs(potential.entries())
        self._keep = ~(held.ravel()[rows] | held.ravel()[columns])

    def __getattr__(self, name: str):
        return getattr(self.potential, name)

    def entries(self) -> tuple[Entries, ...]:
        nodes = np.arange(len(self.held))[None]
        return (*self.potential.entries(), Entries(nodes, np.arange(3), np.arange(3)))

    def evaluate(self, position: np.ndarray) -> WrappedState:
        inner = self.potential.evaluate(self.seen(position))
        offset = (position - self.value)[self.held]
        return WrappedState(inner, position, inner.energy + self.stiffness / 2 * float(offset @ offset))

    def gradient(self, state: WrappedState) -> tuple[np.ndarray, float]:
        gradient, scale = self.potential.gradient(state.inner)
        return np.where(self.held, self.stiffness * (state.position - self.value), gradient), scale

    def hessian(self, state: WrappedState, project: bool = False) -> np.ndarray:
        inner = np.where(self._keep, self.potential.hessian(state.inner, project), 0)
        return np.append(inner, self.stiffness * self.held.T)

    def seen(self, position: np.ndarray) -> np.ndarray:
        """Positions [N,3] as the wrapped potential sees them."""
        return np.where(self.held, self.value, position)

    def reaction(self, state: WrappedState) -> np.ndarray:
        """Forces [N,3] in newton by which the rollers hold their components; zero elsewhere."""
        return np.where(self.held, self.potential.gradient(state.inner)[0], 0)


class DeadLoad:
    """Forces [N,3] in newton that keep their direction: the wrapped potential less their work."""

    def __init__(self, potential, force: np.ndarray) -> None:
        self.potential, self.force = potential, np.array(force, float)

    def __getattr__(self, name: str):
        return getattr(self.potential, name)

    def evaluate(self, position: np.ndarray) -> WrappedState:
        inner = self.potential.evaluate(position)
        return WrappedState(inner, position, inner.energy - float(np.vdot(self.force, position)))

    def gradient(self, state: WrappedState) -> tuple[np.ndarray, float]:
        gradient, scale = self.potential.gradient(state.inner)
        return gradient - self.force, scale

    def hessian(self, state: WrappedState, project: bool = False) -> np.ndarray:
        return self.potential.hessian(state.inner, project)


def box(size, cells, jitter: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Box from the origin to `size` in metres: positions [N,3], tetrahedra [E,4].

    Args:
        size: along x, y, z.
        cells: along x, y, z.
        jitter: inner nodes are moved at random by up to this share of a cell, nodes of a face within the face.
        seed: of the random numbers.
    """
    coordinates, elements = mesh.hexahedral_grid(tuple(cells))
    shift = jitter * np.random.default_rng(seed).uniform(-1, 1, coordinates.shape)
    on_face = (coordinates == 0) | (coordinates == cells)
    return (coordinates + np.where(on_face, 0, shift)) * (np.asarray(size, float) / cells), elements


def on_box(position: np.ndarray, size) -> np.ndarray:
    """[N,3,2] bool: whether a node lies on the lower and the upper face of the box along each axis."""
    tolerance = 1e-9 * np.max(size)
    return np.stack([position < tolerance, position > np.asarray(size) - tolerance], axis=2)


def triangles(position: np.ndarray, elements: np.ndarray) -> np.ndarray:
    """Surface triangles [F,3] of tetrahedra [E,4] of positive volume, normals pointing out."""
    scene = Scene(
        rest_position=position.astype(np.float32),
        elements=elements.astype(np.int32),
        node_type=np.zeros(len(position), np.uint8),
        body=np.zeros(len(position), np.int32),
    )
    return scene.surface()


def newton(
    potential, rest: np.ndarray, prescribed: np.ndarray | None = None, contact: Contact | None = None, tolerance=1e-10
) -> Newton:
    """The product's solver at rest positions [N,3]; without `contact` nothing touches.

    Args:
        potential: what it minimises.
        rest: [N,3] metres.
        prescribed: [N] bool; no node if None.
        contact: of the surfaces.
        tolerance: its stop test, relative to the mean force of an element.
    """
    if contact is None:  # one body, which cannot touch itself
        triangle = np.array([[0, 1, 2]])
        contact = Contact(rest, triangle, np.zeros(len(rest), int), ContactSettings(1e-3, 1.0))
    none = np.zeros(len(rest), bool)
    settings = SolverSettings(force_tolerance=tolerance, max_iterations=200)
    return Newton(potential, contact, none if prescribed is None else prescribed, rest, settings)


def cauchy(elasticity: Elasticity, position: np.ndarray) -> np.ndarray:
    """True stress [3,3,E] in pascal at positions [N,3]."""
    deformation = elasticity.evaluate(position)
    return elasticity.material.cauchy(deformation.F, deformation.J)


def nodal_areas(position: np.ndarray, faces: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """[N] a third of the areas around each node, of the faces [F,3] all of whose nodes are `chosen` [N] bool."""
    faces = faces[chosen[faces].all(axis=1)]
    corners = position[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), minlength=len(position))


def sheet(extent: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat square [0, extent]^2 at z = 0 whose triangles face down: nodes [M,3], triangles [F,3]."""
    line = np.linspace(0, extent, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    position = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, up = corner + cells + 1, corner + 1
    faces = np.concatenate([np.stack([corner, up, right], 1), np.stack([right, up, up + cells + 1], 1)])
    return position, faces
