"""Elastic forces as an input of the nodes, of linear and of second-order tetrahedra."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from data_samples import block, raised

from ast_sim.batches.out_of_balance import SHARPNESS, ElasticTetrahedra
from ast_sim.element_topology import MIDDLES
from ast_sim.material import Material
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import elastic_body, points_at_rest
from ast_sim.scene import Scene
from ast_sim.simulate.shapes.parts import oriented

YOUNG, POISSON = 2.0, 0.3
MATERIAL = Material(("young", "poisson"))


def scene(order: int) -> Scene:
    made = block(2, 2, 1)
    material = np.tile(np.float32([YOUNG, POISSON]), (made.num_elements, 1))
    made = replace(made, material=material, elements=oriented(made.rest_position.astype(float), made.elements))
    return raised(made) if order == 2 else made


def elasticity(made: Scene) -> ElasticTetrahedra:
    return ElasticTetrahedra.of(made, Material() if made.material is None else MATERIAL)


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.tensor(x, dtype=torch.float32) for x in arrays]


def forces_of(made: Scene, position: np.ndarray) -> np.ndarray:
    """The forces themselves, in pascal times square metres."""
    of = ElasticTetrahedra.of(made, MATERIAL)
    values = of.out_of_balance(*tensors(position, made.rest_position))
    return (torch.sinh(values.double()) * of.force[:, None] / SHARPNESS).numpy()


def waves(rest: np.ndarray, size: float) -> np.ndarray:
    return rest + size * np.sin(3 * rest[:, [1, 2, 0]] + [0, 1, 2])


@pytest.mark.parametrize("order", [1, 2])
def test_small_strains_give_the_forces_of_the_solver(order):
    """Its law and the law of St. Venant and Kirchhoff have one stiffness at rest."""
    made = scene(order)
    rest = made.rest_position.astype(float)
    position = waves(rest, 2e-3)
    body = elastic_body(rest, made.elements, NeoHookean(YOUNG, POISSON))
    expected = -body.gradient(body.evaluate(position))[0]
    found = forces_of(made, position)
    free = made.deforming_nodes
    np.testing.assert_allclose(found[free], expected[free], atol=0.05 * np.abs(expected).max())


@pytest.mark.parametrize(
    "material",
    [
        Material(constants={"young": YOUNG, "poisson": POISSON, "friction": 0.2}),
        Material(("poisson",), {"young": YOUNG}),
        Material(("young", "poisson", "friction")),
        Material(("friction", "poisson", "young")),
    ],
)
def test_numbers_of_the_material_are_found_by_name_among_columns_and_constants(material):
    """Constants of plates, and a third column of scenes with friction: both were once taken for no material."""
    made = scene(1)
    numbers = {"young": YOUNG, "poisson": POISSON, "friction": 0.2}
    columns = np.tile(np.float32([numbers[name] for name in material.columns]), (made.num_elements, 1))
    given = ElasticTetrahedra.of(replace(made, material=columns if material.columns else None), material)
    expected = elasticity(made)
    assert torch.equal(given.lame, expected.lame) and torch.equal(given.force, expected.force)


def test_a_ratio_that_the_solver_has_not_is_not_taken():
    made = replace(scene(1), material=None)
    found = ElasticTetrahedra.of(made, Material(constants={"young": YOUNG, "poisson": -0.1}))
    assert torch.equal(found.lame, ElasticTetrahedra.of(made, Material()).lame)


def test_second_order_forces_are_minus_the_derivative_of_the_energy():
    made = scene(2)
    rest = torch.tensor(made.rest_position, dtype=torch.float64)
    position = torch.tensor(waves(rest.numpy(), 0.1), requires_grad=True)
    weights, slopes = points_at_rest(rest.numpy(), made.elements)  # [4, E], [10, 3, 4, E]
    x = position[torch.from_numpy(made.elements.astype(np.int64))]
    F = torch.einsum("eai,ajpe->peij", x, torch.from_numpy(slopes))
    G = (F.mT @ F - torch.eye(3)) / 2
    lam, mu = NeoHookean(YOUNG, POISSON).lam, NeoHookean(YOUNG, POISSON).mu
    trace = G.diagonal(dim1=-2, dim2=-1).sum(-1)
    density = lam / 2 * trace**2 + mu * (G * G).sum((-1, -2))
    (torch.from_numpy(weights) * density).sum().backward()
    expected = -position.grad.numpy()
    np.testing.assert_allclose(forces_of(made, position.detach().numpy()), expected, atol=1e-4 * np.abs(expected).max())


def test_scenes_of_a_batch_keep_their_forces_and_gradients_flow():
    scenes = [scene(2), raised(block(1, 1, 1)), scene(2)]
    positions = [waves(one.rest_position.astype(float), 0.05) for one in scenes]
    joined = ElasticTetrahedra.concatenate([elasticity(one) for one in scenes])
    position, rest = tensors(np.concatenate(positions), np.concatenate([one.rest_position for one in scenes]))
    together = joined.out_of_balance(position.requires_grad_(), rest)
    alone = [
        elasticity(one).out_of_balance(*tensors(x, one.rest_position)) for one, x in zip(scenes, positions, strict=True)
    ]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-5, atol=1e-5)
    together.square().sum().backward()
    assert position.grad.abs().max() > 0 and bool(position.grad.isfinite().all())


def test_a_turned_body_is_in_balance_and_middles_that_are_off_are_not():
    made = scene(2)
    rest = made.rest_position.astype(float)
    turned = rest[:, [1, 2, 0]] + 5
    assert np.abs(forces_of(made, turned)).max() < 1e-4
    off = rest.copy()
    middle = made.elements[0, 4 + MIDDLES.index((0, 3))]
    off[middle] += [0.05, 0, 0]
    found = forces_of(made, off)
    assert np.abs(found).max(axis=1).argmax() == middle and found[middle, 0] < -0.01
