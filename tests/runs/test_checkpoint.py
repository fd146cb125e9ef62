"""Checkpoints: exact round trip, and the previous one stays valid whatever happens to the next."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from ast_sim.runs import checkpoint
from ast_sim.support.errors import CheckpointError

# Saves checkpoints without end; every number of step N is N, so that a mixture of two steps would be seen.
SAVER = """
import sys, torch
from ast_sim.runs import checkpoint
step = int(sys.argv[2])
with checkpoint.lock(sys.argv[1]):
    print("ready", flush=True)
    while True:
        step += 1
        arrays = {"w": torch.full((64, 64), float(step))}
        optimizer = {"m": arrays["w"] + 0.5}
        checkpoint.save(sys.argv[1], step, model=arrays, training=optimizer, state={"step": step}, keep=2)
        if step % 3 == 0:
            checkpoint.mark_best(sys.argv[1], step, 1.0)
"""


def content(step: int):
    generator = torch.Generator().manual_seed(step)
    model = {
        "weight": torch.randn(7, 5, generator=generator),
        "half": torch.randn(3, generator=generator).to(torch.bfloat16),
        "count": torch.tensor(step),
        "empty": torch.zeros(0, 3),
        "mask": torch.tensor([True, False]),
    }
    optimizer = {"weight.exp_avg": torch.randn(7, 5, generator=generator), "weight.step": torch.tensor(float(step))}
    return model, optimizer, {"step": step, "sums": {"loss": 0.1 * step}, "names": ["a", "ü"]}


def save(run, step, **options):
    model, optimizer, state = content(step)
    return checkpoint.save(run, step, model=model, training=optimizer, state=state, **options)


def require_content(path, step):
    found, expected = checkpoint.load(path), content(step)
    for arrays, wanted in zip(found[:2], expected[:2], strict=True):
        assert arrays.keys() == wanted.keys()
        for key in wanted:
            assert arrays[key].dtype == wanted[key].dtype and torch.equal(arrays[key], wanted[key])
    assert found[2] == expected[2]


def steps(run) -> list[int]:
    return sorted(int(path.name.removeprefix("step-")) for path in (run / "checkpoints").iterdir())


def test_what_was_saved_is_loaded_bit_for_bit(tmp_path):
    path = save(tmp_path, 12)
    assert path == tmp_path / "checkpoints" / "step-12" == checkpoint.latest(tmp_path)
    assert sorted(file.name for file in path.iterdir()) == [
        "manifest.json",
        "model.safetensors",
        "state.json",
        "training.safetensors",
    ]
    require_content(path, 12)


def test_strided_and_shared_tensors_are_saved_by_value(tmp_path):
    base = torch.arange(12.0).reshape(3, 4)
    model = {"base": base, "turned": base.t(), "row": base[1], "wide": torch.ones(1).expand(5)}
    path = checkpoint.save(tmp_path, 1, model=model, training={}, state={})
    found, optimizer, state = checkpoint.load(path)
    assert all(torch.equal(found[key], model[key]) for key in model) and optimizer == {} and state == {}


def test_a_run_without_checkpoints_has_none(tmp_path):
    assert checkpoint.latest(tmp_path) is None and checkpoint.best(tmp_path) is None


def test_the_newest_and_the_best_are_kept(tmp_path):
    for step in range(1, 8):
        save(tmp_path, step, keep=2)
        if step in (2, 3):
            checkpoint.mark_best(tmp_path, step, 1.0)
    assert steps(tmp_path) == [3, 6, 7]
    assert checkpoint.best(tmp_path).name == "step-3" and checkpoint.read_best(tmp_path) == (3, 1.0, {})
    assert checkpoint.latest(tmp_path).name == "step-7"  # by number: step-10 comes after step-9
    save(tmp_path, 10, keep=2)
    assert checkpoint.latest(tmp_path).name == "step-10"


def test_marking_a_checkpoint_that_is_not_there_is_refused(tmp_path):
    save(tmp_path, 1)
    checkpoint.mark_best(tmp_path, 1, 1.0)
    with pytest.raises(CheckpointError, match="no checkpoint step-2"):
        checkpoint.mark_best(tmp_path, 2, 1.0)
    assert checkpoint.best(tmp_path).name == "step-1"


def test_a_damaged_best_gives_a_warning_and_none(tmp_path):
    path = save(tmp_path, 1)
    checkpoint.mark_best(tmp_path, 1, 1.0)
    (path / "state.json").write_text("{}")
    with pytest.warns(UserWarning, match="best checkpoint cannot be used"):
        assert checkpoint.best(tmp_path) is None
    (tmp_path / "best").write_text("../../etc")
    with pytest.raises(CheckpointError, match="best: is damaged: remove it"):
        checkpoint.best(tmp_path)


@pytest.mark.parametrize("name", ["manifest.json", "state.json", "model.safetensors", "training.safetensors"])
def test_every_flipped_bit_and_every_truncation_is_found(tmp_path, name):
    file = save(tmp_path, 3) / name
    original = file.read_bytes()
    for byte in range(len(original)):
        file.write_bytes(original[:byte] + bytes([original[byte] ^ 1 << byte * 5 % 8]) + original[byte + 1 :])
        with pytest.raises(CheckpointError, match="step-3"):
            checkpoint.load(file.parent)
    for size in range(0, len(original), 1 + len(original) // 50):
        file.write_bytes(original[:size])
        with pytest.raises(CheckpointError, match="step-3"):
            checkpoint.load(file.parent)
    file.unlink()
    with pytest.raises(CheckpointError, match=name):
        checkpoint.load(file.parent)
    file.write_bytes(original)
    require_content(file.parent, 3)


def test_a_damaged_newest_gives_way_to_the_one_before_with_a_warning(tmp_path):
    save(tmp_path, 1)
    save(tmp_path, 2)
    (tmp_path / "checkpoints" / "step-2" / "model.safetensors").write_bytes(b"")
    with pytest.warns(UserWarning, match="step-2/model.safetensors: has 0 bytes"):
        assert checkpoint.latest(tmp_path).name == "step-1"
    # The run goes on from step 1 and saves more often: the damaged step 2 must not push the good ones out.
    save(tmp_path, 1, keep=1)
    assert steps(tmp_path) == [1]
    save(tmp_path, 2, keep=1)
    require_content(checkpoint.latest(tmp_path), 2)


def test_a_damaged_checkpoint_is_replaced_when_its_step_comes_again(tmp_path):
    path = save(tmp_path, 2)
    (path / "state.json").write_text("{}")
    require_content(save(tmp_path, 2), 2)


def test_damage_everywhere_is_an_error_and_not_a_new_start(tmp_path):
    (save(tmp_path, 1) / "manifest.json").unlink()
    with pytest.warns(UserWarning), pytest.raises(CheckpointError, match="no checkpoint is intact"):
        checkpoint.latest(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m["files"].update({"../../secret": m["files"]["state.json"]}),
        lambda m: m["files"].update({"/etc/passwd": {"size": 1, "sha256": ""}}),
        lambda m: m["files"]["model.safetensors"].update(size=10**18),
        lambda m: m["files"]["model.safetensors"].update(size=-1),
        lambda m: m["files"]["model.safetensors"].update(size="1"),
        lambda m: m["files"].pop("training.safetensors"),
        lambda m: m["files"].update({"state.json": None}),
        lambda m: m.update(files=[]),
        lambda m: m.update(version=2),
        lambda m: m.update(step=4),
        lambda m: m.update(extra=1),
    ],
)
def test_a_hostile_manifest_is_refused(tmp_path, change):
    path = save(tmp_path, 3)
    manifest = json.loads((path / "manifest.json").read_text())
    change(manifest)
    (path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match="step-3"):
        checkpoint.load(path)


@pytest.mark.parametrize("text", ["", "[]", "null", "[" * 60000, '{"version": 1' + " " * 70000 + "}", "\udcff"])
def test_a_manifest_that_is_none_is_refused(tmp_path, text):
    path = save(tmp_path, 3)
    (path / "manifest.json").write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(CheckpointError, match="manifest.json"):
        checkpoint.load(path)


def test_links_and_pipes_are_not_followed(tmp_path):
    path = save(tmp_path, 3)
    (path / "state.json").rename(tmp_path / "elsewhere.json")
    (path / "state.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(CheckpointError, match="state.json"):
        checkpoint.load(path)
    (path / "state.json").unlink()
    os.mkfifo(path / "state.json")
    with pytest.raises(CheckpointError, match="state.json"):
        checkpoint.load(path)


def test_arrays_that_lie_about_their_size_are_refused_with_a_right_hash(tmp_path):
    path = save(tmp_path, 3)
    header = json.dumps({"w": {"dtype": "F32", "shape": [1 << 40], "data_offsets": [0, 1 << 42]}}).encode()
    data = len(header).to_bytes(8, "little") + header
    (path / "model.safetensors").write_bytes(data)
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["files"]["model.safetensors"] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(CheckpointError, match="cannot be understood"):
        checkpoint.load(path)


@pytest.mark.parametrize("call", ["fsync", "rename"])
@pytest.mark.parametrize("nth", range(5))
def test_a_disk_that_fails_leaves_the_previous_checkpoint(tmp_path, monkeypatch, call, nth):
    save(tmp_path, 1)
    original, count = getattr(os, call), 0

    def failing(*arguments):
        nonlocal count
        count += 1
        if count > nth:
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(*arguments)

    monkeypatch.setattr(os, call, failing)
    try:
        save(tmp_path, 2)
    except CheckpointError as error:
        assert "step-2: the checkpoint cannot be written" in str(error) and "No space left" in str(error)
        assert steps(tmp_path) == [1]
    monkeypatch.undo()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        newest = checkpoint.latest(tmp_path)
    require_content(newest, int(newest.name.removeprefix("step-")))
    require_content(tmp_path / "checkpoints" / "step-1", 1)


def test_a_full_disk_leaves_the_previous_checkpoint(tmp_path):
    """A file system of 256 KiB where the system lets us mount one, else a limit on the size of files."""
    program = """
import resource, sys, torch
from ast_sim.runs import checkpoint
from ast_sim.support.errors import CheckpointError
if sys.argv[2] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
checkpoint.save(sys.argv[1], 1, model={"w": torch.ones(100)}, training={}, state={"step": 1})
try:
    checkpoint.save(sys.argv[1], 2, model={"w": torch.ones(100_000)}, training={}, state={"step": 2})
except CheckpointError as error:
    print(error)
print(checkpoint.load(checkpoint.latest(sys.argv[1]))[2])
"""
    run = tmp_path / "run"
    run.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "none", str(run)]
    mounted = os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0
    try:
        command = [sys.executable, "-W", "error", "-c", program, str(run), "0" if mounted else str(256 << 10)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        message, state = done.stdout.splitlines()
        assert "step-2: the checkpoint cannot be written: [Errno" in message and state == "{'step': 1}"
        assert ("No space left" in message) == mounted and done.stderr == ""
        assert steps(run) == [1]
    finally:
        if mounted:
            subprocess.run(["umount", str(run)], check=True)


def test_a_state_that_json_cannot_hold_is_refused(tmp_path):
    save(tmp_path, 1)
    for state in ({"loss": float("nan")}, {"x": object()}):
        with pytest.raises(CheckpointError, match="step-2"):
            checkpoint.save(tmp_path, 2, model={}, training={}, state=state)
    assert steps(tmp_path) == [1]


def start_saver(run: Path, step: int) -> subprocess.Popen:
    process = subprocess.Popen([sys.executable, "-c", SAVER, str(run), str(step)], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    return process


def test_a_kill_at_any_instant_leaves_a_valid_checkpoint(tmp_path):
    """The saver forks a copy of itself for each kill, so that torch is imported once."""
    program = SAVER.replace('print("ready", flush=True)', "pass")
    server = f"""
import itertools, os, random, signal, sys, time, torch
from ast_sim.runs import checkpoint
torch.set_num_threads(1)
program = compile({program!r}, "saver", "exec")
for seed in itertools.count():
    newest = checkpoint.latest(sys.argv[1])
    start = 0 if newest is None else checkpoint.load(newest)[2]["step"]
    child = os.fork()
    if child == 0:
        sys.argv = ["saver", sys.argv[1], str(start)]
        exec(program)
    time.sleep(random.Random(seed).uniform(0.005, 0.12))
    os.kill(child, signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    print("killed", flush=True)
    if not sys.stdin.readline():
        break
"""
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", server, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    last, seen = 0, set()
    rounds = 0
    while rounds < 30 or len(seen) < 10:  # a busy machine saves little between two kills
        rounds += 1
        assert rounds < 1000 and process.stdout.readline() == "killed\n"
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a damaged checkpoint would be passed over with a warning
            newest, marked = checkpoint.latest(tmp_path), checkpoint.best(tmp_path)
        for path in (newest, marked):
            if path is not None:
                model, optimizer, state = checkpoint.load(path)
                step = state["step"]
                assert path.name == f"step-{step}" and bool((model["w"] == step).all())
                assert bool((optimizer["m"] == step + 0.5).all())
        if newest is not None:
            step = checkpoint.load(newest)[2]["step"]
            assert step >= last  # what was once saved is never lost
            last = step
            seen.add(step)
        process.stdin.write("go on\n")
        process.stdin.flush()
    process.stdin.close()
    assert process.wait() == 0


def test_a_second_writer_is_refused_until_the_first_ends(tmp_path):
    process = start_saver(tmp_path, 0)
    try:
        with pytest.raises(CheckpointError, match=f"in use by process {process.pid}"), checkpoint.lock(tmp_path):
            pass
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    refused = pytest.raises(CheckpointError, match=f"in use by process {os.getpid()}")
    with checkpoint.lock(tmp_path), refused, checkpoint.lock(tmp_path):
        pass
    with checkpoint.lock(tmp_path):
        pass


def test_a_lock_that_cannot_be_opened_names_the_folder(tmp_path):
    (tmp_path / ".lock").mkdir()
    with pytest.raises(CheckpointError, match=f"{tmp_path}: cannot be written: .*Is a"), checkpoint.lock(tmp_path):
        pass
