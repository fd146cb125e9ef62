"""A run that starts from another one, and settings from a file."""

import dataclasses
import json
import os
import shutil

import numpy as np
import pytest
import torch
import toy

import ast_sim
from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.runs import checkpoint
from ast_sim.runs.config_toml import read_changes, read_config, read_origin
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.runs.run_file import first_weights
from ast_sim.support.errors import CheckpointError, ConfigError
from ast_sim.training.configure import configure
from ast_sim.training.rates import step_seed
from ast_sim.training.start import start_training

SMALL = [
    "train.steps=200", "train.batch_size=2", "train.validate_every=100", "train.statistics_pairs=8", "model.hidden=8",
    "train.rollout_pool=0", "model.blocks=2", "model.jumps=false", "train.mirror=y", "train.log_every=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A dataset `toy.h5` and a run `source` on it."""
    folder = tmp_path_factory.mktemp("source")
    start_training(folder / "source", configure(toy.write(folder / "toy.h5"), None, SMALL, "mgn"))
    return folder


def validations(run) -> list[float]:
    return [record["valid_rmse"] for record in Metrics(run) if "valid_rmse" in record]


def started(data, source, out, *assignments):
    start_training(out, configure(data, None, assignments, from_run=source), from_run=source)
    return out


# Another run to start from


def test_the_first_loss_comes_from_the_weights_of_the_source(folder, tmp_path):
    trained = RunFolder(folder / "source")
    model, settings = trained.load_model(), trained.settings
    run = started(folder / "toy.h5", folder / "source", tmp_path / "run", "train.steps=2", "train.seed=5")
    options = read_config(run).train
    with Dataset(folder / "toy.h5") as data:
        batch, target = model.pairs(
            data, batch_size=2, seed=5, noise=options.noise, gamma=options.noise_gamma, mirror=("y",)
        ).batch(0)
    torch.manual_seed(step_seed(5, 0))
    expected = model.train().loss(
        model(batch), batch, target, options.stress_weight, strain_weight=options.strain_weight
    )["loss"]
    first = next(iter(Metrics(run)))
    assert first["step"] == 1 and first["loss"] == expected.item()
    assert settings.model == read_config(run).model


def test_more_steps_lower_the_error(folder, tmp_path):
    run = ast_sim.train(folder / "toy.h5", tmp_path / "run", from_run=folder / "source", steps=300)
    source, longer = validations(folder / "source"), validations(run.path)
    assert len(longer) == 10  # chosen again for another number of steps
    assert min(longer) < 0.95 * min(source)
    train = run.settings.train
    assert (train.steps, train.decay, train.warmup, train.mirror) == (300, 300, 15, ("y",))


def test_normalizers_come_from_the_source_on_other_data(folder, tmp_path):
    other = toy.write(tmp_path / "other.h5", counts=(1, 1, 0))
    run = started(other, folder / "source", tmp_path / "run", "train.steps=1")
    theirs, ours = RunFolder(folder / "source").load_model(), RunFolder(run).load_model()
    fixed = [name for name, _ in theirs.named_buffers()]
    assert "motion_normalizer.scale" in fixed
    for name in fixed:
        assert torch.equal(theirs.get_buffer(name), ours.get_buffer(name)), name


def test_the_run_records_where_its_weights_came_from(folder, tmp_path, capsys):
    words = ["train", folder / "toy.h5", "--out", tmp_path / "run", "--from", folder / "source"]
    assert main([*map(str, words), "--set", "train.steps=2"]) == 0
    step = RunFolder(folder / "source").chosen.step
    assert f"starts from {folder / 'source'}, step {step}" in capsys.readouterr().out
    start = read_origin(tmp_path / "run")["start"]
    chosen = folder / "source" / "checkpoints" / f"step-{step}"
    assert start == {"run": str(folder / "source"), "step": step, "sha256": checkpoint.weights_hash(chosen)}
    assert main(["info", "--json", str(tmp_path / "run")]) == 0
    assert json.loads(capsys.readouterr().out)["start"] == start


def test_before_its_first_checkpoint_a_run_needs_the_source_as_it_was(folder, tmp_path):
    source = shutil.copytree(folder / "source", tmp_path / "source")
    run = started(folder / "toy.h5", source, tmp_path / "run", "train.steps=2")
    expected = checkpoint.load(checkpoint.latest(run))[0]
    shutil.rmtree(run / "checkpoints")  # as if it had been killed before
    (run / "best").unlink()
    start_training(run, resume=True)
    again = checkpoint.load(checkpoint.latest(run))[0]
    assert all(torch.equal(expected[key], again[key]) for key in expected)
    step = RunFolder(source).chosen.step
    shutil.rmtree(run / "checkpoints")
    (run / "best").unlink()
    shutil.rmtree(source / "checkpoints" / f"step-{step}")
    with pytest.raises(CheckpointError, match=f"step-{step}: there is no such checkpoint"):
        start_training(run, resume=True)


def test_a_source_that_was_trained_again_is_noticed(folder, tmp_path):
    source = shutil.copytree(folder / "source", tmp_path / "source")
    run = started(folder / "toy.h5", source, tmp_path / "run", "train.steps=2")
    step = RunFolder(source).chosen.step
    shutil.rmtree(source)
    start_training(source, configure(folder / "toy.h5", None, [*SMALL, "train.seed=3"], "mgn"))
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(CheckpointError, match=rf"step-{step} is not the checkpoint that .*run starts from"):
        start_training(run, resume=True)


def test_a_resumed_run_keeps_its_source(folder, tmp_path):
    copy = shutil.copytree(folder / "source", tmp_path / "copy")
    run = started(folder / "toy.h5", folder / "source", tmp_path / "run", "train.steps=2")
    config = configure(folder / "toy.h5", None, ["train.steps=2"], from_run=folder / "source")
    start_training(run, config, resume=True, from_run=folder / "source")
    with pytest.raises(ConfigError, match=rf"was started from {folder / 'source'}, not from {copy}"):
        start_training(run, config, resume=True, from_run=copy)
    plain = tmp_path / "plain"
    same = [setting for setting in SMALL if "validate_every" not in setting]
    start_training(plain, configure(folder / "toy.h5", None, [*same, "train.steps=2"], "mgn"))
    with pytest.raises(ConfigError, match="was started without another run"):
        start_training(plain, config, resume=True, from_run=folder / "source")


def changed(path, trajectory, **facts):
    """A dataset of this one trajectory for training; `facts` replace the toy's."""
    with DatasetWriter(path, ast_sim.DatasetInfo(**{**vars(toy.info()), **facts})) as writer:
        writer.add("train", trajectory)
    return path


def test_data_that_cannot_fit_are_refused_in_one_line(folder, tmp_path):
    plate = toy.plate()
    material = np.ones((plate.scene.num_elements, 2), np.float32)
    soft = dataclasses.replace(plate, scene=dataclasses.replace(plate.scene, material=material))
    for name, path in (
        ("material columns column 0, column 1", changed(tmp_path / "material.h5", soft)),
        ("lengths in mm", changed(tmp_path / "mm.h5", plate, length_unit="mm")),
        ("stress_location none", toy.write(tmp_path / "none.h5", stress=False)),
        ("integration dynamic", toy.write(tmp_path / "dynamic.h5", dynamic=True)),
    ):
        with pytest.raises(ConfigError, match=f"{path.name} has {name}, but .*source was trained with") as error:
            started(path, folder / "source", tmp_path / "run")
        assert "\n" not in str(error.value)
        assert not (tmp_path / "run" / "config.toml").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"assignments": ["model.hidden=16"]}, "model.hidden is 16, but .*source has 8: .* keeps its model"),
        ({"model": "mgn"}, "leave model and preset out"),
        ({"preset": "tiny"}, "leave model and preset out"),
        ({"assignments": ["model.hiden=16"]}, "the nearest is model.hidden"),
    ],
)
def test_the_model_of_the_source_stays(folder, options, message):
    with pytest.raises(ConfigError, match=message):
        configure(folder / "toy.h5", from_run=folder / "source", **options)


def test_a_source_that_is_no_run_is_one_line(folder, tmp_path, capsys):
    words = ["train", folder / "toy.h5", "--out", tmp_path / "run", "--from", tmp_path]
    assert main([*map(str, words)]) == 2
    assert capsys.readouterr().err == (
        f"ast-sim train: {tmp_path} is not a run folder: config.toml cannot be read (No such file or directory)\n"
    )


# Settings from a file


def test_the_settings_of_a_run_come_from_its_file(folder):
    file = folder / "source" / "config.toml"
    config = configure(folder / "toy.h5", config=file)
    facts = read_config(folder / "source").model.data
    assert config.knowing(facts) == read_config(folder / "source") and config.model.data != facts
    longer = configure("other.h5", None, ["train.steps=300", "train.warmup=7"], config=file)
    assert longer.data == "other.h5" and longer.knowing(facts).model == read_config(folder / "source").model
    assert (longer.train.steps, longer.train.warmup, longer.train.decay) == (300, 7, None)


def test_options_win_over_a_file_and_a_file_over_the_preset(folder, tmp_path):
    file = tmp_path / "my.toml"
    file.write_text('[model]\nname = "transolver"\nhidden = 24\n[train]\nclip = 0.5\nmirror = ["x"]\nnoise = "none"\n')
    found = configure("d.h5", None, ["train.clip=0.25"], config=file)
    preset = configure("d.h5", None, [], "transolver")
    assert (found.model.name, found.model.hidden, found.model.slices) == ("transolver", 24, preset.model.slices)
    assert (found.train.clip, found.train.mirror, found.train.noise) == (0.25, ("x",), None)
    assert found.train.peak_rate == preset.train.peak_rate
    assert configure("d.h5", None, [], "mgn", config=file).model.name == "mgn"
    with pytest.raises(ConfigError, match="my.toml: there is no setting model.hidden"):
        file.write_text("[model]\nhidden.x = 3\n")
        configure("d.h5", config=file)
    file.write_text("[train]\nsteps = 3\nmirror = ['x']\n")
    run = ast_sim.train(folder / "toy.h5", tmp_path / "run", config=file, from_run=folder / "source", mirror=())
    assert (run.settings.train.steps, run.settings.train.mirror, run.settings.model.hidden) == (3, (), 8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[train\n", "is not valid TOML"),
        ("[train]\nstep = 3\n", "there is no setting train.step; the nearest is train.steps"),
        ("train = 3\n", "train is a group of settings, such as train.steps"),
        ('[train]\nsteps = "many"\n', "train.steps is 'many'; must be an integer"),
        ('[model]\nname = "mgm"\n', "there is no model 'mgm'; did you mean 'mgn'"),
        ("[model]\nhidden = 0\n", "model.hidden is 0; it must be at least 1"),
        ("version = 9\n", "has version 9, not 2"),
        ("\udcff", "is not valid TOML"),
        (None, "cannot be read: No such file or directory"),
    ],
)
def test_an_error_names_the_file(tmp_path, capsys, text, message):
    file = tmp_path / "my.toml"
    if text is not None:
        file.write_text(text, errors="surrogateescape")
    assert main(["train", str(tmp_path / "d.h5"), "--out", str(tmp_path / "run"), "--config", str(file)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(file) in error and message in error
    assert not (tmp_path / "run").exists()


def test_a_resumed_run_takes_neither(folder, capsys):
    for option in ("--config", "--from"):
        assert main(["train", "--out", str(folder / "source"), "--resume", option, str(folder / "source")]) == 2
        assert (
            "a resumed run keeps its settings: leave out --set and all options but --out and --resume"
            in capsys.readouterr().err
        )


def test_a_settings_file_that_is_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(ConfigError, match="it is no regular file"):
            read_changes(path)


def test_a_run_may_start_from_a_saved_file_or_an_open_run(folder, tmp_path):
    source, path, data = ast_sim.Run(folder / "source"), tmp_path / "source.ast", folder / "toy.h5"
    source.save(path)
    losses = []
    for number, start in enumerate((folder / "source", path, str(path), source, ast_sim.Run(path))):
        run = ast_sim.train(data, tmp_path / f"run{number}", from_run=start, steps=1, progress=False)
        assert run.settings.model == source.settings.model and run.settings.train.seed == source.settings.train.seed
        losses.append(next(iter(Metrics(run.path)))["loss"])
    assert len(set(losses)) == 1  # the weights of the same checkpoint
    with pytest.raises(ConfigError, match=f"was started from .*source, not from {path}"):
        start_training(tmp_path / "run0", resume=True, from_run=path)
    start_training(tmp_path / "run1", resume=True, from_run=path)  # it has ended
    with torch.no_grad():
        next(source.model.parameters()).add_(1)
    with pytest.raises(ConfigError, match=r"have changed since it was opened: save it \(Run.save\), and start from"):
        ast_sim.train(data, tmp_path / "run", from_run=source, steps=1)
    source.save(path)
    with pytest.raises(CheckpointError, match="source.ast is not the checkpoint that .*run1 starts from"):
        first_weights(RunFolder(tmp_path / "run1"))


@pytest.mark.parametrize("name", ["nope.ast", "nope"])
def test_a_run_that_is_not_there_is_named_so(folder, tmp_path, name):
    missing = tmp_path / name
    for call in (
        lambda: ast_sim.Run(missing),
        lambda: ast_sim.train(folder / "toy.h5", tmp_path / "out", from_run=missing, steps=1),
    ):
        with pytest.raises(CheckpointError, match=f"{name}: there is no such file or folder"):
            call()
    with pytest.raises(ConfigError, match="from_run is 5; it must be"):
        ast_sim.train(folder / "toy.h5", tmp_path / "out", from_run=5, steps=1)
    with pytest.raises(CheckpointError, match="is not a run folder"):
        ast_sim.Run(tmp_path)
