"""`train` and `new_model` take the path of a dataset, or the open dataset."""

import pytest
import torch
import toy

from ast_sim import Dataset, new_model, train
from ast_sim.support.errors import ConfigError, DatasetError
from ast_sim.training import start


def test_a_path_or_an_open_dataset(tmp_path, monkeypatch):
    path = toy.write(tmp_path / "toy.h5")
    started = []
    monkeypatch.setattr(start, "start_training", lambda run, config, **_: started.append((run, config)))
    monkeypatch.setattr(start, "Run", type("Run", (), {"__new__": lambda cls, run: run}))
    with Dataset(path) as data:
        for one in (path, str(path), data):
            assert train(one, tmp_path / "run", steps=2) == tmp_path / "run"
        assert started[0] == started[1] == started[2] and started[0][1].data == str(path)
        models = []
        for one in (path, str(path), data):
            torch.manual_seed(0)
            models.append(new_model(one, "mgn", model_settings={"hidden": 16, "blocks": 2}))
        weights = [list(model.state_dict().values()) for model in models]
        assert data.count("train") == 3  # it is still open
    for others in weights[1:]:
        assert len(others) > 10 and all(torch.equal(a, b) for a, b in zip(weights[0], others, strict=True))


def test_an_open_dataset_in_another_unit_is_refused(tmp_path):
    with (
        Dataset(toy.write(tmp_path / "toy.h5"), "mm") as data,
        pytest.raises(DatasetError, match=r"toy.h5 was opened in mm: open it without length_unit"),
    ):
        train(data, tmp_path / "run", steps=2)
    assert not (tmp_path / "run").exists()


def test_the_state_is_a_list_of_names(tmp_path):
    """One text would be taken for its letters."""
    with pytest.raises(
        ConfigError, match=r"state is 'reaction'; it must be a list of names of fields, such as \['reaction'\]"
    ):
        train(toy.write(tmp_path / "toy.h5"), tmp_path / "run", steps=2, state="reaction")
