"""The targets of the benchmarks, and the page that is made from result files of any machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.kernels import performance, targets

ROOT = Path(__file__).parents[2]

MACHINE = {
    "command": "python -m benchmarks.kernels --json F",
    "commit": "0123456789abcdef",
    "processor": "A processor",
    "cores": 3,
    "versions": {"python": "3.11", "torch": "2.13"},
}


def kernel(op: str, shape: str, ours: float, share: float | None = None, **peers: float) -> dict:
    record = {
        "op": op,
        "shape": shape,
        "threads": 2,
        "ours": {"min": ours, "median": ours, "samples": [ours]},
        "peers": {name.replace("_", " "): {"min": t, "median": t, "samples": [t]} for name, t in peers.items()},
        "missing": {},
    }
    return record | ({"gflops": 100.0, "share_of_peak": share} if share else {"nanoseconds_per_item": 3.0})


def step(preset: str, what: str, ours: float, torch: float | None, **numbers) -> dict:
    samples = {"ours": {"min": ours, "median": ours, "samples": [ours]}}
    if torch:
        samples["torch"] = {"min": torch, "median": torch, "samples": [torch]}
    return {"preset": preset, "what": what, "shape": "a batch", "threads": 2, "samples": samples, **numbers}


def test_the_ratio_is_to_the_best_peer():
    record = targets.judge(kernel("segment_sum", "7 rows", 1.0, slow=5.0, quick=3.0))
    assert record["peer"] == {"name": "quick", "min": 3.0} and record["ratio"] == 3.0
    assert "target" not in record and "reached" not in record
    assert "peer" not in targets.judge(kernel("segment_sum", "7 rows", 1.0))


@pytest.mark.parametrize(
    "share, sdpa, other, reached",
    [(0.68, 1.8, 1.0, True), (0.67, 9.0, 9.0, False), (0.9, 1.79, 9.0, False), (0.9, None, 1.0, True)],
)
def test_a_target_asks_for_its_own_peers_alone(share, sdpa, other, reached):
    peers = {"torch_composition": other} | ({"torch_SDPA": sdpa} if sdpa else {})
    shape = "1 x 512 queries, 512 keys, 8 heads x 64"
    assert targets.judge(kernel("attention, forward", shape, 1.0, share, **peers))["reached"] is reached


def test_what_was_not_measured_is_neither_reached_nor_missed():
    assert targets.judge(kernel("farthest_point_sample", "100000 cells to 512", 1.0))["reached"] is None


def test_targets_of_whole_steps():
    record = step("tiny", "training step", 1.0, 2.6, python_share=0.09)
    assert targets.judge(record)["reached"] and not targets.judge(record | {"python_share": 0.11})["reached"]
    large = {"peak_resident_bytes": {"ours": 7e9}, "growth_exponent": 1.04, "nodes": 100_000}
    record = step("abcd_xl", "training step", 1.0, None, **large)
    assert targets.judge(record)["reached"], "without the torch backend, which may not fit in memory"
    assert not targets.judge(record | {"growth_exponent": 1.06})["reached"]
    assert not targets.judge(record | {"peak_resident_bytes": {"ours": 8.1e9}})["reached"]
    assert "target" not in targets.judge(record | {"nodes": 12_000})
    assert not targets.judge(step("deforming_plate", "rollout step", 1.0, 2.0, outside_kernels_share=0.16))["reached"]


def test_judging_twice_changes_nothing():
    record = targets.judge(step("tiny", "training step", 1.0, 2.6, python_share=0.09))
    assert targets.judge(json.loads(json.dumps(record))) == record


def test_page(tmp_path):
    kernels = MACHINE | {
        "peak_gflops_by_threads": None,
        "records": [
            kernel("linear, forward", "100000 x 128 x 128", 2e-3, 0.81, **{"F.linear": 5e-3}),
            kernel("something new", "any", 4e-9),
            {"op": "fps", "missing": {"fpsample": "cannot be imported"}},
        ],
    }
    steps = MACHINE | {
        "peak_gflops_by_threads": {"1": 50.0, "2": 99.6},
        "records": [step("tiny", "training step", 0.5, 1.0, python_share=0.2, missing={"torch": "out of memory"})],
    }
    for name, results in (("kernels", kernels), ("steps", steps)):
        (tmp_path / f"{name}.json").write_text(json.dumps(results))
    out = tmp_path / "page.md"
    files = ["--kernels", tmp_path / "kernels.json", "--steps", tmp_path / "steps.json", "--out", out]
    subprocess.run([sys.executable, "-m", "benchmarks.kernels.performance", *files], check=True, cwd=ROOT)
    text = out.read_text()
    for part in (
        "Targets reached: 1 of 2 measured.",
        "### Dense layers",
        "| 2 ms | 100 GF/s, 0.81 of peak | F.linear 5 ms | 2.50 | at least 0.80 of peak",
        ", at least 2 times `F.linear` | yes |",
        "### Others",
        "| 4 ns | 3.0 ns each | none |  |  |  |",
        "fps: fpsample was not measured, cannot be imported",
        "Peak: not measured.",
        "Peak: 50 GF/s on 1 thread, 100 GF/s on 2 threads.",
        "| **no** |",
        "A processor, 3 cores; python 3.11, torch 2.13.",
        "torch was not measured, out of memory",
    ):
        assert part in text, part
    widths = {
        line.count("|") for line in text.splitlines() if line.startswith("| linear") or line.startswith("| what | s")
    }
    assert widths <= {8, 10}


def test_the_page_of_one_file_alone():
    results = MACHINE | {"peak_gflops_by_threads": None, "records": [step("tiny", "rollout step", 1.0, None)]}
    assert "## Kernels" not in performance.page(None, results)


def test_the_committed_results_make_a_page():
    found = {p.stem: json.loads(p.read_text()) for p in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert performance.page(found["kernels"], found.get("training_step")).count("\n|") > 20
