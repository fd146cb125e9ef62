"""Checks that the tests of all ops share: the accuracy rule, equality over threads and instruction sets."""

import fcntl
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import forked
import numpy as np
import pytest
import torch
from torch import Tensor


def _with_gradients(
    function: Callable, inputs: Sequence, cotangents: list[Tensor] | None
) -> tuple[list[Tensor], list[Tensor]]:
    """Outputs, then gradients of sum(output * cotangent) for every floating input."""
    leaves = [x.detach().requires_grad_() if isinstance(x, Tensor) and x.is_floating_point() else x for x in inputs]
    outputs = function(*leaves)
    outputs = [outputs] if isinstance(outputs, Tensor) else list(outputs)
    if cotangents is None:
        generator = torch.Generator().manual_seed(7)
        cotangents = [torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in outputs]
    total = sum((x * c.to(x.dtype)).sum() for x, c in zip(outputs, cotangents, strict=True))
    wanted = [x for x in leaves if isinstance(x, Tensor) and x.requires_grad]
    gradients = torch.autograd.grad(total, wanted) if wanted and total.requires_grad else []
    return [x.detach() for x in outputs] + list(gradients), cotangents


def errors(op: Callable, reference: Callable, inputs: Sequence) -> list[tuple[float, float, float]]:
    """(e(C), e(T), largest magnitude) of every output and gradient.

    e(C) and e(T) are the largest errors of the op and of the float32 composition against the float64 composition.
    """
    double = [x.double() if isinstance(x, Tensor) and x.is_floating_point() else x for x in inputs]
    exact, cotangents = _with_gradients(reference, double, None)
    composed, _ = _with_gradients(reference, inputs, cotangents)
    fused, _ = _with_gradients(op, inputs, cotangents)
    assert len(fused) == len(composed) == len(exact)
    found = []
    for i, (c, t, e) in enumerate(zip(fused, composed, exact, strict=True)):
        assert c.dtype == torch.float32 and c.shape == e.shape, (i, c.dtype, c.shape, e.shape)
        assert torch.isfinite(c).all(), f"result {i} is not finite"
        if e.numel():
            found.append(tuple(float(x) for x in ((c - e).abs().max(), (t - e).abs().max(), e.abs().max())))
    return found


def assert_accurate(op: Callable, reference: Callable, inputs: Sequence) -> None:
    """The accuracy rule: e(C) <= 2 e(T) + 1e-6 * largest magnitude, for all outputs and gradients."""
    for i, (error_c, error_t, magnitude) in enumerate(errors(op, reference, inputs)):
        bound = 2 * error_t + 1e-6 * magnitude
        assert error_c <= bound, f"result {i}: error {error_c:.3g} exceeds {bound:.3g} (composition: {error_t:.3g})"


def assert_same_for_threads(function: Callable[[], Sequence[Tensor]]) -> None:
    """Bit for bit equal results with 1 and 2 threads, and from run to run."""
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            results.append([x.detach().clone() for x in function()])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        for x, y in zip(results[0], other, strict=True):
            assert torch.equal(x.contiguous().view(torch.uint8), y.contiguous().view(torch.uint8))


def misaligned_read_only(x: Tensor) -> Tensor:
    """The same values at an odd address, in memory that must not be written."""
    buffer = np.empty(x.numel() * x.element_size() + 1, dtype=np.uint8)
    values = buffer[1:].view(x.numpy().dtype).reshape(x.shape)
    values[:] = x.numpy()
    values.setflags(write=False)
    with warnings.catch_warnings():  # torch says once a process that it does not support such memory
        warnings.simplefilter("ignore")
        out = torch.from_numpy(values)
    assert out.data_ptr() % out.element_size()
    return out


def instruction_sets() -> list[str]:
    """The compiled instruction sets that this processor supports."""
    from ast_sim.ops.library import configuration

    return configuration()["supported"]


def run_python(code: str, **environment: str) -> str:
    """Standard output of Python code in a process of its own, with these environment variables."""
    result = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | environment, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that `make` fills, once for all the processes of a test run."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder = root / name
    with open(root / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "whole").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            (folder / "whole").touch()
    return folder


def run_forked(code: str, **environment: str) -> str:
    """As run_python, in a copy of a process that has torch and the ops imported: all but a moment of a short test."""
    end = "import os, sys; sys.stdout.flush(); os._exit(0)"  # to take Python down would take longer than a short test
    result = forked.run(["-c", f"{code}\n{end}"], env=os.environ | environment, imported=forked.OPS)
    assert result.returncode == 0, result.stderr
    return result.stdout


def assert_same_everywhere(code: str) -> None:
    """Code that prints a SHA-256 of its results prints the same on every instruction set and with the compositions."""
    prints = {isa: run_forked(code, AST_SIM_ISA=isa) for isa in instruction_sets()}
    prints["torch"] = run_forked(code, AST_SIM_BACKEND="torch")
    assert "base" in prints and len(set(prints.values())) == 1 and len(prints["base"].strip()) == 64, prints


def turned_axes(plain, mirrored) -> Tensor:
    """[N, 3], -1 on the axes that the scene of a node is mirrored along, by its rest positions; else 1."""
    signs = []
    nodes = plain.node_offsets.diff().tolist()
    for one, other in zip(plain.rest_position.split(nodes), mirrored.rest_position.split(nodes), strict=True):
        alike = ((one - one[:1]) * (other - other[:1])).sum(0)
        assert (alike != 0).all()
        signs.append(alike.sign().expand(len(one), 3))
    return torch.cat(signs)


def assert_mirroring_turns_errors_back(plain, mirrored, error_of: Callable) -> None:
    """Two pools of the same scenes, of which one mirrors them, go on alike from the errors error_of(number, batch,
    target) of the plain one, turned as its scenes are."""
    turned = 0
    for number in range(12):
        (a, x), (b, y) = plain.batch(number), mirrored.batch(number)
        assert a.names == b.names
        sign = turned_axes(a.graph, b.graph)
        torch.testing.assert_close(x.motion * sign, y.motion, atol=1e-6, rtol=1e-4)
        turned += int((sign < 0).any())
        error = error_of(number, a, x)
        plain.advance(number, error)
        mirrored.advance(number, error * sign)
    assert turned > 6
