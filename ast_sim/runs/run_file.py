"""A run as one file, `NAME.ast`, which predicts on any machine: a zip of plain files, without pickle.

    run.json           the settings, the scope, what validation found out about answers, the checkpoint, the data
    model.safetensors  the weights of the checkpoint
    metrics.jsonl      the curves of the training, for reports
    README.md          the model card
    LICENSE            under which terms the weights may be used
    manifest.json      format, version, and the size and SHA-256 of each file

The optimizer's state, the other checkpoints and paths of this machine stay behind. Members are stored, not compressed,
so no member can be larger than the file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

import ast_sim
from ast_sim.models.registry import trained_model
from ast_sim.models.simulator import Simulator
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import has_config
from ast_sim.runs.folder import Chosen, RunFolder
from ast_sim.runs.metrics import METRICS, Metrics
from ast_sim.runs.model_card import card
from ast_sim.runs.scope import Scope
from ast_sim.runs.sealed_line import seal, unseal
from ast_sim.runs.train_config import RunConfig
from ast_sim.support.argument_checks import in_short
from ast_sim.support.disk import replacing
from ast_sim.support.errors import CheckpointError, ConfigError
from ast_sim.support.toml_settings import from_values, to_values

SUFFIX = ".ast"
FORMAT = "ast_sim run"
VERSION = 2  # as of a run's folder (`config_toml`)

_FACTS, _WEIGHTS, _CARD, _LICENCE, _MANIFEST = (
    "run.json",
    "model.safetensors",
    "README.md",
    "LICENSE",
    "manifest.json",
)
_KINDS = {"settings": dict, "scope": dict, "step": int, "answers": dict, "data": str}  # of the facts
_MEMBERS = (_CARD, _LICENCE, _FACTS, METRICS, _WEIGHTS)
_TIME = (1980, 1, 1, 0, 0, 0)  # the same run gives the same bytes
_NO_LICENCE = (
    "The author of this file has not stated a licence for the weights: ask the author before you pass them on.\n"
    "The program that reads it, ast_sim, is under the MIT licence.\n"
)
_ERRORS = (OSError, ValueError, KeyError, TypeError, AttributeError, NotImplementedError, RuntimeError)


class RunFile(RunFolder):
    """A run that was saved as one file; its members are checked when the file is opened.

    Raises:
        CheckpointError: the file cannot be read, is damaged, or is of another version.
        ConfigError: when the settings are read, the model that they name is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._members = _read(path)
        self._facts = _facts_of(path, self._members[_FACTS])
        self.metrics = _KeptMetrics(path, _text(path, self._members, METRICS))
        self._licence = _text(path, self._members, _LICENCE)

    @property
    def licence(self) -> str:
        return self._licence

    @cached_property
    def settings(self) -> RunConfig:
        return from_values(RunConfig, self._facts["settings"]).knowing(self.scope.data)

    @cached_property
    def scope(self) -> Scope:
        return from_values(Scope, self._facts["scope"])

    @cached_property
    def origin(self) -> dict[str, Any]:
        return {key: self._facts[key] for key in ("data", "specification", "scenes") if key in self._facts}

    @cached_property
    def chosen(self) -> Chosen:
        return Chosen(self.path, self._facts["step"], self._facts["answers"])

    def keep_calibration(self, calibration: Mapping[str, Any]) -> None:
        """Keep it in this object, and so in a file that is written of it; this file stays as it is."""
        self.chosen = self.chosen._replace(answers={**self.chosen.answers, "calibration": dict(calibration)})

    def require_best(self) -> None:
        """A file has one checkpoint, which is the best one."""

    def held(self) -> AbstractContextManager[None]:
        """Nothing trains in a file."""
        return nullcontext()

    @property
    def arrays(self) -> dict[str, Tensor]:
        """The weights and scales of the model."""
        return safetensors.torch.load(self._members[_WEIGHTS])

    def start(self) -> dict[str, Any]:
        sha256 = hashlib.sha256(self._members[_WEIGHTS]).hexdigest()
        return {"run": str(self.path.resolve()), "step": self.chosen.step, "sha256": sha256}

    def load_model(self) -> Simulator:
        try:
            return trained_model(self.settings.model, self.arrays)
        except (SafetensorError, RuntimeError) as error:
            why = " ".join(str(error).split())
            raise CheckpointError(f"{self.path}: the weights do not fit the settings: {why}") from error

    def describe(self) -> dict[str, Any]:
        """What `ast-sim info` says of the file."""
        return {
            "kind": "run file",
            "path": str(self.path),
            "bytes": self.path.stat().st_size,
            **dataclasses.asdict(self.settings),
            "step": self.chosen.step,
            "answers": self.chosen.answers,
            "licence": self.licence.partition("\n")[0],
        }


class _KeptMetrics(Metrics):
    """The lines that a run file holds."""

    def __init__(self, path: Path, text: str) -> None:
        self.path = path
        self._lines = text.splitlines()

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for number, line in enumerate(self._lines, 1):
            try:
                yield unseal(line)
            except ValueError as error:
                raise CheckpointError(f"{self.path}: line {number} of {METRICS} is damaged: {error}") from error


def open_run(path: Path) -> RunFolder:
    """The run in a folder, or in a file that `write` made.

    Raises:
        CheckpointError: there is neither; or as `RunFile`.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: there is no such file or folder")
    return RunFile(path) if path.is_file() else RunFolder(path)


def first_weights(run: RunFolder) -> dict[str, Tensor] | None:
    """The weights that a run starts from; None if it does not start from another run.

    Raises:
        CheckpointError: the checkpoint or the file is gone, damaged, or not the one that the run recorded.
    """
    start = run.origin.get("start") if has_config(run.path) else None  # a loop of one's own may have no settings
    if start is None:
        return None
    file = RunFile(Path(start["run"])) if Path(start["run"]).is_file() else None
    path = checkpoint.at_step(start["run"], start["step"]) if file is None else file.path
    if start["sha256"] != (checkpoint.weights_hash(path) if file is None else file.start()["sha256"]):
        raise CheckpointError(f"{path} is not the checkpoint that {run.path} starts from: train in another folder")
    return checkpoint.load(path)[0] if file is None else file.arrays


def write(path: Path, run: RunFolder, model: Simulator, effort: Mapping[str, Any], licence: str | None = None) -> None:
    """Write the run as one file, whole or not at all, with its default effort; `licence` is the text of the licence of
    the weights, by default the one that the run has.

    Raises:
        CheckpointError: the name does not end in `.ast`, or the file cannot be written.
        ConfigError: the licence is no text.
    """
    if path.suffix != SUFFIX:
        raise CheckpointError(f"{path}: the name of a run file must end in {SUFFIX}")
    if licence is not None and not isinstance(licence, str):
        raise ConfigError(f"licence is {licence!r}; it must be the text of a licence")
    settings = run.settings
    chosen = run.chosen
    chosen = chosen._replace(answers={**chosen.answers, "effort": dict(effort)})
    without_path = dataclasses.replace(settings, data=Path(settings.data).name)
    facts = {
        "settings": to_values(without_path),
        "scope": to_values(run.scope),
        "step": chosen.step,
        "answers": chosen.answers,
        "data": run.origin["data"],
        **{key: run.origin[key] for key in ("specification", "scenes") if run.origin.get(key)},
    }
    weights = {key: tensor.detach().clone().contiguous() for key, tensor in model.state_dict().items()}
    members = {
        _CARD: card(path.stem, without_path, run.scope, chosen, model.num_parameters).encode(errors="backslashreplace"),
        _LICENCE: (licence or run.licence or _NO_LICENCE).encode(),
        _FACTS: json.dumps(facts, indent=1, allow_nan=False).encode(),
        METRICS: "".join(map(seal, run.metrics)).encode(),
        _WEIGHTS: safetensors.torch.save(weights),
    }
    manifest = {"format": FORMAT, "version": VERSION, "ast_sim": ast_sim.__version__, "files": _records(members)}
    try:
        with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            for name, content in {**members, _MANIFEST: json.dumps(manifest, indent=1).encode()}.items():
                archive.writestr(zipfile.ZipInfo(name, _TIME), content)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be written: {error.strerror or error}; no part of it was kept") from error


def _records(members: dict[str, bytes]) -> dict[str, dict[str, Any]]:
    return {
        name: {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()} for name, content in members.items()
    }


def _facts_of(path: Path, content: bytes) -> dict[str, Any]:
    """The facts of a run, each of its kind."""
    try:
        facts = json.loads(content)
        wrong = [key for key, kind in _KINDS.items() if not isinstance(facts[key], kind)]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path}: {_FACTS} is damaged: {type(error).__name__}: {error}") from error
    if wrong:
        raise CheckpointError(f"{path}: {_FACTS} is damaged: {wrong[0]} is {in_short(facts[wrong[0]])}")
    return facts


def _text(path: Path, members: Mapping[str, bytes], name: str) -> str:
    try:
        return members[name].decode()
    except UnicodeDecodeError as error:
        raise CheckpointError(f"{path}: {name} is damaged: it is no text") from error


def _read(path: Path) -> dict[str, bytes]:
    """The members by name, all of them as the manifest says."""
    try:
        with zipfile.ZipFile(path) as archive:
            held = {info.filename: info for info in archive.infolist()}
            if sorted(held) != sorted([*_MEMBERS, _MANIFEST]) or len(archive.infolist()) != len(held):
                raise CheckpointError(f"{path} is no run file: it holds {', '.join(sorted(held)[:6]) or 'nothing'}")
            if any(info.compress_type != zipfile.ZIP_STORED for info in held.values()):
                raise CheckpointError(f"{path} is no run file: its members are compressed")
            members = {name: archive.read(name) for name in held}
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"{path} is no run file, or it is damaged: {error}") from error
    except _ERRORS as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    try:
        manifest = json.loads(members.pop(_MANIFEST))
        kind, version, records = manifest["format"], manifest["version"], manifest["files"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{path}: {_MANIFEST} is damaged: {error}") from error
    if (kind, version) != (FORMAT, VERSION):
        raise CheckpointError(f"{path}: is {kind!r} {version}, not {FORMAT!r} {VERSION}: use the ast_sim that wrote it")
    for name, record in _records(members).items():
        if records.get(name) != record:
            raise CheckpointError(f"{path}: {name} is damaged: it differs from the manifest")
    return members
