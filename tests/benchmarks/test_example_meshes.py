"""The study of the examples' meshes, from end to end on a block that a punch presses."""

import json

import pytest
from simulate.own_assembly.assemblies import write_assembly

import ast_sim
from benchmarks.studies import example_meshes
from benchmarks.studies.example_meshes import Row


def test_the_force_on_the_own_mesh_is_the_one_of_generated_scenes(tmp_path, monkeypatch, one_thread):
    spec = write_assembly(tmp_path)
    monkeypatch.setattr(example_meshes, "ROWS", {"block": Row("Block", spec, (0.5,))})
    monkeypatch.setattr(example_meshes, "SCENES", 1)
    monkeypatch.setattr(example_meshes, "RESULTS", tmp_path / "results" / "example_meshes.json")
    monkeypatch.setattr(example_meshes, "PAGE", tmp_path / "example_meshes.md")
    (tmp_path / "results").mkdir()
    example_meshes.main(["block"])
    result = json.loads(example_meshes.RESULTS.read_text())["block"]
    own, finer = result["scenes"][0]
    one = ast_sim.generate("assembly", tmp_path / "one.h5", spec=spec, train=1, valid=0, test=0).path
    with ast_sim.Dataset(one) as data:
        truth = data["train"][0]
    assert own["force"] == pytest.approx(max(truth.attributes["reaction"]), rel=1e-6) and own["force"] > 0.1
    assert own["nodes"] == truth.scene.num_nodes < finer["nodes"] and own["relative"] == 1
    off = own["force"] / finer["force"] - 1
    assert f"| Block | 0 | 1.00 | {own['nodes']:,} | {own['force']:.4g} N | {100 * off:+.1f} % |" in (
        example_meshes.PAGE.read_text()
    )
    assert example_meshes.largest_off(result) == pytest.approx(abs(off))


def test_the_page_is_the_one_that_the_results_make():
    results = json.loads(example_meshes.RESULTS.read_text())
    assert set(results) == set(example_meshes.ROWS)
    assert example_meshes.page(results) + "\n" == example_meshes.PAGE.read_text()
