"""The target of each benchmark, and whether a record reaches it.

Op and shape name a record of benchmarks.kernels. The preset and what is timed name a record of
benchmarks.steps.training_step. `judge` adds to a record `peer` (the best peer and its time) and `ratio` (the peer's
time over ours, by minima). If the record has a target, `judge` also adds `target` and `reached`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

GIGABYTE = 1e9


@dataclass(frozen=True)
class Target:
    """Bounds on the numbers of a record.

    Attributes:
        name: pattern of "op | shape" or "preset, what | shape".
        least: lower bounds by name of the number.
        most: upper bounds.
        peers: pattern of the peers that the ratio counts; the best of them decides.
        nodes: the least number of nodes, where a preset is timed at several sizes.
    """

    name: str
    least: dict[str, float] = field(default_factory=dict)
    most: dict[str, float] = field(default_factory=dict)
    peers: str = ""
    nodes: int = 0


def _attention(what: str, *sizes: tuple[int, int]) -> str:
    shapes = "|".join(f"{queries} queries, {keys} keys" for queries, keys in sizes)
    return rf"^attention, {what} \| 1 x ({shapes}), 8 heads x 64$"


TARGETS = (
    Target(r"^linear, forward \| 100000 x 128 x 128$", {"share_of_peak": 0.80, "ratio": 2}, peers=r"F\.linear"),
    Target(r"^linear, forward \| 512 x 512 x 1024$", {"share_of_peak": 0.85, "ratio": 2}, peers=r"F\.linear"),
    Target(r"^mlp with LayerNorm, forward and backward \| 100000 x ", {"ratio": 3}),
    Target(
        _attention("forward", (512, 512), (512, 100_000), (100_000, 512), (4096, 4096)),
        {"share_of_peak": 0.68, "ratio": 1.8},
        peers="SDPA",
    ),
    Target(
        _attention("forward and backward, dropout 0.1", (512, 512), (512, 8192), (4096, 4096)),
        {"share_of_peak": 0.60, "ratio": 5},
        peers="SDPA",
    ),
    Target(
        r"^sparse_conv, forward and backward \| levels 12 to 8, (9\d|10\d)\d{3} cells",
        {"share_of_peak": 0.55, "ratio": 4},
    ),
    Target(r"^farthest_point_sample \| (100000 cells to 512|50000 cells to 4096)$", {"ratio": 8}, peers="fpsample"),
    Target(r"^octree_levels \| 100000 points", {"ratio": 8}, peers="torch"),
    Target(r"^message passing, forward \| .*: 1[12]\d{5} edges", {"share_of_peak": 0.70, "ratio": 4}),
    Target(r"^message passing, forward and backward \| .*: 1[12]\d{5} edges", {"share_of_peak": 0.60, "ratio": 4}),
    Target(r"^tiny, training step", {"ratio": 2.5}, {"python_share": 0.10}),
    Target(r"^deforming_plate, training step", {"ratio": 3, "share_of_peak": 0.45}),
    Target(
        r"^abcd_xl, training step",
        {"ratio": 4},
        {"resident_gigabytes": 8, "growth_exponent": 1.05},
        nodes=50_000,
    ),
    Target(r"^deforming_plate, rollout step", most={"outside_kernels_share": 0.15}),
    Target(r"^abcd_xl, rollout step", most={"outside_kernels_share": 0.15}, nodes=50_000),
)


def name_of(record: dict) -> str:
    what = record["op"] if "op" in record else f"{record['preset']}, {record['what']}"
    return f"{what} | {record.get('shape', '')}"


def peers_of(record: dict) -> dict[str, float]:
    """Seconds of each peer that was measured."""
    if "samples" in record:
        return {name: times["min"] for name, times in record["samples"].items() if name != "ours"}
    return {name: times["min"] for name, times in record.get("peers", {}).items()}


def seconds_of(record: dict) -> float | None:
    """Our own, if it was measured."""
    times = record["samples"]["ours"] if "samples" in record else record.get("ours")
    return times and times["min"]


def best_peer(record: dict, pattern: str = "") -> tuple[str, float] | None:
    peers = {name: t for name, t in peers_of(record).items() if re.search(pattern, name)}
    return min(peers.items(), key=lambda x: x[1]) if peers else None


def target_of(record: dict) -> Target | None:
    for target in TARGETS:
        if re.search(target.name, name_of(record)) and record.get("nodes", 0) >= target.nodes:
            return target
    return None


def numbers_of(record: dict, target: Target) -> dict[str, float]:
    """The numbers that bounds may name."""
    numbers = {k: v for k, v in record.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    peer, ours = best_peer(record, target.peers), seconds_of(record)
    numbers.pop("ratio", None)
    if peer and ours:
        numbers["ratio"] = peer[1] / ours
    if "ours" in record.get("peak_resident_bytes", {}):
        numbers["resident_gigabytes"] = record["peak_resident_bytes"]["ours"] / GIGABYTE
    return numbers


def judge(record: dict) -> dict:
    """The record itself, with `peer`, `ratio`, and `target` and `reached` if there is a target for it.

    A bound on a number that was not measured (a peer that cannot run) is left out, but named in `target`; without any
    measured number `reached` is None.
    """
    for name in ("peer", "ratio", "target", "reached"):
        record.pop(name, None)
    peer, ours = best_peer(record), seconds_of(record)
    if peer and ours:
        record["peer"] = {"name": peer[0], "min": peer[1]}
        record["ratio"] = peer[1] / ours
    target = target_of(record)
    if target:
        numbers = numbers_of(record, target)
        record["target"] = {"least": target.least, "most": target.most, "peers": target.peers}
        held = [numbers[k] >= bound for k, bound in target.least.items() if k in numbers]
        held += [numbers[k] <= bound for k, bound in target.most.items() if k in numbers]
        record["reached"] = all(held) if held else None
    return record
