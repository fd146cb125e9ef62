"""One measured case: our op beside its peers on the same input, checked for equal results before any time is taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Case:
    """What is timed.

    Attributes:
        op: name of the op.
        shape: the sizes, in words.
        ours: one call of the op.
        peers: one call of each peer on the same input, by name.
        items: things processed in a call (points, pairs, rows), or None.
        flops: useful floating point operations in a call, or None.
        check: raises AssertionError unless ours and the peers agree.
        missing: peers that cannot run here, by name, with the reason.
    """

    op: str
    shape: str
    ours: Callable[[], object]
    peers: dict[str, Callable[[], object]]
    items: int | None
    flops: float | None
    check: Callable[[], None]
    missing: dict[str, str] = field(default_factory=dict)
