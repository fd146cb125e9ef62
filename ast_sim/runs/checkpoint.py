"""Checkpoints that survive a kill, a full disk and a flipped bit.

A checkpoint is the folder `checkpoints/step-N` of a run. It holds `model.safetensors`, `training.safetensors`,
`state.json`, and `manifest.json` with the size and the SHA-256 of each of them. The folder is written under a temporary
name, synced to the disk and then renamed, so a folder `step-N` is always complete. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from ast_sim.support.disk import sync_folder, write_synced, write_text
from ast_sim.support.errors import CheckpointError, warn
from ast_sim.support.toml_settings import NOTHING

FILES = ("model.safetensors", "training.safetensors", "state.json")
MANIFEST = "manifest.json"
VERSION = 1

_FOLDER = "checkpoints"
_BEST = "best"
_LOCK = ".lock"
_TEMPORARY = ".tmp-"
_NAME = re.compile(r"step-(0|[1-9][0-9]{0,17})")
_MANIFEST_BYTES = 1 << 16
_MARK_BYTES = 1 << 18
_ERRORS = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, SafetensorError)


class Best(NamedTuple):
    """The mark of the best checkpoint: its step, its validation error, and what was found out about its answers."""

    step: int
    error: float
    answers: dict[str, Any]


CheckpointContent = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]


def save(
    run_dir: str | os.PathLike[str],
    step: int,
    *,
    model: dict[str, Tensor],
    training: dict[str, Tensor],
    state: dict[str, Any],
    keep: int = 3,
) -> Path:
    """Write the checkpoint of a step. Keep the `keep` newest checkpoints and the best one; remove the others.

    If a valid checkpoint of this step exists it stays, since a run always saves the same content at the same step.

    Raises:
        CheckpointError: the checkpoint cannot be written (a full disk); the earlier checkpoints are untouched.
    """
    final = at_step(run_dir, step)
    parent = final.parent
    with _explained(final, "the checkpoint cannot be written"):
        if not parent.is_dir():
            parent.mkdir(parents=True)
            sync_folder(run_dir)
        _remove_temporary(parent)
        try:
            if _damage(final) is not None:
                temporary = parent / f"{_TEMPORARY}new"
                temporary.mkdir()
                _write_files(temporary, step, model, training, state)
                _discard(final)  # a damaged checkpoint of the same step
                os.rename(temporary, final)
                sync_folder(parent)
            _prune(Path(run_dir), step, keep)
        finally:
            _remove_temporary(parent)
    return final


def load(path: str | os.PathLike[str], run: str | None = None) -> CheckpointContent:
    """The content of a checkpoint: the arrays of the model, the arrays of the training, and the state. All is verified.

    With `run`, the SHA-256 in `run.json`, the checkpoint must have been saved by that run.

    Raises:
        CheckpointError: a file is missing or damaged, or differs from the manifest; the text names the file. Or the
            checkpoint is of another run.
    """
    path = Path(path)
    data = _read_verified(path)
    with _explained(path, "cannot be understood"):
        model, training = (safetensors.torch.load(data.pop(name)) for name in FILES[:2])
        state = json.loads(data["state.json"])
        if run is not None and state["run"] != run:
            raise CheckpointError(f"{path} is of a run with other settings or other data: remove it from this run")
        return model, training, state


def at_step(run_dir: str | os.PathLike[str], step: int) -> Path:
    """The folder of the checkpoint of a step; there may be none."""
    return Path(run_dir) / _FOLDER / f"step-{step}"


def weights_hash(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of the arrays of the model in a checkpoint, as its manifest says.

    Raises:
        CheckpointError: there is no such checkpoint, or its manifest is damaged.
    """
    return _read_manifest(Path(path))[FILES[0]]["sha256"]


def latest(run_dir: str | os.PathLike[str]) -> Path | None:
    """The newest valid checkpoint of a run; None if the run has no checkpoint. Each newer, damaged one gives a warning.

    Raises:
        CheckpointError: the run has checkpoints, but all of them are damaged.
    """
    damage = None
    for path in _newest_first(Path(run_dir) / _FOLDER):
        damage = _damage(path)
        if damage is None:
            return path
        warn(f"{damage}; using the checkpoint before it")
    if damage is not None:
        raise CheckpointError(f"{run_dir}: no checkpoint is intact; the oldest one: {damage}")
    return None


def best(run_dir: str | os.PathLike[str]) -> Path | None:
    """The checkpoint that is marked as the best; None if none is marked, or (with a warning) if it is damaged.

    Raises:
        CheckpointError: the mark itself is damaged.
    """
    path = _marked(Path(run_dir))
    damage = None if path is None else _damage(path)
    if damage is None:
        return path
    warn(f"the best checkpoint cannot be used: {damage}")
    return None


def mark_best(run_dir: str | os.PathLike[str], step: int, error: float, answers: Mapping[str, Any] = NOTHING) -> None:
    """Mark the checkpoint of this step as the best one; it is kept until another one is marked.

    Args:
        error: its validation error.
        answers: what validation found out about answers with this checkpoint, such as the default effort.

    Raises:
        CheckpointError: there is no such checkpoint, or the mark cannot be written.
    """
    if not at_step(run_dir, step).is_dir():
        raise CheckpointError(f"{run_dir}: there is no checkpoint step-{step} to mark as the best")
    path = Path(run_dir) / _BEST
    with _explained(path, "cannot be written"):
        mark = {"step": step, "valid_rmse": error, "answers": dict(answers)}
        write_text(path, _json({**mark, "sha256": _hash(_json(mark))}).decode() + "\n")


def read_best(run_dir: str | os.PathLike[str]) -> Best | None:
    """The mark of the best checkpoint; None if none is marked.

    Raises:
        CheckpointError: the mark is damaged.
    """
    path = Path(run_dir) / _BEST
    if not os.path.lexists(path):
        return None
    advice = f"is damaged: remove it, then ast-sim train --resume --out {run_dir} writes it again"
    with _explained(path, advice):
        mark = json.loads(_read_file(path, _MARK_BYTES))
        if mark.pop("sha256") != _hash(_json(mark)):
            raise ValueError("its content does not fit its SHA-256")
        return Best(int(mark["step"]), float(mark["valid_rmse"]), dict(mark["answers"]))


@contextlib.contextmanager
def lock(run_dir: str | os.PathLike[str]) -> Iterator[None]:
    """Within the block no other process can lock the run folder. The lock ends with the process, even with a kill.

    Raises:
        CheckpointError: another process holds the lock (the text gives its number), or the folder cannot be locked.
    """
    path = Path(run_dir) / _LOCK
    with contextlib.ExitStack() as stack:
        with _explained(Path(run_dir), "cannot be written"):
            path.touch()
            file = stack.enter_context(open(path, "r+b", buffering=0))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = file.read(32).decode(errors="replace") or "unknown"
            raise CheckpointError(
                f"{run_dir} is in use by process {holder}: wait until it ends, or choose another folder"
            ) from error
        except OSError as error:
            raise CheckpointError(f"{path}: this file system cannot lock files: {error}") from error
        with contextlib.suppress(OSError):  # only the message above needs the number
            file.truncate(0)
            file.write(str(os.getpid()).encode())
        yield


@contextlib.contextmanager
def _explained(path: Path, what: str) -> Iterator[None]:
    """Within the block, raise every error of reading or writing as a CheckpointError: `path` and `what` went wrong."""
    try:
        yield
    except _ERRORS as error:
        raise CheckpointError(f"{path}: {what}: {error}") from error


def _write_files(
    folder: Path, step: int, model: dict[str, Tensor], training: dict[str, Tensor], state: dict[str, Any]
) -> None:
    data = {FILES[0]: _packed(model), FILES[1]: _packed(training), FILES[2]: _json(state)}
    records = {name: {"size": len(content), "sha256": _hash(content)} for name, content in data.items()}
    data[MANIFEST] = _json({"version": VERSION, "step": step, "files": records})
    for name, content in data.items():
        write_synced(folder / name, content)
    sync_folder(folder)


def _packed(tensors: dict[str, Tensor]) -> bytes:
    """The bytes of contiguous copies, which share no memory with one another."""
    return safetensors.torch.save(
        {key: tensor.detach().clone(memory_format=torch.contiguous_format) for key, tensor in tensors.items()}
    )


def _json(values: dict[str, Any]) -> bytes:
    return json.dumps(values, allow_nan=False, indent=1).encode()


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _read_manifest(path: Path) -> dict[str, dict[str, Any]]:
    """The size and the hash of each file; a manifest that says anything else is refused."""
    with _explained(path / MANIFEST, "cannot be read"):
        if not path.is_dir():
            raise CheckpointError(f"{path}: there is no such checkpoint")
        manifest = json.loads(_read_file(path / MANIFEST, _MANIFEST_BYTES))
        records = {name: {key: manifest["files"][name][key] for key in ("size", "sha256")} for name in FILES}
        if manifest != {"version": VERSION, "step": step_of(path), "files": records}:
            raise CheckpointError(f"{path / MANIFEST}: is not the manifest of version {VERSION} of this step")
    return records


def _read_verified(path: Path) -> dict[str, bytes]:
    """The content of each file, which is what the manifest says."""
    contents = {}
    for name, record in _read_manifest(path).items():
        file = path / name
        with _explained(file, "cannot be read"):
            size = os.lstat(file).st_size
            if size != record["size"]:
                raise CheckpointError(f"{file}: has {size} bytes, the manifest says {record['size']}")
            contents[name] = _read_file(file, size)
        if _hash(contents[name]) != record["sha256"]:
            raise CheckpointError(f"{file}: is damaged: its SHA-256 differs from the manifest")
    return contents


def _read_file(file: Path, most: int) -> bytes:
    """The content of a plain file with at most `most` bytes; links are not followed."""
    handle = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # a pipe must not block
    with open(handle, "rb") as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise CheckpointError(f"{file}: has more than {most} bytes")
    return data


def _damage(path: Path) -> CheckpointError | None:
    """What is wrong with a checkpoint; None if it is valid."""
    try:
        _read_verified(path)
    except CheckpointError as error:
        return error
    return None


def step_of(path: Path) -> int:
    """The step of a checkpoint's folder."""
    return int(path.name.removeprefix("step-"))


def _newest_first(parent: Path) -> list[Path]:
    return sorted(filter(lambda path: _NAME.fullmatch(path.name), parent.glob("step-*")), key=step_of, reverse=True)


def _marked(run_dir: Path) -> Path | None:
    """The checkpoint that the file `best` names; None if there is no such file."""
    mark = read_best(run_dir)
    return None if mark is None else at_step(run_dir, mark.step)


def _prune(run_dir: Path, step: int, keep: int) -> None:
    """Keep the best checkpoint and the `keep` newest up to this step; remove the others.

    Checkpoints of later steps were damaged when the run was resumed.
    """
    paths = _newest_first(run_dir / _FOLDER)
    first = paths.index(at_step(run_dir, step))
    for path in {*paths[:first], *paths[first + keep :]} - {_marked(run_dir)}:
        _discard(path)


def _discard(path: Path) -> None:
    """Rename a checkpoint, so that a kill never leaves a part of it under its name; `save` removes it in the end."""
    if path.exists():
        os.rename(path, path.with_name(_TEMPORARY + path.name))


def _remove_temporary(parent: Path) -> None:
    """Remove the folders of checkpoints that are not finished or no longer wanted, also after a killed process."""
    for path in parent.glob(f"{_TEMPORARY}*"):
        shutil.rmtree(path, ignore_errors=True)
