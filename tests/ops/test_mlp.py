"""mlp against its composition and its contract."""

import pytest
import torch
from checks import (
    assert_accurate,
    assert_same_for_threads,
    errors,
    instruction_sets,
    misaligned_read_only,
    run_forked,
    run_python,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from ast_sim.ops import _mlp as ops
from ast_sim.ops import mlp

NAMES = ("x", "weight1", "bias1", "weight2", "bias2", "beside", "gamma", "beta", "residual")


def case(rows, inputs, hidden, outputs, beside=0, seed=0, amplitude=1.0):
    """All arguments; the names in `without` of the functions below are left out."""
    g = torch.Generator().manual_seed(seed)
    shapes = [(rows, inputs), (hidden, inputs + beside), (hidden,), (outputs, hidden), (outputs,), (rows, beside)]
    shapes += [(outputs,), (outputs,), (rows, outputs)]
    x = [torch.randn(shape, generator=g) for shape in shapes]
    x[1] = x[1] / (inputs + beside) ** 0.5
    x[3] = x[3] / hidden**0.5
    x[0] = amplitude * x[0]
    return x


def chosen(inputs, beside=True, norm=True, residual=True):
    """The inputs without some of the optional ones, and a function that takes the others."""
    keep = [True] * 5 + [beside, norm, norm, residual]
    return [x for x, k in zip(inputs, keep, strict=True) if k], keep


def fused(keep):
    def function(*given_inputs):
        left = iter(given_inputs)
        x, w1, b1, w2, b2, beside, gamma, beta, residual = (next(left) if k else None for k in keep)
        return mlp(x, w1, b1, w2, b2, beside, None if gamma is None else (gamma, beta), residual)

    return function


def composed(keep):
    def function(*given_inputs):
        left = iter(given_inputs)
        x, w1, b1, w2, b2, beside, gamma, beta, residual = (next(left) if k else None for k in keep)
        return ops._reference(x, beside, w1, b1, w2, b2, gamma, beta, residual, False)[0]

    return function


@pytest.mark.parametrize("norm", [False, True])
def test_accuracy_of_a_million_equal_rows(norm):
    """All roundings of a chain of sums have one sign."""
    inputs, keep = chosen(case(1, 3, 5, 4), beside=False, norm=norm, residual=False)
    inputs[0] = inputs[0].repeat(1_000_000, 1)
    ends = [lambda *x, of=of: 0.1 * of(*x).sum(0) for of in (fused(keep), composed(keep))]
    assert_accurate(*ends, inputs)


def gradients(inputs, keep):
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    out = fused(keep)(*leaves)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
    return [out.detach(), *torch.autograd.grad((out * weights).sum(), leaves)]


OPTIONS = [
    {},
    {"beside": False},
    {"norm": False},
    {"residual": False},
    {"beside": False, "norm": False, "residual": False},
]
SHAPES = [
    (0, 3, 4, 5, 2),
    (1, 1, 1, 2, 1),
    (2, 3, 2, 3, 60),
    (7, 12, 32, 3, 5),
    (97, 128, 33, 4, 17),
    (360, 128, 128, 128, 128),
    (1600, 8, 48, 31, 16),
    (6200, 12, 20, 17, 3),
]


@pytest.mark.parametrize("rows, inputs, hidden, outputs, beside", SHAPES)
@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("saved", [0, ops.SAVED])
def test_accuracy(rows, inputs, hidden, outputs, beside, options, saved, monkeypatch):
    monkeypatch.setattr(ops, "SAVED", saved)
    beside = beside if options.get("beside", True) else 0
    x, keep = chosen(case(rows, inputs, hidden, outputs, beside), **options)
    assert_accurate(fused(keep), composed(keep), x)


@pytest.mark.parametrize("amplitude", [0.0, 1e-30, 30.0, 1e15])
@pytest.mark.parametrize("norm", [False, True])
def test_accuracy_of_small_and_large_values(amplitude, norm):
    inputs = case(200, 24, 40, 20, 0, 0, amplitude)
    x, keep = chosen(inputs, beside=False, norm=norm, residual=False)
    assert_accurate(fused(keep), composed(keep), x)


def test_accuracy_of_a_mean_far_above_the_spread():
    """The variance is taken of the centred row: E[y^2] - E[y]^2 would lose all digits."""
    inputs = case(200, 24, 40, 20)
    inputs[4] = inputs[4] + 3000
    x, keep = chosen(inputs, residual=False)
    assert_accurate(fused(keep), composed(keep), x)


@pytest.mark.parametrize("inputs, hidden, outputs", [(4096, 8, 8), (8, 4096, 8), (8, 8, 4096)])
@pytest.mark.parametrize("positive", [False, True])
@pytest.mark.parametrize("saved", [0, ops.SAVED])
def test_accuracy_of_wide_layers(inputs, hidden, outputs, positive, saved, monkeypatch):
    """Sums over inputs, hidden units and outputs are cut into chains: one chain loses a digit of positive terms."""
    monkeypatch.setattr(ops, "SAVED", saved)
    x, keep = chosen(case(64, inputs, hidden, outputs), beside=False)
    assert_accurate(fused(keep), composed(keep), [y.abs() for y in x] if positive else x)


def test_accuracy_of_long_sums():
    """The gradients of weights, biases, gamma and beta are sums over all rows, here of equal terms."""
    x, keep = chosen(case(50_000, 4, 6, 3), beside=False, residual=False)
    x[0][:] = x[0][:1]
    assert_accurate(lambda *y: fused(keep)(*y).sum(0), lambda *y: composed(keep)(*y).sum(0), x)


@given(
    sizes=st.tuples(*[st.integers(low, high) for low, high in ((0, 40), (1, 40), (1, 40), (1, 40), (1, 20))]),
    options=st.sampled_from(OPTIONS),
    seed=st.integers(0, 2**31),
)
@settings(deadline=None, max_examples=60, derandomize=True)
def test_any_size_agrees_with_the_composition(sizes, options, seed):
    sizes = sizes if options.get("beside", True) else (*sizes[:4], 0)
    x, keep = chosen(case(*sizes, seed), **options)
    torch.testing.assert_close(fused(keep)(*x), composed(keep)(*x), rtol=1e-4, atol=1e-4)


def test_agrees_with_torch_modules():
    x, keep = chosen(case(50, 12, 24, 16), beside=False, residual=False)
    layers = torch.nn.Sequential(
        torch.nn.Linear(12, 24), torch.nn.ReLU(), torch.nn.Linear(24, 16), torch.nn.LayerNorm(16)
    )
    with torch.no_grad():
        for parameter, value in zip(layers.parameters(), x[1:], strict=True):
            parameter.copy_(value)
    torch.testing.assert_close(fused(keep)(*x), layers(x[0]), rtol=1e-5, atol=1e-5)


def test_beside_is_a_concatenation():
    inputs = case(70, 5, 8, 6, 4)
    x, w1, b1, w2, b2, beside, *_ = inputs
    assert torch.equal(mlp(x, w1, b1, w2, b2, beside), mlp(torch.cat([x, beside], 1), w1, b1, w2, b2))


def test_gradients_in_float64():
    for options in OPTIONS:
        beside = 2 if options.get("beside", True) else 0
        x, keep = chosen([y.double().requires_grad_() for y in case(5, 3, 4, 6, beside)], **options)
        assert torch.autograd.gradcheck(fused(keep), x)


# ---- extremes ----


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 3.4e38, 1e-45])
@pytest.mark.parametrize("saved", [0, ops.SAVED])
def test_extreme_values_stay_in_their_row(value, saved, monkeypatch):
    monkeypatch.setattr(ops, "SAVED", saved)
    inputs, keep = chosen(case(70, 5, 9, 6, 3))
    clean = gradients(inputs, keep)
    inputs[0][37, 2] = value
    got, expected = gradients(inputs, keep), composed(keep)(*inputs)
    others = torch.arange(70) != 37
    for i in (0, 1, 6, 9):
        assert torch.equal(got[i][others], clean[i][others])
    if value == 3.4e38:
        return  # which sums overflow depends on their order
    assert torch.equal(got[0].isnan(), expected.isnan())
    assert (got[1].isnan().any(1) == expected.isnan().any(1)).all()


@pytest.mark.parametrize("outputs", [1, 6, 48, 49, 64, 128, 300])
@pytest.mark.parametrize("value", [0.3, 1.1, 1e5 / 3, 1e8 / 3, 1e15 / 3, 3e38, 1e-40])
def test_a_row_of_equal_values_is_beta(outputs, value):
    """A mean that is rounded would stay in every difference."""
    x, w1, b1, w2, b2, _, gamma, beta, _ = case(5, 4, 8, outputs)
    out = mlp(x, w1, b1, torch.zeros_like(w2), torch.full_like(b2, value), norm=(gamma, beta))
    assert torch.equal(out, beta.expand(5, outputs))


@pytest.mark.parametrize("outputs", [20, 64, 131])
@pytest.mark.parametrize("amplitude", [1e18, 1e19, 1e25, 1e35])
@pytest.mark.parametrize("saved", [0, ops.SAVED])
def test_layer_norm_of_large_values(outputs, amplitude, saved, monkeypatch):
    """Their squares are too large for a float; the composition is 0 or NaN there. The bound is the accuracy rule's
    where the composition errs by 5e-7, as it does at 1."""
    monkeypatch.setattr(ops, "SAVED", saved)
    inputs, keep = chosen(case(40, 12, 16, outputs, amplitude=amplitude), beside=False, residual=False)
    inputs[4] *= amplitude
    for result, _, largest in errors(fused(keep), composed(keep), inputs):
        assert result <= 2e-6 * largest


def test_layer_norm_of_a_row_that_is_not_finite_is_nan():
    inputs, keep = chosen(case(6, 4, 8, 20), beside=False, residual=False)
    inputs[0] = inputs[0].abs() + 1
    inputs[1] = inputs[1].abs()
    inputs[3] = torch.randn(20, 8).sign()  # outputs of about +-3e38 times 8 hidden units
    inputs[0][2] = 3e38
    out = fused(keep)(*inputs)
    assert out[2].isnan().all() and out[[0, 1, 3, 4, 5]].isfinite().all()


def test_no_rows():
    inputs, keep = chosen(case(0, 4, 5, 6, 3))
    out, *found = gradients(inputs, keep)
    assert out.shape == (0, 6)
    for x, g in zip(inputs, found, strict=True):
        assert g.shape == x.shape and (g == 0).all()


# ---- determinism ----


@pytest.mark.parametrize("sizes", [(1000, 40, 70, 30, 9), (90, 128, 128, 128, 0), (8000, 12, 8, 3, 4)])
@pytest.mark.parametrize("saved", [0, ops.SAVED])
def test_bitwise_equal_for_threads(sizes, saved, monkeypatch):
    monkeypatch.setattr(ops, "SAVED", saved)
    inputs, keep = chosen(case(*sizes))
    assert_same_for_threads(lambda: gradients(inputs, keep))


def test_kept_and_computed_again_are_the_same_bits(monkeypatch):
    inputs, keep = chosen(case(700, 40, 70, 33, 9))
    kept = gradients(inputs, keep)
    monkeypatch.setattr(ops, "SAVED", 0)
    for name, x, y in zip(("out", *NAMES), kept, gradients(inputs, keep), strict=True):
        assert torch.equal(x, y), name


def test_rows_alone_equal_rows_in_a_batch():
    inputs, keep = chosen(case(700, 40, 70, 33, 9))
    out, dx, *_ = gradients(inputs, keep)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
    for rows in (slice(5, 6), slice(94, 99), slice(100, 213), slice(650, 700)):
        few = [x[rows] if name in ("x", "beside", "residual") else x for name, x in zip(NAMES, inputs, strict=True)]
        few[0] = few[0].clone().requires_grad_()
        mine = fused(keep)(*few)
        (mine * weights[rows]).sum().backward()
        assert torch.equal(mine, out[rows]) and torch.equal(few[0].grad, dx[rows])


CODE = """
import sys; sys.path[:0] = ["tests", "tests/ops"]
from checks import assert_accurate
from test_mlp import case, chosen, composed, fused
inputs, keep = chosen(case(150, 45, 38, 21, 10))
assert_accurate(fused(keep), composed(keep), inputs)
from ast_sim.ops.library import configuration
print(configuration()["instruction_set"])
"""


def test_every_instruction_set():
    for isa in instruction_sets():
        assert run_forked(CODE, AST_SIM_ISA=isa).strip() == isa


# ---- the op ----


def test_opcheck():
    x, w1, b1, w2, b2, beside, gamma, beta, residual = (y.requires_grad_() for y in case(9, 5, 8, 6, 3))
    for save in (False, True):
        torch.library.opcheck(ops._mlp.overload, (x, beside, w1, b1, w2, b2, gamma, beta, residual, save))
    torch.library.opcheck(ops._mlp.overload, (beside, None, w1[:, :3], None, w2, None, None, None, None, True))
    inputs = [y.detach() for y in (residual, x, beside, w1, b1, w2, b2, gamma, beta)]
    _, *kept = ops._mlp(*inputs[1:], None, True)
    for wanted in ([True] * 8, [i % 2 == 0 for i in range(8)]):
        torch.library.opcheck(ops._mlp_backward.overload, (*inputs, None, None, None, wanted))
        torch.library.opcheck(ops._mlp_backward.overload, (*inputs, *kept, wanted))


@pytest.mark.parametrize("wanted", [(i,) for i in range(9)] + [(0, 5), (1, 4), (3, 6)])
def test_any_subset_requires_grad(wanted):
    inputs, keep = chosen(case(120, 10, 20, 9, 4))
    every = [x.clone().requires_grad_() for x in inputs]
    fused(keep)(*every).square().sum().backward()
    for i in wanted:
        inputs[i].requires_grad_()
    fused(keep)(*inputs).square().sum().backward()
    for i in range(9):
        assert torch.equal(inputs[i].grad, every[i].grad) if i in wanted else inputs[i].grad is None


def test_unusual_layouts_and_unchanged_inputs():
    inputs, keep = chosen(case(60, 12, 20, 9, 4))
    expected = fused(keep)(*inputs)
    for i, x in enumerate(inputs):
        odd = [misaligned_read_only(x)]
        if x.dim() == 2:
            wide = torch.randn(x.shape[0], 2 * x.shape[1])
            wide[:, ::2] = x
            apart = torch.randn(x.shape[0], x.shape[1] + 7)
            apart[:, 3:-4] = x
            odd += [wide[:, ::2], apart[:, 3:-4], x.T.contiguous().T]
        for y in odd:
            before = y.clone()
            assert torch.equal(fused(keep)(*inputs[:i], y, *inputs[i + 1 :]), expected) and torch.equal(y, before)


def test_other_dtypes_and_autocast():
    inputs, keep = chosen(case(9, 11, 8, 6, 2))
    exact = composed(keep)(*(x.double() for x in inputs))
    half = [x.bfloat16() for x in inputs]
    out = fused(keep)(*half)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.double(), exact, rtol=0.1, atol=0.1)
    with torch.autocast("cpu", torch.bfloat16):
        out = fused(keep)(*half)
    assert out.dtype == torch.float32


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape[0] > 1])
def test_half_precision_is_as_accurate_as_it_can_be(shape, beside):
    """More inputs beside the others are no less accurate than the same inputs as columns of x."""
    inputs, keep = chosen(case(*shape[:4], shape[4] if beside else 0), beside)
    half = [x.half() for x in inputs]
    x, *layers = (x.double() for x in half)
    x = torch.cat([x, layers.pop(4)], dim=1) if beside else x
    exact = composed([*keep[:5], False, *keep[6:]])(x, *layers)
    assert float((fused(keep)(*half) - exact).abs().max()) <= 1e-3 * float(exact.abs().max())


MEMORY = """
import resource, torch
from ast_sim.ops._mlp import mlp
torch.set_num_threads(1)
def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
def run(rows):
    x = torch.randn(rows, 4, requires_grad=True)
    w1, b1, w2, b2 = torch.randn(512, 4), torch.zeros(512), torch.randn(4, 512), torch.zeros(4)
    mlp(x, w1, b1, w2, b2).sum().backward()
run(256)
before = peak()
run(100_000)
print(peak() - before)
"""


def test_hidden_units_of_many_rows_are_never_stored():
    """They would be 200 MB here; the arrays of this run are 1.6 MB each."""
    assert int(run_python(MEMORY, AST_SIM_DEBUG="0")) * 1024 < 50e6


@pytest.mark.parametrize(
    "change, message",
    [
        ({"x": lambda y: y[0]}, r"x must have shape \[M, I\], not \(5,\)"),
        ({"weight1": lambda y: y[:, 1:]}, r"weight1 must have shape \[H, 8\], not \(10, 7\)"),
        ({"weight2": lambda y: y[:, 1:]}, r"weight2 must have shape \[O, 10\], not \(6, 9\)"),
        ({"bias1": lambda y: y[1:]}, r"bias1 must have shape \[10\], not \(9,\)"),
        ({"bias2": lambda y: y[1:]}, r"bias2 must have shape \[6\], not \(5,\)"),
        ({"gamma": lambda y: y[1:]}, r"gamma must have shape \[6\], not \(5,\)"),
        ({"beta": lambda y: None}, "gamma and beta go together"),
        ({"beside": lambda y: y[1:]}, r"beside must have shape \[9, J\], not \(8, 3\)"),
        ({"residual": lambda y: y[:, 1:]}, r"residual must have shape \[9, 6\], not \(9, 5\)"),
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_name_op_argument_and_value(change, message, dtype):
    inputs = dict(zip(NAMES, (x.to(dtype) for x in case(9, 5, 10, 6, 3)), strict=True))
    inputs |= {name: function(inputs[name]) for name, function in change.items()}
    gamma, beta = inputs.pop("gamma"), inputs.pop("beta")
    with pytest.raises(ValueError, match=message) as error:
        mlp(**inputs, norm=(gamma, beta))
    assert "mlp" in str(error.value)
