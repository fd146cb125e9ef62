"""linear against its composition and its contract."""

import pytest
import torch
import torch.nn.functional as F
from checks import assert_accurate, assert_same_for_threads, instruction_sets, misaligned_read_only, run_forked
from hypothesis import given, settings
from hypothesis import strategies as st

from ast_sim.ops import _linear as ops
from ast_sim.ops import library, linear

ACTIVATIONS = ("none", "relu", "geglu")


def case(rows, inputs, outputs, activation="none", amplitude=1.0, seed=0):
    """x, weight, bias and residual."""
    g = torch.Generator().manual_seed(seed)
    columns = outputs // 2 if activation == "geglu" else outputs
    shapes = [(rows, inputs), (outputs, inputs), (outputs,), (rows, columns)]
    x, weight, bias, residual = (torch.randn(shape, generator=g) for shape in shapes)
    return [amplitude * x, weight / inputs**0.5, bias, residual]


def fused(activation):
    return lambda x, weight, bias=None, residual=None: linear(x, weight, bias, activation, residual)


def composed(activation):
    return lambda x, weight, bias=None, residual=None: ops._linear_reference(
        x, weight, bias, residual, ACTIVATIONS.index(activation), False
    )[0]


SHAPES = [
    (0, 3, 4),
    (1, 1, 2),
    (2, 1, 4),
    (7, 3, 6),
    (13, 17, 34),
    (95, 60, 2),
    (97, 128, 30),
    (360, 33, 66),
    (1600, 12, 128),
    (6200, 128, 48),
    (130, 256, 512),
]


@pytest.mark.parametrize("rows, inputs, outputs", SHAPES)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("with_residual", [False, True])
def test_accuracy(rows, inputs, outputs, activation, with_residual):
    inputs = case(rows, inputs, outputs, activation)
    assert_accurate(fused(activation), composed(activation), inputs if with_residual else inputs[:3])


def test_accuracy_of_a_million_equal_rows():
    """All roundings of a chain of sums have one sign."""
    inputs = [torch.full(shape, 0.3) for shape in ((1_000_000, 3), (4, 3), (4,))]
    ends = [lambda *x, of=of: 0.1 * of(*x).sum(0) for of in (fused("none"), composed("none"))]
    assert_accurate(*ends, inputs)


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("activation", ["none", "relu"])
def test_accuracy_of_odd_outputs(outputs, activation):
    assert_accurate(fused(activation), composed(activation), case(500, 128, outputs))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_accuracy_where_z_is_computed_again(activation, monkeypatch):
    """The gradients are the same bits whether or not the input of the activation is kept."""
    inputs = case(300, 20, 34, activation)
    kept = gradients(activation, inputs)
    monkeypatch.setattr(ops, "SAVED", 0)
    for x, y in zip(kept, gradients(activation, inputs), strict=True):
        assert torch.equal(x, y)
    assert_accurate(fused(activation), composed(activation), inputs)


@pytest.mark.parametrize("amplitude", [0.0, 1e-30, 30.0, 1e15])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_accuracy_of_small_and_large_values(amplitude, activation):
    assert_accurate(fused(activation), composed(activation), case(200, 24, 16, activation, amplitude))


@pytest.mark.parametrize("inputs, outputs", [(193, 4), (4096, 8), (8, 4096)])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("positive", [False, True])
def test_accuracy_of_wide_layers(inputs, outputs, activation, positive):
    """One chain of thousands of terms would lose a digit against sums in blocks, most where all are positive."""
    x = case(64, inputs, outputs, activation)
    assert_accurate(fused(activation), composed(activation), [y.abs() for y in x] if positive else x)


def test_accuracy_of_long_sums():
    """The gradients of weight and bias are sums over all rows; equal terms add up rounding errors of one sign."""
    x, weight, bias, _ = case(50_000, 4, 3)
    x[:, 0] = 0.1
    assert_accurate(lambda *y: fused("none")(*y).sum(0), lambda *y: composed("none")(*y).sum(0), [x, weight, bias])


def gradients(activation, inputs):
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    out = fused(activation)(*leaves)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
    return [out.detach(), *torch.autograd.grad((out * weights).sum(), leaves)]


@given(
    rows=st.integers(0, 40),
    inputs=st.integers(1, 40),
    outputs=st.integers(1, 40),
    activation=st.sampled_from(ACTIVATIONS),
    seed=st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=60, derandomize=True)
def test_any_size_agrees_with_the_composition(rows, inputs, outputs, activation, seed):
    x = case(rows, inputs, 2 * outputs if activation == "geglu" else outputs, activation, seed=seed)
    torch.testing.assert_close(fused(activation)(*x), composed(activation)(*x), rtol=1e-5, atol=1e-5)


def test_values_by_hand():
    x, weight, bias = torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, 4.0], [-5.0, 1.0]]), torch.tensor([0.5, 0.25])
    assert linear(x, weight, bias).tolist() == [[11.5, -2.75]]
    assert linear(x, weight).tolist() == [[11.0, -3.0]]
    assert linear(x, weight, bias, "relu").tolist() == [[11.5, 0.0]]
    assert linear(x, weight, bias, "relu", torch.tensor([[1.0, 2.0]])).tolist() == [[12.5, 2.0]]
    expected = 11.5 * F.gelu(torch.tensor(-2.75, dtype=torch.float64))
    torch.testing.assert_close(linear(x, weight, bias, "geglu").double(), expected.reshape(1, 1), rtol=1e-5, atol=0)


def test_gradients_in_float64():
    for activation in ACTIVATIONS:
        leaves = [x.double().requires_grad_() for x in case(5, 3, 4, activation)]
        assert torch.autograd.gradcheck(fused(activation), leaves)


# ---- extremes ----


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3.4e38, 1e-45])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_extreme_values_stay_in_their_row(value, activation):
    x, weight, bias, residual = case(70, 5, 6, activation)
    clean = gradients(activation, [x, weight, bias, residual])
    x[37, 2] = value
    got = gradients(activation, [x, weight, bias, residual])
    expected = composed(activation)(x, weight, bias, residual)
    others = torch.arange(70) != 37
    for i in (0, 1, 4):
        assert torch.equal(got[i][others], clean[i][others])
    assert torch.equal(got[0].isnan(), expected.isnan()) and torch.equal(got[0].isinf(), expected.isinf())
    torch.testing.assert_close(got[0], expected, rtol=1e-4, atol=1e-5, equal_nan=True)


@pytest.mark.parametrize("place", [1, 2])
def test_not_finite_weights_reach_their_column_only(place):
    inputs = case(70, 5, 6)
    clean = linear(*inputs[:3])
    inputs[place][3] = torch.nan
    out = linear(*inputs[:3])
    others = torch.arange(6) != 3
    assert out[:, 3].isnan().all() and torch.equal(out[:, others], clean[:, others])


def test_no_rows():
    leaves = [x.requires_grad_() for x in case(0, 4, 6)]
    out = linear(*leaves[:3], residual=leaves[3])
    assert out.shape == (0, 6)
    out.sum().backward()
    assert leaves[0].grad.shape == (0, 4) and (leaves[1].grad == 0).all() and (leaves[2].grad == 0).all()


# ---- determinism ----


@pytest.mark.parametrize("rows, inputs, outputs", [(1000, 40, 70), (100, 130, 300), (90, 128, 128), (8000, 16, 8)])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_bitwise_equal_for_threads(rows, inputs, outputs, activation):
    x = case(rows, inputs, outputs, activation)
    assert_same_for_threads(lambda: gradients(activation, x))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_rows_alone_equal_rows_in_a_batch(activation):
    inputs = case(700, 40, 70, activation)
    out, dx, *_ = gradients(activation, inputs)
    x, weight, bias, residual = inputs
    for rows in (slice(5, 6), slice(94, 99), slice(100, 213), slice(650, 700)):
        assert torch.equal(fused(activation)(x[rows], weight, bias, residual[rows]), out[rows])
    leaf = x[3:50].clone().requires_grad_()
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))[3:50]
    (fused(activation)(leaf, weight, bias, residual[3:50]) * weights).sum().backward()
    assert torch.equal(leaf.grad, dx[3:50])


CODE = """
import sys; sys.path[:0] = ["tests", "tests/ops"]
from checks import assert_accurate
from test_linear import case, composed, fused
for activation in ("none", "relu", "geglu"):
    assert_accurate(fused(activation), composed(activation), case(150, 45, 38, activation))
from ast_sim.ops.library import configuration
print(configuration()["instruction_set"])
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == isa


# ---- the op ----


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_opcheck(activation):
    x, weight, bias, residual = (y.requires_grad_() for y in case(9, 5, 6, activation))
    number, plain = ACTIVATIONS.index(activation), activation != "geglu"
    op, backward = (ops._linear, ops._linear_backward) if plain else (ops._geglu, ops._geglu_backward)
    for save in (False, True):
        torch.library.opcheck(op.overload, (x, weight, bias, residual, number, save))
    torch.library.opcheck(op.overload, (x, weight, None, None, number, False))
    dout, x, weight, bias = (y.detach() for y in (residual, x, weight, bias))
    for wanted in ([True] * 3, [True, False, False], [False, True, True]):
        torch.library.opcheck(backward.overload, (dout, x, weight, bias, None, number, wanted))


@pytest.mark.parametrize("wanted", [(0,), (1,), (2,), (3,), (0, 2), (1, 3)])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_any_subset_requires_grad(wanted, activation):
    inputs = case(120, 10, 20, activation)
    every = [x.clone().requires_grad_() for x in inputs]
    fused(activation)(*every).square().sum().backward()
    for i in wanted:
        inputs[i].requires_grad_()
    fused(activation)(*inputs).square().sum().backward()
    for i in range(4):
        assert torch.equal(inputs[i].grad, every[i].grad) if i in wanted else inputs[i].grad is None


def test_slices_of_columns_are_read_in_place():
    wide = torch.randn(150, 60)
    x, residual, weight = wide[:, 3:20], wide[:, 20:26], torch.randn(6, 40)[:, 9:26]
    for tensor, parameter in zip((x, weight), ops._linear.spec.taken, strict=False):
        assert library.contiguous(tensor, parameter) is tensor
    inputs, copies = (x, weight), (x.clone(), weight.clone())
    assert torch.equal(linear(*inputs, residual=residual), linear(*copies, residual=residual.clone()))
    for one in (*inputs, *copies):
        one.requires_grad_()
    for pair in (inputs, copies):
        linear(*pair, activation="geglu").square().sum().backward()
    assert all(torch.equal(one.grad, copy.grad) for one, copy in zip(inputs, copies, strict=True))


def test_unusual_layouts_and_unchanged_inputs():
    x, weight, bias, residual = case(60, 12, 20)
    expected = linear(x, weight, bias, "relu", residual)
    spread = torch.randn(60, 24)
    spread[:, ::2] = x
    for y in (spread[:, ::2], x.T.contiguous().T, misaligned_read_only(x)):
        before = y.clone()
        assert torch.equal(linear(y, weight, bias, "relu", residual), expected) and torch.equal(y, before)
    for w in (weight.T.contiguous().T, misaligned_read_only(weight)):
        assert torch.equal(linear(x, w, bias, "relu", residual), expected)
    one = x[:1].expand(60, 12)
    assert torch.equal(linear(one, weight), linear(one.clone(), weight))
    leaf = x.clone().requires_grad_()
    linear(leaf, weight, bias).sum().backward()  # the incoming gradient is one number, expanded
    torch.testing.assert_close(leaf.grad, weight.sum(0).expand(60, 12))


def test_other_dtypes_and_autocast():
    inputs = case(9, 11, 6)
    exact = composed("relu")(*(x.double() for x in inputs))
    half = [x.bfloat16() for x in inputs]
    out = fused("relu")(*half)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.double(), exact, rtol=0.05, atol=0.05)
    with torch.autocast("cpu", torch.bfloat16):
        out = fused("relu")(*half)
    assert out.dtype == torch.float32


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda x, w, b, r: (x[0], w, b, "none", r), r"x must have shape \[M, I\], not \(5,\)"),
        (lambda x, w, b, r: (x, w[:, :2], b, "none", r), r"weight must have shape \[O, 5\], not \(6, 2\)"),
        (lambda x, w, b, r: (x, w[:0], b[:0], "none", r[:, :0]), r"weight must have a shape without 0, not \(0, 5\)"),
        (lambda x, w, b, r: (x[:, :0], w[:, :0], b, "none", r), r"weight must have a shape without 0, not \(6, 0\)"),
        (lambda x, w, b, r: (x, w, b[:3], "none", r), r"bias must have shape \[6\], not \(3,\)"),
        (lambda x, w, b, r: (x, w, b, "none", r[:3]), r"residual must have shape \[9, 6\], not \(3, 6\)"),
        (lambda x, w, b, r: (x, w, b, "geglu", r), r"residual must have shape \[9, 3\], not \(9, 6\)"),
        (lambda x, w, b, r: (x, w[:5], b[:5], "geglu", None), r"weight must have shape \[2P, 5\], not \(5, 5\)"),
        (lambda x, w, b, r: (x, w, b, "tanh", r), "activation 'tanh' is unknown"),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_name_op_argument_and_value(change, message, dtype):
    with pytest.raises(ValueError, match=message) as error:
        linear(*change(*(x.to(dtype) for x in case(9, 5, 6))))
    assert "linear" in str(error.value)
