"""The time of a predicted frame beside busy processes, from end to end on a scene of few nodes."""

import json
import sys

from benchmarks.steps import busy


def test_a_frame_is_timed_alone_and_beside_busy_loops(tmp_path, monkeypatch):
    out = tmp_path / "busy.json"
    monkeypatch.setattr(busy, "NODES", 30)
    monkeypatch.setattr(sys, "argv", ["busy", "--json", str(out), "--threads", "1", "--samples", "1", "--frames", "1"])
    busy.main()
    found = json.loads(out.read_text())
    for way in busy.SPINS:
        assert found[way]["alone"]["min"] > 0 and set(found[way]["ratio"]) == {"low", "equal"}
