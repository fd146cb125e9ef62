"""CAD-like solids from a seeded grammar: each is a name and the steps that make it."""

from __future__ import annotations

from typing import Any

import numpy as np

Steps = list[dict[str, Any]]


def draw_solid(rng: np.random.Generator) -> tuple[str, Steps]:
    """Draw a solid: its name and the steps that make it. Each step adds, cuts or intersects one primitive.

    Lengths are in units of about the size of the part. Walls are at least 0.12 thick, so a mesh of 1,000 nodes has more
    than one element across a wall.
    """
    name, draw = list(_SOLIDS.items())[rng.integers(len(_SOLIDS))]
    return name, [{key: _plain(value) for key, value in step.items()} for step in draw(rng)]


def _plain(value: Any) -> Any:
    """Numbers and lists of numbers, in the types that JSON knows."""
    return value if isinstance(value, str) else np.asarray(value, float).tolist()


def _step(do: str, shape: str, **arguments: Any) -> dict[str, Any]:
    return {"do": do, "shape": shape, **arguments}


def _bore(size: np.ndarray, axis: int, radius: float, at: tuple[float, float]) -> dict[str, Any]:
    """A hole along `axis` through a box [0, size]. Its centre lies at the shares `at` of the two other sides."""
    start, direction = np.zeros(3), np.zeros(3)
    start[axis] = -0.1
    direction[axis] = size[axis] + 0.2
    others = [i for i in range(3) if i != axis]
    start[others] = size[others] * at
    return _step("cut", "cylinder", at=start, axis=direction, radius=radius)


def _block_with_holes(rng: np.random.Generator) -> Steps:
    size = rng.uniform([0.8, 0.6, 0.35], [1.2, 0.9, 0.6])
    steps = [_step("add", "slab", at=[0, 0, 0], size=size, corner=rng.uniform(0.08, 0.2))]
    count = int(rng.integers(1, 4))
    radius = rng.uniform(0.08, 0.16, count)
    for i in range(count):
        share = (i + rng.uniform(0.4, 0.6)) / count
        room = min(size[0] / count, size[1]) / 2 - 0.12
        steps.append(_bore(size, 2, min(radius[i], room), (share, rng.uniform(0.45, 0.55))))
    if rng.random() < 0.3:
        steps.append(_bore(size, 1, 0.25 * size[2], (rng.uniform(0.3, 0.7), 0.5)))
    return steps


def _cylinder_with_boss(rng: np.random.Generator) -> Steps:
    radius, height = rng.uniform([0.35, 0.25], [0.5, 0.5])
    boss, boss_height, bore = rng.uniform([0.5, 0.15, 0.4], [0.75, 0.4, 0.6]) * [radius, 1, 1]
    steps = [
        _step("add", "cylinder", at=[0, 0, 0], axis=[0, 0, height], radius=radius),
        _step("add", "cylinder", at=[0, 0, 0], axis=[0, 0, height + boss_height], radius=boss),
    ]
    if rng.random() < 0.5 and boss * bore > 0.08:
        room = min(boss * bore, boss - 0.12)
        steps.append(_step("cut", "cylinder", at=[0, 0, -0.1], axis=[0, 0, 1.5], radius=max(room, 0.06)))
    if rng.random() < 0.4:
        flat = rng.uniform(0.75, 0.9) * radius
        steps.append(_step("cut", "box", at=[flat, -1, -0.1], size=[1, 2, height + 0.1]))
    return steps


def _finned_plate(rng: np.random.Generator) -> Steps:
    fins = int(rng.integers(2, 5))
    thickness, gap, width, base, height = rng.uniform([0.13, 0.14, 0.5, 0.15, 0.2], [0.2, 0.22, 0.9, 0.3, 0.4])
    length = fins * thickness + (fins - 1) * gap
    steps = [_step("add", "box", at=[0, 0, 0], size=[length, width, base])]
    for i in range(fins):
        steps.append(_step("add", "box", at=[i * (thickness + gap), 0, 0], size=[thickness, width, base + height]))
    return steps


def _bracket(rng: np.random.Generator) -> Steps:
    length, width, height, thick = rng.uniform([0.8, 0.5, 0.6, 0.18], [1.1, 0.8, 0.9, 0.3])
    steps = [
        _step("add", "box", at=[0, 0, 0], size=[length, width, thick]),
        _step("add", "box", at=[0, 0, 0], size=[thick, width, height]),
        _step(
            "cut",
            "cylinder",
            at=[(length + thick) / 2, width / 2, -0.1],
            axis=[0, 0, thick + 0.2],
            radius=min(rng.uniform(0.08, 0.15), width / 2 - 0.13, (length - thick) / 2 - 0.13),
        ),
    ]
    if rng.random() < 0.5:
        middle = [-0.1, width / 2, (height + thick) / 2]
        steps.append(_step("cut", "cylinder", at=middle, axis=[thick + 0.2, 0, 0], radius=rng.uniform(0.07, 0.1)))
    if rng.random() < 0.5:
        rib = [thick / 2, width / 2, thick / 2]
        steps.append(_step("add", "cylinder", at=rib, axis=[0, width / 2, 0], radius=0.9 * thick))
    return steps


def _ring(rng: np.random.Generator) -> Steps:
    outer, height = rng.uniform([0.38, 0.25], [0.5, 0.6])
    inner = outer - rng.uniform(0.15, 0.25)
    steps = [
        _step("add", "cylinder", at=[0, 0, 0], axis=[0, 0, height], radius=outer),
        _step("cut", "cylinder", at=[0, 0, -0.1], axis=[0, 0, height + 0.2], radius=inner),
    ]
    if rng.random() < 0.4:
        depth = rng.uniform(0.3, 0.5) * height
        steps.append(_step("cut", "box", at=[-1, -0.1, height - depth], size=[2, 0.2, 1]))
    return steps


def _profile(rng: np.random.Generator) -> Steps:
    """A U, T or H profile."""
    kind = rng.integers(3)
    length, width, height = rng.uniform([0.7, 0.6, 0.5], [1.1, 0.9, 0.8])
    wall = rng.uniform(0.15, 0.24)
    foot = _step("add", "box", at=[0, 0, 0], size=[length, width, wall])
    if kind == 0:
        sides = [_step("add", "box", at=[0, y, 0], size=[length, wall, height]) for y in (0, width - wall)]
        return [foot, *sides]
    web = _step("add", "box", at=[0, (width - wall) / 2, 0], size=[length, wall, height])
    top = _step("add", "box", at=[0, 0, height - wall], size=[length, width, wall])
    return [foot, web] if kind == 1 else [foot, web, top]


def _stepped_shaft(rng: np.random.Generator) -> Steps:
    radius, length = rng.uniform([0.22, 0.35], [0.35, 0.5])
    ratio = rng.uniform(0.55, 0.8)
    steps = [
        _step("add", "cylinder", at=[0, 0, 0], axis=[length, 0, 0], radius=radius),
        _step("add", "cylinder", at=[length, 0, 0], axis=[length, 0, 0], radius=ratio * radius),
    ]
    if rng.random() < 0.5:
        steps.append(
            _step("add", "cone", at=[2 * length, 0, 0], axis=[0.2, 0, 0], radius=ratio * radius, radius_end=0.12)
        )
    return steps


def _dome(rng: np.random.Generator) -> Steps:
    """A block rounded by a ball, at times with a bore."""
    size = rng.uniform([0.6, 0.6, 0.5], [0.9, 0.9, 0.7])
    ball = 0.5 * rng.uniform(1.1, 1.3) * np.linalg.norm(size[:2])
    steps = [
        _step("add", "box", at=[0, 0, 0], size=size),
        _step("common", "sphere", at=[*size[:2] / 2, size[2] - ball], radius=ball),
    ]
    if rng.random() < 0.5:
        steps.append(_bore(size, int(rng.integers(2)), rng.uniform(0.09, 0.14), (0.5, 0.45)))
    return steps


def _flange(rng: np.random.Generator) -> Steps:
    """A round flange with a hub and bolt holes."""
    radius, thick, hub, height = rng.uniform([0.42, 0.15, 0.2, 0.35], [0.52, 0.22, 0.24, 0.6])
    bolts = int(rng.integers(3, 6))
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(bolts) / bolts
    middle = (radius + hub) / 2
    steps = [
        _step("add", "cylinder", at=[0, 0, 0], axis=[0, 0, thick], radius=radius),
        _step("add", "cylinder", at=[0, 0, 0], axis=[0, 0, height], radius=hub),
    ]
    for x, y in zip(middle * np.cos(angle), middle * np.sin(angle), strict=True):
        steps.append(_step("cut", "cylinder", at=[x, y, -0.1], axis=[0, 0, thick + 0.2], radius=0.055))
    return steps


_SOLIDS = {
    "block with holes": _block_with_holes,
    "cylinder with boss": _cylinder_with_boss,
    "finned plate": _finned_plate,
    "bracket": _bracket,
    "ring": _ring,
    "profile": _profile,
    "stepped shaft": _stepped_shaft,
    "dome": _dome,
    "flange": _flange,
}
