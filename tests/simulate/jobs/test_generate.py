"""Generation by worker processes: the same bytes whatever the workers, failures, settings, what is shown."""

import hashlib
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import data_samples
import meshio
import numpy as np
import pytest
from meshes import box

import ast_sim
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds, seconds_path
from ast_sim.simulate.jobs import generate as generate_module
from ast_sim.simulate.jobs import pool
from ast_sim.simulate.jobs.display import SceneProgress
from ast_sim.simulate.jobs.generate import generate
from ast_sim.simulate.jobs.manifest import Manifest
from ast_sim.simulate.jobs.recipe import recipe_of, recorded
from ast_sim.simulate.jobs.samples import Recipe, draw_sample, load_sample, make_sample, sample_path, save_sample
from ast_sim.support.errors import AstSimError, ConfigError, DatasetError, MissingExtra, SimulationError, require

NODES, FRAMES = 80, 9
RECIPE = Recipe("deforming_plate", 5, NODES, FRAMES)
COUNTS = {"train": 2, "valid": 1, "test": 1}
ROOT = pathlib.Path(ast_sim.__file__).parent.parent


def plates(out, counts=COUNTS, **changes):
    """The dataset of these tests; changes are settings of `generate`."""
    settings = {"seed": 5, "nodes": NODES, "frames": FRAMES, "progress": False, **changes}
    return generate("deforming_plate", out, **{"valid": 0, "test": 0, **counts}, **settings)


def states(folder) -> dict[str, list[dict]]:
    """The lines of a manifest, by sample."""
    found: dict[str, list[dict]] = {}
    for line in (folder / "manifest.jsonl").read_text().splitlines():
        values = json.loads(line)
        found.setdefault(values["sample"], []).append(values)
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "plates.h5"
    generated = plates(out, workers=2)
    assert generated.path == out and generated.counts == {**COUNTS, "calibration": 0} and generated.truncated == []
    assert sorted(path.name for path in out.parent.iterdir()) == ["plates.h5", "plates.h5.seconds.json"]
    return out


def test_the_dataset_is_whole_and_says_where_it_is_from(undisturbed):
    with Dataset(undisturbed) as dataset:
        assert {split: dataset.count(split) for split in COUNTS} == COUNTS
        info = dataset.info
        assert (info.family, info.integration, info.stress_location) == ("deforming_plate", "quasi_static", "node")
        assert (info.domain_half_width, info.contact_radius) == (1.0, 0.03)
        made = info.generator
        assert (made["seed"], made["nodes"], made["frames"], made["counts"]) == (
            5,
            NODES,
            FRAMES,
            {**COUNTS, "calibration": 0},
        )
        assert (made["solver"], made["command"]) == (
            "own", f"ast-sim generate deforming_plate --seed 5 --nodes {NODES} --frames {FRAMES}"
        )  # fmt: skip
        assert made["versions"]["ipctk"].startswith("1.5.")
        for split, count in COUNTS.items():
            for index in range(count):
                attributes = dataset.attributes(split, index)
                assert (attributes["status"], attributes["seed"], attributes["index"]) == ("complete", 5, index)
                assert 0 < attributes["min_gap"] < attributes["dhat"] and attributes["min_jacobian"] > 0
                assert not [key for key in attributes if key.endswith("_seconds")]
                assert dataset.num_frames(split, index) == FRAMES
        scenes = [dataset.scene(split, 0).num_nodes for split in COUNTS]
        positions = [dataset.load(split, 0).position[-1, :3] for split in COUNTS]
        assert not np.array_equal(positions[0], positions[1]) and len(scenes) == 3  # splits differ at equal index


def test_the_seconds_of_every_sample_lie_beside_the_dataset(undisturbed):
    with Dataset(undisturbed) as dataset:
        seconds = read_seconds(dataset).samples
    assert sorted(seconds) == ["test/000000", "train/000000", "train/000001", "valid/000000"]
    assert all(len(frames) == FRAMES and min(frames) > 0 for frames in seconds.values())
    facts = json.loads(seconds_path(undisturbed).read_text())["samples"]["valid/000000"]
    assert facts["processor"]


def test_one_worker_gives_the_same_bytes_as_two(undisturbed, tmp_path):
    plates(tmp_path / "plates.h5", workers=1)
    assert (tmp_path / "plates.h5").read_bytes() == undisturbed.read_bytes()


def test_a_sample_does_not_depend_on_the_others(undisturbed):
    sample = make_sample(RECIPE, "train", 1)
    with Dataset(undisturbed) as dataset:
        stored = dataset.load("train", 1)
    np.testing.assert_array_equal(sample.position, stored.position)
    np.testing.assert_array_equal(sample.stress, stored.stress)


def test_a_worker_that_is_killed_costs_its_sample_only(undisturbed, tmp_path, monkeypatch, capfd):
    out, folder = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    give = pool.Worker.give

    def kill_at_second(worker, sample):
        give(worker, sample)
        if sample == ("train", 1):
            os.kill(worker.process.pid, signal.SIGKILL)

    with monkeypatch.context() as patched:
        patched.setattr(pool.Worker, "give", kill_at_second)
        with pytest.raises(SimulationError, match=r"1 of 4 samples failed \(train/000001: .* killed by SIGKILL\)"):
            plates(out, workers=1, progress=True)
    assert "train/000001 failed" in capfd.readouterr().err
    assert len(list(folder.glob("*.npz"))) == 3 and not out.exists()
    last = {name: lines[-1] for name, lines in states(folder).items()}
    assert [name for name, values in last.items() if values["state"] == "done"] == [
        "train/000000", "valid/000000", "test/000000"
    ]  # fmt: skip
    assert last["train/000001"]["state"] == "failed" and "SIGKILL" in last["train/000001"]["reason"]
    assert last["valid/000000"]["bytes"] == sample_path(folder, "valid", 0).stat().st_size
    assert [values["state"] for values in states(folder)["valid/000000"]] == ["pending", "running", "done"]
    sample_path(folder, "test", 0).write_bytes(b"PK\x03\x04 not a sample")  # made again, not trusted
    remade, run = [], pool.run_all
    monkeypatch.setattr(pool, "run_all", lambda samples, *rest: remade.extend(samples) or run(samples, *rest))
    plates(out, progress=True)
    shown = capfd.readouterr().err
    assert "2 of 4 scenes are there already" in shown and "train/000001 failed before: its worker process was" in shown
    assert remade == [("train", 1), ("test", 0)]  # finished samples are not made again
    assert out.read_bytes() == undisturbed.read_bytes()


def test_an_exception_in_a_worker_is_reported_and_the_others_go_on(tmp_path, monkeypatch, capfd):
    give = pool.Worker.give

    def unreadable(worker, sample):
        give(worker, ("train", -1) if sample == ("train", 0) else sample)  # a negative index is no seed
        worker.sample = sample

    monkeypatch.setattr(pool.Worker, "give", unreadable)
    with pytest.raises(SimulationError, match=r"1 of 2 samples failed \(train/000000: ValueError"):
        plates(tmp_path / "a.h5", {"train": 2}, workers=1, progress=True)
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
    with pytest.raises(AstSimError, match="train/000000 cannot be written: FileNotFoundError") as caught:
        plates(tmp_path / "a.h5", {"train": 2}, workers=1)
    assert type(caught.value) is AstSimError


def test_parts_of_other_settings_are_refused(tmp_path):
    out, folder = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    folder.mkdir()
    (folder / "settings.json").write_text(json.dumps(recorded(RECIPE)))
    with pytest.raises(ConfigError, match=r"other settings \(seed 5 there, 2 here\)"):
        plates(out, {"train": 1}, seed=2)
    older = {**recorded(RECIPE), "versions": {"numpy": "1.0"}}
    (folder / "settings.json").write_text(json.dumps(older))
    with pytest.raises(ConfigError, match=r"other settings \(versions: numpy 1.0 there, [2-9].* here\)"):
        plates(out, {"train": 1})
    (folder / "settings.json").write_text("{")
    with pytest.raises(DatasetError, match="settings.json is damaged"):
        plates(out, {"train": 1})


def test_an_existing_dataset_is_kept(undisturbed):
    before = undisturbed.stat().st_mtime_ns
    assert plates(undisturbed).counts == {**COUNTS, "calibration": 0}
    with pytest.raises(ConfigError, match="exists and holds other data"):
        plates(undisturbed, seed=6)
    assert undisturbed.stat().st_mtime_ns == before


def test_a_dataset_grows_without_solving_a_scene_twice(undisturbed, tmp_path, monkeypatch):
    out, folder = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    plates(out, {"train": 1, "valid": 1})
    with Dataset(out) as dataset:
        before = read_seconds(dataset).samples
    run_all, made = pool.run_all, []

    def stopped(samples, *rest):
        made.extend(samples)
        run_all(samples[:1], *rest)
        raise KeyboardInterrupt

    monkeypatch.setattr(pool, "run_all", stopped)
    with pytest.raises(KeyboardInterrupt):
        plates(out)
    assert made == [("train", 1), ("test", 0)]
    assert plates(out, {"train": 1, "valid": 1}).counts["train"] == 1  # as it was; what is under way is not lost
    assert (folder / "train-000001.npz").exists()

    monkeypatch.setattr(pool, "run_all", lambda samples, *rest: (made.extend(samples), run_all(samples, *rest)))
    assert plates(out).counts == {**COUNTS, "calibration": 0}
    assert made[2:] == [("test", 0)]
    assert out.read_bytes() == undisturbed.read_bytes() and not folder.exists()
    with Dataset(out) as dataset:
        after = read_seconds(dataset).samples
    assert len(after) == 4 and {name: after[name] for name in before} == before
    with pytest.raises(ConfigError, match=r"holds other data \(counts: train 2 there, 1 here\)"):
        plates(out, {"train": 1, "valid": 1, "test": 1})


def test_a_dataset_whose_seconds_are_lost_grows_without_them(undisturbed, tmp_path):
    out = tmp_path / "plates.h5"
    plates(out, {"train": 1, "valid": 1})
    (tmp_path / "plates.h5.seconds.json").unlink()
    plates(out)
    with Dataset(out) as dataset:
        assert sorted(read_seconds(dataset).samples) == ["test/000000", "train/000001"]
    assert out.read_bytes() == undisturbed.read_bytes()


def test_a_dataset_is_unpacked_with_all_its_arrays(tmp_path):
    member = data_samples.trajectory(data_samples.block(2, 1, 1), 3, stress="element", tensor=True, solver="own")
    path = data_samples.write(tmp_path / "d.h5", {"train": [member]}, stress_location="element")
    generate_module._unpack(path, tmp_path)
    found, seconds = load_sample(sample_path(tmp_path, "train", 0))
    for key in ("position", "stress", "cauchy_stress"):
        assert np.array_equal(getattr(found, key), getattr(member, key))
    assert np.array_equal(found.scene.elements, member.scene.elements) and seconds == {}
    assert found.attributes == {"seed": 0, "solver": "own", "status": "complete"}


def test_a_patient_solve_is_recorded_and_reaches_every_frame(tmp_path, monkeypatch):
    usual, patient = replace(RECIPE, seed=0), replace(RECIPE, seed=0, patient=True)
    assert recorded(usual)["seed"] == 0 and "patient" not in recorded(usual) and recorded(patient)["patient"] is True
    assert recorded(patient)["command"] == recorded(usual)["command"] + " --patient"
    monkeypatch.setattr("ast_sim.mechanics.frames.MAX_FRAME_ITERATIONS", 1)
    assert make_sample(usual, "train", 0).attributes["status"] == "truncated"
    assert make_sample(patient, "train", 0).num_frames == FRAMES


def test_kept_frames_are_frames_of_the_whole_motion_and_recorded(undisturbed, tmp_path):
    kept = (3, 7)
    out = plates(tmp_path / "kept.h5", keep=kept, workers=1).path
    with Dataset(undisturbed) as whole, Dataset(out) as some:
        made = some.info.generator
        assert made["keep"] == [3, 7] and "keep" not in whole.info.generator
        assert (
            made["command"] == f"ast-sim generate deforming_plate --seed 5 --nodes {NODES} --frames {FRAMES} --keep 3,7"
        )
        for split, count in COUNTS.items():
            for index in range(count):
                full, part = whole.load(split, index), some.load(split, index)
                np.testing.assert_array_equal(part.scene.rest_position, full.scene.rest_position)
                fixed, wanted = full.scene.prescribed, full.position[[0, *kept]]
                np.testing.assert_array_equal(part.position[:, fixed], wanted[:, fixed])
                # Without friction the equilibrium does not depend on the way: both solves stop close to it.
                assert part.attributes["status"] == "complete" and max(part.attributes["residual"]) <= 1
                moved = np.linalg.norm(wanted[:, ~fixed] - wanted[0, ~fixed], axis=2).max()
                assert np.abs(part.position - wanted).max() <= 1e-3 * moved
                assert sum(part.attributes["newton_iterations"]) < sum(full.attributes["newton_iterations"])
    before = out.read_bytes()
    assert plates(out, keep=[3, 7]).counts == {**COUNTS, "calibration": 0} and out.read_bytes() == before
    for other in ({"keep": (3, 6)}, {}):
        with pytest.raises(ConfigError, match="holds other data"):
            plates(out, **other)
    with pytest.raises(ConfigError, match=r"holds other data \(keep None there, \[3, 7\] here\)"):
        plates(undisturbed, keep=kept)


def test_second_order_scenes_are_recorded_and_are_other_scenes(undisturbed, tmp_path):
    out = plates(tmp_path / "ten.h5", {"train": 1}, nodes=400, keep=(7,), order=2, workers=1).path
    with Dataset(out) as ten, Dataset(undisturbed) as linear:
        made = ten.info.generator
        assert made["order"] == 2 and "order" not in linear.info.generator
        assert (
            made["command"]
            == f"ast-sim generate deforming_plate --seed 5 --nodes 400 --frames {FRAMES} --order 2 --keep 7"
        )
        assert ten.element_size == 10 and linear.element_size == 4
        again = draw_sample(recipe_of("ten.h5", ten.info), "train", 0).case.scene
        np.testing.assert_array_equal(again.elements, ten.scene("train", 0).elements)
    before = out.read_bytes()
    same = {"nodes": 400, "keep": (7,)}
    assert plates(out, {"train": 1}, **same, order=2).path == out and out.read_bytes() == before
    for order in (None, 1):
        with pytest.raises(ConfigError, match="holds other data"):
            plates(out, {"train": 1}, **same, order=order)
    assert plates(undisturbed, order=1).counts == {**COUNTS, "calibration": 0}  # 1 is the default
    with pytest.raises(ConfigError, match="holds other data"):
        plates(undisturbed, nodes=400, order=2)
    more = plates(out, {"train": 2}, **same, order=2, workers=1)
    assert more.counts["train"] == 2 and more.truncated == []
    with Dataset(out) as ten:
        assert all(t.scene.elements.shape[1] == 10 for t in ten["train"])


def test_calculix_keeps_frames_too():
    recipe = Recipe("deforming_plate", 5, 150, FRAMES, keep=(3, 7))
    own, other = (make_sample(replace(recipe, solver=solver), "train", 2) for solver in ("own", "calculix"))
    assert other.attributes["status"] == "complete" and other.num_frames == 3
    moved = np.linalg.norm(own.position - own.position[0], axis=(1, 2))
    assert (np.linalg.norm(other.position - own.position, axis=(1, 2)) <= 0.1 * moved).all()  # contact differs a little


def test_two_runs_on_one_file_exclude_each_other(tmp_path):
    out = tmp_path / "plates.h5"
    locked = generate_module._locked(tmp_path / "plates.h5.parts", recorded(RECIPE))
    with locked, pytest.raises(AstSimError, match="in use by another process") as caught:
        plates(out, {"train": 1})
    assert type(caught.value) is AstSimError  # no solve has failed


def test_a_folder_without_room_or_in_whose_place_a_file_lies_is_no_failed_solve(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))
        with pytest.raises(AstSimError, match="2 scenes need more than 0.000 GB, but .* has 0.000 GB") as caught:
            plates(tmp_path / "a.h5", {"train": 2})
    assert type(caught.value) is AstSimError
    (tmp_path / "b.h5.parts").write_text("")
    with pytest.raises(AstSimError, match="b.h5.parts cannot be written: .*File exists") as caught:
        plates(tmp_path / "b.h5", {"train": 2})
    assert type(caught.value) is AstSimError


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"family": "deforming_plates"},
            "no scene family 'deforming_plates'; did you mean 'deforming_plate'\\?",
        ),
        ({"train": 0}, "not all 0"),
        ({"seed": -1}, "seed is -1; must be from 0 to"),
        ({"seed": 2**63}, "seed is 9223372036854775808; must be from 0 to 2.63 - 1"),
        ({"seed": 1.5}, "seed is 1.5; it must be a whole number"),
        ({"nodes": "100"}, "nodes is '100'; it must be a whole number"),
        ({"nodes": 20}, "nodes is 20; must be at least 80"),
        ({"frames": 2}, "frames is 2; must be at least 3"),
        ({"workers": 0}, "workers is 0; it must be at least 1"),
        ({"workers": 2, "scheduler": "tcp://localhost:1"}, "give one of them"),
        ({"solver": "abaqus"}, "no solver 'abaqus'; use one of own, calculix"),
        ({"family": "abcd", "solver": "calculix", "patient": True}, "patient is for the own solver"),
        ({"parts": "folder"}, "deforming_plate has no option parts; these families have it: abcd, abcd_xl"),
        ({"keep": []}, r"keep is \[\]; must be numbers of frames from 1 to 399, beside frame 0"),
        ({"keep": [0, 3]}, r"keep is \[0, 3\]; must be numbers of frames from 1 to 399"),
        ({"frames": 9, "keep": [3, 9]}, r"keep is \[3, 9\]; must be numbers of frames from 1 to 8"),
        ({"family": "abcd", "keep": [21]}, r"keep is \[21\]; must be numbers of frames from 1 to 20"),
        ({"keep": [3, 2]}, r"keep is \[3, 2\]; the numbers of frames must ascend"),
        ({"keep": 3}, r"keep is 3; it must be a list of whole numbers"),
        ({"keep": [3.5]}, r"keep\[0\] is 3.5; it must be a whole number"),
        ({"keep": [True]}, r"keep\[0\] is True; it must be a whole number"),
        ({"train": 2.0}, r"train is 2.0; it must be a whole number"),
        ({"train": "2"}, r"train is '2'; it must be a whole number"),
        ({"valid": 1.0}, r"valid is 1.0; it must be a whole number"),
        ({"keep": [3, 3]}, "must ascend"),
        ({"order": 3}, r"order is 3; must be 2 \(tetrahedra of ten nodes\) or 1 \(of four nodes\)"),
        ({"order": "2"}, "order is '2'; it must be a whole number"),
        ({"order": 2, "nodes": 399}, "nodes is 399; must be at least 400"),
        ({"family": "abcd", "order": 2}, "abcd has no option order; these families have it: deforming_plate"),
        (  # it has inertia: every frame follows from the one before
            {"family": "sphere_simple", "keep": [3]},
            "sphere_simple has no option keep; these families have it: deforming_plate, abcd, abcd_xl",
        ),
    ],
)
def test_settings_that_cannot_be(tmp_path, arguments, message):
    with pytest.raises(ConfigError, match=message):
        generate(**{"family": "deforming_plate", "out": tmp_path / "a.h5", **arguments})
    assert list(tmp_path.iterdir()) == []


def test_parts_of_the_user_make_scenes_that_say_which_parts_they_are_of(tmp_path):
    position, elements = box((2, 2, 3), (0.4, 0.4, 0.6))
    folder = tmp_path / "parts"
    folder.mkdir()
    meshio.write(folder / "block.vtu", meshio.Mesh(position, [("tetra", elements)]))
    made = generate(
        "abcd", tmp_path / "a.h5", train=1, valid=0, test=0, nodes=200, parts=folder, workers=1, progress=False
    )
    with Dataset(made.path) as dataset:
        used = dataset.info.generator
        assert used["parts"] == {"block.vtu": hashlib.sha256((folder / "block.vtu").read_bytes()).hexdigest()}
        assert used["command"] == "ast-sim generate abcd --seed 0 --nodes 200 --parts parts"
        count, trajectory = dataset.num_frames("train", 0), dataset.load("train", 0)
        assert trajectory.stress.shape == (count, trajectory.scene.num_elements, 1)
        assert dataset.cauchy_stress("train", 0).shape == (count, trajectory.scene.num_elements, 6)
    moved = folder.rename(tmp_path / "elsewhere")
    assert recorded(Recipe("abcd", 0, 200, parts=str(moved)))["parts"] == used["parts"]
    meshio.write(moved / "broken.vtu", meshio.Mesh(position * (1, 1, 0), [("tetra", elements)]))
    with pytest.raises(SimulationError, match="broken.vtu"):
        generate("abcd", tmp_path / "b.h5", train=1, valid=0, test=0, nodes=200, parts=moved)
    assert not (tmp_path / "b.h5.parts").exists()


def test_parts_without_gmsh_are_announced(monkeypatch):
    monkeypatch.setattr("ast_sim.simulate.shapes.cad.gmsh_process.gmsh_version", lambda: None)
    parts = Recipe("abcd", 0, 200)
    (note,) = generate_module._notes(parts, recorded(parts))
    assert note.startswith("gmsh is not installed") and 'pip install "ast_sim[cad]"' in note
    assert generate_module._notes(RECIPE, recorded(RECIPE)) == []


def test_a_missing_ipctk_is_named_before_anything_starts(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipctk", None)
    with pytest.raises(MissingExtra, match=r'pip install "ast_sim\[simulate\]"'):
        generate("deforming_plate", tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_while_a_compiled_module_is_imported_is_no_missing_extra(tmp_path, monkeypatch):
    lines = ["try:", "    raise KeyboardInterrupt", "except KeyboardInterrupt as error:"]
    (tmp_path / "stopped.py").write_text(
        "\n".join([*lines, "    raise ImportError('initialization failed') from error"])
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        require("simulate", "stopped")
    with pytest.raises(MissingExtra, match="no_such_module is needed here"):
        require("simulate", "no_such_module")


def test_samples_survive_their_file(tmp_path):
    sample = make_sample(RECIPE, "valid", 0)
    save_sample(tmp_path / "a.npz", sample)
    loaded, seconds = load_sample(tmp_path / "a.npz")
    assert {**loaded.attributes, "solve_seconds": seconds["solve_seconds"]} == sample.attributes
    np.testing.assert_array_equal(loaded.position, sample.position)
    np.testing.assert_array_equal(loaded.stress, sample.stress)
    np.testing.assert_array_equal(loaded.scene.elements, sample.scene.elements)
    assert loaded.scene.material is None and loaded.position.dtype == np.float32
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_the_solver_and_its_workers_need_no_torch():
    script = (
        "import sys, ast_sim.simulate.jobs.worker, ast_sim.simulate.jobs.generate;"
        "from ast_sim.simulate.jobs.samples import Recipe, make_sample;"
        "make_sample(Recipe('deforming_plate', 0, 80, 3), 'train', 0);"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"


def test_workers_have_one_thread_each_and_reproducible_products(tmp_path):
    worker = pool.Worker(tmp_path, RECIPE)
    worker.give(("train", 0))
    messages = worker.receive()
    while "progress" in messages[-1]:
        messages += worker.receive()
    assert messages[-1] == {"status": "complete"}
    environment = pathlib.Path(f"/proc/{worker.process.pid}/environ").read_bytes().decode().split("\0")
    threads = len(list(pathlib.Path(f"/proc/{worker.process.pid}/task").iterdir()))
    worker.stop()
    assert {"OMP_NUM_THREADS=1", "OPENBLAS_NUM_THREADS=1", "MKL_NUM_THREADS=1"} <= set(environment)
    assert {"MKL_THREADING_LAYER=SEQUENTIAL", "MKL_CBWR=AVX2"} <= set(environment)
    assert threads == 1


def test_a_torn_manifest_is_only_what_a_person_reads(tmp_path):
    save_sample(sample_path(tmp_path, "train", 0), make_sample(RECIPE, "train", 0))
    (tmp_path / "manifest.jsonl").write_text(
        '{"sample": "train/000000", "state": "failed", "reason": "an old one"}\n{"sample": "train/000000", "state": "pe'
        '\n[]\n{"sample": "train/000001", "state": "done", "bytes": 1}\n\xff\n{"sample": "train/0000'
    )
    manifest = Manifest(tmp_path, [("train", 0), ("train", 1)], {("train", 0)})
    manifest.close()
    assert manifest.failures == {"train/000000": "an old one"}
    assert {name: lines[-1]["state"] for name, lines in states(tmp_path).items()} == {
        "train/000000": "done", "train/000001": "pending"
    }  # fmt: skip


def test_progress_prints_lines_where_there_is_no_terminal(capsys, monkeypatch):
    monkeypatch.setattr("ast_sim.support.progress.SECONDS_BETWEEN_LINES", 0.0)
    with SceneProgress(4, "scenes", True, done=1) as bar:
        bar.advance()
        bar.line("a note")
        bar.advance()
    first, second, note, third = capsys.readouterr().err.splitlines()
    assert first == "1 of 4 scenes are there already" and note == "a note"
    assert second.startswith("2 of 4 scenes, ") and third.startswith("3 of 4 scenes, ") and third.endswith(" s to go")
    with SceneProgress(2, "scenes", False) as bar:
        bar.advance()
    assert capsys.readouterr().err == ""


def test_long_scenes_tell_how_far_they_are(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("ast_sim.simulate.jobs.display.time.monotonic", lambda: now[0])
    with SceneProgress(2, "scenes", True) as bar:
        bar.begin("train/000000")
        bar.inside("train/000000", 4, 21, 120)  # an earlier run left four frames
        bar.begin("train/000001")
        now[0] = 29.0
        bar.tick()
        assert capsys.readouterr().err == ""
        now[0] = 600.0
        bar.inside("train/000000", 8, 21, 300)
        bar.tick()
        now[0] = 610.0
        bar.tick()
        bar.end("train/000000")
        now[0] = 640.0
        bar.tick()
    assert capsys.readouterr().err.splitlines() == [
        "train/000000: frame 8 of 21, 300 iterations, 10 min 00 s so far, about 32 min 30 s to go",
        "train/000001: 10 min 00 s so far",
        "train/000001: 10 min 40 s so far",
    ]
