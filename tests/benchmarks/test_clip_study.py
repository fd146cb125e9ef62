"""The study of the metal clip: what it measures, by hand, and from end to end on plates made by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from toy import one_thread  # noqa: F401 (used by being imported)

import ast_sim
from ast_sim.dataset.solver_seconds import write_seconds
from ast_sim.named_field import REACTION, NamedField
from ast_sim.scene import NodeType, Scene, Trajectory
from benchmarks.studies import clip
from benchmarks.studies.clip import Outcome, Plan, features, gaussian_process, outcome, page


def test_the_set_is_that_of_the_upper_face_and_the_peak_that_of_the_ram():
    rest = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 10], [1, 0, 10], [0, 0, 12]])
    elements, kinds = np.int32([[0, 1, 2, 3]]), np.uint8([3, 3, 3, 0, 0, 1])
    assert NodeType.HANDLE == 3 and NodeType.OBSTACLE == 1
    scene = Scene(rest, elements, kinds, np.int32([0, 0, 0, 0, 0, 1]))
    last = rest.copy()
    last[3:5] += np.float32([[3, 0, 4], [-3, 0, 4]])  # of the two nodes of the upper face; the ram is higher
    reaction = np.zeros((3, 6, 3), np.float32)
    reaction[1, 5], reaction[2, 5], reaction[1, 0] = (3, 4, 0), (1, 0, 0), (100, 0, 0)
    assert outcome(scene, rest, last, reaction) == Outcome(4.0, 5.0)


def test_a_gaussian_process_takes_numbers_and_names():
    known = [{"a": 1.0, "b": "x", "c": 2.0}, {"a": 3.0, "b": "y", "c": 2.0}]
    assert features(known, known).tolist() == [[-1, 1, 0], [1, 0, 1]]
    assert features([{"a": 2.0, "b": "y", "c": 9.0}], known).tolist() == [[0, 0, 1]]


@pytest.mark.parametrize("law", [lambda x: 3 + np.sin(x[:, 0]) + x[:, 1], lambda x: np.exp(3 * x[:, 0] - x[:, 1])])
def test_a_gaussian_process_learns_a_smooth_law(law):
    points = np.random.default_rng(0).uniform(-1, 1, (70, 2))
    said = gaussian_process(points[:50], law(points[:50]), points[50:])
    np.testing.assert_allclose(said, law(points[50:]), rtol=0.02)


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
    return Trajectory(scene, position.astype(np.float32), 1e9 * strain, drawn, fields=fields)


def made(_family, path, **_counts):
    """In place of the simulations: scenes made by hand."""
    depths = {"train": np.linspace(0.01, 0.03, 6), "valid": [0.02], "test": [0.015, 0.025]}
    path.parent.mkdir()
    info = replace(toy.info(), generator={"material": ["young", "poisson", "yield_stress"]})
    with toy.DatasetWriter(path, info) as writer:
        for split, every in depths.items():
            for depth in every:
                writer.add(split, metal(depth))
    names = [f"{split}/{index:06d}" for split, every in depths.items() for index in range(len(every))]
    write_seconds(path, info.generator, {name: {"solve_seconds": [0.0, *[1.0] * 6]} for name in names})
    return type("Made", (), {"path": path})()


def test_from_scenes_to_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(ast_sim, "generate", made)
    monkeypatch.setattr(clip, "RESULTS", tmp_path / "clip.json")
    monkeypatch.setattr(clip, "PAGE", tmp_path / "clip.md")
    monkeypatch.setattr(clip, "Plan", lambda: Plan(steps=2, settings=(("batch_size", 2),)))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    clip.main(["--folder", str(tmp_path / "data")])
    found = json.loads(clip.RESULTS.read_text())
    assert clip.PAGE.read_text() == page(found) + "\n" and torch.get_num_threads() == 1
    assert found["solved"] == {"train": 6, "test": 2}
    for scene, depth in zip(found["scenes"], (0.015, 0.025), strict=True):
        moving = 0.6  # of the upper face: two of its five rows are held
        assert scene["true"]["set"] == pytest.approx(moving * depth * np.hypot(0.3, 1), rel=1e-3)
        assert scene["true"]["peak"] == pytest.approx(16 * depth, rel=1e-3)  # 8 nodes
        assert scene["solver_seconds"] == 6.0 and scene["seconds_of_two"] > 0
        assert scene["run_two_frames"]["set"] == pytest.approx(scene["run"]["set"], rel=1e-3)
        assert scene["gaussian_process"]["set"] == pytest.approx(scene["true"]["set"], rel=0.05)
    off = np.array([abs(one["run"]["set"] / one["true"]["set"] - 1) for one in found["scenes"]])
    row = next(line for line in clip.PAGE.read_text().splitlines() if line.startswith("| the run, all frames"))
    assert row.startswith(f"| the run, all frames | {100 * np.median(off):.2g} ±")
    assert f"| {100 * off.mean():.2g} %" in row
