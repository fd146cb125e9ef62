"""Nodes and elements that a deck of Abaqus makes from others: *NGEN, *NFILL, *NCOPY, *ELGEN and *ELCOPY.

    *NGEN    nodes on the line or the arc between two nodes
    *NFILL   nodes on the lines between the nodes of two sets, in the order of the sets
    *NCOPY   a set of nodes that is moved, turned or mirrored
    *ELGEN   rows and layers of elements like one element
    *ELCOPY  a set of elements on other nodes

Nodes are made of what others are at this place of the deck.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ast_sim.importers.decks.deck_axes import from_angles, placement_of
from ast_sim.importers.decks.deck_numbers import real, tokens, whole
from ast_sim.importers.decks.deck_parts import Content, ElementBlock
from ast_sim.importers.decks.keyword_lines import Keyword, Line
from ast_sim.support.errors import DatasetError, counted

# What one line may make; a wrong number would fill the memory.
_MOST = 20_000_000

# Radii at the two ends of an arc may differ by this share.
_SAME_RADIUS = 1e-3

# The nodes of elements that are mirrored, by their kind.
_MIRRORED = {
    "triangle": [0, 2, 1],
    "triangle6": [0, 2, 1, 5, 4, 3],
    "quad": [0, 3, 2, 1],
    "quad8": [0, 3, 2, 1, 7, 6, 5, 4],
    "tetra": [0, 2, 1, 3],
    "tetra10": [0, 2, 1, 3, 6, 5, 4, 7, 9, 8],
    "pyramid": [0, 3, 2, 1, 4],
    "wedge": [0, 2, 1, 3, 5, 4],
    "wedge15": [0, 2, 1, 3, 5, 4, 8, 7, 6, 11, 10, 9, 12, 14, 13],
    "hexahedron": [0, 3, 2, 1, 4, 7, 6, 5],
    "hexahedron20": [0, 3, 2, 1, 4, 7, 6, 5, 11, 10, 9, 8, 15, 14, 13, 12, 16, 19, 18, 17],
}


def nodes_made(keyword: Keyword, content: Content, numbers_of: Callable[[str], np.ndarray]) -> np.ndarray:
    """Add the nodes that *NGEN, *NFILL or *NCOPY make to a content. The numbers of the set that they go into: the new
    nodes, and the ones that lie at the ends of their lines.

    Args:
        numbers_of: the nodes of a set by its name, in its order.

    Raises:
        DatasetError: something is missing, contradicts itself or is not understood; the text names the line.
    """
    if keyword.name == "NCOPY":
        numbers, points = _copied(keyword, content, numbers_of)
        content.nodes.append((numbers, points))
        return numbers
    members = [np.zeros(0, np.int64)]
    for line in keyword.data:  # a line may go on from the nodes of the line before it
        make = _between if keyword.name == "NGEN" else _filled
        numbers, points, ends = make(keyword, line, content, numbers_of)
        content.nodes.append((numbers, points))
        members += [numbers, ends]
    return np.concatenate(members)


def _points(keyword: Keyword, content: Content, numbers: np.ndarray) -> np.ndarray:
    """[n, 3]: where nodes are."""
    try:
        places = content.node_places.find([block[0] for block in content.nodes], numbers, "node")
    except LookupError as error:
        raise keyword.error(str(error)) from None
    return np.array([content.nodes[block][1][row] for block, row in places]).reshape(-1, 3)


def _entries(keyword: Keyword, line: Line, most: int) -> list[str]:
    """The entries of a data line, empty ones behind them."""
    entries = tokens(line)
    if len(entries) > most:
        raise keyword.error(f"{line.place} has {len(entries)} entries; must have at most {most}")
    return [*entries, *[""] * most][:most]


def _require_few(keyword: Keyword, line: Line, count: int) -> None:
    if count > _MOST:
        raise keyword.error(f"{line.place} makes {count} of them; must be at most {_MOST}")


def _between(
    keyword: Keyword, line: Line, content: Content, _: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    entries = _entries(keyword, line, 10)
    first, last, step = whole(entries[0], line), whole(entries[1], line), whole(entries[2] or "1", line)
    if step == 0 or (last - first) % step or (last - first) // step < 0:
        raise keyword.error(f"{line.place}: steps of {step} do not lead from {first} to {last}")
    count = (last - first) // step
    _require_few(keyword, line, count)
    numbers = first + step * np.arange(count + 1)
    ends = _points(keyword, content, numbers[[0, -1]])
    share = np.linspace(0, 1, count + 1)[:, None]
    kind = keyword.options.get("LINE", "").upper()
    if kind not in ("", "C"):
        raise keyword.error(f"LINE={kind} is not understood here: write the nodes out")
    if not kind and any(entries[3:]):
        raise keyword.error(f"{line.place} has more than three entries; a straight line has no other point (no LINE=C)")
    points = _arc(keyword, line, content, entries, ends, share) if kind else ends[0] * (1 - share) + ends[1] * share
    return numbers[1:-1], points[1:-1], numbers[[0, -1]]


def _arc(
    keyword: Keyword, line: Line, content: Content, entries: list[str], ends: np.ndarray, share: np.ndarray
) -> np.ndarray:
    """Points on the arc about a centre: the shorter way, or counterclockwise about a normal."""
    if entries[3] and any(entries[4:7]):
        raise keyword.error(f"{line.place} has a node and coordinates for the centre; must have one of them")
    if entries[3]:
        centre = _points(keyword, content, np.array([whole(entries[3], line)]))[0]
    else:
        centre = np.array([real(text, line) for text in entries[4:7]])
        system = keyword.options.get("SYSTEM", "RC").upper()
        if system not in ("RC", "C", "S"):
            raise keyword.error(f"SYSTEM={system} is not known; must be RC, C or S")
        centre = centre if system == "RC" else from_angles(centre[None], system == "S")[0]
    one, other = ends - centre
    radii = np.linalg.norm([one, other], axis=1)
    if radii.min() <= 0 or np.ptp(radii) > _SAME_RADIUS * radii.max():
        raise keyword.error(f"{line.place}: the ends of the arc are {radii[0]:g} and {radii[1]:g} from its centre")
    normal = np.array([real(text, line) for text in entries[7:10]])
    if any(entries[7:10]):
        normal /= max(np.linalg.norm(normal), np.finfo(float).tiny)
        if (
            np.linalg.norm(normal) < 0.5
            or abs(ends - centre).max() * _SAME_RADIUS < abs((ends - centre) @ normal).max()
        ):
            raise keyword.error(f"{line.place}: the last three entries are no normal of the arc")
        angle = np.arctan2(np.cross(one, other) @ normal, one @ other) % (2 * np.pi) or 2 * np.pi
    else:
        normal = np.cross(one, other)
        size = np.linalg.norm(normal)
        if size < 1e-6 * radii[0] ** 2:
            raise keyword.error(f"{line.place}: an arc of 180 degrees or more needs a normal in its last three entries")
        normal = normal / size
        angle = np.arctan2(size, one @ other)
    x = one / radii[0]
    turned = np.cos(angle * share) * x + np.sin(angle * share) * np.cross(normal, x)
    return centre + turned * (radii[0] + share * (radii[1] - radii[0]))


def _filled(
    keyword: Keyword, line: Line, content: Content, numbers_of: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    name, other_name, intervals, increment = _entries(keyword, line, 4)
    first, last = numbers_of(name.strip('"')), numbers_of(other_name.strip('"'))
    if len(first) != len(last):
        raise keyword.error(
            f"{line.place}: the sets {name} and {other_name} have {len(first)} and {len(last)} nodes; must have equally"
            " many"
        )
    count, step = whole(intervals or "1", line), whole(increment or "1", line)
    _require_few(keyword, line, count * len(first))
    if count < 1 or step == 0:
        raise keyword.error(f"{line.place}: {counted(count, 'interval')} in steps of {step}")
    shares = _shares(keyword, count)[:, None]
    numbers = first[:, None] + step * np.arange(1, count)
    if (numbers < 1).any():
        raise keyword.error(f"{line.place} makes a node {numbers.min()}; numbers must be at least 1")
    one, other = _points(keyword, content, first)[:, None], _points(keyword, content, last)[:, None]
    points = one * (1 - shares) + other * shares
    return numbers.ravel(), points.reshape(-1, 3), np.concatenate([first, last])


def _shares(keyword: Keyword, count: int) -> np.ndarray:
    """[count - 1]: where the nodes between two others lie. BIAS is the ratio of an interval to the next one; with TWO
    STEP pairs of equal intervals have it, so nodes in the middle of edges stay there."""
    bias = real(keyword.options.get("BIAS") or "1", keyword.line)
    pairs = "TWOSTEP" in keyword.options
    if not bias > 0 or (pairs and count % 2):
        raise keyword.error(
            f"BIAS={bias:g} of {counted(count, 'interval')}; must be above 0, and TWO STEP needs an even number"
        )
    lengths = bias ** -(np.arange(count) // (2 if pairs else 1)).astype(float)
    if not np.isfinite(lengths.sum()):
        raise keyword.error(f"BIAS={bias:g} of {counted(count, 'interval')} makes intervals of no length")
    return (np.cumsum(lengths) / lengths.sum())[:-1]


def _copied(
    keyword: Keyword, content: Content, numbers_of: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    change = whole(keyword.required("CHANGENUMBER"), keyword.line)
    numbers = numbers_of(keyword.required("OLDSET"))
    blocks = [block[0] for block in content.nodes]
    numbers = numbers[np.isin(numbers, np.concatenate([np.zeros(0, np.int64), *blocks]))]  # sets may list other nodes
    points = _points(keyword, content, numbers)
    if numbers.size and numbers.min() + change < 1:
        raise keyword.error(f"makes a node {numbers.min() + change}; numbers must be at least 1")
    manner = [name for name in ("SHIFT", "REFLECT", "POLE") if name in keyword.options]
    if manner == ["SHIFT"]:
        times = whole(keyword.options.get("MULTIPLE") or "1", keyword.line)
        rotation, shift = placement_of(keyword, times)
        return numbers + change, points @ rotation.T + shift
    if manner != ["REFLECT"]:
        raise keyword.error(f"has {' and '.join(manner) or 'no manner'}; SHIFT or REFLECT can be read: write it out")
    return numbers + change, _reflected(keyword, points)


def _reflected(keyword: Keyword, points: np.ndarray) -> np.ndarray:
    kind = keyword.options["REFLECT"].upper()
    needed = {"POINT": 3, "LINE": 6, "MIRROR": 9}.get(kind, 0)
    given = [_entries(keyword, line, 6) for line in keyword.data]
    values = [real(text, line) for row, line in zip(given, keyword.data, strict=True) for text in row[:6]][:needed]
    if not needed or len(given) != (2 if kind == "MIRROR" else 1):
        raise keyword.error(
            f"REFLECT={kind} with {counted(len(given), 'line')}; POINT and LINE must have one, MIRROR two"
        )
    origin, *others = np.array(values).reshape(-1, 3)
    offset = points - origin
    if kind == "POINT":
        return origin - offset
    axis = others[0] - origin
    axis = np.cross(axis, others[1] - origin) if kind == "MIRROR" else axis
    size = np.linalg.norm(axis)
    if not size > 0:
        raise keyword.error("its points lie on a line" if kind == "MIRROR" else "its two points lie at one place")
    along = (offset @ axis / size**2)[:, None] * axis
    return points - 2 * along if kind == "MIRROR" else origin - offset + 2 * along


def elements_made(
    keyword: Keyword, content: Content, numbers_of: Callable[[str], np.ndarray]
) -> tuple[np.ndarray, Counter[str]]:
    """Add the elements that *ELGEN or *ELCOPY makes to a content. The numbers of the set that they go into: the new
    ones, and the ones that *ELGEN multiplies; and how many of which type are left out.

    Args:
        numbers_of: the elements of a set by its name.

    Raises:
        DatasetError: something is missing, contradicts itself or is not understood; the text names the line.
    """
    if content.users_own:
        raise keyword.error("beside elements of a user's own it is not understood here: write the mesh out")
    if keyword.name == "ELCOPY":
        if keyword.data:
            raise DatasetError(f"{keyword.data[0].place}: a data line of *ELCOPY, which has none")
        copies = list(_copies(keyword, content, numbers_of(keyword.required("OLDSET"))))
        content.blocks.extend(copies)
        return np.concatenate([np.zeros(0, np.int64), *(block.numbers for block in copies)]), Counter()
    numbers = [np.zeros(0, np.int64)]
    left_out: Counter[str] = Counter()
    for line in keyword.data:
        master, block = _like(keyword, line, content)
        numbers.append(np.array([master]))
        if isinstance(block, int):
            left_out[content.left_out[master]] += block
        else:
            content.blocks.append(block)
            numbers.append(block.numbers)
    return np.concatenate(numbers), left_out


def _like(keyword: Keyword, line: Line, content: Content) -> tuple[int, ElementBlock | int]:
    """An element, and the ones that are made like it; or how many, if it is left out."""
    entries = _entries(keyword, line, 10)
    master = whole(entries[0], line)
    counts = [whole(text or "1", line) for text in (entries[1], entries[4], entries[7])]
    steps = [entries[2:4], entries[5:7], entries[8:10]]
    if min(counts) < 1 or any(n > 1 and not all(step) for n, step in zip(counts[1:], steps[1:], strict=True)):
        raise keyword.error(f"{line.place}: a row or a layer has no elements, or no steps to them")
    _require_few(keyword, line, counts[0] * counts[1] * counts[2])
    try:
        blocks = [block.numbers for block in content.blocks]
        block, row = content.element_places.find(blocks, np.array([master]), "element")[0]
    except LookupError as error:
        if master in content.left_out:
            return master, counts[0] * counts[1] * counts[2] - 1
        raise keyword.error(str(error)) from None
    like = content.blocks[block]
    node_steps, own_steps = np.array([[whole(text or "1", line) for text in step] for step in steps]).T
    grid = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)[1:]
    nodes = _plain_nodes(keyword, like)[row] + (grid @ node_steps)[:, None]
    return master, replace(like, numbers=master + grid @ own_steps, nodes=nodes, keyword=keyword)


def _copies(keyword: Keyword, content: Content, numbers: np.ndarray) -> Iterator[ElementBlock]:
    change, node_change = (whole(keyword.required(name), keyword.line) for name in ("ELEMENTSHIFT", "SHIFTNODES"))
    for block in content.blocks:
        kept = np.isin(block.numbers, numbers)
        if not kept.any():
            continue
        nodes = _plain_nodes(keyword, block)[kept] + node_change
        if "REFLECT" in keyword.options:
            if block.kind not in _MIRRORED:
                raise keyword.error(f"REFLECT of elements of the type {block.type_name} is not understood here")
            nodes = nodes[:, _MIRRORED[block.kind]]
        yield replace(block, numbers=block.numbers[kept] + change, nodes=nodes, keyword=keyword)


def _plain_nodes(keyword: Keyword, block: ElementBlock) -> np.ndarray:
    if not isinstance(block.nodes, np.ndarray):
        raise keyword.error("its elements have nodes of several instances: write the mesh out")
    return block.nodes
