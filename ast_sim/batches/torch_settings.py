"""Settings of torch that a program chooses for work of its own, and that change nothing here.

The dtype of new tensors is one for all threads of a process. So it is left alone: this package names the dtype of every
tensor that it makes. Only while a model is built, whose layers are torch's own, it is float32 for a moment.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from threading import Lock

import torch
from torch.backends.mkldnn import MkldnnModule

_EXACT = ("none", "ieee")  # what torch calls products of float32 that are made in float32


class _Shared:
    """A setting of the whole process that is changed while any thread is within; the last one puts it back."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._before: str | None = None

    @contextmanager
    def exact_products(self) -> Iterator[None]:
        """Within the block torch multiplies float32 in float32."""
        chosen = MkldnnModule.matmul
        with self._lock:
            self._inside += 1
            if self._before is None and chosen.fp32_precision not in _EXACT:
                self._before = chosen.fp32_precision
                chosen.fp32_precision = "ieee"
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside and self._before is not None:
                    chosen.fp32_precision = self._before
                    self._before = None


_products = _Shared()
_building = Lock()


@contextmanager
def tensors_on_cpu() -> Iterator[None]:
    """Within the block new tensors of this thread are on the CPU."""
    with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
        yield


@contextmanager
def usual_settings() -> Iterator[None]:
    """Within the block this thread computes as in a program that has chosen nothing: new tensors are on the CPU,
    gradients are recorded, there is no autocast, and products of float32 are made in float32."""
    with tensors_on_cpu(), ExitStack() as changed:
        if torch.is_autocast_enabled("cpu"):
            changed.enter_context(torch.autocast("cpu", enabled=False))
        changed.enter_context(torch.inference_mode(False))  # records gradients within no_grad, too
        changed.enter_context(_products.exact_products())
        yield


@contextmanager
def float32_layers() -> Iterator[None]:
    """Within the block new layers of torch are of float32, whatever the dtype of new tensors is."""
    with _building:
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(before)
