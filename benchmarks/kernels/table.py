"""Prints the table of a result file of benchmarks.kernels: `python -m benchmarks.kernels.table FILE`."""

from __future__ import annotations

import json
import sys
from pathlib import Path


def rows(results: dict) -> list[str]:
    """One Markdown row a case: our minimum, the rate, and how many times as long each peer takes (by minima)."""
    lines = ["| op | size | ours | rate | times ours |", "| --- | --- | --- | --- | --- |"]
    for record in results["records"]:
        if "ours" not in record:
            continue
        rate = ""
        if record.get("share_of_peak"):
            rate = f"{record['gflops']:.0f} GF/s, {record['share_of_peak']:.0%} of peak"
        elif "nanoseconds_per_item" in record:
            rate = f"{record['nanoseconds_per_item']:.1f} ns each"
        peers = [f"{name} {peer['ratio_of_min']:.1f}" for name, peer in record["peers"].items()]
        peers += [f"{name}: not run" for name in record["missing"]]
        seconds = record["ours"]["min"]
        lines.append(f"| {record['op']} | {record['shape']} | {1e3 * seconds:.3g} ms | {rate} | {', '.join(peers)} |")
    return lines


if __name__ == "__main__":
    print("\n".join(rows(json.loads(Path(sys.argv[1]).read_text()))))
