"""Training in two processes under torchrun: the same as in one with the whole batch; goes on with another number."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import toy
from safetensors.torch import load_file

from ast_sim.runs import checkpoint
from ast_sim.runs.metrics import Metrics

SETTINGS = [
    "model.hidden=16", "model.L_SA=1", "model.L_cell=3", "train.batch_size=4", "train.statistics_pairs=8",
    "train.log_every=4", "train.validate_every=4", "train.noise=1e-4", "model.jumps=false",
]  # fmt: skip


def command(processes: int, *words: str, program: tuple[str, ...] = ("-m", "ast_sim.cli")) -> list[str]:
    start = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"] if processes > 1 else []
    return [sys.executable, *start, *program, "train", *words]


def train(processes: int, data: Path, run: Path, steps: int, *words: str, check: bool = True):
    settings = [word for setting in (*SETTINGS, f"train.steps={steps}") for word in ("--set", setting)]
    words = (str(data), "--out", str(run), *settings, *words)
    return subprocess.run(command(processes, *words), capture_output=True, text=True, check=check, timeout=300)


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
        ["--set", "model.jumps=true", "--set", "train.noise=none", "--set", "train.calls=3"],
    ],
    ids=["pairs", "rollouts", "jumps"],
)
def test_two_processes_do_what_one_does(data, tmp_path, along):
    told = train(2, data, tmp_path / "two", 8, *along).stdout
    train(1, data, tmp_path / "one", 8, *along)
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

    # Two that were interrupted end in the same bits.
    shutil.rmtree(tmp_path / "two/checkpoints/step-8")
    subprocess.run(command(2, "--out", str(tmp_path / "two"), "--resume"), check=True, timeout=300)
    assert all(torch.equal(value, two[name]) for name, value in weights(tmp_path / "two").items())

    # What one began two go on with, and the group that they are ends with training.
    script = tmp_path / "train_then_count.py"
    script.write_text(
        "import sys\n"
        "from pathlib import Path\n"
        "from ast_sim.cli import main\n"
        "status = main()\n"
        "threads = [name.read_text().strip() for name in Path('/proc/self/task').glob('*/comm')]\n"
        "assert not any('gloo' in name for name in threads), threads\n"
        "sys.exit(status)\n"
    )
    launch = command(2, "--out", str(tmp_path / "one"), "--resume", program=(str(script),))
    done = subprocess.run(launch, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "going on after step 8" in done.stdout, done.stderr


def test_a_batch_that_cannot_be_cut_is_refused(data, tmp_path):
    done = train(2, data, tmp_path / "run", 4, "--set", "train.batch_size=3", check=False)
    assert done.returncode != 0 and "train.batch_size = 3 cannot be cut for 2 processes" in done.stderr
    assert not (tmp_path / "run/config.toml").exists()  # else the corrected command would be refused, too


def test_a_signal_to_one_process_stops_both_after_the_step(data, tmp_path):
    run = tmp_path / "run"
    few = (*SETTINGS, "train.steps=100000", "train.log_every=1")
    settings = [word for setting in few for word in ("--set", setting)]
    process = subprocess.Popen(command(2, str(data), "--out", str(run), *settings), stdout=subprocess.DEVNULL)
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
