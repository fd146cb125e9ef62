"""The derivatives of an op: the gradient that has a kernel of its own, and all others by compositions."""

from __future__ import annotations

from collections.abc import Callable

import torch

from ast_sim.ops.library import LIBRARY, Op


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
        output = op.kernel(*args)
        setup_context(ctx, args, output)
        return output

    body = {"forward": staticmethod(forward), "backward": staticmethod(backward_of_some)}
    op.function = type(f"ast_sim_{op.name}", (torch.autograd.Function,), body)


def _is_old_batch(x: torch.Tensor | None) -> bool:
    """Whether x is batched by `is_grads_batched=True`, whose vmap is older than torch.func and knows few ops."""
    return x is not None and torch._C._functorch.is_legacy_batchedtensor(x)


def _backward_of_each(backward: Callable, ctx, gradients: tuple) -> tuple:
    """`backward`, one sample after the other."""
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    batches = [torch._remove_batch_dim(x, level, 0, 0) if _is_old_batch(x) else x for x in gradients]
    num = next(len(x) for x, y in zip(batches, gradients, strict=True) if _is_old_batch(y))
    samples = [[x[i] if _is_old_batch(y) else x for x, y in zip(batches, gradients, strict=True)] for i in range(num)]
    found = zip(*(backward(ctx, *sample) for sample in samples), strict=True)
    return tuple(None if x[0] is None else torch._add_batch_dim(torch.stack(x), 0, level) for x in found)


def differentiate_by_composition(op: Op, kept: tuple[int, ...] = ()) -> None:
    """Register the derivatives of the composition as those of an op, such as the gradient of another op.

    Args:
        op: the op.
        kept: the numbers of the arguments that follow from the others and were kept from the forward op. Where the
            composition is differentiated it gets None and computes them again; their derivatives would be lost.
    """
    op.kept = kept

    def save(ctx, inputs, output) -> None:
        ctx.set_materialize_grads(False)
        ctx.others = [None if isinstance(x, torch.Tensor) else x for x in inputs]
        tensors = (x if isinstance(x, torch.Tensor) and i not in kept else None for i, x in enumerate(inputs))
        ctx.save_for_backward(*tensors)

    def gradient(ctx, *gradients):
        wanted = [i for i, needed in enumerate(ctx.needs_input_grad) if needed and i not in kept]
        args = [y if x is None else x for x, y in zip(ctx.saved_tensors, ctx.others, strict=True)]
        with torch.enable_grad():
            for i in wanted:  # by a view of its own: an argument may be a function of another, such as dout of x
                args[i] = args[i].view_as(args[i])
            outputs = op.compose(*args)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        pairs = [(y, dy) for y, dy in zip(outputs, gradients, strict=True) if y.requires_grad and dy is not None]
        if not pairs:
            return (None,) * len(args)
        ys, dys = zip(*pairs, strict=True)
        again, variables = torch.is_grad_enabled(), [args[i] for i in wanted]
        found = iter(torch.autograd.grad(ys, variables, dys, create_graph=again, allow_unused=True))
        return tuple(next(found) if i in wanted else None for i in range(len(args)))

    differentiate(op, save, gradient)
