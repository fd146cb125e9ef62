"""A run as one file: the same answers from another place, nothing of this machine in it, no damage in silence."""

import functools
import json
import operator
import os
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import toy

from ast_sim import Dataset, DatasetWriter, Run, train
from ast_sim.cli import main
from ast_sim.runs import run_file
from ast_sim.support.errors import CheckpointError, ConfigError

MEMBERS = {"README.md", "LICENSE", "run.json", "metrics.jsonl", "model.safetensors", "manifest.json"}


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> tuple[Path, Run]:
    """The file of a run of the preset `tiny`, trained for a moment, and that run; both lie in one folder."""
    folder = tmp_path_factory.mktemp("somewhere")
    with DatasetWriter(folder / "toy.h5", toy.info()) as writer:
        for seed, split in enumerate(("train", "valid", "test")):
            plate = toy.plate(seed)
            plate.attributes.update(young=1e6, poisson=0.4, dhat=0.001)
            writer.add(split, plate)
    run = train(folder / "toy.h5", folder / "run", steps=2, statistics_pairs=4, batch_size=2)
    run.save(folder / "toy.ast", licence="CC BY 4.0")
    return folder / "toy.ast", run


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_a_file_answers_as_the_folder_does(saved, tmp_path, capsys):
    file, run = saved
    moved = tmp_path / "moved.ast"
    shutil.copy(file, moved)
    found = Run(moved)
    assert (found.scope, found.effort, found.step, found.info) == (run.scope, run.effort, run.step, run.info)
    assert found.settings.model == run.settings.model and found.settings.train == run.settings.train
    assert list(found.folder.metrics) == list(run.folder.metrics) != []
    with Dataset(run.settings.data) as data:
        truth = data["train"][0]
    answers = [one.predict(truth, frames=[-1]) for one in (run, found)]
    assert np.array_equal(answers[0].position, answers[1].position)
    assert np.array_equal(answers[0].stress, answers[1].stress)
    assert answers[0].expected_error == answers[1].expected_error is not None
    found.save(tmp_path / "again.ast", licence="CC BY 4.0")
    again = members(tmp_path / "again.ast")
    assert {name: again[name] for name in MEMBERS - {"README.md", "manifest.json"}} == {
        name: content for name, content in members(file).items() if name not in ("README.md", "manifest.json")
    }
    assert main(["info", str(moved)]) == 0
    assert re.search(r"^licence +CC BY 4.0$", capsys.readouterr().out, re.M)


def test_what_the_file_holds(saved):
    file, run = saved
    held = members(file)
    assert held.keys() == MEMBERS
    assert file.stat().st_size < 3e6  # `tiny`, without the state of the optimizer
    assert str(file.parent).encode() not in file.read_bytes()  # no path of this machine
    assert held["LICENSE"] == b"CC BY 4.0"
    card = held["README.md"].decode()
    assert 'ast_sim.Run("toy.ast")' in card and "family `toy_plate`, lengths in m" in card
    low, high = run.scope.travel
    assert f"| travel of prescribed nodes [m] | {low:.4g} | {high:.4g} |" in card
    default = f"| {run.effort.corrections} | {run.effort.newton_steps} * |"
    assert card.count(" * |") == 1 and default in card


def test_the_same_run_gives_the_same_bytes(saved, tmp_path):
    file, run = saved
    run.save(tmp_path / "toy.ast", licence="CC BY 4.0")
    assert (tmp_path / "toy.ast").read_bytes() == file.read_bytes()
    run.save(tmp_path / "toy.ast")
    assert b"has not stated a licence" in members(tmp_path / "toy.ast")["LICENSE"]


def test_the_dataset_stays_behind(saved):
    file, run = saved
    found = Run(file)
    with pytest.raises(ConfigError, match=r"toy.ast holds no dataset: name one; the run learned from toy.h5"):
        found.evaluate()
    with Dataset(run.settings.data, "mm") as data:  # an open one; lengths get the run's unit
        evaluation = found.evaluate(data)
    error = evaluation.figures.error("displacement").rmse_sequence
    assert f"Evaluation(run: toy.ast, data: toy.h5, scenes: 1, displacement error: {error:.4g} m, " in repr(evaluation)
    assert "<pre>" in evaluation._repr_html_() and "<td" in evaluation._repr_html_()


def test_a_run_shows_what_it_is(saved):
    file, run = saved
    parameters = sum(p.numel() for p in run.model.parameters())
    shown = repr(Run(file))
    assert shown.startswith(f"Run(path: toy.ast, model: ast, {parameters:,} parameters, checkpoint: step {run.step}, ")
    assert f"family: toy_plate, lengths in m, effort: {run.effort.text}, expected error: " in shown
    errors = [one["valid_rmse"] for one in run.folder.metrics if "valid_rmse" in one]
    heights = [f"{100 * error / max(errors):.1f}" for error in errors]
    for one in (run, Run(file)):
        table = one._repr_html_()
        assert "<td" in table and f"{parameters:,} parameters" in table
        assert [f"{float(height):.1f}" for height in re.findall(r'<rect [^>]*height="(\S+)"', table)] == heights != []


def test_no_damage_is_silent(saved, tmp_path):
    """Flipped bits end in one line, or stand where nothing reads them; a file that was cut off ends in one line."""
    content = bytearray(saved[0].read_bytes())
    whole, refused = run_file._read(saved[0]), 0
    damaged = tmp_path / "damaged.ast"
    for place in np.random.default_rng(0).integers(0, len(content), 60):
        content[place] ^= 1 << (place % 8)
        damaged.write_bytes(content)
        content[place] ^= 1 << (place % 8)
        try:
            assert run_file._read(damaged) == whole
        except CheckpointError as error:
            refused += 1
            assert "\n" not in str(error) and str(damaged) in str(error)
    assert refused > 50
    for size in np.random.default_rng(1).integers(0, len(content), 10):
        damaged.write_bytes(content[:size])
        with pytest.raises(CheckpointError, match="no run file, or it is damaged"):
            run_file._read(damaged)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"run.json": None}, "is no run file: it holds LICENSE, README.md, manifest.json"),
        ({"more.pkl": b""}, "is no run file: it holds"),
        ({"LICENSE": b"MIT"}, "LICENSE is damaged: it differs from the manifest"),
        ({"manifest.json": b"[]"}, "manifest.json is damaged"),
        (
            {"manifest.json": b'{"format": "ast_sim run", "version": 3, "files": {}}'},
            "'ast_sim run' 3, not 'ast_sim run' 2",
        ),
    ],
)
def test_other_files_are_refused(saved, tmp_path, changed, text):
    with zipfile.ZipFile(tmp_path / "other.ast", "w") as archive:
        for name, content in {**members(saved[0]), **changed}.items():
            if content is not None:
                archive.writestr(name, content)
    with pytest.raises(CheckpointError, match=text):
        Run(tmp_path / "other.ast")


def test_compressed_members_are_refused(saved, tmp_path):
    with zipfile.ZipFile(tmp_path / "other.ast", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members(saved[0]).items():
            archive.writestr(name, content)
    with pytest.raises(CheckpointError, match="its members are compressed"):
        Run(tmp_path / "other.ast")


def test_an_earlier_file_stays_if_the_disk_is_full(saved, tmp_path, monkeypatch):
    file, run = saved
    target = tmp_path / "kept.ast"
    shutil.copy(file, target)
    written = []

    def full(self, info, content):
        written.append(info.filename)
        if len(written) == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    with pytest.raises(CheckpointError, match="cannot be written: No space left on device; no part of it was kept"):
        run.save(target)
    assert target.read_bytes() == file.read_bytes() and [path.name for path in tmp_path.iterdir()] == ["kept.ast"]


def test_a_licence_is_a_text(saved, tmp_path):
    with pytest.raises(ConfigError, match="licence is 5; it must be the text of a licence"):
        saved[1].save(tmp_path / "run.ast", licence=5)
    assert not (tmp_path / "run.ast").exists()


def test_the_name_ends_in_ast(saved, tmp_path):
    with pytest.raises(CheckpointError, match=r"run.zip: the name of a run file must end in .ast"):
        saved[1].save(tmp_path / "run.zip")


def edited(saved, path: Path, name: str, content: bytes) -> Path:
    """A copy of the file with another member, and a manifest that fits."""
    changed = {**members(saved[0]), name: content}
    manifest = json.loads(changed.pop("manifest.json"))
    manifest["files"] = run_file._records(changed)
    with zipfile.ZipFile(path, "w") as archive:
        for key, value in {**changed, "manifest.json": json.dumps(manifest).encode()}.items():
            archive.writestr(key, value)
    return path


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("run.json", b"", "run.json is damaged: JSONDecodeError"),
        ("run.json", b"\xff\xfe", "run.json is damaged: "),
        ("run.json", b"[" * 100_000, "run.json is damaged: RecursionError"),
        ("run.json", b"null", "run.json is damaged: TypeError"),
        ("run.json", b"[]", "run.json is damaged: TypeError"),
        ("run.json", b"{}", "run.json is damaged: KeyError: 'settings'"),
        ("LICENSE", b"\xff\xfe", "LICENSE is damaged: it is no text"),
        ("metrics.jsonl", b"\xff\xfe", "metrics.jsonl is damaged: it is no text"),
        ("model.safetensors", b"{}", "the weights do not fit the settings: "),
    ],
)
def test_an_edited_file_whose_manifest_fits_is_one_line(saved, tmp_path, name, content, text):
    path = edited(saved, tmp_path / "edited.ast", name, content)
    with pytest.raises(CheckpointError, match=re.escape(f"{path}: {text}")) as error:
        Run(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("place", "value", "text"),
    [
        (("settings",), [], "run.json is damaged: settings is of the type list"),
        (("step",), "2", "run.json is damaged: step is '2'"),
        (("data",), None, "run.json is damaged: data is None"),
        (("settings", "model", "hidden"), {}, "model.hidden is {}; must be an integer"),
        (("settings", "model", "hidden"), 7, "the weights do not fit the settings: Error(s) in loading"),
        (("answers", "effort"), [1], "what it keeps of its answers cannot be read: "),
        (("answers", "effort"), {"corrections": -1}, "what it keeps of its answers cannot be read: corrections is -1"),
        (("answers", "effort"), {"calls": 1}, "what it keeps of its answers cannot be read: "),
        (("answers", "valid_by_effort"), [{"error": 0.1}], "what it keeps of its answers cannot be read: 'effort'"),
        (("answers", "valid_by_effort", 0, "error"), "<b>", "answers cannot be read: '<b>' is no number"),
    ],
)
def test_an_edited_fact_of_another_kind_is_one_line(saved, tmp_path, place, value, text):
    facts = json.loads(members(saved[0])["run.json"])
    *parents, last = place
    functools.reduce(operator.getitem, parents, facts)[last] = value
    path = edited(saved, tmp_path / "edited.ast", "run.json", json.dumps(facts).encode())
    with pytest.raises((CheckpointError, ConfigError), match=re.escape(text)) as error:
        Run(path)
    assert "\n" not in str(error.value)


def test_a_damaged_curve_is_told_where_it_is_read(saved, tmp_path):
    run = Run(edited(saved, tmp_path / "edited.ast", "metrics.jsonl", b'{"step": 1}\n'))
    with pytest.raises(CheckpointError, match=r"edited.ast: line 1 of metrics.jsonl is damaged: it is no sealed line"):
        run.save(tmp_path / "again.ast")
    assert not (tmp_path / "again.ast").exists()


def test_a_name_of_bytes_that_are_no_text(saved, tmp_path):
    """A name that a shell can type; the model card shows it with an escape."""
    path = Path(os.fsdecode(bytes(tmp_path) + b"/b\xff.ast"))
    saved[1].save(path)
    assert Run(path).step == saved[1].step and b"# b\\udcff\n" in members(path)["README.md"]
