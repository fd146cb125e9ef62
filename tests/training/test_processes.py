"""Training in two processes, by `--processes` and under torchrun: the same as in one with the whole batch."""

import functools
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import forked
import pytest
import torch
import toy
from safetensors.torch import load_file

import ast_sim
from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.runs import checkpoint
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.support.errors import ConfigError
from ast_sim.training.configure import configure
from ast_sim.training.parallel import launch

SETTINGS = [
    "model.hidden=16", "model.L_SA=1", "model.L_cell=3", "train.batch_size=4", "train.statistics_pairs=8",
    "train.log_every=4", "train.validate_every=4", "train.noise=1e-4", "model.jumps=false",
]  # fmt: skip


TRAIN = ("-m", "ast_sim.cli", "train")


def under_torchrun(*words: str) -> list[str]:
    start = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return [sys.executable, *start, *TRAIN, *words]


def words_of(data: Path, run: Path, steps: int, *words: str) -> tuple[str, ...]:
    settings = [word for setting in (*SETTINGS, f"train.steps={steps}") for word in ("--set", setting)]
    return (str(data), "--out", str(run), *settings, *words)


def train_two(data: Path, run: Path, steps: int, *words: str, check: bool = True):
    done = forked.run([*TRAIN, *words_of(data, run, steps, "--processes", "2", *words)])
    assert not check or done.returncode == 0, done.stderr
    return done


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(checkpoint.latest(run) / "model.safetensors")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")


@pytest.mark.parametrize(
    "along",
    [
        [],
        ["--set", "train.rollout_pool=8"],
        ["--set", "model.jumps=true", "--set", "train.noise=none", "--set", "train.corrections=2"],
    ],
    ids=["pairs", "rollouts", "jumps"],
)
def test_two_processes_do_what_one_does(data, tmp_path, along):
    told = train_two(data, tmp_path / "two", 8, *along).stdout
    assert main(["train", *words_of(data, tmp_path / "one", 8, *along)]) == 0
    one, two = weights(tmp_path / "one"), weights(tmp_path / "two")
    for name, ours in one.items():
        # Sums over two parts round otherwise; Adam's steps of about the rate follow even the smallest gradients.
        torch.testing.assert_close(two[name], ours, rtol=1e-4, atol=2e-5, msg=name)
    lines, others = list(Metrics(tmp_path / "one")), list(Metrics(tmp_path / "two"))
    assert [line["step"] for line in others] == [line["step"] for line in lines] == [4, 4, 8, 8]
    for ours, theirs in zip(lines, others, strict=True):
        assert theirs.keys() == ours.keys()
        for key in {"loss", "grad_norm", "valid_rmse", "valid_hold_still"} & ours.keys():
            assert theirs[key] == pytest.approx(ours[key], rel=1e-3), key
    assert told.count("parameters") == 1  # one process tells
    assert RunFolder(tmp_path / "two").settings.train.processes == 2

    # Two that were interrupted end in the same bits: a run that goes on keeps its number of processes.
    shutil.rmtree(tmp_path / "two/checkpoints/step-8")
    done = forked.run([*TRAIN, "--out", tmp_path / "two", "--resume"])
    assert done.returncode == 0, done.stderr
    assert all(torch.equal(value, two[name]) for name, value in weights(tmp_path / "two").items())


def test_torchrun_and_a_notebook_train_the_same_model(data, tmp_path, request, capsys):
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1"}  # of each process: sums over threads round otherwise
    subprocess.run(under_torchrun(*words_of(data, tmp_path / "torchrun", 8)), check=True, timeout=300, env=one_thread)
    settings = dict(setting.split("=") for setting in SETTINGS)
    given = {key.removeprefix("train."): float(value) for key, value in settings.items() if key.startswith("train.")}
    given |= {key: int(given[key]) for key in ("batch_size", "statistics_pairs", "log_every", "validate_every")}
    model = {"hidden": 16, "L_SA": 1, "L_cell": 3, "jumps": False}
    steps: list[int] = []
    request.addfinalizer(functools.partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(2)
    ast_sim.train(
        data, tmp_path / "notebook", model_settings=model, callback=lambda step, _: steps.append(step), steps=8,
        processes=2, **given,
    )  # fmt: skip
    assert steps == [4, 4, 8, 8]
    assert "WORLD_SIZE" not in os.environ and torch.get_num_threads() == 2
    ours, theirs = (weights(tmp_path / name) for name in ("notebook", "torchrun"))
    for name, value in ours.items():  # earlier tests have used this process: its arrays lie elsewhere, sums differ
        torch.testing.assert_close(value, theirs[name], rtol=1e-4, atol=2e-5, msg=name)
    assert RunFolder(tmp_path / "torchrun").settings.train.processes == 2
    names = [name.read_text().strip() for name in Path("/proc/self/task").glob("*/comm")]
    assert not any("gloo" in name for name in names), names

    # What two began one goes on with.
    words = words_of(data, tmp_path / "torchrun", 12, "--resume", "--processes", "1")
    assert main(["train", *words]) == 2
    assert (
        "was started with train.steps = 8, not 12" in capsys.readouterr().err
    )  # only the number of processes may differ
    shutil.rmtree(tmp_path / "torchrun/checkpoints/step-8")
    words = words_of(data, tmp_path / "torchrun", 8, "--resume", "--processes", "1")
    assert main(["train", *words]) == 0 and "going on after step 4" in capsys.readouterr().out


def test_the_usual_number_follows_from_the_size_of_a_step(data, monkeypatch):
    def usual(threads: int, least: int, **settings) -> int:
        monkeypatch.setattr(launch, "LEAST_NODES", least)
        monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
        changes = {f"train.{key}": value for key, value in settings.items()}
        return launch.usual_processes(configure(data, changes=changes))

    with Dataset(data) as dataset:
        nodes = dataset.scene("train", 0).num_nodes
    long = 1_000_000
    assert usual(2, 4 * nodes, batch_size=8, steps=long) == 2
    assert usual(2, 4 * nodes + 1, batch_size=8, steps=long) == 1  # the parts would be too small
    assert usual(1, 1, batch_size=8, steps=long) == 1
    assert usual(6, 1, batch_size=8, steps=long) == 4  # six would not cut the batch
    assert usual(2, 1, batch_size=8, steps=10) == 1
    assert usual(2, 1, batch_size=8, minutes=10) == 2 and usual(2, 1, batch_size=8, minutes=0.5) == 1


def test_a_process_that_is_killed_ends_the_training_with_its_cause(data, tmp_path):
    words = words_of(data, tmp_path / "run", 100_000, "--processes", "2", "--set", "train.log_every=1")
    process = forked.Forked([*TRAIN, *words])
    try:
        deadline = time.monotonic() + 300
        while not list(Metrics(tmp_path / "run")):
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.1)
        along = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
        assert len(along) == 1
        os.kill(int(along[0]), signal.SIGKILL)
        _, error = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 2
    assert error.strip() == (
        "ast-sim train: a process that trains along has ended (signal 9): go on with resume=True (--resume)"
    )


def test_a_batch_that_cannot_be_cut_is_refused(data, tmp_path):
    done = train_two(data, tmp_path / "run", 4, "--set", "train.batch_size=3", check=False)
    assert done.returncode != 0 and "train.batch_size = 3 cannot be cut for 2 processes" in done.stderr
    assert not (tmp_path / "run/config.toml").exists()  # else the corrected command would be refused, too


@pytest.mark.parametrize("count", [0, -1])
def test_fewer_than_one_process_is_refused(data, tmp_path, count):
    with pytest.raises(ConfigError, match=f"train.processes is {count}; it must be at least 1"):
        ast_sim.train(data, tmp_path / "run", steps=1, processes=count)
    assert not (tmp_path / "run").exists()


def test_a_signal_to_one_process_stops_both_after_the_step(data, tmp_path):
    run = tmp_path / "run"
    few = (*SETTINGS, "train.steps=100000", "train.log_every=1")
    settings = [word for setting in few for word in ("--set", setting)]
    process = subprocess.Popen(under_torchrun(str(data), "--out", str(run), *settings), stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 300
        while not list(Metrics(run)):
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.1)
        children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
        assert len(children) == 2
        subprocess.run(["kill", f"-{int(signal.SIGTERM)}", children[1]], check=True)
        assert process.wait(timeout=120) != 0
    finally:
        process.kill()
    last, logged = checkpoint.latest(run), max(record["step"] for record in Metrics(run))
    assert last is not None and int(last.name.removeprefix("step-")) == logged
    checkpoint.load(last)
