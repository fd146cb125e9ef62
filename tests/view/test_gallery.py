"""The report of a dataset without a browser: figures, histograms, choice of scenes, bounds, and the command."""

from __future__ import annotations

import dataclasses
import json
import re
import sys

import numpy as np
import pytest
from checks import run_python
from view_scenes import cloth, pair, plate

from ast_sim.cli import main
from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds, seconds_path, write_seconds
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import NodeType, Trajectory
from ast_sim.simulate.jobs.generate import generate
from ast_sim.view.dataset_page import gallery, survey
from ast_sim.view.dataset_page.bounds import verdicts
from ast_sim.view.dataset_page.histogram import BINS, histogram

BLOCKS = DatasetInfo("abcd", "quasi_static", "element", (0.0, 0.0, 0.0), 1.0, 0.003, 0.0, generator={"licence": "CC0"})


def blocks(path, count=5, **changes):
    """A dataset of pairs of blocks, pressed ever deeper; `changes` are attributes of the sample train/000001."""
    with DatasetWriter(path, BLOCKS) as writer:
        for i in range(count):
            sample = pair(6, cells=2, crush=0.04 * (i + 1))
            if i == 1:
                sample = dataclasses.replace(sample, attributes={**sample.attributes, **changes})
            writer.add("test" if i == count - 1 else "train", sample)
    return path


def shown(path):
    """The page's data, with every sample's figures."""
    with Dataset(path) as dataset:
        seconds = read_seconds(dataset)
        samples = list(survey.survey(dataset, seconds))
        return gallery.page_data(dataset, samples, seconds), samples


def sample(name="train/000000", **changes):
    figures = {"nodes": 10, "elements": 20, "frames": 5, "bodies": 2, "displacement": 0.1, "stress": None, "peak": 4}
    return survey.SampleFigures(name, **{**figures, "outside": False, "attributes": {}, "seconds": None, **changes})


def fails(capsys, *arguments):
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    return error


# Figures


def test_figures_count_the_deforming_bodies():
    truth = plate(9, stress="element")
    truth.stress[3, -1] = 1e9  # in the obstacle
    free = truth.scene.node_type != NodeType.OBSTACLE
    truth.position[7][~free] += (0.09, 0, 0)  # further than any node of the plate
    found = survey.figures("train/000000", truth, dataclasses.replace(BLOCKS, domain_half_width=0.3), None)
    moved = np.linalg.norm(truth.position - truth.scene.rest_position, axis=2)[:, free]
    assert found.displacement == pytest.approx(moved.max(), rel=1e-6)
    assert found.peak == moved.max(axis=1).argmax() == 4
    assert 1e4 < found.stress < 1e6
    sizes = (truth.scene.num_nodes, truth.scene.num_elements, 9, 2)
    assert (found.nodes, found.elements, found.frames, found.bodies) == sizes
    assert not found.outside
    assert survey.figures("a", truth, dataclasses.replace(BLOCKS, domain_half_width=0.2), None).outside


def test_records_of_other_origin_may_be_missing():
    bare = sample()
    assert bare.complete and bare.contact_area is None and bare.total_seconds is None
    assert bare.numbers("newton_iterations") == bare.iterations == []
    assert sample(attributes={"contact_area": [0.0, 2.0, 1.0]}).contact_area == 2.0
    assert sample(attributes={"newton_iterations": [0.0, 3.0, 4.0]}).iterations == [3.0, 4.0]
    assert not sample(attributes={"status": "truncated"}).complete


def test_seconds_lie_beside_the_file(tmp_path):
    path = blocks(tmp_path / "blocks.h5")
    assert [s.total_seconds for s in shown(path)[1]] == [None] * 5
    times = {"train/000001": {"solve_seconds": [0.5, 1.0, 0.5, 0.5, 0.5, 0.5], "processor": "A processor"}}
    write_seconds(path, BLOCKS.generator, times)
    data, samples = shown(path)
    assert [s.total_seconds for s in samples] == [None, 3.5, None, None, None]
    per_frame, per_sample = (chart for chart in data["histograms"] if chart["title"] == "Solver time")
    assert (per_frame["count"], per_sample["count"], per_sample["recorded"]) == (5, 1, 1)
    assert per_sample["summary"]["median"] == 3.5
    assert ["Solved on", "A processor"] in data["facts"]
    seconds_path(path).write_text("{")
    with pytest.warns(UserWarning, match="blocks.h5.seconds.json is damaged"):
        assert [s.total_seconds for s in shown(path)[1]] == [None] * 5


def test_seconds_of_earlier_versions_are_in_the_file():
    assert survey.figures("a", plate(4), BLOCKS, None).seconds == [0.03] * 4
    assert survey.figures("a", plate(4), BLOCKS, [1.0] * 4).seconds == [1.0] * 4


# Histograms


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("count", [1, 2, 7, 40, 3000])
def test_counts_add_up_between_round_edges(count, whole):
    rng = np.random.default_rng(count)
    values = rng.lognormal(3.0, 1.5, count)
    values = np.rint(values) if whole else values
    found = histogram({"train": values[: count // 2], "test": values[count // 2 :]}, whole)
    assert sum(found["counts"]["train"]) == count // 2 and sum(found["counts"]["test"]) == count - count // 2
    edges = np.array(found["edges"])
    step = edges[1] - edges[0]
    assert 1 <= len(edges) - 1 <= BINS + 2
    assert f"{step:.0e}"[0] in "125" and np.allclose(edges / step, np.rint(edges / step))
    assert edges[0] <= values.min() and (found["open"] or values.max() <= edges[-1])
    if whole:
        assert step >= 1
    both = np.add(found["counts"]["train"], found["counts"]["test"])
    inner = [((values >= low) & (values < high)).sum() for low, high in zip(edges[:-2], edges[1:-1], strict=True)]
    assert both[:-1].tolist() == inner


def test_a_long_tail_shares_the_last_bin():
    found = histogram({"train": [*np.linspace(1, 10, 400), 1000.0]})
    assert found["open"] and found["edges"][-1] <= 11 and found["counts"]["train"][-1] >= 1
    assert found["summary"]["largest"] == 1000.0
    assert not histogram({"train": np.linspace(1, 10, 400)})["open"]


def test_what_is_not_finite_is_counted_apart():
    found = histogram({"train": [1.0, np.nan, np.inf, 3.0]})
    assert (found["count"], found["not_finite"], sum(found["counts"]["train"])) == (2, 2, 2)
    assert histogram({"train": []}) == {"not_finite": 0, "count": 0}
    equal = histogram({"train": [0.3] * 4})
    assert sum(equal["counts"]["train"]) == 4 and equal["edges"][0] <= 0.3 <= equal["edges"][-1]


# The choice of scenes


def test_scenes_are_spread_over_the_ranks():
    assert gallery.spread(23, 12) == [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22]
    assert gallery.spread(3, 12) == [0, 1, 2]
    assert gallery.spread(9, 1) == [4]
    assert gallery.spread(1, 12) == [0]


def test_large_scenes_have_fewer_panels_and_frames():
    def choose(surface, frame, count=30, frames=400):
        return gallery.choose_panels(lambda index: gallery._Cost(surface, frame, frames), count)

    assert choose(10_000, 1_000) == (gallery.spread(30, 12), 60)
    for surface, frame in ((40_000, 12_000), (300_000, 60_000), (900_000, 250_000)):
        chosen, frames = choose(surface, frame)
        assert len(chosen) * (surface + frames * frame) <= gallery.SCENE_BYTES
        assert (len(chosen) + 1) * (surface + gallery.MIN_FRAMES * frame) > gallery.SCENE_BYTES or len(chosen) == 12
        assert frames >= gallery.MIN_FRAMES
    assert choose(10_000_000, 1_000_000) == ([14], 2)


def test_the_page_keeps_its_size_and_says_what_it_leaves_out(tmp_path, monkeypatch):
    path = blocks(tmp_path / "blocks.h5")
    whole = shown(path)[0]
    assert [scene["name"] for scene in whole["scenes"]] == [*(f"train/{i:06d}" for i in range(4)), "test/000000"]
    assert whole["scenesNote"] == "All samples, from the least to the most displaced. The panels show surfaces only."
    cost = len(json.dumps(whole["scenes"][0]))
    monkeypatch.setattr(gallery, "MIN_FRAMES", 3)
    monkeypatch.setattr(gallery, "SCENE_BYTES", int(2.5 * cost))
    data = shown(path)[0]
    assert len(json.dumps(data["scenes"])) <= 2.5 * cost
    assert [scene["name"] for scene in data["scenes"]] == ["train/000000", "train/000002", "test/000000"]
    frames = data["scenes"][0]["frames"]
    assert 3 <= len(frames) < 6 and (frames[0], frames[-1]) == (0, 5)
    assert data["scenesNote"] == (
        "3 of 5 samples: in order of their largest displacement, at even steps from the least to the most displaced."
        " The panels show surfaces only, fewer scenes because they are large,"
        f" at most {len(frames)} evenly spaced frames of each."
    )


# Bounds, yield, facts


def energies(*, lost: float = 0.0, snap: float = 0.0) -> dict[str, list[float]]:
    """Records of five frames: each stores 1 J and loses `lost` of it unexplained; the third also snaps."""
    work = np.arange(5.0) + np.where(np.arange(5) >= 3, snap, 0)
    return {"work": work.tolist(), "elastic_energy": (np.arange(5) * (1 - lost)).tolist(), **NO_CONTACT}


NO_CONTACT = {"contact_energy": [0.0] * 5, "dissipation": [0.0] * 5}


def test_bounds_have_verdicts():
    good = {"min_gap": 1e-4, "min_jacobian": 0.5, "residual": [0.0, 0.9], **energies(lost=0.0199)}
    rows = {row["title"]: row for row in verdicts([sample(attributes=good), sample("train/000001")], "m")}
    assert [row["passed"] for row in rows.values()] == [True] * 5
    assert [row["recorded"] for row in rows.values()] == [1, 1, 1, 1, 2]
    assert rows["Residual"]["range"] == [0.9, 0.9] and rows["Gap"]["unit"] == "m"
    none = {row["title"]: row for row in verdicts([sample()], "m")}
    assert [row["passed"] for row in none.values()] == [None] * 4 + [True]


@pytest.mark.parametrize(
    ("key", "value", "title"),
    [
        ("min_gap", 0.0, "Gap"),
        ("gap", [1.0, -1e-9], "Gap"),
        ("min_jacobian", -0.1, "det F"),
        ("min_jacobian", float("nan"), "det F"),
        ("max_residual", 1.001, "Residual"),
        ("residual", [0.0, float("nan"), 0.5], "Residual"),
        ("elastic_energy", energies(lost=0.0201)["elastic_energy"], "Work balance"),
        ("work", [0.0, 1.0, float("nan"), 3.0, 4.0], "Work balance"),
    ],
)
def test_a_broken_bound_names_the_sample(key, value, title):
    good = {"min_gap": 1e-4, "min_jacobian": 0.5, "max_residual": 0.9, **energies()}
    if key in ("gap", "residual"):
        del good[f"min_{key}" if key == "gap" else f"max_{key}"]
    samples = [sample(f"train/{i:06d}", attributes={**good, **({key: value} if i == 1 else {})}) for i in range(3)]
    failed = [row for row in verdicts(samples, "m") if row["passed"] is False]
    assert [(row["title"], row["worst"], row["failed"]) for row in failed] == [(title, "train/000001", 1)]


def test_a_snap_is_no_broken_bound():
    """A body that snaps through loses energy in one frame. Cloth in motion has no balance of this kind."""
    for snap in (-3.0, 0.5, 40.0):
        found = sample(attributes=energies(snap=snap)).work_imbalance
        assert found == 0
    friction = sample(attributes={**energies(lost=0.5), "dissipation": [0.0, 0.5, 1.0, 1.5, 2.0]})
    assert friction.work_imbalance == 0
    assert sample(attributes=energies(lost=0.5)).work_imbalance == 0.125
    assert sample(attributes={**energies(), "kinetic_energy": [0.0] * 5}).work_imbalance is None


def test_nothing_to_touch_is_no_failure():
    (row, *_) = verdicts([sample(attributes={"min_gap": float("inf")})], "m")
    assert row["passed"] is True and row["range"] is None
    (*_, row) = verdicts([sample(), sample("train/000001", outside=True)], "m")
    assert (row["title"], row["passed"], row["worst"]) == ("Domain", False, "train/000001")


def test_yield_counts_reasons_without_their_figures(tmp_path):
    stopped = "frame 4: Newton did not converge in 200 iterations (residual 3.2e-2 N)"
    path = blocks(tmp_path / "blocks.h5", status="truncated", stopped_by=stopped)
    data, _ = shown(path)
    assert data["yields"] == {
        "complete": 4,
        "count": 5,
        "splits": {"train": [3, 4], "test": [1, 1]},
        "reasons": [["Newton did not converge in … iterations", 1]],
        "stopped": [["train/000001", 6, stopped]],
        "left_out": 0,
    }
    assert data["tiles"][0] == {"label": "Complete", "value": "80", "suffix": " %", "detail": "4 of 5 samples"}
    assert [scene["stopped"] for scene in data["scenes"]] == [None, 5, None, None, None]
    assert gallery._floor_percent(1999, 2000) == "99.9"


def test_facts_give_settings_and_say_what_is_missing(tmp_path):
    data, _ = shown(blocks(tmp_path / "blocks.h5", friction=0.3))
    facts = dict(data["facts"])
    assert facts["Licence"] == "CC0" and facts["Command"] == "not recorded"
    assert facts["Young’s modulus"] == "1,000,000 to 2,000,000 Pa"
    assert facts["Friction"] == "0 to 0.3" and facts["Contact distance dhat"] == "0.001 m"
    assert facts["Sizes"] == "150 nodes, 384 elements, 6 frames, 2 bodies"


def test_a_generated_dataset_has_its_figures(tmp_path):
    path = tmp_path / "plates.h5"
    generate("deforming_plate", path, train=2, valid=0, test=1, seed=1, nodes=80, frames=41, workers=1, progress=False)
    data, samples = shown(path)
    charts = {(chart["title"], chart["counted"]): chart for chart in data["histograms"]}
    assert charts["Newton iterations", "frames"]["count"] == sum(s.frames - 1 for s in samples) == 120
    assert charts["Largest von Mises stress", "samples"]["summary"]["largest"] == max(s.stress for s in samples)
    assert [row["passed"] for row in data["checks"][:2]] == [True, True]
    assert dict(data["facts"])["Command"] == "ast-sim generate deforming_plate --seed 1 --nodes 80 --frames 41"
    json.dumps(data, allow_nan=False)


def test_cloth_has_no_stress(tmp_path):
    info = dataclasses.replace(BLOCKS, family="sphere_simple", integration="dynamic", stress_location="none")
    with DatasetWriter(tmp_path / "cloth.h5", info) as writer:
        writer.add("train", cloth(5))
        writer.add("train", Trajectory(cloth(5).scene, cloth(5).position))
    data, samples = shown(tmp_path / "cloth.h5")
    assert samples[0].stress is None and list(data["scenes"][0]["ranges"]) == ["displacement"]
    assert {chart["title"]: chart["recorded"] for chart in data["histograms"]}["Newton iterations"] == 1
    assert dict(data["facts"])["Elements"] == "triangles"


# The command


def test_report_of_a_dataset_is_one_page(tmp_path):
    path, out = blocks(tmp_path / "blocks.h5"), tmp_path / "pages" / "report.html"
    assert main(["report", str(path), "--out", str(out)]) == 0
    text = out.read_text(encoding="utf-8")
    assert text.startswith("<!doctype html>") and "<title>abcd: blocks.h5</title>" in text
    assert len(text) < 6_000_000 and not re.search(r"<(link|img|iframe|script)[^>]*\s(src|href)=", text)
    assert list(out.parent.iterdir()) == [out]
    code = f"import sys; from ast_sim.cli import main; main(['report', {str(path)!r}, '--out', {str(out)!r}])"
    assert "torch" not in run_python(code + "; print([m for m in sys.modules if m.split('.')[0] == 'torch'])")


def test_a_dataset_without_samples_has_a_page(tmp_path):
    with DatasetWriter(tmp_path / "empty.h5", BLOCKS):
        pass
    data, _ = shown(tmp_path / "empty.h5")
    assert data["lead"] == "empty.h5 holds no samples." and data["scenes"] == data["checks"] == data["tiles"] == []
    assert main(["report", str(tmp_path / "empty.h5"), "--out", str(tmp_path / "empty.html")]) == 0


def test_runs_and_datasets_are_not_mixed(tmp_path, capsys):
    path, run, out = blocks(tmp_path / "blocks.h5", 1), tmp_path / "run", tmp_path / "report.html"
    run.mkdir()
    error = fails(capsys, "report", run, path, "--out", out)
    assert "blocks.h5 is a dataset, the others are runs" in error and "--data" in error
    assert "one dataset, not 2" in fails(capsys, "report", path, path, "--out", out)
    assert "leave --data out" in fails(capsys, "report", path, "--data", path, "--out", out)
    assert "absent.h5" in fails(capsys, "report", tmp_path / "absent.h5", "--out", out)
    assert "not a run folder" in fails(capsys, "report", run, "--out", out)
    (tmp_path / "damaged.h5").write_bytes(b"nothing")
    assert "damaged.h5" in fails(capsys, "report", tmp_path / "damaged.h5", "--out", out)
    assert "damaged.h5" in fails(capsys, "report", path, "--out", tmp_path / "damaged.h5" / "report.html")
    assert not out.exists()


def test_missing_plotly_names_the_extra(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    path = blocks(tmp_path / "blocks.h5", 1)
    assert 'pip install "ast_sim[view]"' in fails(capsys, "report", path, "--out", tmp_path / "report.html")
