"""Times every op beside its torch composition and beside the best peers that can be installed.

`python -m benchmarks.kernels --json FILE`. Within a case, our op and the peers take turns, so that other load on the
machine meets all of them. Every sample is kept. Results are compared before any time is taken.
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import torch

import ast_sim
from ast_sim.ops.library import configuration
from ast_sim.support.provenance import provenance
from benchmarks.kernels.case import Case
from benchmarks.kernels.peak import peak
from benchmarks.kernels.targets import judge

FAMILIES = (
    "octree",
    "fps",
    "sparse_conv",
    "attention",
    "segment",
    "elastic_forces",
    "elastic_stiffness",
    "proximity",
    "mesh",
    "message",
    "linear",
)
SHORTEST = 2e-3  # seconds of a sample at least: faster calls are repeated within it


def seconds_of(function: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls


def measure(case: Case, repeats: int, limit: float | None) -> dict:
    """One record: all samples in seconds a call, of ours and of each peer, their minima, medians and ratios."""
    case.check()
    functions = {"ours": case.ours, **case.peers}
    calls = {name: max(1, round(SHORTEST / seconds_of(f, 1))) for name, f in functions.items()}
    samples: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            samples[name].append(seconds_of(function, calls[name]))
    best = {name: min(x) for name, x in samples.items()}
    median = {name: statistics.median(x) for name, x in samples.items()}
    record = {
        "op": case.op,
        "shape": case.shape,
        "threads": torch.get_num_threads(),
        "ours": {"min": best["ours"], "median": median["ours"], "samples": samples["ours"]},
        "peers": {
            name: {
                "min": best[name],
                "median": median[name],
                "ratio_of_min": best[name] / best["ours"],
                "ratio_of_median": median[name] / median["ours"],
                "samples": samples[name],
            }
            for name in case.peers
        },
        "missing": case.missing,
    }
    if case.items:
        record["nanoseconds_per_item"] = best["ours"] / case.items * 1e9
    if case.flops:
        record["gflops"] = case.flops / best["ours"] / 1e9
        record["share_of_peak"] = record["gflops"] / limit if limit else None
    return judge(record)


def line_of(record: dict) -> str:
    rate = f"{record['gflops']:.0f} GF/s" if "gflops" in record else ""
    if record.get("share_of_peak"):
        rate += f" ({record['share_of_peak']:.0%} of peak)"
    if "nanoseconds_per_item" in record:
        rate += f" {record['nanoseconds_per_item']:.1f} ns/item"
    ours = record["ours"]
    text = f"{record['op']}, {record['shape']}: {ours['min'] * 1e3:.3f} ms, median {ours['median'] * 1e3:.3f}, {rate}"
    for name, peer in record["peers"].items():
        text += f"\n    {name}: {peer['min'] * 1e3:.3f} ms, {peer['ratio_of_min']:.2f} x ours"
        text += f" (medians {peer['ratio_of_median']:.2f} x)"
    for name, reason in record["missing"].items():
        text += f"\n    {name}: not measured, {reason}"
    if record.get("reached") is not None:
        text += f"\n    target {'reached' if record['reached'] else 'NOT reached'}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="write all records and samples here")
    parser.add_argument("--threads", type=int, default=2, help="threads of torch and of the core (%(default)s)")
    parser.add_argument("--repeats", type=int, default=20, help="samples of each function (%(default)s)")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES, help="only these")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    ast_sim.keep_memory()
    limits = peak(arguments.threads)
    header = {
        **provenance(" ".join(["python -m benchmarks.kernels", *sys.argv[1:]])),
        "configuration": configuration(),
        "peer_versions": {name: metadata.version(name) for name in ("fpsample", "spconv") if _installed(name)},
        "peak_gflops_by_threads": limits,
    }
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    records: list[dict] = []
    for family in arguments.families:
        for record in _measure_family(family, arguments.repeats, limits and limits[str(arguments.threads)]):
            records.append(record)
            # After every case, so that a long run that is cut off leaves what it found.
            arguments.json.write_text(json.dumps({**header, "records": records}, indent=1) + "\n")


def _measure_family(family: str, repeats: int, limit: float | None) -> Iterator[dict]:
    try:
        module = importlib.import_module(f"benchmarks.kernels.{family}")
    except ImportError as error:
        print(f"{family}: not measured, {error}", flush=True)
        yield {"op": family, "missing": {str(error.name): f"cannot be imported: {error}"}}
        return
    for case in module.cases():
        record = measure(case, repeats, limit)
        print(line_of(record), flush=True)
        yield record


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


if __name__ == "__main__":
    main()
