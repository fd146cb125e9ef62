"""The study of the metal clip: what it measures, by hand, and from end to end on plates made by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy

import ast_sim
from ast_sim.dataset.solver_seconds import read_seconds, write_seconds
from ast_sim.named_field import REACTION, NamedField
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from benchmarks.studies import clip, clip_variants
from benchmarks.studies.clip import Plan
from benchmarks.studies.clip_outcome import SPEC, Outcome, outcome
from benchmarks.studies.clip_page import page
from benchmarks.studies.clip_variants import FINER, OWN, Variant


def test_the_set_is_of_the_upper_face_and_the_peak_of_the_ram():
    rest = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 10], [1, 0, 10], [0, 0, 12]])
    elements, kinds = np.int32([[0, 1, 2, 3]]), np.uint8([3, 3, 3, 0, 0, 1])
    assert NodeType.HANDLE == 3 and NodeType.OBSTACLE == 1
    scene = Scene(rest, elements, kinds, np.int32([0, 0, 0, 0, 0, 1]))
    last = rest.copy()
    last[3:5] += np.float32([[3, 0, 4], [-3, 0, 4]])  # of the two nodes of the upper face; the ram is higher
    reaction = np.zeros((3, 6, 3), np.float32)
    reaction[1, 5], reaction[2, 5], reaction[1, 0] = (3, 4, 0), (1, 0, 0), (100, 0, 0)
    assert outcome(scene, rest, last, reaction) == Outcome(4.0, 5.0)


def metal(depth: float) -> Trajectory:
    """A plate whose set follows from the depth, with the records of CalculiX; the block is the ram."""
    truth = toy.plate(0)
    scene = replace(truth.scene, material=np.tile(np.float32([2e11, 0.3, 3e8]), (truth.scene.num_elements, 1)))
    share = np.where(scene.body == 0, [[0], [1], [1.5], [2], [1], [1], [1]], [[0], [1], [1.5], [2], [1], [0.5], [0]])
    moves = (scene.node_type != NodeType.HANDLE)[:, None]
    position = truth.position[0] + depth * share[:, :, None] * np.float32([0.3, 0, -1]) * moves
    strain = np.float32(depth * np.minimum(share, 1))[:, :, None]
    force = np.float32(depth * share * (scene.body == 1))[:, :, None] * np.float32([0, 0, 1])
    fields = {"PEEQ": NamedField(strain, "node"), REACTION: NamedField(force, "node", "N")}
    drawn = {"parameter depth": depth, "parameter file": "flat" if depth > 0.02 else "thick"}
    drawn["per frame"] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    return Trajectory(scene, position.astype(np.float32), 1e9 * strain, drawn, fields=fields)


def made(_family, path, train=0, **_counts):
    """In place of the simulations: scenes made by hand, one of them with another cutout."""
    depths = {"test": [0.02]}
    if train:
        depths = {"train": np.linspace(0.01, 0.03, 6), "valid": [0.02], "test": [0.015, 0.025], "calibration": [0.017]}
    if path.exists():
        return type("Made", (), {"path": path})()
    path.parent.mkdir(exist_ok=True)
    info = replace(toy.info(), generator={"material": ["young", "poisson", "yield_stress"]})
    with toy.DatasetWriter(path, info) as writer:
        for split, every in depths.items():
            for depth in every:
                writer.add(split, metal(depth))
    names = [f"{split}/{index:06d}" for split, every in depths.items() for index in range(len(every))]
    write_seconds(path, info.generator, {name: {"solve_seconds": [0.0, *[1.0] * 6]} for name in names})
    return type("Made", (), {"path": path})()


def variants_by_hand(drawn, _nodes, _file):
    """In place of CalculiX: the coarse mesh is 1 % off, another one 20 %; the largest increments fail in one scene."""
    true = [{"set": 0.6 * one["depth"] * np.hypot(0.3, 1), "peak": 16 * one["depth"]} for one in drawn]
    found = {}
    for name, off, seconds in ((FINER.name, 1.05, 40), ("near", 1.01, 3), ("far", 1.2, 1)):
        solved = [{"nodes": 100, **{key: off * one[key] for key in one}, "seconds": seconds} for one in true]
        found[name] = [{**one, "failures": ["it hung"] if name == "far" else []} for one in solved]
    found[FINER.name].pop()
    return {**found, "fails": [found["near"][0], {"failures": ["no convergence"]}]}


def test_from_scenes_to_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(ast_sim, "generate", made)
    for name in ("RESULTS", "PAGE", "SHARED"):
        monkeypatch.setattr(clip, name, tmp_path / getattr(clip, name).name)
    monkeypatch.setattr(clip, "Plan", lambda: Plan(steps=2, settings=(("batch_size", 2),), seeds=(0, 1)))
    monkeypatch.setattr(clip_variants, "SCENES", ("test/000000", "test/000001"))
    monkeypatch.setattr(clip_variants, "solved", variants_by_hand)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    clip.main(["--folder", str(tmp_path / "data")])
    found = json.loads(clip.RESULTS.read_text())
    assert clip.PAGE.read_text() == page(found) + "\n" and torch.get_num_threads() == 1
    assert found["simulation_seconds"] == {"train": 36.0, "valid": 6.0, "test": 12.0, "calibration": 6.0}
    assert found["unseen"][0]["true"]["set"] == pytest.approx(0.6 * 0.017 * np.hypot(0.3, 1), rel=1e-3)
    assert found["other_cutout"][0]["true"]["set"] == pytest.approx(0.6 * 0.02 * np.hypot(0.3, 1), rel=1e-3)
    assert "| 1 clips with two holes, a cutout that no training scene has |" in clip.PAGE.read_text()
    for scene, depth in zip(found["scenes"], (0.015, 0.025), strict=True):
        moving = 0.6  # of the upper face: two of its five rows are held
        assert scene["true"]["set"] == pytest.approx(moving * depth * np.hypot(0.3, 1), rel=1e-3)
        assert scene["true"]["peak"] == pytest.approx(16 * depth, rel=1e-3)  # 8 nodes
        assert scene["solver_seconds"] == 6.0 and scene["seconds_of_two"] > 0
        assert scene["seed 1"]["set"] > 0 and scene["seed 1"] != scene["run"]
        assert scene["run_two_frames"]["set"] == pytest.approx(scene["run"]["set"], rel=1e-3)
        assert scene["gaussian_process"]["set"] == pytest.approx(scene["true"]["set"], rel=0.05)
    off = np.array([abs(one["run"]["set"] / one["true"]["set"] - 1) for one in found["scenes"]])
    row = next(line for line in clip.PAGE.read_text().splitlines() if line.startswith("| the run, all frames"))
    assert row.startswith(f"| the run, all frames | {100 * np.median(off):.2g} ±")
    assert f"| {100 * off.mean():.2g} %" in row and "| the same with seed 1, all frames |" in clip.PAGE.read_text()
    with ast_sim.Dataset(clip.SHARED) as shared, ast_sim.Dataset(tmp_path / "data" / "clip.h5") as whole:
        assert shared.count("test") == 2 and shared.count("train") == 0
        assert read_seconds(shared).samples == dict.fromkeys(("test/000000", "test/000001"), [0.0, 3.0, 3.0])
        for one, truth in zip(shared["test"], whole["test"], strict=True):
            np.testing.assert_array_equal(one.position, truth.position[[0, 3, 6]])
            np.testing.assert_array_equal(one.fields[REACTION].values, truth.fields[REACTION].values[[0, 3, 6]])
            assert one.numbers == (0, 1, 2) and one.attributes["per frame"] == [0.0, 3.0, 6.0]


def test_the_other_cutout_is_all_that_differs():
    text, other = (file.read_text().splitlines() for file in (SPEC, clip.OTHER_CUTOUT))
    differ = [(one, another) for one, another in zip(text, other, strict=True) if one != another]
    assert len(differ) == 2 and differ[1][1] == 'file = "two_holes.py:two_holes"'
    assert "two_holes" not in "".join(text)


def found_by_hand():
    """Two scenes: the run is 2 and 3 % off in the set, 1 and 2 % in the force."""
    scenes = []
    for name, depth, of_set, of_peak in (("test/000000", 0.015, 1.02, 0.99), ("test/000001", 0.025, 0.97, 1.02)):
        true = {"set": 0.6 * depth * np.hypot(0.3, 1), "peak": 16 * depth}
        said = {"set": of_set * true["set"], "peak": of_peak * true["peak"]}
        process = {key: 1.01 * value for key, value in true.items()}
        answers = {"run": said, "run_two_frames": said, "gaussian_process": process, "solver_seconds": 10.0}
        fields = dict.fromkeys(("turn_error", "last_error", "strain_error", "force_error"), 0.1)
        seconds = {"seconds": 0.02, "seconds_of_two": 0.01}
        scenes.append({"name": name, "true": true, "parameters": {"depth": depth}, **answers, **fields, **seconds})
    own = [{"nodes": 100, **scene["true"], "seconds": scene["solver_seconds"], "failures": []} for scene in scenes]
    return {
        "processor": "a processor",
        "plan": {"nodes": 1400, "train": 6, "steps": 2},
        "simulation_seconds": {"train": 60.0, "valid": 10.0},
        "training_seconds": 30.0,
        "parameters": 7,
        "scenes": scenes,
        "unseen": [],
        "other_cutout": [],
        "variants": {OWN: own, **variants_by_hand([scene["parameters"] for scene in scenes], 0, None)},
    }


def test_the_page_says_which_variant_of_calculix_is_as_accurate_and_when_the_run_pays(monkeypatch):
    monkeypatch.setattr(clip_variants, "SCENES", ("test/000000", "test/000001"))
    told = page(found_by_hand())
    # Of two scenes a bootstrap draws one twice as often as not; the Gaussian process is 1 % off in both.
    ahead = (
        "in the set 2.5 (2 to 3) times as large, the Gaussian process is ahead; in the peak force 1.5 (1 to 2) times"
    )
    assert ahead in told and told.count("both are level") == 1
    assert "| near | 100 | 0 | 1 % | 1 % | 1 % | 1 % | 3 s |" in told  # the run: 3 % and 2 %
    assert "| far | 100 | 2 | 20 % | 20 % | 20 % | 20 % | 1 s |" in told
    assert "| fails | 100 | 1 | - | - | - | - | - |" in told
    # 100 s; 9.99 s and 2.99 s are saved by an answer. The Gaussian process: 60 s, 10 s.
    assert "the run pays after 11 questions" in told and "training scenes alone, after 6 questions" in told
    best = "as accurate as the run in both numbers, in 90 % of the scenes: near, 3 s, 300 ± 0 times as long"
    assert best in told and told.count("Beside it the run pays after 34 questions.") == 3
    # The mesh is 1 / 1.05 of the finer one, and the run 1.02 / 1.05 and 0.99 / 1.05.
    assert "| test/000000 | 100 | -4.8 % | +2.0 % | -2.9 % | -4.8 % | -1.0 % | -5.7 % | 40 s |" in told
    assert "| test/000001 | 100 |" not in told


def test_calculix_on_a_coarse_mesh_is_solved_once(tmp_path, monkeypatch):
    coarse = Variant("coarse", 0.15, clip_variants.YIELDING[0], True)
    monkeypatch.setattr(clip_variants, "VARIANTS", (coarse, Variant("never", 1.0, scenes=0)))
    values = completed(read_spec(SPEC).parameters, {"travel": 2.0})
    found = clip_variants.solved([values], 1400, tmp_path / "variants.json")
    (one,) = found["coarse"]
    assert found["never"] == [] and 100 < one["nodes"] < 400
    assert 0.5 < one["set"] < 2 and 20 < one["peak"] < 120 and one["seconds"] > 0.1
    monkeypatch.setattr(clip_variants, "quasi_static", None)
    assert clip_variants.solved([values], 1400, tmp_path / "variants.json") == found


def test_a_mesh_that_fails_is_followed_by_others_of_nearly_that_size(monkeypatch, tmp_path):
    tried = []

    def no_mesh(_spec, _values, nodes, _frames):
        tried.append(nodes)
        raise clip_variants.SimulationError("no mesh")

    monkeypatch.setattr(clip_variants.assembly, "scene_of", no_mesh)
    monkeypatch.setattr(clip_variants, "VARIANTS", (Variant("half", 0.5),))
    found = clip_variants.solved([{}], 1000, tmp_path / "variants.json")
    assert tried == [500, 475, 525, 450, 550]
    assert found == {"half": [{"failures": ["no mesh"] * 5}]}
