"""Checkpoints that survive a kill, a full disk and a flipped bit.

A checkpoint is the folder `checkpoints/step-N` of a run: `model.safetensors`, `training.safetensors`, `state.json`,
and `manifest.json` with the size and the SHA-256 of each. It is written under another name, synced to the disk and
then renamed, so under its name it is whole or absent. Nothing is pickled.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from ast_sim.data.disk import replacing, sync_folder, write_synced
from ast_sim.errors import CheckpointError

FILES = ("model.safetensors", "training.safetensors", "state.json")
MANIFEST = "manifest.json"
VERSION = 1

_FOLDER = "checkpoints"
_BEST = "best"
_LOCK = ".lock"
_TEMPORARY = ".tmp-"
_NAME = re.compile(r"step-(0|[1-9][0-9]{0,17})")
_MANIFEST_BYTES = 1 << 16

Content = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]


def save(
    run_dir: str | os.PathLike[str],
    step: int,
    *,
    model: dict[str, Tensor],
    training: dict[str, Tensor],
    state: dict[str, Any],
    keep: int = 3,
) -> Path:
    """Write the checkpoint of a step; keep the `keep` newest and the best, remove the others.

    A checkpoint of this step that is there and valid is left as it is: what a run saves follows from its step.

    Raises:
        CheckpointError: it cannot be written (a full disk); the checkpoints before it are untouched.
    """
    if keep < 1:
        raise CheckpointError(f"at least one checkpoint must be kept, not {keep}")
    parent = Path(run_dir) / _FOLDER
    final = parent / f"step-{step}"
    temporary = parent / f"{_TEMPORARY}{secrets.token_hex(4)}"
    try:
        if not parent.is_dir():
            parent.mkdir(parents=True)
            sync_folder(run_dir)
        _clean(parent)
        if not _is_valid(final):
            temporary.mkdir()
            _write_files(temporary, step, model, training, state)
            _discard(final)  # a damaged one of the same name
            os.rename(temporary, final)
            sync_folder(parent)
        _prune(Path(run_dir), step, keep)
    except (OSError, ValueError, TypeError, SafetensorError) as error:
        raise CheckpointError(f"{final}: the checkpoint cannot be written: {error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return final


def load(path: str | os.PathLike[str]) -> Content:
    """The model's arrays, those that training goes on with, and the state of a checkpoint; all of it verified.

    Raises:
        CheckpointError: naming the file that is missing, damaged or not what the manifest says.
    """
    path = Path(path)
    data = {name: _read_verified(path, name, record) for name, record in _read_manifest(path).items()}
    try:
        model, training = (safetensors.torch.load(data.pop(name)) for name in FILES[:2])
        state = json.loads(data["state.json"])
    except (SafetensorError, ValueError, RecursionError, RuntimeError) as error:
        raise CheckpointError(f"{path}: cannot be understood: {error}") from error
    return model, training, state


def latest(run_dir: str | os.PathLike[str]) -> Path | None:
    """The newest valid checkpoint of a run, None if there is none yet; each damaged newer one gives a warning.

    Raises:
        CheckpointError: there are checkpoints, but all of them are damaged.
    """
    damage = None
    for path in _newest_first(Path(run_dir) / _FOLDER):
        try:
            _verify(path)
        except CheckpointError as error:
            damage = error
            warnings.warn(f"{error}; using the checkpoint before it", stacklevel=2)
        else:
            return path
    if damage is not None:
        raise CheckpointError(f"{run_dir}: no checkpoint is intact; the oldest one: {damage}")
    return None


def best(run_dir: str | os.PathLike[str]) -> Path | None:
    """The checkpoint marked as best, None if none is; a damaged one gives a warning and None."""
    path = _marked(Path(run_dir))
    if path is None:
        return None
    try:
        _verify(path)
    except CheckpointError as error:
        warnings.warn(f"the best checkpoint cannot be used: {error}", stacklevel=2)
        return None
    return path


def mark_best(run_dir: str | os.PathLike[str], step: int) -> None:
    """Make the checkpoint of this step the best one; it is kept until another one is.

    Raises:
        CheckpointError: there is no such checkpoint, or the mark cannot be written.
    """
    run_dir = Path(run_dir)
    name = f"step-{step}"
    if not (run_dir / _FOLDER / name).is_dir():
        raise CheckpointError(f"{run_dir}: there is no checkpoint {name} to mark as the best")
    try:
        with replacing(run_dir / _BEST) as temporary:
            write_synced(temporary, f"{name}\n".encode())
    except OSError as error:
        raise CheckpointError(f"{run_dir / _BEST}: cannot be written: {error}") from error


@contextlib.contextmanager
def lock(run_dir: str | os.PathLike[str]) -> Iterator[None]:
    """Keep every other process from writing into the run folder; the lock ends with the process, however it ends.

    Raises:
        CheckpointError: another process holds it; its number is named.
    """
    path = Path(run_dir) / _LOCK
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise CheckpointError(f"{run_dir}: cannot be written: {error}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(handle, 32, 0).decode(errors="replace").strip() or "unknown"
            raise CheckpointError(
                f"{run_dir} is in use by process {holder}: wait until it ends, or choose another folder"
            ) from error
        except OSError as error:
            raise CheckpointError(f"{path}: this file system cannot lock files: {error}") from error
        with contextlib.suppress(OSError):  # the number is for the message alone
            os.ftruncate(handle, 0)
            os.pwrite(handle, str(os.getpid()).encode(), 0)
        yield
    finally:
        os.close(handle)


def _write_files(
    folder: Path, step: int, model: dict[str, Tensor], training: dict[str, Tensor], state: dict[str, Any]
) -> None:
    records = {}
    for name, content in zip(FILES, (model, training, state), strict=True):
        if name.endswith(".json"):
            data = json.dumps(content, allow_nan=False, indent=1).encode()
        else:
            data = safetensors.torch.save({key: _detached(tensor) for key, tensor in content.items()})
        records[name] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        write_synced(folder / name, data)
    manifest = {"version": VERSION, "step": step, "files": records}
    write_synced(folder / MANIFEST, json.dumps(manifest, indent=1).encode())
    sync_folder(folder)


def _detached(tensor: Tensor) -> Tensor:
    """A copy of its own: the file keeps no shared, strided or expanded memory."""
    return tensor.detach().cpu().contiguous().clone()


def _read_manifest(path: Path) -> dict[str, dict[str, Any]]:
    """The size and hash of each file; nothing but the known names is accepted."""
    try:
        if not path.is_dir():
            raise CheckpointError(f"{path}: there is no such checkpoint")
        data = _read_file(path / MANIFEST, _MANIFEST_BYTES)
        manifest = json.loads(data)
        step = int(path.name.removeprefix("step-")) if _NAME.fullmatch(path.name) else manifest["step"]
        if manifest.keys() != {"version", "step", "files"} or (manifest["version"], manifest["step"]) != (
            VERSION,
            step,
        ):
            raise CheckpointError(f"{path / MANIFEST}: is not the manifest of version {VERSION} of this step")
        records = manifest["files"]
        if set(records) != set(FILES) or any(set(record) != {"size", "sha256"} for record in records.values()):
            raise CheckpointError(f"{path / MANIFEST}: must list {', '.join(FILES)} with size and sha256")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"{path / MANIFEST}: cannot be read: {error}") from error
    return {name: records[name] for name in FILES}


def _read_verified(path: Path, name: str, record: dict[str, Any]) -> bytes:
    file = path / name
    try:
        size = os.lstat(file).st_size
        if size != record["size"]:
            raise CheckpointError(f"{file}: has {size} bytes, the manifest says {record['size']}")
        data = _read_file(file, size)
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read: {error}") from error
    if hashlib.sha256(data).hexdigest() != record["sha256"]:
        raise CheckpointError(f"{file}: is damaged: its SHA-256 is not that of the manifest")
    return data


def _read_file(file: Path, most: int) -> bytes:
    """A plain file of at most so many bytes; links are not followed."""
    handle = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)  # a pipe must not block
    with open(handle, "rb") as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise CheckpointError(f"{file}: has more than {most} bytes")
    return data


def _verify(path: Path) -> None:
    for name, record in _read_manifest(path).items():
        _read_verified(path, name, record)


def _is_valid(path: Path) -> bool:
    try:
        _verify(path)
    except CheckpointError:
        return False
    return True


def _newest_first(parent: Path) -> list[Path]:
    paths = [path for path in parent.glob("step-*") if _NAME.fullmatch(path.name)]
    return sorted(paths, key=lambda path: int(path.name.removeprefix("step-")), reverse=True)


def _marked(run_dir: Path) -> Path | None:
    """The folder that the file `best` names, if it names one."""
    try:
        name = _read_file(run_dir / _BEST, 64).decode(errors="replace").strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise CheckpointError(f"{run_dir / _BEST}: cannot be read: {error}") from error
    if not _NAME.fullmatch(name):
        warnings.warn(f"{run_dir / _BEST}: names no checkpoint: {name!r}", stacklevel=3)
        return None
    return run_dir / _FOLDER / name


def _prune(run_dir: Path, step: int, keep: int) -> None:
    """Remove all but the best and the newest up to this step; later ones were damaged when the run was resumed."""
    paths = _newest_first(run_dir / _FOLDER)
    current = run_dir / _FOLDER / f"step-{step}"
    first = paths.index(current)
    kept = {*paths[first : first + keep], _marked(run_dir)}
    for path in paths:
        if path not in kept:
            _discard(path)


def _discard(path: Path) -> None:
    """Remove a checkpoint: its name goes first, so that no half of it is ever found under it."""
    if path.exists():
        aside = path.with_name(f"{_TEMPORARY}{secrets.token_hex(4)}")
        os.rename(path, aside)
        shutil.rmtree(aside, ignore_errors=True)


def _clean(parent: Path) -> None:
    """Remove what a kill left of writing or of removing."""
    for path in parent.glob(f"{_TEMPORARY}*"):
        shutil.rmtree(path, ignore_errors=True)
