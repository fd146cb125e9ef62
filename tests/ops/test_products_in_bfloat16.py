"""Dense layers that multiply in bfloat16, against torch's compositions in bfloat16; elsewhere they warn and stay."""

import threading
import warnings

import pytest
import torch
from checks import _with_gradients, run_python
from torch import Tensor

from ast_sim.ops import (
    EdgeSet,
    _attention,
    _linear,
    _message,
    _mlp,
    _sparse_conv,
    attention_block,
    linear,
    message_sum,
    mlp,
    octree,
    products_in,
    sparse_conv,
)
from ast_sim.ops.library import configuration
from ast_sim.support.errors import ConfigError

FASTER = configuration()["bfloat16"] is not None


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed)) / shape[-1] ** 0.5


def linear_case():
    inputs = [40 * normal(1600, 128), normal(128, 128, seed=1), normal(128)]
    return linear, lambda x, w, b: _linear._linear_reference(x, w, b, None, 0, False)[0], inputs


def mlp_case():
    x = [40 * normal(700, 96), normal(128, 96, seed=1), normal(128), normal(64, 128, seed=2), normal(64)]
    norm = [1 + normal(64, seed=3), normal(64, seed=4)]

    def fused(x, w1, b1, w2, b2, gamma, beta):
        return mlp(x, w1, b1, w2, b2, norm=(gamma, beta))

    def composed(x, w1, b1, w2, b2, gamma, beta):
        return _mlp._reference(x, None, w1, b1, w2, b2, gamma, beta, None, False)[0]

    return fused, composed, [*x, *norm]


def message_case():
    g = torch.Generator().manual_seed(0)
    edges = EdgeSet.from_pairs(*(torch.randint(0, 300, (4000,), generator=g) for _ in range(2)), 300, 300)
    inputs = [20 * normal(300, 64), 20 * normal(300, 64, seed=1), normal(4000, 8), normal(64, 8), normal(64)]
    inputs += [normal(64, 64, seed=2), normal(64, 64, seed=3), normal(64), 1 + normal(64, seed=4), normal(64)]

    def fused(P, Q, e, A1, a1, A2, *layer):
        return message_sum(edges, P, Q, e, (A1, a1, A2), *layer)

    def composed(P, Q, e, A1, a1, A2, *layer):
        of_edges = _message._of_edges(edges, P, e, (A1, a1, A2))
        return _message._reference(P, Q, *of_edges, *layer, edges.senders, edges.receivers, None, False)[0]

    return fused, composed, inputs


def attention_case():
    q, k, v = (4 * normal(rows, 2, 32, seed=rows) for rows in (333, 150, 151))
    offsets = torch.tensor([0, 133, 333]), torch.tensor([0, 20, 150])
    plain = (*offsets, 32**-0.5, 0.0, 0)
    return (
        lambda q, k, v: _attention.attention(q, k, v, *offsets)[0],
        lambda q, k, v: _attention._reference(q, k, v, *plain)[0],
        [q, k, v[:150]],
    )


def conv_case():
    g = torch.Generator().manual_seed(0)
    positions = torch.rand(3000, 3, generator=g)
    level = octree(positions, torch.tensor([0, len(positions)]), (0.5, 0.5, 0.5), 0.5, 5)
    step = level.coarsen()
    inputs = [10 * normal(step.num_fine, 64), normal(27, 64, 48, seed=1), normal(48)]
    pairs = (False, step.pair_offsets, step.fine, step.coarse_index, step.coarse_by_fine, step.fine_by_fine)

    def composed(x, weight, bias):
        return _sparse_conv._reference(x, weight, bias, *pairs, len(step.coarse.keys))

    return lambda x, weight, bias: sparse_conv(x, weight, step, bias), composed, inputs


CASES = {
    "linear": linear_case,
    "mlp": mlp_case,
    "message": message_case,
    "attention": attention_case,
    "conv": conv_case,
}


def off(results: list[Tensor], exact: list[Tensor]) -> list[float]:
    """The root mean square errors, as shares of the root mean square values."""
    return [float((x.double() - e).norm() / e.norm()) for x, e in zip(results, exact, strict=True)]


@pytest.mark.parametrize("name", CASES)
def test_errors_are_at_most_twice_those_of_torch(name):
    """Of the output and of each gradient; where nothing is faster in bfloat16, there are no errors of this size."""
    fused, composed, inputs = CASES[name]()
    exact, cotangents = _with_gradients(composed, [x.double() for x in inputs], None)
    low, _ = _with_gradients(composed, [x.bfloat16() for x in inputs], cotangents)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if not FASTER else "error")
        with products_in("bfloat16"):
            ours, _ = _with_gradients(fused, inputs, cotangents)
    ours, theirs = off(ours, exact), off(low, exact)
    assert all(one <= 2 * other for one, other in zip(ours, theirs, strict=True)), (ours, theirs)
    assert (ours[0] > 1e-4) == FASTER, ours


def test_a_block_of_attention_multiplies_in_bfloat16():
    g = torch.Generator().manual_seed(0)
    shapes = [(64,), (64,), (64,), (64,), (64, 64), (128, 64), (64, 64), (64,)]
    shapes += [(64,), (64,), (256, 64), (256,), (64, 128), (64,)]
    parameters = [torch.randn(shape, generator=g) / shape[-1] ** 0.5 for shape in shapes]
    x, context = torch.randn(200, 64, generator=g), torch.randn(90, 64, generator=g)
    offsets = torch.tensor([0, 200]), torch.tensor([0, 90])
    given = [x, context, None, None, *offsets]
    exact = _attention._block_reference(
        *(v.double() if v is not None and v.is_floating_point() else v for v in [*given, *parameters]), 2, False, False
    )[0]
    low = _attention._block_reference(
        *(v.bfloat16() if v is not None and v.is_floating_point() else v for v in [*given, *parameters]),
        2, False, False,
    )[0]  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with products_in("bfloat16"):
            ours = attention_block(*given, parameters, 2)
    (our,), (their,) = off([ours], [exact]), off([low], [exact])
    assert our <= 2 * their and (our > 1e-4) == FASTER, (our, their)


def test_it_ends_with_the_block_and_holds_for_one_thread():
    x, weight = normal(200, 128), normal(64, 128, seed=1)
    plain = linear(x, weight)
    other: list[Tensor] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with products_in("bfloat16"):
            low = linear(x, weight)
            with products_in("float32"):
                assert torch.equal(linear(x, weight), plain)
            assert torch.equal(linear(x, weight), low)
            thread = threading.Thread(target=lambda: other.append(linear(x, weight)))
            thread.start()
            thread.join()
    assert torch.equal(other[0], plain) and torch.equal(linear(x, weight), plain)
    assert torch.equal(low, plain) != FASTER


def test_other_precisions_are_refused():
    with (
        pytest.raises(ConfigError, match="precision is 'float16': choose of float32, bfloat16"),
        products_in("float16"),
    ):
        pass


CODE = """
import warnings
import torch
from ast_sim.ops import linear, products_in
x, weight = torch.full((2, 40), 1.001), torch.ones(3, 40)
plain = linear(x, weight)
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    with products_in("bfloat16"):
        assert torch.equal(linear(x, weight), plain)
print(*(warning.message for warning in told))
"""


@pytest.mark.parametrize("environment", [{"AST_SIM_ISA": "base"}, {"AST_SIM_BACKEND": "torch"}])
def test_where_nothing_is_faster_a_line_says_so(environment):
    told = "this processor is no faster in bfloat16, or its kernels were not chosen: float32 is used\n"
    assert run_python(CODE, **environment) == told
