"""What an op takes and gives, said once: its schema, its outputs, and the checks here and in the core follow from it.

    x[M,I] rows_apart, weight[O,I] rows_apart filled, bias?[O], source[P] index(M), depth integer(0,21); save switch
    -> out[M,O], z[M,O] if(save)

`csrc/README.md` explains the words.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
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
        parts = [(int(term[1] or 1), term[2]) for term in terms if term and term[0]]
        _require(len({letter for _, letter in parts}) == len(terms), f"{text!r} is no size such as 27, 4E or C+1")
        constant = sum(n for n, letter in parts if not letter)
        return Dimension(text.strip(), constant, {letter: n for n, letter in parts if letter})

    def size(self, sizes: Sizes) -> int:
        return self.constant + sum(n * sizes.get(letter, 0) for letter, n in self.factors.items())

    @property
    def single(self) -> str:
        """The letter, if it stands alone."""
        return next(iter(self.factors)) if len(self.factors) == 1 else ""

    def fits(self, length: int, sizes: Sizes) -> bool:
        """Whether an axis may be as long as this. A letter that stands alone binds at first sight."""
        if self.single and self.single not in sizes:
            sizes[self.single] = max(length - self.constant, 0) // self.factors[self.single]
        return length == self.size(sizes)

    def show(self, sizes: Sizes) -> str:
        return self.text if self.single and self.single not in sizes else str(self.size(sizes))

    @property
    def expression(self) -> str:
        """The size as Python, where the letters are numbers."""
        terms = [f"{n} * {letter}" if n > 1 else letter for letter, n in self.factors.items()]
        return " + ".join(terms + [str(self.constant)] * (self.constant > 0 or not terms))

    def numbers(self) -> list[int]:
        """As csrc/spec.h takes it."""
        factors, letters = [*self.factors.values(), 0, 0], [*map(ord, self.factors), 0, 0]
        return [self.constant, *factors[:2], *letters[:2]]


@dataclass(frozen=True)
class Argument:
    """One argument of an op. `shape` is None for what is no tensor."""

    name: str
    optional: bool
    output: bool
    shape: tuple[Dimension, ...] | None
    words: dict[str, str]  # each with what stands in its parentheses

    def names(self, word: str) -> list[str]:
        """What stands in the parentheses of a word, taken apart."""
        return [name.strip() for name in self.words.get(word, "").split(",") if name]

    @property
    def dtype(self) -> torch.dtype:
        if "int32" in self.words:
            return torch.int32
        return torch.int64 if "int64" in self.words or self.words.keys() & CHECKS.keys() else torch.float32

    @property
    def bounds(self) -> tuple[int, int]:
        most = 2**48 if "size" in self.words else int("flag" in self.words)
        low, high = self.names("integer") or self.names("number") or (0, most)
        return int(low), int(high)

    @property
    def type(self) -> str:
        """In torch's schema language."""
        if self.shape is not None:
            return "Tensor?" if self.optional else "Tensor"
        wants = len(self.names("wants"))
        return f"bool[{wants}]" if wants > 1 else next(_SCHEMA[word] for word in self.words if word in _SCHEMA)

    def numbers(self, places: dict[str, int], checks: list[str]) -> list[int]:
        """As csrc/spec.h takes it, given the place of each parameter and the names of the core's checks."""
        flags = (self.optional or "if" in self.words, self.output, "rows_apart" in self.words, "filled" in self.words)
        other = places[self.words["with"]] if "with" in self.words else -1
        mine = [word for word in self.words if word in CHECKS]
        sizes = [Dimension.of(name) for name in self.names("size")] or self.shape or ()
        kind = 0 if self.shape is not None else max(_KINDS.get(word, 1) for word in self.words)
        numbers = [kind, _TYPES[self.dtype], *map(int, flags), *self.bounds, other, len(self.shape or ()), len(mine)]
        rows = [d.numbers() for d in sizes] + [[0] * 5] * (4 - len(sizes))
        for word in mine:
            bound, arrays = _inside(self.words[word])
            others = [*(places[name] for name in arrays), -1, -1]
            rows.append([checks.index(word), *bound.numbers(), *others[:2]])
        return [n for row in (numbers, *rows) for n in row] + [0] * 8 * (2 - len(mine))


_SCHEMA = {"flag": "bool", "switch": "bool", "wants": "bool", "size": "SymInt", "integer": "int"}
_SCHEMA |= {"number": "float", "bits": "int"}
_KINDS = {"number": 2, "bits": 3}  # what is no array, as csrc/spec.h counts; 1 is a whole number
_WORDS = {"int64", "int32", "rows_apart", "filled", "late", "with", "added", "if", *_SCHEMA}
_COUNTED = "torch.library.get_ctx().new_dynamic_size()"  # for tracing
_TYPES = {dtype: np.dtype(str(dtype)[6:]).num for dtype in (torch.float32, torch.int64, torch.int32)}


def _inside(text: str) -> tuple[Dimension, list[str]]:
    """The dimension, or the names of arrays, in the parentheses of a check."""
    names = [name.strip() for name in text.split(",")] if text[:1].islower() else []
    return Dimension.of("0" if names else text or "0"), names


def _require(right: object, what: str) -> None:
    if not right:
        raise ValueError(f"in a spec, {what}")


def _parameters(text: str, output: bool = False) -> list[Argument]:
    parameters = []
    understood = "".join(match[0] for match in _PARAMETER.finditer(text))
    _require(understood == text, f"only {understood!r} of {text!r} can be read")
    for name, optional, shape, words in _PARAMETER.findall(text):
        dimensions = tuple(map(Dimension.of, shape.split(","))) if shape else None
        known = dict(_WORD.findall(words))
        _require(known.keys() <= {*_WORDS, *CHECKS}, f"{name} has words that nobody knows: {words}")
        _require(dimensions or known.keys() & _SCHEMA.keys(), f"{name} has neither a shape nor a word for what it is")
        parameters.append(Argument(name, bool(optional), output, dimensions, known))
    return parameters


class Spec:
    """The text taken apart: what the kernel takes (`taken`), what the op takes (`inputs`), and the outputs of both."""

    def __init__(self, text: str) -> None:
        inputs, _, outputs = text.partition("->")
        taken, _, others = inputs.partition(";")
        self.taken = _parameters(taken)
        self.outputs = _parameters(outputs, output=True)
        self.inputs = self.taken + _parameters(others)
        self.counts = _COUNTED in self._sizes().values()  # then the kernel counts the outputs, and makes them all

    @property
    def schema(self) -> str:
        """In torch's schema language."""
        inputs = ", ".join(f"{p.type} {p.name}" for p in self.inputs)
        outputs = ", ".join(["Tensor"] * len(self.outputs))
        outputs = "Tensor[]" if self.counts else outputs if len(self.outputs) == 1 else f"({outputs})"
        return f"({inputs}) -> {outputs}"

    @cached_property
    def arguments(self) -> Callable[..., tuple]:
        """The kernel's arguments from the op's: what it takes, and new outputs, None where one is not wanted.

        It is written out as Python, as methods of a dataclass are: going through lists takes 3 to 6 times as long.
        """
        return self._function([p.name for p in self.taken] + [self._new(p) for p in self.outputs], self._sizes())

    @cached_property
    def wanted(self) -> Callable[..., tuple[bool, ...]]:
        """Whether each output is wanted, from the arguments of the op."""
        return self._function([self._condition(p) for p in self.outputs])

    def _function(self, expressions: list[str], sizes: dict[str, str] | None = None) -> Callable[..., tuple]:
        lines = [f"def function({', '.join(p.name for p in self.inputs)}):"]
        lines += [f"    {letter} = {size}" for letter, size in (sizes or {}).items()]
        namespace: dict[str, Any] = {"torch": torch}
        exec("\n".join([*lines, f"    return {', '.join(expressions)},"]), namespace)
        return namespace["function"]

    def _new(self, p: Argument) -> str:
        """The expression of an output without values."""
        tensors = [x for x in self.inputs if x.shape is not None]
        like = next((x for x in tensors if x.dtype == p.dtype), tensors[0])
        lengths = ", ".join(d.expression for d in p.shape or ())
        dtype = "" if like.dtype == p.dtype else f", dtype={p.dtype}"
        return f"{like.name}.new_empty({lengths}{dtype}) if {self._condition(p)} else None"

    def _sizes(self) -> dict[str, str]:
        """The expression of each letter of the outputs; from a tensor that is always there, if there is such a one."""
        used = {letter for p in self.outputs for d in p.shape or () for letter in d.factors}
        sizes = {p.words["size"]: p.name for p in self.inputs if "size" in p.words}
        for p in sorted(self.inputs, key=lambda p: p.optional):
            for axis, d in enumerate(p.shape or ()):
                if d.single in used and d.single not in sizes:
                    size = f"{p.name}.shape[{axis}]" + f" - {d.constant}" * (d.constant > 0)
                    size = f"({size}) // {d.factors[d.single]}" if d.factors[d.single] > 1 else size
                    sizes[d.single] = f"0 if {p.name} is None else {size}" if p.optional else size
        return dict.fromkeys(sorted(used), _COUNTED) | sizes

    def _condition(self, p: Argument) -> str:
        """The expression of whether an output is wanted."""
        conditions = []
        for name in p.names("if"):
            other = {x.name: x for x in self.inputs}[name]
            wants = other.names("wants")
            place = f"[{wants.index(p.name[1:])}]" if len(wants) > 1 else ""
            conditions.append(f"{name}{place}" + " is not None" * (other.shape is not None))
        return " and ".join(conditions) or "True"


# ---- arguments that do not fit ----


def check(name: str, parameters: list[Argument], given: Given, exact: bool = False) -> Sizes:
    """Raise ValueError or TypeError if these arguments do not fit, and return the sizes by letter.

    Parameters that are not given are not looked at. Tensors of floating point may have any dtype, unless it must be
    `exact`.
    """
    sizes: Sizes = {p.words["size"]: given[p.name] for p in parameters if "size" in p.words and p.name in given}
    known = [p for p in parameters if p.name in given]
    for p in sorted(known, key=lambda p: (p.output, "late" in p.words)):
        if p.shape is None:
            _check_number(name, p, given[p.name])
            continue
        present = given[p.name] is not None
        if not present and not p.optional and "if" not in p.words:
            raise TypeError(f"{name}: {p.name} must not be None")
        if "with" in p.words and present != (given[p.words["with"]] is not None):
            raise ValueError(f"{name}: {p.words['with']} and {p.name} go together")
        if present:
            _check_tensor(name, p, given[p.name], sizes, exact)
    for p in known:
        for word, inside in p.words.items():
            if word in CHECKS and given[p.name] is not None:
                bound, arrays = _inside(inside)
                others = [given[other] for other in arrays] or ([bound.size(sizes)] if inside else [])
                CHECKS[word](name, p.name, given[p.name], *others)
    return sizes


def _check_number(name: str, p: Argument, value: float) -> None:
    low, high = p.bounds
    if p.words.keys() & {"integer", "size"} and not low <= value <= high:
        raise ValueError(f"{name}: {p.name} must lie in {low}..{high}, not {value}")
    if p.words.get("number") and not low <= value < high:
        raise ValueError(f"{name}: {p.name} must lie in [{low}, {high}), not {value}")


def _check_tensor(name: str, p: Argument, x: Tensor, sizes: Sizes, exact: bool) -> None:
    if x.dtype != p.dtype and (exact or not (p.dtype.is_floating_point and x.dtype.is_floating_point)):
        raise TypeError(f"{name}: {p.name} must be {str(p.dtype)[6:]}, not {x.dtype}")
    shape = p.shape or ()
    before = dict(sizes)
    if x.dim() != len(shape) or not all(d.fits(n, sizes) for d, n in zip(shape, x.shape, strict=True)):
        wanted = ", ".join(d.show(before) for d in shape)
        raise ValueError(f"{name}: {p.name} must have shape [{wanted}], not {tuple(x.shape)}")
    if "filled" in p.words and not x.numel():
        raise ValueError(f"{name}: {p.name} must have a shape without 0, not {tuple(x.shape)}")


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
        at = tuple(wrong[0].tolist())
        place = ", ".join(map(str, at))
        raise ValueError(f"{kernel}: {name}[{place}] = {int(index[at])} is not an index below {bound}")


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


CHECKS: dict[str, Callable[..., None]] = {"offsets": check_offsets, "index": check_index, "rising": _check_rising}
CHECKS |= {"permutation": _check_permutation, "scenes": _check_scenes, "segments": _check_segments}
CHECKS |= {"corners": _check_corners}


def segment_of(offsets: Tensor) -> Tensor:
    """[N] int64: the segment of each row, from the offsets [C + 1] of the segments."""
    return torch.arange(len(offsets) - 1, device=offsets.device).repeat_interleave(offsets.diff())
