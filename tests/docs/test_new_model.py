"""docs/how-to/new-model.md, followed: its package is installed, and its commands train, evaluate and report."""

import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import forked
import pytest
import toy

from ast_sim.runs.metrics import Metrics

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "new-model.md"
FEW = [
    "train.steps=200", "train.statistics_pairs=8", "train.log_every=20", "train.noise=1e-3", "model.width=32"
]  # fmt: skip


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def run(*words: str, folder: Path, packages: Sequence[Path] = ()) -> subprocess.CompletedProcess[str]:
    """`ast-sim` in a process of its own, which finds what is installed in `packages`."""
    return forked.run(["-m", "ast_sim.cli", *words], cwd=folder, path=packages)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder that the package of the page is installed in."""
    folder = tmp_path_factory.mktemp("new_model")
    source = folder / "local-model"
    source.mkdir()
    (source / "local_model.py").write_text("\n\n".join(blocks("python")), encoding="utf-8")
    (source / "pyproject.toml").write_text("\n".join(blocks("toml")), encoding="utf-8")
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(folder / "packages")]
    words = [sys.executable, "-m", "pip", "install", "--quiet", *offline, str(source)]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "packages"


def test_the_page_leads_to_a_model(installed, tmp_path):
    toy.write(tmp_path / "plates.h5")
    commands = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("ast-sim")]
    assert [shlex.split(command)[1] for command in commands] == ["train", "evaluate", "report"]
    more = {"train": [word for setting in FEW for word in ("--set", setting)], "evaluate": ["--out", "errors.json"]}
    for command in commands:
        words = shlex.split(command)[1:]
        done = run(*words, *more.get(words[0], []), folder=tmp_path, packages=[installed])
        assert done.returncode == 0, done.stderr
    losses = [line["loss"] for line in Metrics(tmp_path / "run") if "loss" in line]
    assert losses[-1] < 0.8 * losses[0], losses
    settings = tomllib.loads((tmp_path / "run" / "config.toml").read_text(encoding="utf-8"))["model"]
    assert (settings["name"], settings["width"], settings["jumps"]) == ("local", 32, False)
    found = json.loads((tmp_path / "errors.json").read_text())
    errors = found["errors"]["displacement"]
    model, still = (errors[key]["one_step"]["normal"]["rmse_sequence"] for key in ("model", "hold_still"))
    assert found["failures"] == 0 and model < still
    assert "local" in (tmp_path / "run.html").read_text(encoding="utf-8")
    # A run names its model, not code: without the package it cannot be opened.
    done = run("evaluate", "run", "plates.h5", folder=tmp_path)
    assert done.returncode == 2 and "there is no model 'local'; there are: " in done.stderr


def test_its_settings_are_known(installed, tmp_path):
    shown = run("train", "--help", folder=tmp_path, packages=[installed]).stdout
    assert "\nlocal, presets tiny:\n" in shown and "model.width=64  (an integer)\n        hidden width" in shown
    words = ["train", "plates.h5", "--out", "run", "--model", "local", "--set", "model.widht=3"]
    done = run(*words, folder=tmp_path, packages=[installed])
    assert done.returncode == 2 and "no setting model.widht; the nearest is model.width" in done.stderr
