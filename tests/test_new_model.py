"""docs/new-model.md, followed: the code on the page is a model that trains, is found again and rolls out."""

import re
from pathlib import Path

import numpy as np
import toy
from toy import one_thread  # noqa: F401

from ast_sim import models, run
from ast_sim.model.ast_config import ASTConfig
from ast_sim.results import open_run, predict
from ast_sim.train import configure, train

PAGE = Path(__file__).parents[1] / "docs" / "new-model.md"


def test_the_page_leads_to_a_model(tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    made: dict = {"__name__": "local"}
    exec(compile("\n".join(blocks[:3]), str(PAGE), "exec", dont_inherit=True), made)
    # The last block is the line of the table.
    assert '"local": Model(LocalConfig, Local, LOCAL_PRESETS)' in blocks[3]
    monkeypatch.setitem(models.MODELS, "local", models.Model(made["LocalConfig"], made["Local"], made["PRESETS"]))
    monkeypatch.setattr(run, "AnyConfig", ASTConfig | made["LocalConfig"])

    data = toy.write(tmp_path / "toy.h5", dynamic=True, stress=False)
    few = [
        "train.steps=200",
        "train.statistics_pairs=8",
        "train.log_every=20",
        "train.peak_rate=5e-3",
        "model.width=32",
    ]
    train(tmp_path / "run", configure(data, "tiny", few, "local"))
    losses = [line["loss"] for line in run.Metrics(tmp_path / "run") if "loss" in line]
    assert losses[-1] < 0.9 * losses[0], losses
    with open_run(tmp_path / "run") as found:
        assert type(found.model) is made["Local"] and found.settings.model.width == 32
        truth, result = predict(found, "test", 0)
    assert result.failure is None and np.isfinite(result.position).all()
    assert result.position.shape == truth.position.shape and np.abs(result.position - truth.position[0]).max() > 1e-4
