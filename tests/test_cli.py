"""The command line: every command on real files, and every kind of bad input as one line and exit code 2."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import toy
from data_samples import sign

import ast_sim
from ast_sim.cli import build_parser, main
from ast_sim.dataset.reader import Dataset
from ast_sim.support.errors import AstSimError
from ast_sim.support.toml_settings import settings
from ast_sim.training.configure import configure

SMALL = [
    "train.steps=6", "train.batch_size=2", "train.log_every=2", "train.statistics_pairs=4", "model.hidden=16",
    "model.decoder_hidden=16", "model.d_token=16", "model.heads=1", "model.head_dim=16", "model.ffn_inner=16",
    "model.L_SA=1",
]  # fmt: skip
SET = [part for assignment in SMALL for part in ("--set", assignment)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A dataset and a run on it."""
    folder = tmp_path_factory.mktemp("cli")
    data = toy.write(folder / "toy.h5")
    assert main(["train", str(data), "--out", str(folder / "run"), *SET]) == 0
    return data, folder / "run"


def fails(capsys, *arguments) -> str:
    """Run a command that must fail with one line on stderr; returns the line."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        sys.exit(main([str(argument) for argument in arguments]))
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert error.count("\n") == 1, error
    return error


# What the commands do


def test_help_lists_every_command_and_imports_no_torch():
    code = (
        "import sys; from ast_sim.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'numpy', 'h5py'} & set(sys.modules), sorted(sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in ("demo", "generate", "convert", "info", "train", "predict", "evaluate", "report"):
        assert f"\n    {name} " in found.stdout


def test_train_help_explains_every_setting(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    shown = capsys.readouterr().out
    # What a training gets without --preset, not the defaults of the paper.
    for name in ("ast", "mgn"):
        config = configure("d.h5", "tiny", model=name)
        section = shown[shown.index(f"\n{name}, presets") :].split("\n\n")[0]
        for setting in settings(type(config.model), vars(config.model)):
            assert f"  model.{setting.key}={setting.default}  (" in section
    assert "train.batch_size=4  (" in shown and "train.optimizer=muon  (" in shown
    assert "model.L_SA=2  (" in shown and "model.L_cell=none  (" in shown
    assert "\n  train.peak_rate=0.004  (in tiny)" in shown
    lines = shown.splitlines()
    unset = [text for line, text in zip(lines, lines[1:], strict=False) if re.match(r"  (train|model)\.\w+=none", line)]
    assert len(unset) > 10 and all("unset:" in text or "from the dataset" in text for text in unset), unset
    assert "ast, presets tiny, deforming_plate, sphere_simple, abcd, abcd_xl:" in shown
    for model in ("mgn", "bsms", "hcmt", "transolver"):
        assert f"\n{model}, presets tiny, " in shown
    assert "model.slices=32" in shown and "model.most_world_edges=none" in shown


def test_generate_help_tells_of_every_family_and_imports_no_solver():
    code = (
        "import sys; from ast_sim.cli import main\n"
        "try: main(['generate', '--help'])\n"
        "except SystemExit: pass\n"
        "assert not {'torch', 'numpy', 'h5py', 'ipctk'} & set(sys.modules), sorted(sys.modules)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    for name in ("deforming_plate", "sphere_simple", "abcd", "abcd_xl"):
        assert f"\n  {name} " in shown
    for option in ("nodes", "frames", "keep", "order", "solver", "parts", "workers", "scheduler"):
        assert f"--{option}" in shown


def test_generate_makes_a_dataset_of_the_settings_given(tmp_path, capsys):
    out = tmp_path / "plates.h5"
    counts = ["--count", "1", "--valid", "0", "--test", "0", "--calibration", "1"]
    options = [*counts, "--seed", "3", "--nodes", "80", "--frames", "3", "--workers", "1"]
    assert main(["generate", "deforming_plate", "--out", str(out), *options]) == 0
    assert f"{out}: 1 train, 0 valid, 0 test, 1 calibration" in capsys.readouterr().out
    with Dataset(out) as dataset:
        assert dataset.num_frames("train", 0) == 3
        first, other = dataset["train"][0], dataset.calibration[0]
        assert not np.array_equal(first.scene.rest_position[:3], other.scene.rest_position[:3])  # another draw
        assert dataset.info.generator["command"] == "ast-sim generate deforming_plate --seed 3 --nodes 80 --frames 3"


def test_generate_keeps_the_frames_asked_for(tmp_path, capsys):
    out = tmp_path / "plates.h5"
    plates = (
        "generate",
        "deforming_plate",
        "--out",
        str(out),
        "--count",
        "1",
        "--valid",
        "0",
        "--test",
        "0",
        "--nodes",
        "80",
    )
    assert main([*plates, "--frames", "9", "--keep", "2,6", "--workers", "1"]) == 0
    with Dataset(out) as dataset:
        assert dataset.num_frames("train", 0) == 3
        assert dataset.info.generator["command"].endswith("--nodes 80 --frames 9 --keep 2,6")
    assert "'2;6' is no list of whole numbers, such as 5,10,-1" in fails(capsys, *plates, "--keep", "2;6")
    error = fails(capsys, *plates, "--frames", "9", "--keep", "2,9")
    assert "keep is [2, 9]; must be numbers of frames from 1 to 8, beside frame 0" in error


def test_info_of_a_dataset(trained, capsys):
    data, _ = trained
    assert main(["info", str(data), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "dataset"
    assert facts["integration"] == "quasi_static"
    assert {split: values["trajectories"] for split, values in facts["splits"].items()} == {
        "train": 3, "valid": 2, "test": 2,
    }  # fmt: skip
    train = facts["splits"]["train"]
    assert train["nodes"] == [48, 58]  # 5 x 4 x 2 or 5 x 5 x 2 of the plate and 8 of the block
    assert train["frames"] == [7, 7]
    assert train["node_types"] == {"NORMAL": 24 + 30 + 24, "OBSTACLE": 24, "HANDLE": 16 + 20 + 16}
    assert train["truncated"] == train["outside_domain"] == []
    assert main(["info", str(data)]) == 0
    assert "stress_location" in capsys.readouterr().out


def test_info_of_a_run(trained, capsys):
    _, run = trained
    assert main(["info", str(run), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "run"
    assert facts["latest_checkpoint"] == "step-6"
    assert facts["train"]["steps"] == 6
    assert facts["best_validation"]["valid_rmse"] > 0


def test_evaluate_prints_a_table_and_writes_all_figures(trained, tmp_path, capsys):
    data, run = trained
    assert main(["evaluate", str(run), str(data), "--out", str(tmp_path / "evaluation.json")]) == 0
    shown = capsys.readouterr().out
    assert "hold_still" in shown and "stress_frame_mean" in shown
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["errors"]["displacement"]["model"]["rollout_all"]["normal"]["rmse_sequence"] > 0
    assert found["origin"]["split"] == "test"
    assert [scene["name"] for scene in found["scenes"]] == ["test/000000", "test/000001"]


@pytest.mark.parametrize("name", ["prediction.h5", "prediction.pvd", "prediction.vtkhdf"])
def test_predict_writes_the_format_that_the_name_asks_for(trained, tmp_path, capsys, name):
    data, run = trained
    out = tmp_path / "new" / name
    assert main(["predict", str(run), str(data), "--index", "1", "--out", str(out)]) == 0
    assert "6 frames predicted" in capsys.readouterr().out
    with Dataset(data) as dataset:
        truth = dataset.load("test", 1)
    if name.endswith(".h5"):
        with Dataset(out) as dataset:
            prediction = dataset.load("test", 0)
        assert np.array_equal(prediction.scene.elements, truth.scene.elements)
        prescribed = truth.scene.prescribed
        assert np.array_equal(prediction.position[:, prescribed], truth.position[:, prescribed])
        assert prediction.attributes["source"].endswith("toy.h5: test/000001")
        assert prediction.attributes["status"] == "complete"
    elif name.endswith(".vtkhdf"):
        with h5py.File(out) as file:
            assert file["VTKHDF/Steps"].attrs["NSteps"] == 7
    else:
        assert out.read_text().count("<DataSet ") == 7


def test_a_failing_prediction_keeps_the_frames_before(trained, tmp_path, capsys, monkeypatch):
    import torch

    from ast_sim.models.simulator import Prediction, Simulator

    real = Simulator.predict

    def predict(self, batch):
        prediction = real(self, batch)
        wrong = torch.tensor([name.endswith("frame 3") for name in batch.names])
        rows = wrong.repeat_interleave(batch.graph.node_offsets.diff())
        return Prediction(torch.where(rows[:, None], torch.inf, prediction.motion), prediction.fields)

    monkeypatch.setattr(Simulator, "predict", predict)
    data, run = trained
    out = tmp_path / "prediction.h5"
    error = fails(capsys, "predict", run, data, "--index", 0, "--out", out)
    assert "frame 3" in error and str(out) in error
    with Dataset(out) as dataset:
        assert dataset.num_frames("test", 0) == 3
        assert dataset.attributes("test", 0)["status"] == "truncated"


def test_report_is_one_page(trained, tmp_path, capsys):
    _, run = trained
    assert main(["report", str(run), "--out", str(tmp_path / "pages" / "report.html")]) == 0
    page = (tmp_path / "pages" / "report.html").read_text()
    assert page.startswith("<!")
    assert "test/000001" in page


def test_a_page_compares_runs_on_one_dataset(trained, tmp_path, capsys):
    """Scenes of two datasets have the same names; the page would show the truth of one and the answers to the other."""
    data, run = trained
    other = toy.write(tmp_path / "other.h5", (3, 1, 1))
    assert main(["train", str(other), "--out", str(tmp_path / "second"), *SET]) == 0
    error = fails(capsys, "report", run, tmp_path / "second", "--out", tmp_path / "page.html")
    assert "second was evaluated on other scenes (other.h5) than" in error and "--data" in error
    shown = ("report", str(run), str(tmp_path / "second"), "--data", str(data), "--out", str(tmp_path / "page.html"))
    assert main(list(shown)) == 0 and (tmp_path / "page.html").is_file()


def test_what_looks_wrong_is_a_table(tmp_path, capsys):
    from ast_sim.view import export

    still = toy.plate(0)
    still.position[:, -1] += np.linspace(0, 0.01, len(still.position))[:, None]  # a corner of the rigid tool is pulled
    export.write(tmp_path / "case.pvd", still)
    out = tmp_path / "own.h5"
    assert main(["convert", str(tmp_path / "case.pvd"), "--out", str(out), "--shares", "1", "0", "0"]) == 0
    shown = capsys.readouterr()
    first, second, *_ = [line for line in shown.out.splitlines() if "  " in line]
    assert first.split("  ")[0] == "what looks wrong" and "edges of obstacles that change" in second
    assert first.index("what it means") == second.index("edges of an obstacle change by") and shown.err == ""


def test_a_series_of_another_program_becomes_a_dataset(tmp_path, capsys):
    from ast_sim.view import export

    (tmp_path / "results").mkdir()
    for seed in range(3):
        export.write(tmp_path / "results" / f"case{seed}.pvd", toy.plate(seed))
    shares = ["--shares", "0.5", "0", "0.5", "--calibration", "1"]
    assert main(["convert", str(tmp_path / "results"), "--out", str(tmp_path / "own.h5"), *shares]) == 0
    assert "1 train, 0 valid, 1 test, 1 calibration" in capsys.readouterr().out
    with Dataset(tmp_path / "own.h5") as dataset:
        assert dataset.info.stress_location == "node"
        assert dataset.num_frames("test", 0) == 7


def test_resume_without_a_dataset_takes_the_dataset_of_the_run(trained, capsys):
    _, run = trained
    assert main(["train", "--out", str(run), "--resume"]) == 0
    assert "going on after step 6" in capsys.readouterr().out


# What an output may overwrite


@pytest.fixture
def commands(trained, tmp_path):
    """Each command that writes a file, without its output; and its own copies of what it reads."""
    from ast_sim.view import export

    data, run = shutil.copy(trained[0], tmp_path / "toy.h5"), shutil.copytree(trained[1], tmp_path / "run")
    (tmp_path / "series").mkdir()
    export.write(tmp_path / "series" / "case.pvd", toy.plate())
    return {
        "convert": ("convert", tmp_path / "series" / "case.pvd", "--shares", 1, 0, 0, "--out"),
        "predict": ("predict", run, data, "--index", 1, "--out"),
        "report": ("report", run, "--data", data, "--out"),
        "evaluate": ("evaluate", run, data, "--out"),
    }


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


OUTPUTS = {"convert": "new.h5", "predict": "new.h5", "report": "new.html", "evaluate": "new.json"}


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_that_exists_is_replaced_only_with_overwrite(commands, tmp_path, capsys, name):
    out = tmp_path / OUTPUTS[name]
    out.write_text("old")
    assert "exists: name another output, or give --overwrite" in fails(capsys, *commands[name], out)
    assert out.read_text() == "old"
    assert main([str(word) for word in (*commands[name], out, "--overwrite")]) == 0
    assert out.read_bytes() != b"old"


@pytest.mark.parametrize("name", OUTPUTS)
def test_an_output_in_a_run_is_refused(commands, tmp_path, capsys, name):
    before = contents(tmp_path / "run")
    (tmp_path / "link").symlink_to(tmp_path / "run")
    for folder in (tmp_path / "run", tmp_path / "run" / "checkpoints", tmp_path / "link", tmp_path / "run" / "new"):
        assert "lies in the run" in fails(capsys, *commands[name], folder / OUTPUTS[name], "--overwrite")
    assert contents(tmp_path / "run") == before
    assert "lies in the run" in fails(capsys, *commands["evaluate"], tmp_path / "run" / "config.toml", "--overwrite")


@pytest.mark.parametrize("link", ["no link", "symbolic link", "hard link"])
def test_an_output_that_is_an_input_is_refused(commands, tmp_path, capsys, link):
    before = contents(tmp_path)
    for name, given, suffix in (
        ("predict", "toy.h5", ".h5"),
        ("evaluate", "toy.h5", ".h5"),
        ("convert", "series/case.pvd", ".h5"),
    ):
        out = tmp_path / given
        if link != "no link":
            out = tmp_path / f"{name}{suffix}"
            out.symlink_to(tmp_path / given) if link == "symbolic link" else out.hardlink_to(tmp_path / given)
        elif name == "convert":
            continue
        error = fails(capsys, *commands[name], out, "--overwrite")
        assert f"would overwrite the input {tmp_path / given}" in error
    assert {path: data for path, data in contents(tmp_path).items() if path in before} == before


def test_a_series_that_is_an_input_is_not_replaced(commands, tmp_path, capsys):
    mesh = tmp_path / "series" / "case" / "frame_00000.vtu"
    error = fails(capsys, "predict", tmp_path / "run", mesh, "--out", tmp_path / "series" / "case.pvd", "--overwrite")
    assert "would overwrite the input" in error
    (tmp_path / "series" / "case.pvd").unlink()
    error = fails(capsys, *commands["predict"], tmp_path / "series" / "case.pvd")
    assert f"{tmp_path / 'series' / 'case'} exists" in error


def test_a_folder_that_is_converted_may_hold_the_dataset_but_not_lose_a_file(commands, tmp_path, capsys):
    series = tmp_path / "series"
    command = ["convert", str(series), "--shares", "1", "0", "0", "--out", str(series / "new.h5")]
    assert main(command) == 0
    assert "exists" in fails(capsys, *command)
    assert main([*command, "--overwrite"]) == 0
    (series / "link.h5").symlink_to(series / "case.pvd")
    error = fails(capsys, "convert", series, "--out", series / "link.h5", "--overwrite")
    assert f"would overwrite the input {series / 'case.pvd'}" in error
    assert "must end in .h5" in fails(capsys, "convert", series, "--out", series / "case.pvd", "--overwrite")


# What is wrong, in one line


def test_unknown_keys_presets_and_commands_name_what_there_is(trained, tmp_path, capsys):
    data, _ = trained
    out = ("--out", tmp_path / "run")
    assert "train.batch_size" in fails(capsys, "train", data, *out, "--set", "train.batchsize=3")
    assert "train.steps" in fails(capsys, "train", data, *out, "--set", "train.steps=many")
    assert "did you mean 'tiny'" in fails(capsys, "train", data, *out, "--preset", "tny")
    assert "invalid choice" in fails(capsys, "trian")
    unknown = "ast-sim train: there is no option --reusme; did you mean '--resume'? (see ast-sim train --help)\n"
    assert fails(capsys, "train", data, *out, "--reusme") == fails(capsys, "train", data, *out, "--reusme=1") == unknown
    assert "ast-sim info: there is no option -x; there are: --help, --debug, --json, --" in fails(
        capsys, "info", data, "-x"
    )
    assert "ast-sim train: 'more' is one argument too many (see" in fails(capsys, "train", data, "more", *out)
    assert "--set" in fails(capsys, "train", "--out", tmp_path / "run", "--resume", "--set", "train.steps=3")
    assert not (tmp_path / "run").exists()


def test_damaged_datasets(trained, tmp_path, capsys):
    data, _ = trained
    whole = data.read_bytes()
    (tmp_path / "short.h5").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.h5").write_text("positions: 1 2 3\n")
    for name in ("short.h5", "text.h5", "absent.h5"):
        for command in (("info",), ("train", "--out", tmp_path / "run")):
            assert name in fails(capsys, *command, tmp_path / name)


def spoiled(data, path, array, index, value):
    path.write_bytes(data.read_bytes())
    with h5py.File(path, "r+") as file:
        file[f"train/000001/{array}"][index] = value
        sign(file)
    return path


def test_a_position_that_is_nan_names_file_sample_frame_and_node(trained, tmp_path, capsys):
    path = spoiled(trained[0], tmp_path / "nan.h5", "position", (3, 17, 0), np.nan)
    for command in (("info", path), ("train", path, "--out", tmp_path / "run")):
        error = fails(capsys, *command)
        assert "nan.h5" in error and "train/000001" in error and "frame 3" in error and "node 17" in error


def test_an_index_out_of_range_names_file_sample_and_element(trained, tmp_path, capsys):
    path = spoiled(trained[0], tmp_path / "index.h5", "elements", (5, 2), 999)
    error = fails(capsys, "train", path, "--out", tmp_path / "run")
    assert "index.h5" in error and "train/000001" in error and "element 5 refers to node 999" in error


def test_a_node_outside_the_domain_names_the_samples_and_the_node(trained, tmp_path, capsys):
    path = tmp_path / "outside.h5"
    path.write_bytes(trained[0].read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["domain_half_width"] = 0.15
    error = fails(capsys, "train", path, "--out", tmp_path / "run", *SET)
    assert "outside.h5" in error and "train/00000" in error and "domain_half_width" in error
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["splits"]["train"]["outside_domain"] == [0, 1, 2]


def test_missing_extras_name_the_pip_line(trained, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipctk", None)
    monkeypatch.setitem(sys.modules, "plotly", None)
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    error = fails(capsys, "generate", "deforming_plate", "--out", tmp_path / "plates.h5", "--count", 1)
    assert 'pip install "ast_sim[simulate]"' in error
    error = fails(capsys, "report", trained[1], "--out", tmp_path / "report.html")
    assert 'pip install "ast_sim[view]"' in error


def test_a_folder_that_is_no_run_and_a_dataset_of_another_kind(trained, tmp_path, capsys):
    data, run = trained
    assert "not a run folder" in fails(capsys, "evaluate", tmp_path, data)
    other = toy.write(tmp_path / "other.h5", stress=False)
    error = fails(capsys, "evaluate", run, other)
    assert "stress_location none" in error and "other.h5" in error
    assert "the split has 2" in fails(capsys, "predict", run, data, "--index", 2, "--out", tmp_path / "x.h5")
    assert ".vtkhdf" in fails(capsys, "predict", run, data, "--index", 0, "--out", tmp_path / "x.obj")
    assert "must end in .json" in fails(capsys, "evaluate", run, data, "--out", tmp_path / "x.html")


def test_arguments_out_of_range(tmp_path, capsys):
    assert "0 is below 1" in fails(capsys, "generate", "deforming_plate", "--out", tmp_path / "a.h5", "--count", 0)
    assert "ball" in fails(capsys, "generate", "ball", "--out", tmp_path / "a.h5", "--count", 1)
    plates = ("generate", "deforming_plate", "--out", tmp_path / "a.h5", "--count", 1)
    assert "frames is 2; must be at least 3" in fails(capsys, *plates, "--frames", 2)
    assert "invalid choice: 'abaqus'" in fails(capsys, *plates, "--solver", "abaqus")
    assert "not allowed with" in fails(capsys, *plates, "--workers", 2, "--scheduler", "tcp://host:8786")
    error = fails(capsys, *plates, "--parts", tmp_path)
    assert "deforming_plate has no option parts; these families have it: abcd, abcd_xl" in error
    assert os.listdir(tmp_path) == []


def test_what_is_given_twice_for_one_thing_is_refused(trained, tmp_path, capsys):
    data, run = trained
    scene = tmp_path / "scene.vtu"
    with Dataset(data) as dataset:
        dataset["test"][0].scene.to_meshio().write(scene)
    out = ("predict", run, scene, "--out", tmp_path / "x.h5")
    assert "--move is given twice for 1: leave one out" in fails(capsys, *out, "--move=1=0,0,1", "--move=1=0,0,2")
    moved = (*out, "--move=1=0,0,1")
    errors = ("--error=2%", "--error=displacement=5%")
    assert "--error is given twice for displacement: leave one out" in fails(capsys, *moved, *errors)
    convert = ("convert", "results", "--out", tmp_path / "x.h5")
    for option in ("--obstacle", "--handle", "--stress", "--reaction"):
        assert f"{option} is given twice: leave one out" in fails(capsys, *convert, option, "a", option, "b")
    materials = ("--material=0=1e6,0.3", "--material=0=2e6,0.3")
    assert "--material is given twice for 0: leave one out" in fails(capsys, *moved, *materials)
    assert os.listdir(tmp_path) == ["scene.vtu"]


def test_options_with_several_values_may_be_repeated():
    parser = build_parser()
    columns = ("--material", "young=E", "--material", "poisson=nu", "--split", "train", "--split", "test")
    given = parser.parse_args(["convert", "source", "--out", "data.h5", *columns])
    assert given.material == ["young=E", "poisson=nu"] and given.split == ["train", "test"]
    runs = ("--beside", "a", "--beside", "b", "c")
    given = parser.parse_args(["trade", "run", "data.h5", "--out", "page.html", *runs])
    assert given.beside == [Path(name) for name in "abc"]


def test_a_report_is_html_and_its_name_says_so(trained, tmp_path, capsys):
    from ast_sim import Trade
    from ast_sim.inference.evaluation.evaluated_run import report_evaluations
    from ast_sim.view.dataset_page import gallery

    error = fails(capsys, "report", trained[0], "--out", tmp_path / "rr.pdf")
    assert "rr.pdf: the name of a page must end in .html or .htm" in error
    with pytest.raises(AstSimError, match="must end in"):
        gallery.write(tmp_path / "rr", trained[0])
    for write in (Trade({}).report, lambda path: report_evaluations(path, [None])):
        with pytest.raises(AstSimError, match="must end in"):
            write(tmp_path / "a folder" / "rr.pdf")
    assert os.listdir(tmp_path) == []
    assert main(["report", str(trained[0]), "--out", str(tmp_path / "RR.HTM")]) == 0


def test_a_folder_that_cannot_be_made_is_one_line(trained, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert "file" in fails(capsys, "train", trained[0], "--out", tmp_path / "file" / "run")
    assert "file" in fails(capsys, "report", trained[1], "--out", tmp_path / "file" / "report.html")


PLATES = ("generate", "deforming_plate", "--count", 1)


@pytest.mark.parametrize("kind", ["empty", "folder"])
def test_an_output_without_a_name_and_a_folder_as_a_file(trained, tmp_path, capsys, monkeypatch, kind):
    data, run = trained
    monkeypatch.chdir(tmp_path)
    files = [
        (*PLATES, "--out"),
        ("convert", tmp_path, "--out"),
        ("predict", run, data, "--index", 0, "--out"),
        ("evaluate", run, data, "--out"),
        ("report", run, "--out"),
    ]
    if kind == "empty":
        for command in (*files, ("train", data, "--out"), ("demo", "--quick", "--out"), ("info",)):
            assert "'' is no name of a file or a folder" in fails(capsys, *command, "")
    else:
        for command in files:
            suffix = {"report": ".html", "evaluate": ".json"}.get(command[0], ".h5")
            folder = tmp_path / f"folder{suffix}"
            folder.mkdir(exist_ok=True)
            assert f"{folder} is a folder: name a file" in fails(capsys, *command, folder)
    assert all(path.is_dir() and not list(path.iterdir()) for path in tmp_path.iterdir())


def test_more_scenes_than_a_dataset_or_the_disk_can_hold(tmp_path, capsys, monkeypatch):
    out = tmp_path / "new" / "a.h5"
    many = ("generate", "deforming_plate", "--out", out, "--count")
    assert "at most 1,000,000" in fails(capsys, *many, 99999999999)
    assert "1,000,001 scenes are too many" in fails(capsys, *many, 833_333)
    usage = shutil.disk_usage(tmp_path)._replace(free=16 * 12 * 1000 * 100 - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage if folder == tmp_path else None)
    error = fails(capsys, *many, 10, "--valid", 1, "--test", 1, "--nodes", 1000, "--frames", 100)
    assert f"12 scenes need more than 0.019 GB, but {tmp_path} has 0.019 GB" in error
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("command", [["info"], ["--help"]])
def test_a_closed_output_is_one_line(trained, command):
    words = [sys.executable, "-m", "ast_sim.cli", *command, *([str(trained[0])] if command == ["info"] else [])]
    found = subprocess.run(["sh", "-c", 'exec "$@" >&-', "sh", *words], stderr=subprocess.PIPE, text=True)
    assert found.returncode == 2
    assert found.stderr == "ast-sim: standard output is closed: send it to /dev/null instead\n"


def test_what_a_file_holds_cannot_drive_the_terminal(trained, tmp_path, capsys):
    path = tmp_path / "escapes.h5"
    path.write_bytes(trained[0].read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["family"] = "plate\x1b]0;title\x07\nkind  run"
        file.attrs["generator"] = json.dumps({"\x1b[2J": {"\x9b1m": "\u202e"}})
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert r"plate\x1b]0;title\x07\nkind  run" in shown
    assert r"\x1b[2J" in shown and r"\x9b1m  \u202e" in shown
    assert all(line.isprintable() for line in shown.split("\n"))
    with h5py.File(path, "r+") as file:
        file.attrs["integration"] = "\x1b[31mred"
    assert fails(capsys, "info", path).strip().isprintable()


def test_debug_shows_the_traceback(tmp_path):
    from ast_sim.support.errors import DatasetError

    with pytest.raises(DatasetError):
        main(["info", str(tmp_path / "absent.h5"), "--debug"])


def test_a_reader_that_goes_away_is_no_error(trained):
    process = subprocess.Popen(
        [sys.executable, "-m", "ast_sim.cli", "info", str(trained[0])], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 141


def test_the_command_needs_no_terminal_and_no_home(trained):
    environment = {key: value for key, value in os.environ.items() if key != "HOME"}
    subprocess.run([sys.executable, "-m", "ast_sim.cli", "info", str(trained[0])], check=True, env=environment)


def test_names_that_are_not_utf_8(trained, tmp_path, capsys):
    """They work, and messages show them escaped, or they are refused where a file cannot hold them."""
    from ast_sim.view import export

    folder = tmp_path / os.fsdecode(b"f\xff")
    folder.mkdir()
    data, run = folder / os.fsdecode(b"d\xe9.h5"), folder / os.fsdecode(b"r\xe9")
    shutil.copy(trained[0], data)
    shutil.copytree(trained[1], run)
    export.write(tmp_path / "case.pvd", toy.plate())
    (tmp_path / "case").rename(folder / os.fsdecode(b"c\xe9"))

    def works(*words) -> str:
        assert main([str(word) for word in words]) == 0
        capsys.readouterr().out.encode()
        return str(words[-1])

    shown = r"f\udcff/d\udce9.h5"
    works("info", data)
    works("info", run)
    prediction = works("predict", run, data, "--index", 0, "--out", folder / os.fsdecode(b"p\xe9.h5"))
    with Dataset(prediction) as dataset:
        assert dataset.attributes("test", 0)["source"].endswith(rf"{shown}: test/000000")
    works("predict", run, data, "--index", 0, "--out", folder / os.fsdecode(b"p\xe9.vtkhdf"))
    works("evaluate", run, data, "--out", folder / os.fsdecode(b"e\xe9.json"))
    for shows in ((data,), (run, "--data", data)):
        page = works("report", *shows, "--overwrite", "--out", folder / os.fsdecode(b"w\xe9.html"))
        with open(page, encoding="utf-8") as file:
            assert r"\udce9" in file.read()
    works("convert", folder, "--shares", "1", "0", "0", "--out", folder / os.fsdecode(b"n\xe9.h5"))
    error = fails(capsys, "train", data, "--out", tmp_path / "new", *SET)
    assert shown in error and "a run cannot keep a path that is not UTF-8" in error and not (tmp_path / "new").exists()
    pvd = folder / os.fsdecode(b"q\xe9.pvd")
    assert "cannot hold a name that is not UTF-8" in fails(capsys, "predict", run, data, "--index", 0, "--out", pvd)
    assert not pvd.exists() and not pvd.with_suffix("").exists()
    assert r"absent\udce9.h5" in fails(capsys, "info", folder / os.fsdecode(b"absent\xe9.h5"))


@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize("words", [["--help"], ["--version"], ["train", "--help"]])
def test_a_help_that_cannot_be_written_is_an_error(words, buffered):
    environment = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    command = [sys.executable, "-m", "ast_sim.cli", *words]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    name = " ".join(["ast-sim", *words[:-1]])
    assert (done.returncode, done.stderr) == (2, f"{name}: [Errno 28] No space left on device\n")


@pytest.mark.parametrize("redirect", ["2>/dev/full", "2>&-"])
def test_a_warning_that_nobody_can_read_ends_nothing(trained, tmp_path, redirect, capsys):
    """This question warns: a toy is no plate."""
    run = Path(ast_sim.__file__).parent / "example_runs/plates.ast"
    words = ["predict", str(run), str(trained[0]), "--index", "0", "--out", str(tmp_path / "o.h5")]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(words) == 0
    assert "warning: " in capsys.readouterr().err
    (tmp_path / "o.h5").unlink()
    asked = shlex.join([sys.executable, "-m", "ast_sim.cli", *words])
    buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(["sh", "-c", f"{asked} {redirect}"], stdout=subprocess.PIPE, text=True, env=buffered)
    assert done.returncode == 0 and done.stdout.startswith(f"{tmp_path}/o.h5: 6 frames predicted")
    with Dataset(tmp_path / "o.h5") as answer:
        assert answer["test"][0].num_frames == 7


def test_warnings_as_errors_are_one_line(trained, tmp_path):
    run = Path(ast_sim.__file__).parent / "example_runs/plates.ast"
    words = ["predict", run, trained[0], "--index", "0", "--out", tmp_path / "o.h5"]
    with warnings.catch_warnings(action="error"):
        assert main([str(word) for word in words]) == 2
    assert not (tmp_path / "o.h5").exists()
