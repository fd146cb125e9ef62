"""What follows from the text of a spec: schema, arguments of the kernel with new outputs, and checks."""

import pytest
import torch

from ast_sim.ops.spec import Spec, check

TEXT = """x[M,I] rows_apart, offsets[B+1] offsets(M), bias?[4O] with(scale), scale?[O], mean flag;
          num size(R), save switch, wanted wants(x,bias)
          -> y[R,I+O], index[B] int64, kept[M] if(save,bias), dbias[4O] if(wanted)"""
SPEC = Spec(TEXT)
X, OFFSETS = torch.zeros(5, 3), torch.tensor([0, 2, 5])


def test_the_schema_follows():
    assert SPEC.schema == (
        "(Tensor x, Tensor offsets, Tensor? bias, Tensor? scale, bool mean, SymInt num, bool save,"
        " bool[2] wanted) -> (Tensor, Tensor, Tensor, Tensor)"
    )
    assert Spec("x[N] -> y[N]").schema == "(Tensor x) -> Tensor"


def test_the_arguments_of_the_kernel_follow():
    bias, scale = torch.zeros(8), torch.zeros(2)
    x, offsets, b, s, mean, y, index, kept, dbias = SPEC.arguments(
        X, OFFSETS, bias, scale, True, 7, True, [False, True]
    )
    assert x is X and offsets is OFFSETS and b is bias and s is scale and mean is True
    assert y.shape == (7, 5) and index.shape == (2,) and index.dtype == torch.int64
    assert kept.shape == (5,) and dbias.shape == (8,)
    *_, y, _, kept, dbias = SPEC.arguments(X, OFFSETS, None, None, False, 7, True, [True, False])
    assert y.shape == (7, 3) and kept is None and dbias is None
    assert SPEC.wanted(X, OFFSETS, None, None, False, 7, True, [True, False]) == (True, True, False, False)


@pytest.mark.parametrize(
    "message, changed",
    [
        (r"op: x must have shape \[M, I\], not \(5,\)", {"x": X[:, 0]}),
        (r"op: x must be float32, not torch.int64", {"x": X.long()}),
        (r"op: x must not be None", {"x": None}),
        (r"op: offsets must end at the number of rows 5, not 4", {"offsets": torch.tensor([0, 4])}),
        (r"op: offsets must never fall, but falls to 1 at 2", {"offsets": torch.tensor([0, 2, 1])}),
        (r"op: scale and bias go together", {"bias": torch.zeros(8)}),
        (r"op: bias must have shape \[4O\], not \(7,\)", {"bias": torch.zeros(7), "scale": torch.zeros(2)}),
    ],
)
def test_checks_name_what_is_wrong(message, changed):
    given = {"x": X, "offsets": OFFSETS, "bias": None, "scale": None}
    assert check("op", SPEC.inputs, given)["I"] == 3
    with pytest.raises((TypeError, ValueError), match=message):
        check("op", SPEC.inputs, given | changed)


def test_a_late_array_is_to_blame():
    x, dy = torch.zeros(5), torch.zeros(4)
    with pytest.raises(ValueError, match=r"dy must have shape \[5\], not \(4,\)"):
        check("op", Spec("dy[N] late, x[N]").inputs, {"dy": dy, "x": x})
    with pytest.raises(ValueError, match=r"x must have shape \[4\], not \(5,\)"):
        check("op", Spec("dy[N], x[N]").inputs, {"dy": dy, "x": x})


@pytest.mark.parametrize(
    "text, message",
    [
        ("x[N] dense -> y[N]", "x has words that nobody knows:  dense"),
        ("x[m,I] -> y[I]", "'m' is no size"),
        ("x[2*M,I] -> y[M]", r"'2\*M' is no size"),
        ("x[M-1] -> y[M]", "'M-1' is no size"),
        ("x[M,] -> y[M]", "'' is no size"),
        ("x[M+] -> y[M]", r"'M\+' is no size"),
        ("x[M+M] -> y[M]", r"'M\+M' is no size"),
        ("x[M,I rows, weight[O,I] -> y[M]", "'I rows' is no size"),
        ("x[N] index(O -> y[N]", r"only .* of 'x\[N\] index\(O"),
        ("x[N] y[N] -> z[N]", r"only .* of 'x\[N\] y\[N\]"),
        ("x[N] -> y[N]; z[N]", r"only .* of ' y\[N\]; z\[N\]"),
        ("x[N], mean -> y[N]", "mean has neither a shape nor a word"),
    ],
)
def test_what_is_no_spec_is_refused(text, message):
    with pytest.raises(ValueError, match=message):
        Spec(text).arguments(torch.zeros(1))
