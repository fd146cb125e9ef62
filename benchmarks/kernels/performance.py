"""Writes docs/results/performance.md from the result files: `python -m benchmarks.kernels.performance`.

The files may come from any machine. They are benchmarks/results/kernels.json (from benchmarks.kernels) and
training_step.json (from benchmarks.steps.training_step).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from benchmarks.kernels import targets

RESULTS = Path(__file__).parents[1] / "results"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "performance.md"
FAMILIES = {
    "Dense layers": ("linear", "mlp"),
    "Message passing": ("message",),
    "Attention": ("attention",),
    "Sparse convolution": ("sparse_conv",),
    "Farthest point sampling": ("farthest_point_sample",),
    "Octree": ("octree",),
    "Sums over segments": ("segment", "column_sum"),
    "Elastic forces and stiffness": ("elastic_forces", "elastic_stiffness"),
    "Distance to other bodies": ("proximity",),
    "Meshes": ("mesh_edges", "outer_faces", "counting_sort"),
}
INTRODUCTION = """# How fast it is

Made by `python -m benchmarks.kernels.performance` from `benchmarks/results/`; do not edit.

Every case runs ours and its peers in turns on the same input, after their results were compared. Times are the shortest
of all samples. "Best peer" is the fastest of them, "ratio" its time over ours: 2 means that ours takes half the time.
"Peak" is what the processor reaches with multiply-adds on registers alone, measured in the same run; "of peak" is the
share of it that useful arithmetic has. Ratios hold for the processor that is named, and for no other; the share of peak
depends on it much less. "Target" is what was aimed at; where it is not reached, [the log](../log.md) has the reason.
"""
NUMBERS = {
    "share_of_peak": ("{:.2f} of peak", "at least"),
    "ratio": ("{:g} times {peer}", "at least"),
    "python_share": ("{:.0%} in Python", "below"),
    "outside_kernels_share": ("{:.0%} outside C kernels", "below"),
    "resident_gigabytes": ("{:g} GB resident", "at most"),
    "growth_exponent": ("growth exponent {:g}", "at most"),
}


def time_of(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def target_text(record: dict) -> str:
    target = record.get("target")
    if not target:
        return ""
    peer = {"SDPA": "SDPA", r"F\.linear": "`F.linear`", "fpsample": "fpsample"}.get(target["peers"], "the best peer")
    parts = []
    for name, bound in {**target["least"], **target["most"]}.items():
        text, relation = NUMBERS[name]
        parts.append(f"{relation} {text.format(bound, peer=peer)}")
    return ", ".join(parts)


def reached_text(record: dict) -> str:
    if "target" not in record:
        return ""
    return {True: "yes", False: "**no**", None: "not measured"}[record["reached"]]


def rate_of(record: dict) -> str:
    if record.get("gflops"):
        share = record.get("share_of_peak")
        return f"{record['gflops']:.0f} GF/s" + (f", {share:.2f} of peak" if share else "")
    if "nanoseconds_per_item" in record:
        return f"{record['nanoseconds_per_item']:.1f} ns each"
    return ""


def row(record: dict, what: str) -> str:
    ours = targets.seconds_of(record)
    peer, ratio = "none", ""
    if record.get("peer"):
        peer = f"{record['peer']['name']} {time_of(record['peer']['min'])}"
        ratio = f"{record['ratio']:.2f}"
    cells = [what, record["shape"], record["threads"], time_of(ours), rate_of(record), peer, ratio]
    return "| " + " | ".join(str(x) for x in [*cells, target_text(record), reached_text(record)]) + " |"


HEADER = [
    "| what | size | threads | ours | rate | best peer | ratio | target | reached |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
]


def machine_of(results: dict) -> list[str]:
    peaks = results.get("peak_gflops_by_threads") or {}
    versions = ", ".join(f"{name} {version}" for name, version in results.get("versions", {}).items())
    peak = ", ".join(f"{gflops:.0f} GF/s on {n} thread{'s' if n != '1' else ''}" for n, gflops in peaks.items())
    isa = results.get("configuration", {}).get("instruction_set")
    lines = [f"{results['processor']}, {results['cores']} cores" + (f", {isa}" if isa else "") + f"; {versions}."]
    lines.append(f"Peak: {peak}." if peak else "Peak: not measured.")
    lines.append(f"Commit `{results['commit'][:12]}`, command `{results['command']}`.")
    return lines


def kernel_section(results: dict) -> list[str]:
    lines = ["## Kernels", "", *machine_of(results)]
    records = [targets.judge(dict(r)) for r in results["records"]]
    measured = [r for r in records if "ours" in r]
    for title, prefixes in {**FAMILIES, "Others": ("",)}.items():
        rows = [r for r in measured if r["op"].startswith(prefixes)]
        measured = [r for r in measured if r not in rows]
        if rows:
            lines += ["", f"### {title}", "", *HEADER, *(row(r, r["op"]) for r in rows)]
    return [*lines, "", *missing_of(records)]


def missing_of(records: list[dict]) -> list[str]:
    """Peers that did not run, a line for each reason."""
    reasons: dict[str, None] = {}
    for record in records:
        for name, reason in (record.get("missing") or {}).items():
            what = record.get("op") or f"{record['preset']}, {record['what']}"
            reasons[f"- {what}: {name} was not measured, {reason}"] = None
    return [*reasons, ""] if reasons else []


def step_section(results: dict) -> list[str]:
    lines = ["## Whole steps", "", *machine_of(results), ""]
    lines += ["The peer is the torch backend of the same model on the same scenes, both with kept memory.", "", *HEADER]
    records = [targets.judge(dict(r)) for r in results["records"]]
    lines += [row(r, f"{r['preset']}, {r['what']}") for r in records]
    lines += ["", "| what | size | threads | in Python | outside C kernels | resident | growth exponent |"]
    lines.append("| --- | --- | --- | --- | --- | --- | --- |")
    for r in records:
        resident = (r.get("peak_resident_bytes") or {}).get("ours")
        cells = [
            f"{r['preset']}, {r['what']}",
            r["shape"],
            r["threads"],
            f"{r['python_share']:.0%}" if "python_share" in r else "",
            f"{r['outside_kernels_share']:.0%}" if "outside_kernels_share" in r else "",
            f"{resident / 1e9:.2f} GB" if resident else "",
            f"{r['growth_exponent']:.3f}" if "growth_exponent" in r else "",
        ]
        lines.append("| " + " | ".join(str(x) for x in cells) + " |")
    return [*lines, "", *missing_of(records)]


def summary(records: list[dict]) -> str:
    judged = [r["reached"] for r in map(targets.judge, map(dict, records)) if "target" in r]
    measured = [x for x in judged if x is not None]
    return f"Targets reached: {sum(measured)} of {len(measured)} measured."


def page(kernels: dict | None, steps: dict | None) -> str:
    results = [x for x in (kernels, steps) if x]
    records = [r for x in results for r in x["records"] if "shape" in r]
    lines = [INTRODUCTION, summary(records), ""]
    lines += kernel_section(kernels) if kernels else []
    lines += step_section(steps) if steps else []
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kernels", type=Path, default=RESULTS / "kernels.json", metavar="FILE", help="%(default)s")
    parser.add_argument(
        "--steps", type=Path, default=RESULTS / "training_step.json", metavar="FILE", help="%(default)s"
    )
    parser.add_argument("--out", type=Path, default=PAGE, metavar="FILE", help="%(default)s")
    arguments = parser.parse_args()
    files = [json.loads(p.read_text()) if p.exists() else None for p in (arguments.kernels, arguments.steps)]
    if not any(files):
        parser.error(f"neither {arguments.kernels} nor {arguments.steps} exists")
    arguments.out.write_text(page(*files))


if __name__ == "__main__":
    main()
