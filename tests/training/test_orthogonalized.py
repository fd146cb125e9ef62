"""orthogonalized against its composition and its contract."""

import pytest
import torch
from checks import assert_accurate

from ast_sim.training.muon import _reference, orthogonalized


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 50), (64, 64), (64, 192), (256, 64), (100, 33)])
def test_accuracy(rows, columns):
    x = torch.randn(3, rows, columns, generator=torch.Generator().manual_seed(rows))
    assert_accurate(orthogonalized, _reference, [x])


def steep(k: int, rows: int, columns: int, dtype=torch.float32) -> torch.Tensor:
    """Matrices whose singular values fall from 1 to 0.01, times 10."""
    generator = torch.Generator().manual_seed(rows)
    u, _, v = torch.linalg.svd(
        torch.randn(k, rows, columns, generator=generator, dtype=torch.float64), full_matrices=False
    )
    return (u * torch.logspace(1, -1, min(rows, columns), dtype=torch.float64) @ v).to(dtype)


@pytest.mark.parametrize(("rows", "columns"), [(16, 16), (16, 40), (40, 16)])
def test_all_singular_values_become_about_one_and_directions_stay(rows, columns):
    x = steep(3, rows, columns)
    u, _, v = torch.linalg.svd(x.double(), full_matrices=False)
    in_its_directions = u.mT @ orthogonalized(x).double() @ v.mT
    singular = in_its_directions.diagonal(dim1=1, dim2=2)
    assert singular.min() > 0.67 and singular.max() < 1.22
    torch.testing.assert_close(in_its_directions, torch.diag_embed(singular), rtol=0, atol=1e-3)


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30])
def test_the_size_of_a_gradient_does_not_matter_and_none_gives_none(value):
    x = value * steep(2, 16, 24)
    expected = orthogonalized(steep(2, 16, 24)) if value else torch.zeros(2, 16, 24)
    torch.testing.assert_close(orthogonalized(x), expected, rtol=0, atol=1e-3)


def test_a_matrix_of_rank_one_keeps_its_vectors():
    u, v = torch.nn.functional.normalize(torch.randn(2, 48, generator=torch.Generator().manual_seed(0)), dim=1)
    for size in (1e-30, 1e30):
        out = orthogonalized((size * u[:, None] * v)[None])[0]
        singular = u @ out @ v
        assert 0.67 < singular < 1.22
        torch.testing.assert_close(out, singular * u[:, None] * v, rtol=0, atol=2e-4)


def test_neighbours_do_not_matter_and_what_is_not_finite_shows():
    x = torch.randn(3, 20, 30, generator=torch.Generator().manual_seed(0))
    alone = orthogonalized(x[2:])
    x[0, 3, 4], x[1, 5, 6] = float("nan"), float("inf")
    out = orthogonalized(x)
    assert torch.equal(out[2:], alone) and out[:2].isnan().all() and _reference(x)[:2].isnan().all()


def test_no_matrices_give_none():
    assert orthogonalized(torch.zeros(0, 3, 4)).shape == (0, 3, 4)
    assert orthogonalized(torch.zeros(2, 0, 4)).shape == (2, 0, 4)
    with pytest.raises(ValueError, match="orthogonalize: x must have shape"):
        orthogonalized(torch.zeros(3, 4))
