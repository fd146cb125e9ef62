"""What a kernel takes, said once. The C core checks every call by this text, and so do the compositions.

    x[M,I] rows, weight[O,I] filled, bias?[O], source[P] index(M), depth integer(0,21) -> out[M,O]

`csrc/README.md` explains the words.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

Sizes = dict[str, int]
Given = dict[str, Any]

_PARAMETER = re.compile(r"\s*(\w+)(\??)(?:\[([^]]*)\])?((?:\s+\w+(?:\([^)]*\))?)*)\s*(?:,|$)")
_WORD = re.compile(r"(\w+)(?:\(([^)]*)\))?")
_TERM = re.compile(r"(\d*)([A-Z]?)")


@dataclass(frozen=True)
class Dimension:
    """A size such as 27, N, 4E, C+1 or I+J."""

    text: str
    constant: int
    factors: dict[str, int]

    @staticmethod
    def of(text: str) -> Dimension:
        terms = [_TERM.fullmatch(term.strip()) for term in text.split("+")]
        parts = [(int(term[1] or 1), term[2]) for term in terms if term]
        constant = sum(n for n, letter in parts if not letter)
        return Dimension(text.strip(), constant, {letter: n for n, letter in parts if letter})

    def size(self, sizes: Sizes) -> int:
        return self.constant + sum(n * sizes.get(letter, 0) for letter, n in self.factors.items())

    def fits(self, length: int, sizes: Sizes) -> bool:
        """Whether an axis may be as long as this. A letter that stands alone binds at first sight."""
        if len(self.factors) == 1:
            ((letter, factor),) = self.factors.items()
            rest = length - self.constant
            if letter not in sizes and rest >= 0 and rest % factor == 0:
                sizes[letter] = rest // factor
            return letter in sizes and length == self.size(sizes)
        return length == self.size(sizes)

    def show(self, sizes: Sizes) -> str:
        return str(self.size(sizes)) if len(self.factors) != 1 or [*self.factors][0] in sizes else self.text

    def numbers(self) -> tuple:
        """As csrc/spec.h takes it."""
        terms = [(n, letter) for letter, n in self.factors.items()] + [(0, "\0")] * 2
        return self.text, self.constant, *terms[0], *terms[1]


@dataclass(frozen=True)
class Parameter:
    """One argument of a kernel. `shape` is None for a number."""

    name: str
    optional: bool
    output: bool
    shape: tuple[Dimension, ...] | None
    words: dict[str, str]  # each with what stands in its parentheses

    @property
    def dtype(self) -> torch.dtype:
        if "int32" in self.words:
            return torch.int32
        return torch.int64 if "int64" in self.words or self.words.keys() & CHECKS.keys() else torch.float32

    def numbers(self, places: dict[str, int]) -> tuple:
        """As csrc/spec.h takes it, given the place of each parameter."""
        kind = next((i for i, word in enumerate(("integer", "number", "bits"), 1) if word in self.words), 0)
        low, high = map(int, self.words.get("integer", "0,0").split(","))
        others = (places[self.words[word]] if word in self.words else -1 for word in ("with", "needs"))
        flags = (self.optional, self.output, "rows" in self.words, "filled" in self.words)
        checks = []
        for word in (word for word in self.words if word in CHECKS):
            bound, arrays = _inside(self.words[word])
            checks.append((word, bound.numbers(), *([places[name] for name in arrays] + [-1, -1])[:2]))
        shape = tuple(d.numbers() for d in self.shape or ())
        return self.name, kind, _TYPES[self.dtype], *flags, low, high, *others, shape, tuple(checks)


_WORDS = ("int64", "int32", "rows", "filled", "integer", "number", "bits", "with", "needs")
_TYPES = {dtype: np.dtype(str(dtype)[6:]).num for dtype in (torch.float32, torch.int64, torch.int32)}


def _inside(text: str) -> tuple[Dimension, list[str]]:
    """The dimension, or the names of arrays, in the parentheses of a check."""
    names = [name.strip() for name in text.split(",")] if text[:1].islower() else []
    return Dimension.of("0" if names else text or "0"), names


def parameters_of(spec: str) -> list[Parameter]:
    inputs, _, outputs = spec.partition("->")
    parameters = []
    for part in (inputs, outputs):
        for name, optional, shape, words in _PARAMETER.findall(part):
            dimensions = tuple(map(Dimension.of, shape.split(","))) if shape else None
            known = dict(_WORD.findall(words))
            if not known.keys() <= {*_WORDS, *CHECKS}:
                raise ValueError(f"{name} in a spec has words that nobody knows: {words}")
            parameters.append(Parameter(name, bool(optional), part is outputs, dimensions, known))
    return parameters


def check(kernel: str, parameters: list[Parameter], given: Given) -> None:
    """Raise the ValueError or TypeError that the C core would raise for these arguments; others are not looked at.

    A letter may be given, too. Tensors of floating point may have any dtype.
    """
    sizes = {letter: n for letter, n in given.items() if len(letter) == 1 and letter.isupper()}
    known = [p for p in parameters if p.name in given]
    for p in known:
        if p.shape is None:
            _check_number(kernel, p, given[p.name])
        elif _is_present(kernel, p, given):
            _check_array(kernel, p, given[p.name], sizes)
    for p in known:
        for word, inside in p.words.items():
            if word in CHECKS and given[p.name] is not None:
                bound, arrays = _inside(inside)
                others = [given[name] for name in arrays] or ([bound.size(sizes)] if inside else [])
                CHECKS[word](kernel, p.name, given[p.name], *others)


def _check_number(kernel: str, p: Parameter, value: float) -> None:
    if "integer" in p.words:
        low, high = (int(n) for n in p.words["integer"].split(","))
        if not low <= value <= high:
            raise ValueError(f"{kernel}: {p.name} must lie in {low}..{high}, not {value}")


def _is_present(kernel: str, p: Parameter, given: Given) -> bool:
    present = given[p.name] is not None
    if not present and not p.optional:
        raise TypeError(f"{kernel}: {p.name} must not be None")
    other = p.words.get("with")
    if other and present != (given[other] is not None):
        raise ValueError(f"{kernel}: {other} and {p.name} go together")
    other = p.words.get("needs")
    if other and present and given[other] is None:
        raise ValueError(f"{kernel}: {p.name} needs {other}")
    return present


def _check_array(kernel: str, p: Parameter, x: Tensor, sizes: Sizes) -> None:
    if x.dtype != p.dtype and not (p.dtype.is_floating_point and x.dtype.is_floating_point):
        raise TypeError(f"{kernel}: {p.name} must be {str(p.dtype)[6:]}, not {x.dtype}")
    shape, before = p.shape or (), dict(sizes)
    if x.dim() != len(shape) or not all(d.fits(n, sizes) for d, n in zip(shape, x.shape, strict=True)):
        wanted = ", ".join(d.show(before) for d in shape)
        raise ValueError(f"{kernel}: {p.name} must have shape [{wanted}], not {tuple(x.shape)}")
    if "filled" in p.words and not x.numel():
        raise ValueError(f"{kernel}: {p.name} must have a shape without 0, not {tuple(x.shape)}")


# ---- values of index tensors ----


def check_offsets(kernel: str, name: str, offsets: Tensor, rows: int) -> None:
    """Raise ValueError unless the offsets [B + 1] start with 0, never fall and end at the number of rows."""
    if len(offsets) < 1 or offsets[0] != 0:
        raise ValueError(f"{kernel}: {name} must start with 0")
    falls = (offsets.diff() < 0).nonzero()
    if len(falls):
        at = int(falls[0]) + 1
        raise ValueError(f"{kernel}: {name} must never fall, but falls to {int(offsets[at])} at {at}")
    if offsets[-1] != rows:
        raise ValueError(f"{kernel}: {name} must end at the number of rows {rows}, not {int(offsets[-1])}")


def check_index(kernel: str, name: str, index: Tensor, bound: int) -> None:
    """Raise ValueError unless all values of an index lie in [0, bound). The message names the first that does not."""
    wrong = ((index < 0) | (index >= bound)).nonzero()
    if len(wrong):
        at = wrong[0].tolist()
        place, value = ", ".join(map(str, at)), int(index[tuple(at)])
        raise ValueError(f"{kernel}: {name}[{place}] = {value} is not an index below {bound}")


def _check_permutation(kernel: str, name: str, order: Tensor) -> None:
    check_index(kernel, name, order, len(order))
    twice = (order.bincount(minlength=1) > 1).nonzero()
    if len(twice):
        raise ValueError(f"{kernel}: {name} must be a permutation, but holds {int(twice[0])} twice")


def _check_rising(kernel: str, name: str, index: Tensor, offsets: Tensor) -> None:
    falls = index.diff() <= 0
    falls[[i - 1 for i in offsets.tolist() if 0 < i < len(index)]] = False
    if falls.any():
        at = int(falls.nonzero()[0]) + 1
        raise ValueError(f"{kernel}: {name} must rise strictly within each kernel offset, but does not at {at}")


def _check_scenes(kernel: str, name: str, offsets: Tensor, keys: Tensor) -> None:
    scenes = segment_of(offsets)
    wrong = keys < 0
    wrong[1:] |= (keys[1:] <= keys[:-1]) & (scenes[1:] == scenes[:-1])
    if wrong.any():
        at = int(wrong.nonzero()[0])
        raise ValueError(
            f"{kernel}: keys must be at least 0 and rise strictly within each scene, but keys[{at}] is {int(keys[at])}"
        )


def _check_segments(kernel: str, name: str, offsets: Tensor, segments: Tensor) -> None:
    expected = segment_of(offsets)
    wrong = (segments != expected).nonzero()
    if len(wrong):
        at = int(wrong[0])
        raise ValueError(f"{kernel}: receivers[{at}] is {int(segments[at])}, but {name} say {int(expected[at])}")


def _check_corners(kernel: str, name: str, offsets: Tensor, elements: Tensor, order: Tensor) -> None:
    nodes = elements.flatten()
    check_index(kernel, "elements", elements, len(offsets) - 1)
    if not torch.equal(order, torch.argsort(nodes, stable=True)) or not torch.equal(nodes[order], segment_of(offsets)):
        raise ValueError(f"{kernel}: node_order must be the corners of the elements at each node, ascending")


CHECKS: dict[str, Callable[..., None]] = {
    "offsets": check_offsets,
    "index": check_index,
    "permutation": _check_permutation,
    "rising": _check_rising,
    "scenes": _check_scenes,
    "segments": _check_segments,
    "corners": _check_corners,
}


def segment_of(offsets: Tensor) -> Tensor:
    """[N] int64: the segment of each row, from the offsets [C + 1] of the segments."""
    return torch.arange(len(offsets) - 1, device=offsets.device).repeat_interleave(offsets.diff())
