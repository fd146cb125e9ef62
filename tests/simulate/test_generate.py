"""Generation by worker processes: determinism, resuming after a kill, failures, settings."""

import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import ast_sim
from ast_sim.data.file import Dataset
from ast_sim.errors import MissingExtra, SimulationError
from ast_sim.simulate import generate as generate_module
from ast_sim.simulate import pool
from ast_sim.simulate.generate import generate
from ast_sim.simulate.progress import Progress
from ast_sim.simulate.samples import load_sample, make_sample, sample_path, save_sample

NODES = 80
COUNTS = {"train": 3, "valid": 1, "test": 1}
ROOT = pathlib.Path(ast_sim.__file__).parent.parent


def arrays(path) -> dict[str, np.ndarray]:
    """Everything in a dataset file that must be reproducible."""
    found = {}
    with Dataset(path) as dataset:
        for split in ("train", "valid", "test"):
            for index in range(dataset.count(split)):
                sample, name = dataset.load(split, index), f"{split}/{index}"
                for key in ("rest_position", "elements", "node_type", "body"):
                    found[f"{name}/{key}"] = getattr(sample.scene, key)
                found[f"{name}/position"], found[f"{name}/stress"] = sample.position, sample.stress
                for key, value in sample.attributes.items():
                    if key != "solve_seconds":
                        found[f"{name}/{key}"] = np.asarray(value)
    return found


def assert_same(a, b) -> None:
    a, b = arrays(a), arrays(b)
    assert a.keys() == b.keys()
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "plates.h5"
    generated = generate("deforming_plate", out, COUNTS, seed=5, nodes=NODES, workers=2, progress=False)
    assert generated.path == out and generated.counts == COUNTS and generated.truncated == []
    assert not out.with_name("plates.h5.parts").exists()
    return out


def test_the_dataset_is_whole_and_says_where_it_is_from(undisturbed):
    with Dataset(undisturbed) as dataset:
        assert {split: dataset.count(split) for split in COUNTS} == COUNTS
        info = dataset.info
        assert (info.family, info.integration, info.stress_location) == ("deforming_plate", "quasi_static", "node")
        assert (info.domain_half_width, info.contact_radius) == (1.0, 0.03)
        assert (info.generator["seed"], info.generator["nodes"], info.generator["counts"]) == (5, NODES, COUNTS)
        assert info.generator["versions"]["ipctk"].startswith("1.5.")
        for split, count in COUNTS.items():
            for index in range(count):
                attributes = dataset.attributes(split, index)
                assert (attributes["status"], attributes["seed"], attributes["index"]) == ("complete", 5, index)
                assert 0 < attributes["min_gap"] < attributes["dhat"] and attributes["min_jacobian"] > 0
                assert len(attributes["solve_seconds"]) == 41 and attributes["max_residual"] <= 1
        scenes = [dataset.scene(split, 0).num_nodes for split in COUNTS]
        positions = [dataset.load(split, 0).position[-1, :3] for split in COUNTS]
        assert not np.array_equal(positions[0], positions[1]) and len(scenes) == 3  # splits differ at equal index


def test_one_worker_gives_the_same_arrays_as_two(undisturbed, tmp_path):
    out = tmp_path / "plates.h5"
    generate("deforming_plate", out, COUNTS, seed=5, nodes=NODES, workers=1, progress=False)
    assert_same(out, undisturbed)


def test_a_sample_does_not_depend_on_the_others(undisturbed):
    sample = make_sample("deforming_plate", 5, "train", 2, NODES)
    with Dataset(undisturbed) as dataset:
        stored = dataset.load("train", 2)
    np.testing.assert_array_equal(sample.position, stored.position)
    np.testing.assert_array_equal(sample.stress, stored.stress)


def test_a_killed_run_goes_on_to_the_same_dataset(undisturbed, tmp_path, monkeypatch):
    out = tmp_path / "plates.h5"
    script = (
        "from ast_sim.simulate.generate import generate;"
        f"generate('deforming_plate', {str(out)!r}, {COUNTS!r}, seed=5, nodes={NODES}, workers=1)"
    )
    parts = out.with_name("plates.h5.parts")
    with subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stderr=subprocess.PIPE) as process:
        while not list(parts.glob("*.npz")) and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert not out.exists()
    there = {path.name for path in parts.glob("*.npz")}
    assert "train-000000.npz" in there and len(there) < 5
    sample_path(parts, "test", 0).write_bytes(b"PK\x03\x04 not a sample")  # made anew, not trusted
    asked, run = [], pool.run_all
    monkeypatch.setattr(generate_module, "run_all", lambda samples, *rest: asked.extend(samples) or run(samples, *rest))
    generate("deforming_plate", out, COUNTS, seed=5, nodes=NODES, workers=2, progress=False)
    assert_same(out, undisturbed)
    assert ("train", 0) not in asked and ("test", 0) in asked  # finished samples are not made again
    assert not parts.exists()


def test_a_worker_that_is_killed_costs_its_sample_only(tmp_path, monkeypatch, capfd):
    out = tmp_path / "plates.h5"
    give = pool.Worker.give

    def kill_at_second(worker, sample):
        give(worker, sample)
        if sample == ("train", 1):
            os.kill(worker.process.pid, signal.SIGKILL)

    monkeypatch.setattr(pool.Worker, "give", kill_at_second)
    with pytest.raises(SimulationError, match=r"1 of 5 samples failed \(train/000001: .* killed by SIGKILL\)"):
        generate("deforming_plate", out, COUNTS, seed=5, nodes=NODES, workers=1)
    assert "train/000001 failed" in capfd.readouterr().err
    assert len(list((tmp_path / "plates.h5.parts").glob("*.npz"))) == 4
    assert not out.exists()


def test_an_exception_in_a_worker_is_reported_and_the_others_go_on(tmp_path, monkeypatch, capfd):
    give = pool.Worker.give

    def unreadable(worker, sample):
        give(worker, ("train", -1) if sample == ("train", 0) else sample)  # a negative index is no seed
        worker.sample = sample

    monkeypatch.setattr(pool.Worker, "give", unreadable)
    with pytest.raises(SimulationError, match=r"1 of 2 samples failed \(train/000000: ValueError"):
        generate("deforming_plate", tmp_path / "a.h5", {"train": 2}, nodes=NODES, workers=1)
    assert "Traceback" in capfd.readouterr().err
    assert sample_path(tmp_path / "a.h5.parts", "train", 1).exists()


def test_a_disk_that_cannot_be_written_stops_the_run(tmp_path, monkeypatch):
    give = pool.Worker.give

    def remove_folder(worker, sample):
        for path in (tmp_path / "a.h5.parts").glob("*"):
            path.unlink()
        (tmp_path / "a.h5.parts").rmdir()
        give(worker, sample)

    monkeypatch.setattr(pool.Worker, "give", remove_folder)
    with pytest.raises(SimulationError, match="train/000000 cannot be written: FileNotFoundError"):
        generate("deforming_plate", tmp_path / "a.h5", {"train": 2}, nodes=NODES, workers=1, progress=False)


def test_parts_of_other_settings_are_refused(tmp_path):
    out, parts = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    parts.mkdir()
    settings = generate_module._settings("deforming_plate", 1, NODES)
    (parts / "settings.json").write_text(json.dumps(settings))
    with pytest.raises(SimulationError, match=r"other settings \(seed 1 there, 2 here\)"):
        generate("deforming_plate", out, {"train": 1}, seed=2, nodes=NODES, progress=False)
    (parts / "settings.json").write_text("{")
    with pytest.raises(SimulationError, match="settings.json is damaged"):
        generate("deforming_plate", out, {"train": 1}, seed=1, nodes=NODES, progress=False)


def test_an_existing_dataset_is_kept(undisturbed):
    before = undisturbed.stat().st_mtime_ns
    assert generate("deforming_plate", undisturbed, COUNTS, seed=5, nodes=NODES).counts == COUNTS
    with pytest.raises(SimulationError, match="exists and holds other data"):
        generate("deforming_plate", undisturbed, COUNTS, seed=6, nodes=NODES)
    assert undisturbed.stat().st_mtime_ns == before


def test_two_runs_on_one_file_exclude_each_other(tmp_path):
    out, parts = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    settings = generate_module._settings("deforming_plate", 0, NODES)
    with generate_module._locked(parts, settings), pytest.raises(SimulationError, match="in use by another process"):
        generate("deforming_plate", out, {"train": 1}, nodes=NODES, progress=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"family": "deforming_plates"}, "no scene family 'deforming_plates'; use one of deforming_plate"),
        ({"counts": {"training": 1}}, "no split 'training'"),
        ({"counts": {"train": 0}}, "not all 0"),
        ({"seed": -1}, "seed is -1; must be at least 0"),
        ({"nodes": 20}, "nodes is 20; must be at least 80"),
        ({"workers": 0}, "workers is 0; must be at least 1"),
    ],
)
def test_settings_that_cannot_be(tmp_path, arguments, message):
    with pytest.raises(SimulationError, match=message):
        generate(**{"family": "deforming_plate", "out": tmp_path / "a.h5", **arguments})
    assert list(tmp_path.iterdir()) == []


def test_a_missing_ipctk_is_named_before_anything_starts(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipctk", None)
    with pytest.raises(MissingExtra, match=r'pip install "ast_sim\[simulate\]"'):
        generate("deforming_plate", tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_samples_survive_their_file(tmp_path):
    sample = make_sample("deforming_plate", 5, "valid", 0, NODES)
    save_sample(tmp_path / "a.npz", sample)
    loaded = load_sample(tmp_path / "a.npz")
    assert loaded.attributes == sample.attributes
    np.testing.assert_array_equal(loaded.position, sample.position)
    np.testing.assert_array_equal(loaded.scene.elements, sample.scene.elements)
    assert loaded.scene.material is None and loaded.position.dtype == np.float32
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_the_solver_and_its_workers_need_no_torch():
    script = (
        "import sys, ast_sim.simulate.worker, ast_sim.simulate.generate;"
        "ast_sim.simulate.samples.make_sample('deforming_plate', 0, 'train', 0, 80);"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_workers_have_one_thread_each(tmp_path):
    worker = pool.Worker(tmp_path, ("deforming_plate", "0", "80"))
    worker.give(("train", 0))
    assert worker.receive() == {"status": "complete"}
    environment = pathlib.Path(f"/proc/{worker.process.pid}/environ").read_bytes().split(b"\0")
    threads = len(list(pathlib.Path(f"/proc/{worker.process.pid}/task").iterdir()))
    worker.stop()
    assert {b"OMP_NUM_THREADS=1", b"OPENBLAS_NUM_THREADS=1", b"MKL_NUM_THREADS=1"} <= set(environment)
    assert threads == 1


def test_progress_prints_lines_where_there_is_no_terminal(capsys, monkeypatch):
    monkeypatch.setattr("ast_sim.simulate.progress.SECONDS_BETWEEN_LINES", 0.0)
    with Progress(4, 1, "scenes", True) as bar:
        bar.advance()
        bar.note("a note")
        bar.advance()
    first, second, note, third = capsys.readouterr().err.splitlines()
    assert first == "1 of 4 scenes are there already" and note == "a note"
    assert second.startswith("2 of 4 scenes, ") and third.startswith("3 of 4 scenes, ") and third.endswith(" s to go")
    with Progress(2, 0, "scenes", False) as bar:
        bar.advance()
    assert capsys.readouterr().err == ""
