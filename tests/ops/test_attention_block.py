"""attention_block against its composition and its contract."""

import pytest
import torch
from checks import assert_accurate
from torch import Tensor

from ast_sim.ops import _attention as ops
from ast_sim.ops import attention_block

HEADS, WIDTH = 2, 16


def case(queries: list[int], keys: list[int], width: int, context: int, rotated: bool = True) -> list:
    """The arguments for scenes of these numbers of queries and keys."""
    g = torch.Generator().manual_seed(0)
    inner, hidden = HEADS * WIDTH, 20
    q_offsets, k_offsets = (torch.tensor([0, *sizes]).cumsum(0) for sizes in (queries, keys))
    shapes = [(width,), (width,), (context,), (context,), (inner, width), (2 * inner, context), (width, inner)]
    shapes += [(width,), (width,), (width,), (2 * hidden, width), (2 * hidden,), (width, hidden), (width,)]
    parameters = [torch.randn(shape, generator=g) / shape[-1] ** 0.5 for shape in shapes]
    angles = [torch.rand(sum(sizes), WIDTH // 2, generator=g) * 6 for sizes in (queries, keys)]
    turns = [torch.stack([a.cos(), a.sin()], dim=2).flatten(1) if rotated else None for a in angles]
    rows = [torch.randn(sum(queries), width, generator=g), torch.randn(sum(keys), context, generator=g)]
    return [*rows, *turns, q_offsets, k_offsets, *parameters]


def fused(*given: Tensor | None) -> Tensor:
    return attention_block(*given[:6], given[6:], HEADS)


def composed(*given: Tensor | None) -> Tensor:
    return ops._block_reference(*given, HEADS, False, False)[0]


@pytest.mark.parametrize("rotated", [True, False])
@pytest.mark.parametrize("sizes", [([1], [1]), ([130, 0, 5], [7, 9, 300]), ([3, 4], [0, 5])])
def test_accuracy(sizes, rotated, monkeypatch):
    """The vectors and all gradients but of rotations, for which there is no kernel; with and without the inputs of
    GEGLU kept between."""
    x, context, *turns, q_offsets, k_offsets, _ = (inputs := case(*sizes, 40, 24, rotated))[:7]

    def turned(function):
        def of_others(x, context, *parameters):
            rotations = [None if turn is None else turn.to(x.dtype) for turn in turns]
            return function(x, context, *rotations, q_offsets, k_offsets, *parameters)

        return of_others

    for most in (ops.SAVED, 0):
        monkeypatch.setattr(ops, "SAVED", most)
        assert_accurate(turned(fused), turned(composed), [x, context, *inputs[6:]])


def test_rotations_have_a_gradient_by_the_composition():
    inputs = case([5, 6], [7, 8], 40, 24)
    assert_accurate(fused, composed, inputs)


def test_only_wanted_gradients_are_made():
    inputs = case([5, 6], [7, 8], 40, 24)
    for place in (0, 10, 19):
        given = list(inputs)
        given[place] = inputs[place].clone().requires_grad_()
        every = [x.clone().requires_grad_() if i in (0, 1) or i > 5 else x for i, x in enumerate(inputs)]
        (one,) = torch.autograd.grad(fused(*given).square().sum(), given[place])
        assert torch.equal(one, torch.autograd.grad(fused(*every).square().sum(), every[place])[0])


def test_bfloat16_takes_the_composition():
    """Rotations and all, whose numbers are read as they are."""
    inputs = [x.bfloat16() if x.is_floating_point() else x for x in case([5, 6], [7, 8], 40, 24)]
    out = fused(*inputs)
    assert out.dtype == torch.bfloat16
    exact = composed(*[x.double() if x.is_floating_point() else x for x in inputs])
    assert (out - exact).abs().max() < 0.03 * exact.abs().max()


def test_no_vectors():
    assert fused(*case([0], [2], 40, 24)).shape == (0, 40) and fused(*case([], [], 40, 24)).shape == (0, 40)


def test_vectors_that_attend_to_themselves_and_slices_of_a_weight():
    x, _, turns, _, offsets, _, *weights = case([50, 20], [50, 20], 40, 40)
    together = torch.cat([weights[4], weights[5]])
    query, key_value = together.split((HEADS * WIDTH, 2 * HEADS * WIDTH))
    given = (x, x, turns, turns, offsets, offsets, *weights[:4], query, key_value, *weights[6:])
    torch.testing.assert_close(fused(*given), composed(*given), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("place", "change", "message"),
    [
        (0, lambda x: x[:, :-1], "x|gamma"),
        (2, lambda x: x[:, :-2], "rotations|head dimension"),
        (3, lambda x: x[:-1], "context_rotations"),
        (4, lambda x: x + 1, "q_offsets must start with 0"),
        (10, lambda x: x[:-2], "head dimension|key_value"),
        (16, lambda x: x[:-1], "first"),
    ],
)
def test_what_does_not_fit_is_named(place, change, message):
    inputs = case([5, 6], [7, 8], 40, 24)
    inputs[place] = change(inputs[place])
    with pytest.raises(ValueError, match=f"attention_block: .*({message})"):
        fused(*inputs)
    double = [x.double() if x.is_floating_point() else x for x in inputs]
    with pytest.raises(ValueError, match=f"attention_block: .*({message})"):
        fused(*double)
