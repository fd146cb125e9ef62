"""The table of what is not computed: what is left out changes no wanted frame; the page is made of the JSON."""

import json
import warnings

import numpy as np
import pytest

import ast_sim
from benchmarks.steps import savings


@pytest.fixture
def rows(tmp_path, monkeypatch):
    monkeypatch.setattr(savings, "PLATES", {**savings.PLATES, "frames": 5, "keep": None})
    monkeypatch.setattr(savings, "TRAVELS", (-0.01, -0.02))
    path = ast_sim.generate("deforming_plate", tmp_path / "plate.h5", progress=False, **savings.PLATES).path
    with ast_sim.Dataset(path) as data:
        return savings.savings(ast_sim.example_run("plates"), data["test"][0].scene)


def test_what_is_left_out_changes_no_wanted_frame(rows):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for frames in rows[:2]:
            assert np.array_equal(frames.more().position[-1], frames.less().position[-1])
        for questions in rows[4:]:
            for alone, together in zip(questions.more(), questions.less(), strict=True):
                np.testing.assert_allclose(alone.position[-1], together.position[-1], rtol=0, atol=1e-6)


def test_the_page_shows_least_median_and_share(tmp_path, monkeypatch):
    milliseconds = {"more": [100.0, 110.0, 120.0], "less": [50.0, 44.0, 60.0]}
    results = {"processor": "P", "rows": [{"text": "frames", "milliseconds": milliseconds}]}
    monkeypatch.setattr(savings, "RESULTS", tmp_path / "savings.json")
    monkeypatch.setattr(savings, "PAGE", tmp_path / "savings.md")
    savings.RESULTS.write_text(json.dumps(results))
    savings.main(["--page"])
    assert "| frames | 100 (110) ms | 44 (50) ms | 50 % |" in savings.PAGE.read_text()
