"""Derivatives of every order and direction, of every op, against its composition in float64, or one clear error."""

from collections.abc import Callable
from functools import cache

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd import functional as F

from ast_sim.ops import (
    EdgeSet,
    TetrahedronSet,
    attention,
    attention_block,
    elastic_forces,
    farthest_point_sample,
    library,
    linear,
    message_edges,
    message_sum,
    mlp,
    octree,
    proximity,
    segment_mean,
    segment_sum,
    sparse_conv,
    sparse_conv_transposed,
)
from ast_sim.ops._segment import column_sum

EDGES = EdgeSet.from_pairs(torch.tensor([0, 2, 1, 1, 3, 0, 2]), torch.tensor([1, 1, 0, 2, 2, 2, 4]), 4, 5)
LAYERS = ((6, 5), (6,), (6,), (6,))  # W2, b2, gamma, beta
BLOCK = ((6,), (6,), (5,), (5,), (16, 6), (32, 5), (6, 16), (6,), (6,), (6,), (8, 6), (8,), (6, 4), (6,))  # parameters
SEGMENTS = (torch.tensor([3, 0, 1, 4, 2]), torch.tensor([0, 2, 2, 5]))
TETRAHEDRA = TetrahedronSet.from_elements(torch.tensor([[0, 1, 2, 3], [1, 4, 2, 3], [4, 0, 1, 5]]), 7)
REST = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 1, -1], [5, 5, 5]])
SCENES = (torch.tensor([0, 3, 3, 5]), torch.tensor([0, 4, 5, 7]))
EMPTY_SCENES = (torch.tensor([0, 2, 3, 5]), torch.tensor([0, 4, 4, 7]))


def normal(*shape: int, key: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(key), dtype=torch.float64)


@cache
def cells():
    return octree(normal(12, 3).tanh().float(), torch.tensor([0, 5, 12]), (0.0, 0.0, 0.0), 1.0, 3).coarsen()


FINE, COARSE = cells().num_fine, len(cells().coarse.keys)


def elastic(x: Tensor) -> Tensor:
    return elastic_forces(x, REST.to(x.dtype), torch.full((3, 2), 0.1, dtype=x.dtype), TETRAHEDRA)


# For each op a function of float tensors, and their shapes.
OPS: dict[str, tuple[Callable, list[tuple[int, ...]]]] = {
    "linear": (linear, [(5, 4), (6, 4), (6,)]),
    "linear relu": (lambda x, w, b: linear(x, w, b, "relu"), [(5, 4), (6, 4), (6,)]),
    "linear relu residual": (lambda x, w, b, r: linear(x, w, b, "relu", r), [(5, 4), (6, 4), (6,), (5, 6)]),
    "linear geglu residual": (lambda x, w, b, r: linear(x, w, b, "geglu", r), [(5, 4), (6, 4), (6,), (5, 3)]),
    "mlp": (lambda x, w, v: mlp(x, w, None, v, None), [(5, 4), (7, 4), (3, 7)]),
    "mlp norm": (
        lambda x, w, b, v, c, y, g, h, r: mlp(x, w, b, v, c, y, (g, h), r),
        [(5, 4), (7, 6), (7,), (3, 7), (3,), (5, 2), (3,), (3,), (5, 3)],
    ),
    "attention": (lambda *x: attention(*x, *SCENES, 0.7)[0], [(5, 2, 16), (7, 2, 16), (7, 2, 16)]),
    "attention dropout": (lambda *x: attention(*x, *SCENES, 0.7, 0.3, 5)[0], [(5, 2, 16), (7, 2, 16), (7, 2, 16)]),
    "attention no keys": (lambda *x: attention(*x, *EMPTY_SCENES)[0], [(5, 1, 16), (7, 1, 16), (7, 1, 16)]),
    "attention among tokens": (lambda x: attention(*x.unbind(1), *[SCENES[0]] * 2)[0], [(5, 3, 2, 16)]),
    "attention_block": (
        lambda x, context, *weights: attention_block(x, context, None, None, *SCENES, weights, 1),
        [(5, 6), (7, 5), *BLOCK],
    ),
    "message_sum": (
        lambda s, r, e, a, b, c, *w: message_sum(EDGES, s, r, e, (a, b, c), *w),
        [(4, 5), (5, 5), (7, 3), (8, 3), (8,), (5, 8), *LAYERS],
    ),
    "message_sum latents": (
        lambda s, r, e, *w: message_sum(EDGES, s, r, e, None, *w),
        [(4, 5), (5, 5), (7, 5), *LAYERS],
    ),
    "message_sum bare": (lambda s, r, *w: message_sum(EDGES, s, r, None, None, *w), [(4, 5), (5, 5), *LAYERS]),
    "message_edges": (
        lambda s, r, e, *w: torch.cat(message_edges(EDGES, s, r, e, None, *w)),
        [(4, 5), (5, 5), (7, 5), *LAYERS],
    ),
    "sparse_conv": (lambda x, w, b: sparse_conv(x, w, cells(), b), [(FINE, 3), (27, 3, 2), (2,)]),
    "sparse_conv_transposed": (
        lambda x, w, b: sparse_conv_transposed(x, w, cells(), b),
        [(COARSE, 3), (27, 3, 2), (2,)],
    ),
    "segment_sum": (lambda x: segment_sum(x, *SEGMENTS), [(5, 3)]),
    "segment_mean": (lambda x: segment_mean(x, *SEGMENTS), [(5, 3)]),
    "column_sum": (column_sum, [(5, 3)]),
    "elastic_forces": (elastic, [(7, 3)]),
}
every_op = pytest.mark.parametrize("name", OPS)


def case(name: str, dtype: torch.dtype = torch.float32) -> tuple[Callable, tuple[Tensor, ...], tuple[Tensor, ...]]:
    """The op followed by a function that is no polynomial of low degree, its inputs, and a direction for each."""
    op, shapes = OPS[name]

    def curved(*inputs: Tensor) -> Tensor:
        return op(*inputs).sin()

    inputs, directions = ([normal(*s, key=i + k).to(dtype) for i, s in enumerate(shapes)] for k in (20, 60))
    return curved, tuple(inputs), tuple(directions)


def exact(monkeypatch, derivative: Callable, name: str):
    """What torch makes of the composition in float64, by differentiating backwards only."""
    with monkeypatch.context() as patch:
        patch.setattr(library, "BACKEND", "torch")
        patch.setattr(torch.nn.functional, "layer_norm", layer_norm)  # torch's own loses terms in third derivatives
        return derivative(*case(name, torch.float64))


def layer_norm(x: Tensor, shape, gamma: Tensor, beta: Tensor, epsilon: float) -> Tensor:
    x = x - x.mean(-1, keepdim=True)
    return x / (x.square().mean(-1, keepdim=True) + epsilon).sqrt() * gamma + beta


def assert_right(found, wanted) -> None:
    found, wanted = ([x] if isinstance(x, Tensor) else list(x) for x in (found, wanted))
    assert len(found) == len(wanted)
    for x, y in zip(found, wanted, strict=True):
        assert x.dtype == torch.float32 and y.dtype == torch.float64
        torch.testing.assert_close(x.double(), y, rtol=1e-3, atol=2e-5 * float(1 + y.abs().max()))


def leaves(inputs: tuple[Tensor, ...]) -> list[Tensor]:
    return [x.clone().requires_grad_() for x in inputs]


# ---- second derivatives ----


def penalty(function: Callable, inputs, directions):
    """The gradients of a loss to which the squared gradient of the output is added."""
    inputs = leaves(inputs)
    out = function(*inputs)
    first = torch.autograd.grad(out.sum(), inputs, create_graph=True)
    return torch.autograd.grad(out.square().sum() + sum(g.square().sum() for g in first), inputs)


@every_op
def test_gradient_penalty(name, monkeypatch):
    assert_right(penalty(*case(name)), exact(monkeypatch, penalty, name))


def third(function: Callable, inputs, directions):
    inputs = leaves(inputs)
    gradients = torch.autograd.grad(function(*inputs).sum(), inputs, create_graph=True)
    for order in (2, 3):
        along = sum((g * d).sum() for g, d in zip(gradients, directions, strict=True))
        gradients = torch.autograd.grad(along, inputs, create_graph=order < 3)
    return gradients


@every_op
def test_third_derivative(name, monkeypatch):
    assert_right(third(*case(name)), exact(monkeypatch, third, name))


def hvp(function: Callable, inputs, directions):
    return F.hvp(lambda *x: function(*x).sum(), inputs, directions)[1]


@every_op
def test_hessian_vector_product(name, monkeypatch):
    wanted = exact(monkeypatch, hvp, name)
    function, inputs, directions = case(name)
    assert_right(hvp(function, inputs, directions), wanted)
    gradient = torch.func.grad(lambda *x: function(*x).sum(), tuple(range(len(inputs))))
    assert_right(torch.func.jvp(gradient, inputs, directions)[1], wanted)
    with forward_ad.dual_level():  # backwards, then forwards
        duals = [forward_ad.make_dual(x.requires_grad_(), d) for x, d in zip(inputs, directions, strict=True)]
        found = torch.autograd.grad(function(*duals).sum(), duals)
        assert_right([forward_ad.unpack_dual(g).tangent for g in found], wanted)


def on_a_plane(function: Callable, inputs, directions):
    """The function of two numbers that move all inputs along two directions each."""

    def at(t: Tensor) -> Tensor:
        moved = (x + t[0] * d + t[1] * d.flip(0) for x, d in zip(inputs, directions, strict=True))
        return function(*moved).square().sum()

    return at, inputs[0].new_tensor([0.1, -0.2])


HESSIANS = {
    "autograd": F.hessian,
    "vectorized": lambda f, t: F.hessian(f, t, vectorize=True),
    "forward over reverse": lambda f, t: torch.func.hessian(f)(t),
    "reverse over reverse": lambda f, t: torch.func.jacrev(torch.func.jacrev(f))(t),
    "forward over forward": lambda f, t: torch.func.jacfwd(torch.func.jacfwd(f))(t),
    "vectorized twice": lambda f, t: F.jacobian(
        lambda t: F.jacobian(f, t, create_graph=True, vectorize=True), t, vectorize=True
    ),
}


@every_op
def test_hessian(name, monkeypatch):
    wanted = exact(monkeypatch, lambda *c: F.hessian(*on_a_plane(*c)), name)
    for hessian in HESSIANS.values():
        assert_right(hessian(*on_a_plane(*case(name))), wanted)


# ---- tangents and transforms ----


@every_op
def test_tangents(name, monkeypatch):
    """Of all inputs at once, and of each input alone."""
    function, inputs, directions = case(name)
    for i in (None, *range(len(inputs))):
        moves = [i in (None, j) for j in range(len(inputs))]

        def jvp(function, inputs, directions, moves=moves):
            return F.jvp(function, inputs, tuple(d * m for d, m in zip(directions, moves, strict=True)))[1]

        wanted = exact(monkeypatch, jvp, name)
        some = [d * m for d, m in zip(directions, moves, strict=True)]
        assert_right(torch.func.jvp(function, inputs, tuple(some))[1], wanted)
        with forward_ad.dual_level(), torch.no_grad():
            moved = zip(inputs, directions, moves, strict=True)
            duals = [forward_ad.make_dual(x, d) if m else x for x, d, m in moved]
            assert_right(forward_ad.unpack_dual(function(*duals)).tangent, wanted)


def gradients(function: Callable, inputs, directions):
    inputs = leaves(inputs)
    return torch.autograd.grad(function(*inputs).sum(), inputs)


@every_op
def test_gradients_of_functions(name, monkeypatch):
    wanted = exact(monkeypatch, gradients, name)
    function, inputs, _ = case(name)
    numbers = tuple(range(len(inputs)))
    assert_right(torch.func.grad(lambda *x: function(*x).sum(), numbers)(*inputs), wanted)
    out, pullback = torch.func.vjp(function, *inputs)
    assert_right(pullback(torch.ones_like(out)), wanted)


@every_op
def test_a_tangent_of_the_gradient_alone(name, monkeypatch):
    """Backwards is a function of what comes in: a tangent, or one for each sample of a vmap, passes through it."""
    function, inputs, _ = case(name)
    inputs = leaves(inputs)
    out = function(*inputs)
    cotangents = normal(3, *out.shape, key=5).float()
    each = [torch.autograd.grad(out, inputs, g, retain_graph=True) for g in cotangents]
    with forward_ad.dual_level():
        found = torch.autograd.grad(out, inputs, forward_ad.make_dual(cotangents[0], cotangents[1]), retain_graph=True)
        tangents = [forward_ad.unpack_dual(g).tangent for g in found]
    together = torch.autograd.grad(out, inputs, cotangents, is_grads_batched=True)
    for i in range(len(inputs)):
        torch.testing.assert_close(tangents[i], each[1][i], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(together[i], torch.stack([g[i] for g in each]), rtol=1e-4, atol=1e-4)


@every_op
def test_vmap(name):
    """Over all inputs, and over each alone, beside others that all samples share."""
    function, inputs, directions = case(name)
    for i in (None, *range(len(inputs))):
        chosen = [i in (None, j) for j in range(len(inputs))]
        stacks = [torch.stack([x, d, x - d], 1) if c else x for x, d, c in zip(inputs, directions, chosen, strict=True)]
        found = torch.func.vmap(function, tuple(1 if c else None for c in chosen))(*stacks)
        wanted = [function(*(s[:, b] if c else s for s, c in zip(stacks, chosen, strict=True))) for b in range(3)]
        torch.testing.assert_close(found, torch.stack(wanted), rtol=1e-4, atol=1e-4)


# ---- the composition itself, against differences ----


@every_op
def test_composition_against_differences(name):
    function, inputs, _ = case(name, torch.float64)
    inputs = leaves(inputs)
    torch.autograd.gradcheck(function, inputs, fast_mode=True, check_forward_ad=True)
    torch.autograd.gradgradcheck(function, inputs, fast_mode=True)


# ---- what stays as it was, and what is refused ----


@every_op
def test_the_first_gradient_keeps_its_bits(name):
    """Whether or not it is differentiated again."""
    function, inputs, _ = case(name)
    inputs = leaves(inputs)
    out = function(*inputs)
    plain = torch.autograd.grad(out.sum(), inputs, retain_graph=True)
    for x, y in zip(plain, torch.autograd.grad(out.sum(), inputs, create_graph=True), strict=True):
        assert torch.equal(x, y) and y.requires_grad


def test_inputs_that_depend_on_each_other():
    """The gradient by one of them does not pass through the other twice."""

    def loss(x: Tensor) -> Tensor:
        return linear(x, (x @ x.mT).exp()[:, :4], None, "geglu").sum()

    x = normal(4, 4).float() / 2
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(library, "BACKEND", "torch")
        wanted = F.hessian(loss, x.double())
    assert_right(F.hessian(loss, x), wanted)


def test_autocast_with_transforms():
    x = torch.ones(3, 2, dtype=torch.bfloat16)
    with torch.autocast("cpu", torch.bfloat16):
        out, tangent = torch.func.jvp(lambda x: linear(x, x), (x,), (x,))
    assert out.dtype == tangent.dtype == torch.float32
    assert torch.equal(tangent, torch.full((3, 3), 4.0))


@pytest.mark.parametrize("transform", ["jvp", "vmap"])
def test_compiled_transforms(transform):
    x, w = normal(3, 5, 4).float(), normal(6, 4).float()
    transformed = {
        "jvp": lambda x: torch.func.jvp(lambda x: linear(x, w, None, "geglu"), (x[0],), (x[1],)),
        "vmap": lambda x: torch.func.vmap(lambda x: linear(x, w, None, "geglu"))(x),
    }[transform]
    torch.testing.assert_close(torch.compile(transformed, backend="aot_eager")(x), transformed(x))


@pytest.mark.parametrize(
    "name, call, inputs",
    [
        ("segment_sum: vmap over node_order", lambda o: segment_sum(torch.ones(5, 3), o, SEGMENTS[1]), SEGMENTS[0]),
        (
            "attention: vmap over q_offsets",
            lambda o: attention(*[torch.ones(5, 1, 16)] * 3, o, o)[0],
            torch.tensor([0, 2, 5]),
        ),
        (
            "octree: vmap over positions",
            lambda x: octree(x, torch.tensor([0, 4]), (0.0, 0.0, 0.0), 1.0, 3).keys,
            torch.zeros(4, 3),
        ),
        (
            "farthest_point_sample: vmap over coordinates",
            lambda x: farthest_point_sample(x, torch.tensor([0, 4]), 2)[0],
            torch.zeros(4, 3, dtype=torch.int32),
        ),
    ],
)
def test_vmap_over_indices_is_refused(name, call, inputs):
    with pytest.raises(ValueError, match=f"{name} is not possible: give every sample the same"):
        torch.func.vmap(call)(torch.stack([inputs, inputs]))


def test_the_log_sum_exp_has_no_derivative_in_any_direction():
    q = normal(5, 2, 16).float()
    lse = lambda q: attention(q, q, q, SCENES[0], SCENES[0])[1]  # noqa: E731
    assert not lse(q.clone().requires_grad_()).requires_grad
    assert not torch.func.jvp(lse, (q,), (q,))[1].any()


def test_octree_has_no_tangent():
    x, offsets = normal(4, 3).tanh().float(), torch.tensor([0, 4])
    keys = lambda x: octree(x, offsets, (0.0, 0.0, 0.0), 1.0, 3).keys  # noqa: E731
    assert torch.equal(torch.func.jvp(keys, (x,), (x,))[0], keys(x))
    with forward_ad.dual_level():
        assert forward_ad.unpack_dual(keys(forward_ad.make_dual(x, x))).tangent is None


def proximity_of(x: Tensor) -> Tensor:
    offsets, surface_offsets = torch.tensor([0, 4]), torch.tensor([0, 1])
    body, surface = torch.tensor([0, 0, 0, 1]), torch.tensor([[0, 1, 2]])
    return proximity(x, torch.zeros_like(x), offsets, body, surface, surface_offsets, 1.0)


def test_proximity_refuses_derivatives():
    x = normal(4, 3)
    error = pytest.raises(ValueError, match="proximity: it has no derivatives")
    with error:
        proximity_of(x.clone().requires_grad_())
    with error:
        torch.func.jvp(proximity_of, (x,), (x,))
    with error, forward_ad.dual_level():
        proximity_of(forward_ad.make_dual(x, x))
    with error:
        torch.func.vmap(proximity_of)(x[None])


@pytest.mark.filterwarnings("ignore")  # torch's own
@every_op
def test_linearized(name, monkeypatch):
    """`linearize` traces a tangent once, and gives the tangent in every direction. No value is read of what it
    traces."""
    wanted = exact(monkeypatch, lambda function, x, d: torch.func.jvp(function, x, d)[1], name)
    function, inputs, directions = case(name)
    _, tangent = torch.func.linearize(function, *inputs)
    assert_right(tangent(*directions), wanted)
