"""Real processes, really killed: resuming ends in the bits of a training that nothing disturbed."""

import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import toy
from forked import Forked

from ast_sim.runs import checkpoint
from ast_sim.runs.metrics import Metrics

STEPS = 60
SMALL = [
    f"train.steps={STEPS}", "train.batch_size=2", "train.log_every=7", "train.checkpoint_every=3", "train.keep=2",
    "train.validate_every=20", "train.statistics_pairs=8", "model.hidden=16", "model.decoder_hidden=16",
    "model.d_token=16", "model.heads=1", "model.head_dim=16", "model.ffn_inner=16", "model.L_SA=1", "model.dropout=0.1",
    "train.mirror=x,y", "train.optimizer=muon",  # whose momenta are kept beside the moments of AdamW
]  # fmt: skip


def command(*arguments, settings=()) -> list[str]:
    assignments = [part for setting in settings for part in ("--set", setting)]
    return ["-m", "ast_sim.cli", "train", *map(str, arguments), *assignments]


def start(*arguments, settings=(), **options) -> Forked:
    return Forked(command(*arguments, settings=settings), **options)


def start_anew(*arguments, settings=(), **options) -> subprocess.Popen:
    """In a process that is no copy; its output is buffered, as where a user starts it."""
    words = [sys.executable, *command(*arguments, settings=settings)]
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(words, env=environment, **pipes, **options)


def finish(process: Forked | subprocess.Popen, code: int = 0) -> tuple[str, str]:
    out, error = process.communicate(timeout=120)
    assert process.returncode == code, error
    return out, error


def newest(run: Path) -> int:
    """The step of the newest checkpoint; -1 without one."""
    steps = [int(path.name.removeprefix("step-")) for path in (run / "checkpoints").glob("step-*")]
    return max(steps, default=-1)


def wait_for_progress(process: Forked, run: Path, beyond: int) -> None:
    while newest(run) <= beyond:
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


def outcome(run: Path) -> tuple[list[str], list[dict]]:
    """SHA-256 of the final weights and optimizer state, and all metrics but the times."""
    final = run / "checkpoints" / f"step-{STEPS}"
    hashes = [hashlib.sha256((final / name).read_bytes()).hexdigest() for name in checkpoint.FILES]
    records = list(Metrics(run))
    best = (run / "best").read_text()
    return [*hashes, best], [{key: value for key, value in record.items() if key != "seconds"} for record in records]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The data, and the outcome of a training that nothing disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    data = toy.write(folder / "toy.h5")
    finish(start(data, "--out", folder / "run", settings=SMALL))
    return data, outcome(folder / "run")


def test_kill_at_random_moments_and_resume_ends_in_the_same_bits(undisturbed, tmp_path):
    data, expected = undisturbed
    run, moments = tmp_path / "run", random.Random(5)
    reached = -1
    for _ in range(3):
        process = start(data, "--out", run, "--resume", settings=SMALL)
        wait_for_progress(process, run, reached)
        time.sleep(moments.uniform(0.0, 0.1))
        process.kill()
        finish(process, -signal.SIGKILL)
        reached = newest(run)
        assert reached < STEPS
    finish(start("--out", run, "--resume"))
    assert outcome(run) == expected


def test_a_run_that_starts_from_another_one_is_killed_and_resumes_to_the_same_bits(undisturbed, tmp_path):
    data, _ = undisturbed
    finish(start(data, "--out", tmp_path / "source", settings=[*SMALL, "train.steps=30"]))
    words, settings = (
        (data, "--from", tmp_path / "source", "--out"),
        [f"train.steps={STEPS}", "train.checkpoint_every=3"],
    )
    finish(start(*words, tmp_path / "whole", settings=settings))
    run = tmp_path / "run"
    process = start(*words, run, settings=settings)
    while not (run / "config.toml").exists():  # killed before its first checkpoint
        time.sleep(0.005)
    process.kill()
    finish(process, -signal.SIGKILL)
    assert newest(run) == -1
    process = start(*words, run, "--resume", settings=settings)
    wait_for_progress(process, run, -1)
    process.kill()
    finish(process, -signal.SIGKILL)
    assert 0 < newest(run) < STEPS
    finish(start("--out", run, "--resume"))
    assert outcome(run) == outcome(tmp_path / "whole")


def test_signals_finish_the_step_write_a_checkpoint_and_exit(undisturbed, tmp_path):
    data, expected = undisturbed
    run, reached = tmp_path / "run", -1
    for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)):
        process = start(data, "--out", run, "--resume", settings=SMALL)
        wait_for_progress(process, run, reached)
        process.send_signal(number)
        out, error = finish(process, code)
        assert f"stopped after step {newest(run)}: go on with resume=True (--resume)" in out
        assert "Traceback" not in error
        assert reached < newest(run) < STEPS
        reached = newest(run)
    finish(start("--out", run, "--resume"))
    assert outcome(run) == expected


def test_an_interrupt_in_python_is_a_keyboard_interrupt_after_a_checkpoint(undisturbed, tmp_path):
    """A notebook goes on after Ctrl-C; only the command line turns it into an exit code."""
    data, expected = undisturbed
    run = tmp_path / "run"
    code = f"""
import ast_sim
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training
try:
    start_training({str(run)!r}, configure({str(data)!r}, "tiny", {SMALL!r}))
except KeyboardInterrupt as interrupt:
    print("interrupted:", interrupt, flush=True)
"""
    process = Forked(["-c", code])
    wait_for_progress(process, run, -1)
    process.send_signal(signal.SIGINT)
    out, _ = finish(process, 0)
    assert out.splitlines()[-1] == "interrupted: stopped by SIGINT" and 0 < newest(run) < STEPS
    finish(start("--out", run, "--resume"))
    assert outcome(run) == expected


def test_a_closed_pipe_finishes_the_step_writes_a_checkpoint_and_exits(undisturbed, tmp_path):
    data, expected = undisturbed
    run = tmp_path / "run"
    process = start_anew(data, "--out", run, settings=SMALL)
    process.stdout.close()  # what `ast-sim train ... | head` does
    error = process.stderr.read()
    assert process.wait(timeout=120) == 141, error
    assert error == ""
    process.stderr.close()
    process = start(data, "--out", run, "--resume", settings=SMALL)
    for line in process.stdout:  # of the introduction; then the pipe is closed between two steps
        if line.startswith("cell side"):
            break
    wait_for_progress(process, run, -1)
    process.stdout.close()
    error = process.stderr.read()
    assert process.wait(timeout=120) == 141 and error == ""
    assert 0 < newest(run) < STEPS
    finish(start("--out", run, "--resume"))
    assert outcome(run) == expected


def test_a_process_that_ignores_a_lost_terminal_goes_on(undisturbed, tmp_path):
    data, expected = undisturbed
    run = tmp_path / "run"
    process = start(data, "--out", run, settings=SMALL, ignored=[signal.SIGHUP])
    wait_for_progress(process, run, -1)
    process.send_signal(signal.SIGHUP)
    finish(process)
    assert outcome(run) == expected


def test_a_run_in_use_is_refused_with_the_number_of_the_process(undisturbed, tmp_path):
    data, _ = undisturbed
    run = tmp_path / "run"
    first = start(data, "--out", run, settings=[*SMALL, "train.steps=100000", "train.validate_every=100000"])
    try:
        wait_for_progress(first, run, -1)
        _, error = finish(start("--out", run, "--resume"), 2)
        assert error.count("\n") == 1
        assert f"in use by process {first.pid}" in error
        assert first.poll() is None
    finally:
        first.kill()
        first.communicate()


def test_a_full_disk_is_one_line_and_nothing_is_lost(undisturbed, tmp_path):
    data, expected = undisturbed
    run = tmp_path / "disk" / "run"
    run.parent.mkdir()
    with ExitStack() as cleanup:
        mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(run.parent)]
        mounted = os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0
        if mounted:
            cleanup.callback(subprocess.run, ["umount", str(run.parent)], check=True)
            (run.parent / "ballast").write_bytes(bytes(500_000))
            process = start(data, "--out", run, settings=SMALL)
        else:
            # No file system of our own: files may not grow beyond this, which fails likewise when they are written.
            limits = (60_000, 60_000)
            process = start_anew(
                data, "--out", run, settings=SMALL, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            )
        _, error = finish(process, 2)
        assert error.count("\n") == 1
        assert str(run) in error
        assert "No space left" in error or "File too large" in error
        if mounted:
            assert newest(run) > 0
            checkpoint.load(checkpoint.latest(run))
            (run.parent / "ballast").unlink()
            subprocess.run(["mount", "-o", "remount,size=16m", str(run.parent)], check=True)
        finish(start(data, "--out", run, "--resume", settings=SMALL))
        assert outcome(run) == expected
