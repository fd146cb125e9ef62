"""The derivatives of an op: the gradient that has a kernel of its own, and all others by compositions.

A gradient op goes by names: it takes inputs and outputs of its op, and the gradient of the output y as `dy`. It returns
the gradient of the input x as `dx`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._C._functorch import is_legacy_batchedtensor

from ast_sim.ops.library import LIBRARY, Kernel, Op
from ast_sim.ops.spec import Argument


def gradient_op(op: Op, kernel: Kernel, known: dict[str, Callable[[dict], Any]] | None = None) -> Op:
    """The gradient of an op as an op of its own. Torch derives its composition from the op's.

    Args:
        op: gets this gradient.
        kernel: computes it in the core.
        known: for an output of the op which the kernel takes: what stands for it, or None, by all inputs and outputs.
    """
    inputs = op.spec.inputs
    outputs = op.spec.outputs
    taken = kernel.spec.inputs
    place = {p.name: i for i, p in enumerate([*inputs, *outputs])}
    numbers = {f"d{p.name}": i for i, p in enumerate(outputs)}
    cotangents = {i: numbers[p.name] for i, p in enumerate(taken) if p.name in numbers}
    sources = [place.get(p.name) for p in taken]
    kept = [i for i, source in enumerate(sources) if source is not None and source >= len(inputs)]
    wants = {i: [place[name] for name in p.names("wants")] for i, p in enumerate(taken) if "wants" in p.words}
    of_inputs = [place[p.name[1:]] for p in kernel.spec.outputs]
    added = [i for i, p in enumerate(inputs) if "added" in p.words]

    def composition(*args) -> tuple:
        given = {p.name: x for p, x in zip(taken, args, strict=True)}
        dys = [given.get(f"d{p.name}") for p in outputs]
        switches = {name for p, dy in zip(outputs, dys, strict=True) if dy is not None for name in p.names("if")}
        xs = [p.name in switches if "switch" in p.words else given.get(p.name) for p in inputs]
        wanted = [i for i, want in zip(of_inputs, kernel.spec.wanted(*args), strict=True) if want]
        by_input = dict(zip(wanted, pull_back(op.composition, xs, wanted, dys), strict=True))
        return tuple(by_input.get(i) for i in of_inputs)

    gradient = Op(kernel, composition)

    def save(ctx, inputs, output) -> None:
        ys = output if isinstance(output, tuple) else (output,)
        ctx.set_materialize_grads(len(cotangents) == len(ys))
        ctx.mark_non_differentiable(*(y for i, y in enumerate(ys) if i not in cotangents.values()))
        given = (*inputs, *ys)
        values = [None if i is None else given[i] for i in sources]
        for i in kept:
            function = (known or {}).get(taken[i].name)
            y = function(dict(zip(place, given, strict=True))) if function else values[i]
            values[i] = _wanted(y, taken[i])
        _keep(ctx, values)

    def backward(ctx, *dys):
        args = _kept(ctx)
        needed = ctx.needs_input_grad
        for i, output in cotangents.items():
            args[i] = _wanted(dys[output], taken[i])
        for i, which in wants.items():
            args[i] = [needed[k] for k in which] if len(which) > 1 else needed[which[0]]
        dxs: list[Tensor | None] = [dys[0] if i in added and need else None for i, need in enumerate(needed)]
        if any(needed[i] for i in of_inputs):
            results = gradient(*args)
            for i, dx in zip(of_inputs, results if isinstance(results, tuple) else (results,), strict=True):
                dxs[i] = dx if needed[i] else None
        return tuple(dxs)

    differentiate(op, save, backward)
    differentiate_by_composition(gradient, kept)
    return gradient


def _wanted(y: Tensor | None, p: Argument) -> Tensor | None:
    """None for the empty tensor that stands for an output which was not wanted."""
    return None if p.optional and y is not None and y.numel() == 0 else y


def _keep(ctx, values: Sequence) -> None:
    ctx.save_for_backward(*(x if isinstance(x, Tensor) else None for x in values))
    ctx.others = [None if isinstance(x, Tensor) else x for x in values]


def _kept(ctx) -> list:
    return [y if x is None else x for x, y in zip(ctx.saved_tensors, ctx.others, strict=True)]


def pull_back(
    function: Callable, xs: Sequence, wanted: Sequence[int], dys: Sequence[Tensor | None]
) -> Sequence[Tensor]:
    """The gradients of function(*xs) by the arguments `wanted`, from `dys` by its outputs; None counts as 0."""
    given = [i for i, dy in enumerate(dys) if dy is not None]

    def part(*some: Tensor) -> tuple[Tensor, ...]:
        by_input = dict(zip(wanted, some, strict=True))
        ys = function(*(by_input.get(i, x) for i, x in enumerate(xs)))
        return tuple((ys if isinstance(ys, tuple) else (ys,))[i] for i in given)

    return torch.func.vjp(part, *(xs[i] for i in wanted))[1](tuple(dys[i] for i in given))


def differentiate_by_composition(op: Op, kept: Sequence[int] = ()) -> None:
    """Register the derivatives of the composition as the derivatives of an op.

    Args:
        op: the op.
        kept: the numbers of the arguments that the composition does not read, because they follow from the others.
    """

    def save(ctx, inputs, output) -> None:
        ctx.set_materialize_grads(False)
        _keep(ctx, inputs)

    def backward(ctx, *gradients):
        args = _kept(ctx)
        wanted = [i for i, needed in enumerate(ctx.needs_input_grad) if needed and i not in kept]
        results = dict(zip(wanted, pull_back(op.compose, args, wanted, gradients), strict=True))
        return tuple(results.get(i) for i in range(len(args)))

    differentiate(op, save, backward)


def differentiate(op: Op, setup_context: Callable, backward: Callable) -> None:
    """Register the gradient of an op. `backward` calls ops only, so that it can be traced.

    `backward` is not called if all gradients of the outputs are None. That happens only where `setup_context` has
    called `set_materialize_grads(False)`.
    """

    def backward_of_some(ctx, *gradients):
        if all(gradient is None for gradient in gradients):
            return (None,) * len(ctx.needs_input_grad)
        if any(map(_is_old_batch, gradients)):
            return _backward_of_each(backward, ctx, gradients)
        return backward(ctx, *gradients)

    torch.library.register_autograd(op.overload.name(), backward_of_some, setup_context=setup_context, lib=LIBRARY)

    def forward(ctx, *args):
        output = op.kernel.run(*args)
        setup_context(ctx, args, output)
        return output

    body = {"forward": staticmethod(forward), "backward": staticmethod(backward_of_some)}
    op.function = type(f"ast_sim_{op.name}", (torch.autograd.Function,), body)


def _is_old_batch(x: Tensor | None) -> bool:
    """Whether x is batched by `is_grads_batched=True`, whose vmap is older than torch.func and knows few ops."""
    return x is not None and is_legacy_batchedtensor(x)


def _backward_of_each(backward: Callable, ctx, gradients: tuple) -> tuple:
    """`backward`, one sample after the other."""
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    batches = [torch.ops.aten._remove_batch_dim(x, level, 0, 0) if _is_old_batch(x) else x for x in gradients]
    num = next(len(x) for x, y in zip(batches, gradients, strict=True) if _is_old_batch(y))
    samples = [[x[i] if _is_old_batch(y) else x for x, y in zip(batches, gradients, strict=True)] for i in range(num)]
    parts = zip(*(backward(ctx, *sample) for sample in samples), strict=True)
    return tuple(None if x[0] is None else torch.ops.aten._add_batch_dim(torch.stack(x), 0, level) for x in parts)
