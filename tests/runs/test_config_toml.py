"""`run.json`: edited and damaged settings are noticed, and so are checkpoints of another run."""

import random
import shutil

import pytest
import toy

from ast_sim import Run
from ast_sim.cli import main
from ast_sim.runs import checkpoint
from ast_sim.runs import folder as folder_module
from ast_sim.runs.config_toml import read_config, read_origin, read_scope
from ast_sim.runs.folder import RunFolder
from ast_sim.support.errors import CheckpointError, ConfigError
from ast_sim.training import start

SMALL = [
    "train.steps=4", "train.batch_size=2", "train.validate_every=2", "train.statistics_pairs=4", "train.rollout_pool=0",
    "model.hidden=8", "model.blocks=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run and another one, which differs in the seed only."""
    folder = tmp_path_factory.mktemp("trained")
    data = toy.write(folder / "toy.h5")
    for name, seed in (("run", 0), ("other", 1)):
        start.start_training(folder / name, start.configure(data, "tiny", [*SMALL, f"train.seed={seed}"], "mgn"))
    return folder


@pytest.fixture
def run(trained, tmp_path):
    return shutil.copytree(trained / "run", tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("config.toml", "hidden = 8\n", "hidden = 3\n", r"config.toml: model.hidden is 3, but .* started with 8"),
        ("config.toml", "hidden = 8\n", "", r"config.toml: model.hidden is missing; the run was started with 8"),
        ("config.toml", "hidden = 8\n", "hidden = 8\nheads = 3\n", r"config.toml: model.heads is no setting"),
        ("config.toml", "hidden = 8\n", "hidden = \n", r"config.toml is damaged: it is not valid TOML"),
        ("config.toml", "hidden = 8\n", f"hidden = {'9' * 5000}\n", r"config.toml is damaged: it is not valid TOML"),
        ("config.toml", "[model]", "[modem]", r"config.toml: model.name is missing"),
        ("config.toml", "version = 2", "version = 3", r"config.toml: version is 3, but .* started with 2"),
        ("scope.toml", "corners = 4", "corners = 5", r"scope.toml: corners is 5, but .* started with 4"),
    ],
)
def test_an_edited_file_is_refused_with_the_setting_that_differs(run, name, old, new, message):
    text = (run / name).read_text()
    assert old in text
    (run / name).write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        (read_config if name == "config.toml" else read_scope)(run)


@pytest.mark.parametrize("name", ["config.toml", "scope.toml", "run.json"])
def test_no_flipped_bit_and_no_truncation_changes_a_setting(run, name):
    intact, content, draw = (read_config(run), read_scope(run)), (run / name).read_bytes(), random.Random(0)
    damages = [content[: draw.randrange(len(content))] for _ in range(100)]
    for _ in range(300):
        place = draw.randrange(len(content))
        damages.append(content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :])
    refused = 0
    for damaged in damages:
        (run / name).write_bytes(damaged)
        try:
            assert (read_config(run), read_scope(run)) == intact
        except (ConfigError, CheckpointError) as error:
            assert name in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 350


def test_a_run_without_its_record_is_refused_in_one_line(run, capsys):
    (run / "run.json").unlink()
    assert main(["info", str(run)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "run.json cannot be read" in error and "restore run.json" in error


def test_a_whole_checkpoint_of_another_run_is_refused(trained, run):
    name = checkpoint.latest(run).name
    for path in (run / "checkpoints").iterdir():
        shutil.rmtree(path)
        shutil.copytree(trained / "other" / "checkpoints" / name, path.with_name(name), dirs_exist_ok=True)
    with pytest.raises(CheckpointError, match="is of a run with other settings or other data"):
        start.start_training(run, resume=True)
    (run / "best").unlink()
    with pytest.raises(CheckpointError, match=r"is of a run with other settings|best"):
        RunFolder(run).load_model()


def test_a_run_reads_each_of_its_files_once(run, tmp_path, monkeypatch):
    """However often they are used, until it is opened again."""
    calls = []

    def counted(reader):
        def read(path):
            calls.append(reader.__name__)
            return reader(path)

        return read

    for reader in (read_config, read_scope, read_origin):
        monkeypatch.setattr(folder_module, reader.__name__, counted(reader))
    for times in (1, 2):
        opened = Run(run)
        for _ in range(2):
            opened.evaluate(solver_scenes=0, progress=False)
            opened.save(tmp_path / "run.ast")
            assert opened.info.family == "toy_plate" and opened.folder.specification is None
        assert sorted(calls) == sorted(times * ["read_config", "read_scope", "read_origin"])
