"""Sweeps with rows that are wrong, that have no scene, or that are stopped: the other rows are not lost."""

import csv
import warnings

import pytest
from simulate.own_assembly.assemblies import SPEC, write_assembly

import ast_sim
from ast_sim.cli import main
from ast_sim.inference import sweep as sweeping
from ast_sim.support.errors import ConfigError, SimulationError

# The punch starts `lift` above its place: below it, it lies in the block.
LIFTED = SPEC.replace("[parameters]", "[parameters]\nlift = [0, 0.5]").replace(
    "rigid = true", 'rigid = true\noffset = [0, 0, "lift"]'
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A specification and a run of a few steps."""
    folder = tmp_path_factory.mktemp("lifted")
    spec = write_assembly(folder, LIFTED)
    data = folder / "study.h5"
    ast_sim.generate("assembly", data, spec=spec, train=4, valid=1, test=1, workers=1, progress=False)
    return spec, ast_sim.train(data, folder / "run", steps=10, validate_every=10, checkpoint_every=10, progress=False)


@pytest.fixture
def small_batches(monkeypatch):
    monkeypatch.setattr(sweeping, "TOGETHER", 2)
    monkeypatch.setattr("ast_sim.view.sweep_files.SECONDS_BETWEEN_PARTS", 0.0)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"travel": "abc"}, "row 4 .*: travel is 'abc'; must be a finite number"),
        ({"travel": ""}, "row 4 .*: travel is ''; must be a finite number"),
        ({"travel": float("nan")}, "row 4 .*: travel is nan; must be"),
        ({"travle": 1.0}, "row 4 .*: there is no parameter 'travle'; did you mean 'travel'"),
        ({"block.young": -1.0}, "row 4 .*: block.young is -1; must be above 0"),
    ],
)
def test_a_wrong_row_is_named_before_any_row_is_predicted(trained, small_batches, wrong, words):
    """It was told after hundreds of rows had been predicted, without its number, and they were lost."""
    spec, run = trained
    predicted = []
    rows = [{"travel": 0.8 + 0.1 * number} for number in range(4)]
    with pytest.raises(ConfigError, match=words):
        run.sweep(spec, table=[*rows, wrong], progress=lambda *told: predicted.append(told))
    assert not predicted


def test_a_row_without_a_scene_leaves_the_others(trained, small_batches, tmp_path, capsys):
    spec, run = trained
    table = [{"travel": 1.0}, {"travel": 1.0, "lift": -3.0}, {"travel": 1.2}, {"lift": -2.0}, {"lift": -2.5}]
    with pytest.warns(UserWarning, match="3 of 5 rows failed; the first: row 1: with lift=-3, travel=1"):
        swept = run.sweep(spec, table=table, progress=False)
    assert ["failure" in row for row in swept.rows] == [False, True, False, True, True]
    assert swept.rows[1]["lift"] == -3.0 and "reaction" not in swept.rows[1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = run.sweep(spec, table=[table[0], table[2]], progress=False)
    assert [swept.rows[0], swept.rows[2]] == alone.rows
    with pytest.raises(SimulationError, match="with lift=-3, travel=1"):  # nothing is left
        run.sweep(spec, table=table[1:2], progress=False)
    out = tmp_path / "force.csv"
    assert main(["sweep", str(run.path), str(spec), "--set", "lift=0.1,-3", "--out", str(out)]) == 0
    assert "warning: 1 of 2 rows failed; the first: row 1" in capsys.readouterr().err
    assert [bool(row["failure"]) for row in csv.DictReader(out.open())] == [False, True]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, MemoryError])
def test_rows_of_a_stopped_sweep_are_kept(trained, small_batches, tmp_path, capsys, monkeypatch, stop):
    spec, run = trained
    values = {"travel": [0.6, 0.7, 0.8, 0.9, 1.0]}
    whole = run.sweep(spec, values, progress=False)
    predict_scenes = ast_sim.Run.predict_scenes
    calls = []

    def stopping(self, *given, **more):
        calls.append(1)
        if len(calls) == 3:
            raise stop
        return predict_scenes(self, *given, **more)

    monkeypatch.setattr(ast_sim.Run, "predict_scenes", stopping)
    words = ["sweep", str(run.path), str(spec), "--set", "travel=0.6,0.7,0.8,0.9,1.0", "--out"]
    out, part = tmp_path / "force.csv", tmp_path / "force.part.csv"
    if stop is KeyboardInterrupt:
        assert main([*words, str(out)]) == 130
    else:
        with pytest.raises(MemoryError):
            main([*words, str(out)])
    assert f"stopped: the first 4 of 5 rows are in {part}" in capsys.readouterr().err
    rows = list(csv.DictReader(part.open()))
    assert [float(row["reaction"]) for row in rows] == [row["reaction"] for row in whole.rows[:4]]
    assert not out.exists()
    assert main([*words, str(out)]) == 2 and "force.part.csv exists" in capsys.readouterr().err  # it is not lost now
    assert main([*words, str(out), "--overwrite"]) == 0
    assert out.exists() and not part.exists()


def test_rows_of_a_killed_sweep_are_kept(trained, small_batches, tmp_path):
    """What a kill leaves is what was written before: here after each pair of rows."""
    spec, run = trained
    seen = []

    def look(done, total, text):
        seen.append(len(list(csv.DictReader((tmp_path / "part.csv").open()))) if done > 2 else 0)

    run.sweep(spec, {"travel": [0.6, 0.7, 0.8, 0.9, 1.0]}, part=tmp_path / "part.csv", progress=look)
    assert seen[:2] == [0, 2]
    assert len(list(csv.DictReader((tmp_path / "part.csv").open()))) == 5


def test_no_picture_of_other_rows_stays_beside_a_table(trained, tmp_path):
    spec, run = trained
    out = tmp_path / "force.csv"
    words = ["sweep", str(run.path), str(spec), "--out", str(out)]
    assert main([*words, "--set", "travel=0.8,1.0"]) == 0
    assert out.with_suffix(".png").exists()
    assert main([*words, "--set", "travel=1.0", "--overwrite"]) == 0
    assert not out.with_suffix(".png").exists()


def test_a_second_sweep_does_not_replace_the_table_of_one_that_goes_on(trained, small_batches, tmp_path, capsys):
    """Both began when there was no table; 30 rows were replaced by 40, and both said that theirs were written."""
    spec, run = trained
    out, part = tmp_path / "force.csv", tmp_path / "force.part.csv"
    second = []

    def begin(done, total, text):
        if not second:
            second.append(main(["sweep", str(run.path), str(spec), "--set", "travel=1,1.1", "--out", str(out)]))

    run.sweep(spec, {"travel": [0.6, 0.7]}, part=part, progress=begin)
    assert second == [2] and "force.part.csv exists" in capsys.readouterr().err and not out.exists()


def test_a_sweep_that_fails_before_its_first_row_leaves_no_file(trained, tmp_path, monkeypatch):
    spec, run = trained
    monkeypatch.setattr(ast_sim.Run, "predict_scenes", lambda *_, **__: (_ for _ in ()).throw(MemoryError))
    with pytest.raises(MemoryError):
        run.sweep(spec, {"travel": [0.6, 0.7]}, part=tmp_path / "new" / "part.csv", progress=False)
    assert not list((tmp_path / "new").iterdir())
