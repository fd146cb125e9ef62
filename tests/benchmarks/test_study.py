"""The protocol of a study: its file, the phases of contact, the choice of rates, a small one from end to end."""

import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import toy
from chosen_figures import evaluation

from ast_sim.figures import MeanError
from ast_sim.inference.answer import Answer
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.runs.config_toml import read_config
from ast_sim.scene import Trajectory
from ast_sim.support.errors import ConfigError
from benchmarks.simulation import increments
from benchmarks.studies import __main__ as study
from benchmarks.studies import page as study_page
from benchmarks.studies import run as study_run
from benchmarks.studies.measure import phase_errors, phases, repeated
from benchmarks.studies.measured_run import MeasuredRun
from benchmarks.studies.plan import Data, Entry, Study, read

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"

TOML = """
title = "Toy"
samples = 16
rates = [1e-3]
validations = 2
horizons = 3
settings = ["train.statistics_pairs=4", "train.batch_size=4"]
[data]
path = "toy.h5"
[models.ast]
settings = ["model.hidden=16", "model.L_SA=1", "model.L_cell=3"]
"""


def written(folder, text: str):
    file = folder / "toy.toml"
    file.write_text(text)
    return file


def test_the_file_says_what_is_compared(tmp_path):
    plan, entries = read(written(tmp_path, TOML + '[models.other]\nmodel = "mgn"\nrates = [1e-4, 2e-4]'))
    common = ("train.statistics_pairs=4", "train.batch_size=4")
    assert plan == Study("Toy", Data(path="toy.h5"), (1e-3,), samples=16, validations=2, horizons=3, settings=common)
    assert list(entries) == ["ast", "other"] and entries["other"] == Entry("mgn", rates=(1e-4, 2e-4))


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("samples = 16", "", "either minutes or samples"),
        ("samples = 16", "samples = 16\nminutes = 1", "either minutes or samples"),
        ("rates = [1e-3]", "rates = []", "at least one of rates"),
        ("title", "titel", "no setting titel; the nearest is title"),
        ('path = "toy.h5"', 'path = "toy.h5"\nfamily = "abcd"', "either|family"),
        ("[models.ast]", "[modles.ast]", "nothing to compare"),
        ('settings = ["m', 'setings = ["m', "no setting setings; the nearest is settings"),
        ("[data]", "[data", "toy.toml: "),
    ],
)
def test_a_wrong_file_is_refused_in_words(tmp_path, old, new, message):
    with pytest.raises(ConfigError, match=message):
        read(written(tmp_path, TOML.replace(old, new)))


def touching(*area: float) -> Trajectory:
    truth = toy.plate(0, frames=len(area))
    return Trajectory(truth.scene, truth.position, truth.stress, {"contact_area": list(area)})


def test_phases_follow_contact_and_the_deepest_frame():
    # The block of the toy scenes is deepest in the middle, at frame 5 of 11.
    truth = touching(0, 0, 1, 2, 2, 3, 2, 2, 1, 0, 0)
    found = {name: np.flatnonzero(frames).tolist() for name, frames in phases(truth).items()}
    assert found == {"before": [0, 1], "first": [2, 3, 4], "full": [5], "release": [6, 7, 8, 9, 10]}
    never = phases(touching(0, 0, 0, 0, 0))
    assert never["before"].all() and not any(never[name].any() for name in ("first", "full", "release"))
    assert phases(toy.plate(0)) is None


def test_errors_of_a_phase_come_from_its_frames():
    truth = touching(0, 0, 1, 2, 2, 3, 2, 2, 1, 0, 0)
    position = truth.position.copy()
    position[3] += 0.5
    found = phase_errors(truth, Answer("scene", truth.scene, position, None, 1, []))
    normal = int((truth.scene.node_type == 0).sum())
    assert found["first"].total == pytest.approx(0.25 * 3 * normal, rel=1e-5) and found["first"].count == 9 * normal
    assert found["before"].count == 3 * normal  # frame 0 is given
    assert found["before"].total == found["full"].total == found["release"].total == 0
    assert phase_errors(truth, Answer("scene", truth.scene, position[:6], None, 1, [])) == {}


def test_a_long_script_goes_forward_and_backward():
    truth = toy.plate(0, frames=4)
    assert np.array_equal(repeated(truth, 3).position, truth.position[[0, 1, 2, 3, 2, 1, 0, 1, 2, 3]])


@pytest.mark.parametrize("search", [1.0, 0.2])
def test_each_model_has_the_rate_of_its_best_validation(monkeypatch, tmp_path, search):
    errors = {("a", 1e-3): 2.0, ("a", 1e-4): 1.0, ("b", 1e-3): 3.0, ("b", 1e-4): None}
    trained, measured = [], []

    def record(job, done):
        done.append((job.name, job.seed, job.rate, job.share))
        error = errors[job.name, job.rate]
        return {"name": job.name, "seed": job.seed, "rate": job.rate, "steps": 1, "best_valid": error}

    monkeypatch.setattr(study, "train", lambda job: record(job, trained))
    monkeypatch.setattr(study, "run", lambda job: record(job, measured))
    monkeypatch.setattr(study, "measure_speeds", lambda jobs: None)
    monkeypatch.setattr(study, "keep_speed", lambda job, record: None)
    plan = Study("x", Data(path="d"), (1e-3, 1e-4), seeds=(5, 6), samples=1, search=search)
    counts = []
    for found in study.conduct(plan, {"a": Entry(), "b": Entry()}, tmp_path, tmp_path, 2, {}):
        counts.append([len(entry["runs"]) for entry in found.values()])
    assert counts == [[1], [1, 1], [2, 1], [2, 2]]
    assert {name: model["rate"] for name, model in found.items()} == {"a": 1e-4, "b": 1e-3}
    assert [run["seed"] for run in found["a"]["runs"]] == [5, 6]
    assert found["a"]["search"] == {"0.001": 2.0, "0.0001": 1.0} and found["b"]["search"]["0.0001"] is None
    assert {(seed, share) for _, seed, _, share in trained} == {(5, search)}
    assert sorted(measured) == [("a", 5, 1e-4, 1), ("a", 6, 1e-4, 1), ("b", 5, 1e-3, 1), ("b", 6, 1e-3, 1)]
    measured.clear()
    known = {"a": {**found["a"], "runs": found["a"]["runs"][1:]}}
    *_, found = study.conduct(plan, {"a": Entry(), "b": Entry(seeds=(7,))}, tmp_path, tmp_path, 2, known)
    assert sorted(measured) == [("a", 5, 1e-4, 1), ("b", 7, 1e-3, 1)]
    assert [run["seed"] for run in found["a"]["runs"]] == [5, 6] and len(trained) == 6


def test_told_to_stop_while_it_writes_it_stops_what_runs(monkeypatch, tmp_path):
    stopped = threading.Event()

    def run(job):
        record = {"name": job.name, "seed": job.seed, "rate": job.rate, "steps": 1, "best_valid": 1.0}
        return record if job.name == "a" or stopped.wait(5) else pytest.fail("it was waited for")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "run", run)
    monkeypatch.setattr(study, "stop", stopped.set)
    monkeypatch.setattr(study, "measure_speeds", lambda jobs: None)
    monkeypatch.setattr(study_page, "write_page", interrupted)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    toy.write(tmp_path / "toy.h5")
    written(tmp_path, TOML.replace("[models.ast]", "[models.a]\n[models.b]"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["study", "toy.toml", "--workers", "2"])
    with pytest.raises(SystemExit, match="stopped: the same command goes on from here"):
        study.main()
    assert stopped.is_set()


def test_a_small_study_from_end_to_end(tmp_path):
    data = toy.write(tmp_path / "toy.h5")
    plan, entries = read(written(tmp_path, TOML.replace("toy.h5", str(data)).replace("1e-3]", "1e-3, 1e-4]")))

    def conducted(**entries: Entry) -> dict:
        return list(study.conduct(plan, entries, data, tmp_path / "runs", 1, {}))[-1]

    with pytest.raises(ConfigError, match="odd: .*no setting model.hiden"):
        conducted(odd=Entry(settings=("model.hiden=3",)))
    found = conducted(ast=entries["ast"])
    (made,) = found["ast"]["runs"]
    assert made["steps"] == 4 and made["batch"] == 4 and made["seconds_per_step"] > 0
    assert [point["step"] for point in made["curve"]] == [2, 4]
    assert made["best_valid"] == min(point["valid_rmse"] for point in made["curve"])
    assert made["best_valid"] == min(found["ast"]["search"].values())
    summary = made["measured"]["errors"]["displacement"]["model"]["rollout_all"]["normal"]["rmse_sequence"]
    assert made["measured"]["horizons"] == 3 and made["measured"]["diverged"] == {} and summary > 0
    # Only the run with the best rate is measured.
    folders = tmp_path / "runs/ast"
    assert {path.name for path in folders.glob("rate*")} == {"rate_0.001_seed_0", "rate_0.0001_seed_0"}
    (result,) = folders.glob("*/result.json")
    config = read_config(result.parent / "run")
    assert config.train.statistics_pairs == 4 and config.model.hidden == 16  # the study's, and the entry's
    # Again: nothing is trained, the same record is read.
    before = result.stat().st_mtime_ns
    assert conducted(ast=entries["ast"]) == found and result.stat().st_mtime_ns == before
    page(tmp_path, found, summary)


def processes_with(word: str) -> list[str]:
    lines = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists()]
    return [line.decode() for line in lines if word.encode() in line]


def test_a_study_that_is_stopped_goes_on(tmp_path, monkeypatch, capsys):
    data = toy.write(tmp_path / "toy.h5")
    written(tmp_path, TOML.replace("toy.h5", str(data)).replace("samples = 16", "samples = 400"))
    command = [sys.executable, "-m", "benchmarks.studies", str(tmp_path / "toy.toml")]
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.chdir(tmp_path)
    begun = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    folder = tmp_path / "build/study/toy/ast/rate_0.001_seed_0"
    deadline = time.monotonic() + 120
    while not (folder / "run/config.toml").exists():
        assert begun.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    assert processes_with(str(folder.relative_to(tmp_path)))
    begun.send_signal(signal.SIGTERM)
    _, told = begun.communicate(timeout=60)
    assert begun.returncode == 1 and told.decode().endswith("stopped: the same command goes on from here\n")
    assert not processes_with(str(folder.relative_to(tmp_path)))
    assert not (folder / "trained.json").exists()
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "argv", command[2:])
    study.main()
    assert "100 steps" in capsys.readouterr().out and (tmp_path / "docs/results/study.md").exists()
    result = tmp_path / "benchmarks/results/study_toy.json"
    (run,) = json.loads(result.read_text())["models"]["ast"]["runs"]
    assert run["steps"] == 100 and "measured" in run
    # Another seed, on a machine that has only the result: the first run stands, the new one has as many steps.
    shutil.rmtree(tmp_path / "build")
    text = (tmp_path / "toy.toml").read_text()
    (tmp_path / "toy.toml").write_text("seeds = [0, 1]\n" + text)
    study.main()
    first, second = json.loads(result.read_text())["models"]["ast"]["runs"]
    assert first == run and not folder.exists()
    assert second["seed"] == 1 and second["curve"] != run["curve"]
    assert [second[name] == run[name] for name in ("seconds_per_step", "batch", "steps")] == [True, True, True]


def test_an_entry_that_joins_has_the_speed_of_the_hour_of_the_others(tmp_path, monkeypatch):
    plan, _ = read(written(tmp_path, TOML))
    now, began = {"mgn": [9.0, 3.0, 2.0, 3.0, 3.0, 3.0], "hcmt": [9.0] * 6, "bsms": [0.1] + [5.0] * 5}, []

    class Clock:
        def __init__(self, backend, threads, setup, log) -> None:
            self.model, self.turns = setup.model, iter(now[setup.model])
            began.append(setup.model)

        def ask(self, what, count=1):
            return next(self.turns) if what == "step" else 4

        def close(self) -> None:
            pass

    monkeypatch.setattr(study_run, "Worker", Clock)
    first, *others = (study_run.Job(plan, m, Entry(m), 0, 1e-3, 1, tmp_path, tmp_path) for m in ("mgn", "hcmt", "bsms"))
    study_run.keep_speed(first, {"seconds_per_step": 0.5, "batch": 2})
    for _ in range(2):
        study_run.measure_speeds([first, *others])
    assert began == ["hcmt", "bsms", "mgn"]  # once: then all are known
    kept = [json.loads(job.speed.read_text()) for job in (first, *others)]
    assert kept == [{"seconds_per_step": s, "batch": b} for s, b in ((0.5, 2), (9 / 4, 4), (5 / 4, 4))]


def test_a_result_stands_for_the_same_entry_and_study(tmp_path):
    plan, entries = read(written(tmp_path, TOML.replace("samples", "seeds = [0, 1]\nsamples")))
    runs = [{"seed": 0}, {"seed": 1, "failed": "no memory"}, {"seed": 2}]
    rows = {name: {**asdict(entry), "rate": 1e-3, "search": {}, "runs": runs} for name, entry in entries.items()}
    file = tmp_path / "study_toy.json"
    assert study.finished(file, plan, entries) == {}
    file.write_text(json.dumps({"study": asdict(plan), "models": rows}))
    found = study.finished(file, replace(plan, title="Other", about="it", seeds=(1, 0)), entries)
    assert study.finished(file, replace(plan, seeds=(3,)), {"ast": replace(entries["ast"], seeds=(1, 0))}) == {
        "ast": {**found["ast"], "seeds": [1, 0]}
    }
    assert found["ast"]["runs"] == [{"seed": 0}] and found["ast"]["rate"] == 1e-3
    assert study.finished(file, replace(plan, seeds=(1,)), entries) == {}
    assert study.finished(file, replace(plan, samples=17), entries) == {}
    assert study.finished(file, replace(plan, data=Data("other.h5")), entries) == {}
    changed = {"ast": replace(entries["ast"], settings=()), "new": Entry()}
    assert study.finished(file, plan, changed) == {}


def test_a_failure_is_tried_again(tmp_path, monkeypatch):
    """A training that fails, then a measurement that fails: what has been done stands, what failed is done again."""
    plan, entries = read(written(tmp_path, TOML))
    job = study_run.Job(plan, "ast", entries["ast"], 0, 1e-3, 1, tmp_path / "toy.h5", tmp_path / "runs")
    study_run.keep_speed(job, {"seconds_per_step": 0.5, "batch": 4})
    codes, begun = [1, 0, 1, 0], []

    def python(job, words, log):
        begun.append(words[1])
        (job.folder / log).write_text("it began\nit broke\n")
        (job.folder / "measured.json").write_text('{"horizons": 3}')
        return codes[len(begun) - 1], 10**6

    monkeypatch.setattr(study_run, "_python", python)
    assert study_run.run(job)["failed"] == "it broke" and not (job.folder / "trained.json").exists()
    assert study_run.run(job)["failed"] == "it broke" and not (job.folder / "result.json").exists()
    record = study_run.run(job)
    assert "failed" not in record and record["measured"] == {"horizons": 3} and record["steps"] == 4
    assert study_run.run(job) == record
    assert begun == ["ast_sim.cli", "ast_sim.cli", "benchmarks.studies.measure", "benchmarks.studies.measure"]


def page(folder, found, summary) -> None:
    """The document has the figure, and the picture that it names."""
    values = {"title": "Toy", "about": "", "minutes": None, "samples": 16, "threads": 1, "seeds": [0, 1], "horizons": 3}
    values |= {"search": 1.0, "settings": ["train.statistics_pairs=4"]}
    values["data"] = {"nodes": None, "frames": None}
    scenes = {"name": "toy.h5", "train": 3, "valid": 2, "test": 2}
    result = {"commit": None, "processor": "p", "study": values, "scenes": scenes, "models": found}
    (folder / "study_toy.json").write_text(json.dumps(result))
    study_page.write_page(folder, folder / "pages")
    text = (folder / "pages/study.md").read_text()
    assert f"{1e3 * summary:.3g}" in text and "every model stays finite" in text and "16 frame pairs" in text
    assert "all: `train.statistics_pairs=4`; ast: `model.hidden=16 model.L_SA=1 model.L_cell=3`." in text
    assert "seeds 0; commit " in text  # not the ones that are still to come
    assert "by learning rate; the best in bold:\n\n| model | 0.0001 | 0.001 |\n| --- | ---: | ---: |\n| ast |" in text
    assert (folder / "pages/study/toy.svg").read_text().startswith("<?xml")


def test_measured_runs_are_read_again():
    files = sorted(RESULTS.glob("study_*.json"))
    for file in files:
        for model in json.loads(file.read_text())["models"].values():
            for values in (run["measured"] for run in model["runs"]):
                one = MeasuredRun.from_json(values)
                assert json.loads(json.dumps(one.to_json())) == values
                assert (
                    one.error("displacement").rmse_sequence > 0
                    and one.error("stress", "hold_still").rmse_pooled is None
                )
    assert len(files) == 5


def size_of(model: str, nodes: int, seconds: float | None) -> dict:
    found = {"failed": "no memory"} if seconds is None else {"seconds": {"min": seconds}, "peak_resident_bytes": 2e9}
    return {"model": model, "nodes": nodes, **found}


def test_the_page_tells_what_the_size_of_a_mesh_costs(tmp_path):
    records = [size_of("ast", 1000, 0.5), size_of("mgn", 1000, 2.0), size_of("ast", 2000, 0.75)]
    records += [size_of("mgn", 2000, None), size_of("ast", 4000, 1.0)]
    found = {"threads": 2, "memory_limit_bytes": 20e9, "commit": None, "processor": "p", "records": records}
    (tmp_path / "scaling.json").write_text(json.dumps(found))
    study_page.write_page(tmp_path, tmp_path / "pages")
    text = (tmp_path / "pages/study.md").read_text()
    for line in ("| nodes | AST | MGN |", "| 1,000 | 0.5 | 2 |", "| 2,000 | 0.75 | failed |", "| 4,000 | 1 |  |"):
        assert line in text
    assert "| 2,000 | 2 | failed |" in text and "- MGN at 2,000 nodes: no memory" in text
    assert (tmp_path / "pages/study/scaling.svg").read_text().startswith("<?xml")


def run_of(rollout: float | None, milliseconds: float) -> dict:
    error = MeanError("displacement", "model", "rollout_all", "normal", rollout, None)
    measured = MeasuredRun(replace(evaluation({}), errors=(error,)), 1000, {}, 10, {}, 1.0)
    return {"seed": 0, "seconds_per_step": 4e-3 * milliseconds, "batch": 4, "measured": measured}


def test_the_seeds_of_most_rows_come_first():
    of = {
        name: {"runs": [{"seed": seed} for seed in seeds]} for name, seeds in (("a", [0, 1]), ("b", [0]), ("c", [0, 1]))
    }
    assert study_page.seeds(of) == "seeds 0, 1 (b: 0)"


def test_the_verdict_names_the_best_baseline_and_who_is_better():
    models = {
        "AST": {"model": "ast", "runs": [run_of(1e-3, 5.0), run_of(2e-3, 5.0)]},
        "MGN": {"model": "mgn", "runs": [run_of(4e-3, 20.0)]},
        "BSMS": {"model": "bsms", "runs": [run_of(2.5e-3, 9.0)]},
        "HCMT": {"model": "hcmt", "runs": [run_of(None, 9.0)]},
        "AST, other": {"model": "ast", "runs": [run_of(1.2e-3, 5.0)]},
    }
    (text, _) = study_page.verdict(models)
    assert "0.6 times the error of the best baseline, BSMS" in text and "0.5, not reached" in text
    assert "0.25 of MGN's time" in text and text.endswith("Better: AST, other (0.48).")
    head, rule, line = [line for line in study_page.glance({"Toy": models, "no AST": {}}) if line.startswith("|")]
    assert line == "| Toy | AST | BSMS | 1.5 : 2.5 = **0.6** | - | - |"
    assert head.count("|") == rule.count("|") == line.count("|")
    assert study_page.glance({"no AST": {"MGN": models["MGN"]}}) == []
    models["AST"]["runs"] = [run_of(1e-3, 5.0)]
    (text, _) = study_page.verdict(models)
    assert (
        "0.4 times the error of" in text
        and "0.5, reached" in text
        and text.endswith("No other row has a smaller error.")
    )
    del models["AST"]
    (text, _) = study_page.verdict(models)
    assert text.startswith("**The rollout error of AST, other is 0.48 times the error of the best baseline, BSMS**")
    assert (
        study_page.verdict({"AST, other": models["AST, other"]}) == []
        and study_page.verdict({"MGN": models["MGN"]}) == []
    )


def test_the_cost_of_increments_is_read_from_an_unfinished_sample(tmp_path):
    records = [{"solve_seconds": 0.0}, {"solve_seconds": 3.0, "newton_iterations": 4}, {"solve_seconds": 1.5}]
    file = Checkpoint(tmp_path / "train-000000.checkpoint")
    file.save(
        {"position": np.zeros((3, 5, 3)), "stress": np.zeros((3, 7, 1)), "records": np.array(json.dumps(records))}
    )
    found = increments.measure(file.path)
    assert found == {"nodes": 5, "elements": 7, "seconds": 4.5, "increments": records[1:]}
    with pytest.raises(SystemExit, match="no frames to be read"):
        increments.measure(tmp_path / "none")
