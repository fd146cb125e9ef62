"""Arrays of numbers: conversion from any type, checks that name what is wrong; the parts of a mesh."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from ast_sim.support.argument_checks import in_short, several
from ast_sim.support.errors import ConfigError, DatasetError, counted
from ast_sim.support.toml_settings import required_whole

# Rounding to float32 may move points by this share of the shortest edge before a warning is given.
_ROUNDING = 0.01

# Elements from which the search for connected parts makes pairs of nodes at a time. This limits its memory.
_ELEMENTS_AT_ONCE = 1 << 13


def real_numbers(name: str, array: str, value: Any) -> np.ndarray:
    """Numbers of any real type, an array or lists, as float32.

    Raises:
        DatasetError: these are no numbers, or a finite one is too large for float32; the text names `name` and `array`.
    """
    given = plain_array(name, array, value)
    if given.dtype.kind not in "fiu":
        raise DatasetError(f"{name}: {array} must be numbers, not {given.dtype}")
    with np.errstate(over="ignore", under="ignore"):
        single = np.array(given, np.float32, order="C")
    too_large = np.isfinite(given) & ~np.isfinite(single)
    if too_large.any():
        raise DatasetError(f"{name}: {array} holds {given[too_large][0]:g}, which is too large for float32")
    return single


def rounding(exact: np.ndarray, rounded: np.ndarray, elements: np.ndarray) -> list[str]:
    """One sentence if points [N, 3] lie elsewhere as float32, by a share of the shortest edge of elements [E, k]."""
    with np.errstate(invalid="ignore"):  # inf - inf; a check of the points tells of them
        off = float(np.abs(rounded - exact).max(initial=0))
        corners = exact[elements[:, :4]].astype(np.float64)
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    shortest = float(lengths[lengths > 0].min(initial=np.inf))
    if not off > _ROUNDING * shortest:
        return []
    farthest = float(np.abs(exact).max())
    return [
        f"rounding to float32 moves points by up to {off:.3g}, and the shortest edge is {shortest:.3g}: the mesh is too"
        f" fine for coordinates of up to {farthest:.3g}; move it to the origin"
    ]


def three_numbers(name: str, array: str, value: Any) -> np.ndarray:
    """A point or the like, three finite numbers of any real type, as [3] float64.

    Raises:
        DatasetError: these are others; the text names `name` and `array`.
    """
    numbers = real_numbers(name, array, value)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise DatasetError(f"{name}: {array} must be three finite numbers, not {np.asarray(value).tolist()}")
    return np.asarray(value, np.float64)


def whole_numbers(name: str, array: str, value: Any, dtype: type) -> np.ndarray:
    """Whole numbers of any type, an array or lists, as an array of the integer type `dtype`.

    Raises:
        DatasetError: one is not whole, or does not fit into the type; the text names `name`, `array` and the number.
    """
    given = plain_array(name, array, value)
    if given.dtype.kind not in "fiu":
        raise DatasetError(f"{name}: {array} must be whole numbers, not {given.dtype}")
    limits = np.iinfo(dtype)
    wrong = ~((given == np.round(given)) & (given >= limits.min) & (given <= limits.max))
    if wrong.any():
        at = [int(i) for i in np.argwhere(wrong)[0]]
        raise DatasetError(
            f"{name}: {array} holds {given[wrong][0]} at {at}; must be whole numbers of {np.dtype(dtype)}"
        )
    return np.array(given, dtype, order="C")


def plain_array(name: str, array: str, value: Any) -> np.ndarray:
    """An array of NumPy, from one or from lists.

    Raises:
        DatasetError: these are rows of different lengths, masked numbers or a tensor of torch with gradients.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise DatasetError(f"{name}: {array} has masked numbers: fill them, or leave out what they belong to")
    try:
        return np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise DatasetError(f"{name}: {array} must be an array: {error}") from error
    except (TypeError, RuntimeError) as error:  # a tensor of torch that has gradients, or is no plain array of numbers
        why = str(error).splitlines()[0]
        raise DatasetError(
            f"{name}: {array} is no array of NumPy: hand over .detach().float().numpy() ({why})"
        ) from error


def connected_parts(elements: np.ndarray, num_nodes: int) -> np.ndarray:
    """[N] int32: the connected part of the mesh that each node belongs to. Parts are numbered from 0 in the order of
    their lowest nodes."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    part = np.arange(num_nodes, dtype=np.int32)
    for start in range(0, len(elements), _ELEMENTS_AT_ONCE):
        corners = part[elements[start : start + _ELEMENTS_AT_ONCE]]
        # The edges from the first corner to all others connect the element, so the other edges are not needed.
        first = np.repeat(corners[:, 0], corners.shape[1] - 1)
        other = corners[:, 1:].ravel()
        graph = coo_array((np.ones(len(first), np.int8), (first, other)), shape=(num_nodes, num_nodes))
        part = connected_components(graph, directed=False)[1].astype(np.int32)[part]
    return part


def nodes_of_body(body: np.ndarray, number: int) -> np.ndarray:
    """[N] bool: the nodes of the body with this number; `body` [N] is as in `Scene`.

    Raises:
        ConfigError: it is no whole number, or there is no such body; the text names the existing bodies.
    """
    (number,) = required_whole(body=number)
    nodes = body == number
    if not nodes.any():
        numbers, counts = np.unique(body, return_counts=True)
        known = [f"{one} ({counted(count, 'node')})" for one, count in zip(numbers[:10], counts[:10], strict=True)]
        more = ["..."] if len(numbers) > 10 else []
        raise ConfigError(f"there is no body {number}; there are: {', '.join(known + more)}")
    return nodes


def require_array(name: str, array: str, value: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Raise DatasetError unless `value` has the dtype and the shape; None in `shape` allows any size."""
    if not isinstance(value, np.ndarray):
        raise DatasetError(f"{name}: {array} must be an array of {np.dtype(dtype)}, not {in_short(value)}")
    if value.dtype != dtype:
        raise DatasetError(f"{name}: {array} must be {np.dtype(dtype)}, not {value.dtype}")
    fits = len(value.shape) == len(shape) and all(w in (None, s) for s, w in zip(value.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise DatasetError(f"{name}: {array} has the shape {list(value.shape)}, must be [{wanted}]")


def require_nodes(name: str, kind: str, elements: np.ndarray, count: int) -> None:
    """Raise DatasetError naming the first of the `elements` [E, k] that refers to a node beyond 0 to `count` - 1."""
    outside = (elements < 0) | (elements >= count)
    if outside.any():
        row, corner = np.unravel_index(np.argmax(outside), outside.shape)
        node = elements[row, corner]
        raise DatasetError(f"{name}: {kind} {row} refers to node {node}, but the nodes are 0 to {count - 1}")


def require_finite(name: str, array: str, row: str, value: np.ndarray, first_frame: int = 0) -> None:
    """Raise DatasetError naming the first frame and row of `value`, [S, rows, F] or [rows, F], that is not finite."""
    finite = np.isfinite(value)
    if not finite.all():
        *frame, index, _ = np.unravel_index(np.argmin(finite), finite.shape)
        at = f"in frame {first_frame + frame[0]} at {row} {index}" if frame else f"of {row} {index}"
        raise DatasetError(f"{name}: {array} {at} is not finite: {value[*frame, index].tolist()}")


def ascending(name: str, numbers: Any) -> list[int]:
    """Whole numbers, each once, from the smallest to the largest.

    Raises:
        ConfigError: one is no whole number, or there is none; the text names the argument `name`.
    """
    chosen = {required_whole(**{name: number})[0] for number in several(name, numbers, "whole numbers")}
    if not chosen:
        raise ConfigError(f"{name} is empty: name at least one")
    return sorted(chosen)


def require_numbering(name: str, count: int, frames: Sequence[int] | None, times: Sequence[float] | None) -> None:
    """Raise DatasetError unless the numbers and the times of frames, where they are known, are `count` and ascend."""
    for what, values, kinds, kind in (("frames", frames, "iu", "whole numbers"), ("times", times, "iuf", "finite")):
        if values is None:
            continue
        if len(values) != count:
            raise DatasetError(f"{name}: {what} holds {counted(len(values), 'number')} for {counted(count, 'frame')}")
        are_numbers = np.asarray(values).dtype.kind in kinds
        if not are_numbers or not np.isfinite(values).all() or (np.diff(values) <= 0).any():
            raise DatasetError(f"{name}: {what} must be {kind} and ascend: {list(values)}")
    if frames is not None and frames[0] < 0:
        raise DatasetError(f"{name}: frames starts at {frames[0]}; the first frame of a motion is 0")


def require_whole_motion(name: str, numbers: Sequence[int], advice: str) -> None:
    """Raise ConfigError unless these are the numbers of all frames of a motion, 0, 1, 2 and so on; it ends with the
    advice."""
    if tuple(numbers) != tuple(range(len(numbers))):
        raise ConfigError(
            f"{name} has the frames {ranges(numbers)} of a motion: a model needs all frames from 0 on; {advice}"
        )


def ranges(numbers: Iterable[int]) -> str:
    """Ascending whole numbers as text: "0 to 5, 8, 10 to 12"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)


def percent(share: float, digits: int = 2) -> str:
    """A share as text, "1.2 %" or "100 %", never with an exponent."""
    return f"{_without_exponent(100 * share, digits)} %"


def measured_time(seconds: float) -> str:
    """A time that was measured as text, "28.3 ms" or "1.77 s", never with an exponent."""
    within_a_second = seconds < 0.9995
    return f"{_without_exponent(1000 * seconds, 3)} ms" if within_a_second else f"{_without_exponent(seconds, 3)} s"


def _without_exponent(value: float, digits: int) -> str:
    rounded = f"{float(value):.{digits}g}"
    return f"{Decimal(rounded):f}" if math.isfinite(value) else rounded


def point(x: Iterable[float]) -> str:
    """A point as text: (0.1, 2, 3)."""
    return "(" + ", ".join(f"{value:.6g}" for value in x) + ")"
