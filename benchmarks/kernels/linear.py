"""linear and mlp beside three torch peers: F.linear (MKL), torch's private oneDNN op, and composed modules."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ast_sim.ops import linear, mlp
from benchmarks.kernels.case import Case

# rows, inputs, outputs; the small ones occur in the demo's model
LINEAR = [(100_000, 128, 128), (512, 512, 1024), (1600, 128, 128), (360, 128, 128), (90, 128, 128)]
GEGLU = [(512, 256, 1024), (360, 128, 512)]
MLP = [100_000, 1600, 90]


def _onednn(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")


def _geglu(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    a, b = F.linear(x, weight, bias).chunk(2, dim=1)
    return a * F.gelu(b)


def _mlp(x: Tensor, w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor, gamma: Tensor, beta: Tensor) -> Tensor:
    return F.layer_norm(F.linear(F.relu(F.linear(x, w1, b1)), w2, b2), gamma.shape, gamma, beta)


def _forward(function: Callable[..., Tensor], inputs: list[Tensor]) -> Callable[[], list[Tensor]]:
    def call() -> list[Tensor]:
        with torch.no_grad():
            return [function(*inputs)]

    return call


def _both(function: Callable[..., Tensor], inputs: list[Tensor], dout: Tensor) -> Callable[[], list[Tensor]]:
    leaves = [x.detach().requires_grad_() for x in inputs]

    def call() -> list[Tensor]:
        out = function(*leaves)
        return [out, *torch.autograd.grad(out, leaves, dout)]

    return call


def _case(name: str, shape: str, ours: Callable, peers: dict[str, Callable], inputs: list, flops: float) -> list[Case]:
    """Forward, then forward and backward, which oneDNN's private op has not."""
    with torch.no_grad():
        dout = torch.randn(ours(*inputs).shape, generator=torch.Generator().manual_seed(1))
    cases = []
    for backward in (False, True):
        chosen = {k: f for k, f in peers.items() if not (backward and f is _onednn)}
        calls = {k: _both(f, inputs, dout) if backward else _forward(f, inputs) for k, f in chosen.items()}
        mine = _both(ours, inputs, dout) if backward else _forward(ours, inputs)

        def check(mine=mine, calls=calls) -> None:
            for peer in calls.values():
                for x, y in zip(mine(), peer(), strict=True):
                    torch.testing.assert_close(x, y, rtol=1e-3, atol=1e-4 * float(y.detach().abs().max()))

        passes = "forward and backward" if backward else "forward"
        cases.append(Case(f"{name}, {passes}", shape, mine, calls, None, (3 if backward else 1) * flops, check))
    return cases


def cases() -> list[Case]:
    all_cases = []
    g = torch.Generator().manual_seed(0)
    for geglu, sizes in ((False, LINEAR), (True, GEGLU)):
        for rows, inputs, outputs in sizes:
            x, weight, bias = (torch.randn(s, generator=g) for s in ((rows, inputs), (outputs, inputs), (outputs,)))
            all_cases += _case(
                "linear, GEGLU" if geglu else "linear",
                f"{rows} x {inputs} x {outputs}",
                (lambda x, w, b: linear(x, w, b, "geglu")) if geglu else linear,
                {"torch composition": _geglu} if geglu else {"F.linear": F.linear, "oneDNN": _onednn},
                [x, weight / inputs**0.5, bias],
                2 * rows * inputs * outputs,
            )
    for rows in MLP:
        shapes = [(rows, 128), (128, 128), (128,), (128, 128), (128,), (128,), (128,)]
        x = [torch.randn(s, generator=g) for s in shapes]
        x[1], x[3] = x[1] / 128**0.5, x[3] / 128**0.5

        def ours(x, w1, b1, w2, b2, gamma, beta):
            return mlp(x, w1, b1, w2, b2, norm=(gamma, beta))

        all_cases += _case(
            "mlp with LayerNorm", f"{rows} x 128-128-128", ours, {"torch composition": _mlp}, x, 4 * rows * 128**2
        )
    return all_cases
