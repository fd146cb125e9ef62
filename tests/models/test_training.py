"""The models with world edges train, are found again from their settings, and roll out the validation scenes."""

from dataclasses import replace

import numpy as np
import pytest
import toy

from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import find_model, find_preset
from ast_sim.runs.config_toml import read_config
from ast_sim.runs.folder import RunFolder
from ast_sim.runs.metrics import Metrics
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training

SMALL = {"mgn": "model.blocks=2", "bsms": "model.levels=2", "hcmt": "model.levels=2"}


@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.parametrize("name", SMALL)
def test_it_trains_and_is_found_again(tmp_path, name, dynamic):
    data = toy.write(tmp_path / "toy.h5", dynamic=dynamic, stress=not dynamic)
    settings = [SMALL[name], "model.hidden=16", "model.world_radius=0.07", "train.statistics_pairs=8"]
    settings += ["train.batch_size=2", "train.steps=100", "train.log_every=10", "train.warmup=10"]
    config = configure(
        data, "tiny", [*settings, *([] if not dynamic else ["train.noise=1e-4"]), "train.peak_rate=2e-3"], name
    )
    assert config.model.node_inputs is None
    start_training(tmp_path / "run", config)
    lines = list(Metrics(tmp_path / "run"))
    losses = [line["loss"] for line in lines if "loss" in line]
    assert losses[-1] < 0.75 * losses[0], losses
    trained = RunFolder(tmp_path / "run")
    model, found = trained.load_model(), trained.settings
    assert type(model) is find_model(name).simulator and found == read_config(tmp_path / "run")
    assert found.model.node_inputs == (("velocity",) if dynamic else ("out_of_balance",))
    assert (found.model.hidden, found.model.world_radius) == (16, 0.07)
    assert np.isfinite([line["valid_rmse"] for line in lines if "valid_rmse" in line]).all()


def test_the_world_radius_is_the_mesh_spacing_where_the_contact_radius_joins_no_nodes(tmp_path, capsys):
    """The contact of parts acts within 0.003, a thirtieth of the distance between two nodes."""
    tiny = find_preset("mgn", "tiny").model
    for contact, expected in ((0.003, 0.1), (0.05, 0.05), (0.3, 0.3), (0.0, 0.1)):
        info = replace(toy.info(), contact_radius=contact)
        assert tiny.resolve(DataFacts.of(info, (), 0.1)).world_radius == expected
    chosen = replace(tiny, world_radius=0.003)
    assert chosen.resolve(DataFacts.of(toy.info(), (), 0.1)).world_radius == 0.003
    data, few = toy.write(tmp_path / "toy.h5"), [SMALL["mgn"], "train.steps=1", "train.statistics_pairs=4"]
    start_training(tmp_path / "blind", configure(data, "tiny", [*few, "model.world_radius=1e-6"], "mgn"))
    assert "warning: no node has a world edge of at most 1e-06 in 4 scenes" in capsys.readouterr().out
    start_training(tmp_path / "seeing", configure(data, "tiny", [*few, "model.world_radius=0.1"], "mgn"))
    assert "a scene, on average over 4 scenes" in capsys.readouterr().out
