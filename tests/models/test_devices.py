"""Models run on the CPU: another device is refused in one line, another precision is not."""

from dataclasses import replace

import pytest
import torch
from graph_models import made, resolved

from ast_sim.models.mgn import MGNConfig
from ast_sim.support.errors import ConfigError

CONFIG = MGNConfig(hidden=16, blocks=2)


@pytest.mark.parametrize(
    "move",
    [
        lambda model: model.to("meta"),
        lambda model: model.to("cuda"),
        lambda model: model.to_empty(device="meta"),
        lambda model: model.to(torch.empty(0, device="meta")),
    ],
)
def test_a_model_does_not_leave_the_cpu(move):
    model, batch = made(resolved(CONFIG), 0)
    before = model.predict(batch).motion
    with pytest.raises(ConfigError, match=r"^models run on the CPU only: [^\n]+$"):
        move(model)
    assert torch.equal(model.predict(batch).motion, before)


def test_a_batch_on_another_device_is_refused():
    model, batch = made(resolved(CONFIG), 0)
    elsewhere = replace(batch, position=batch.position.to("meta"))
    for call in (model, model.predict):
        with pytest.raises(ConfigError, match="^models run on the CPU only: the batch cannot be on meta"):
            call(elsewhere)


def test_a_model_may_change_its_precision():
    model, _ = made(resolved(CONFIG), 0)
    assert {p.dtype for p in model.to(torch.float64).parameters()} == {torch.float64}
    assert {p.dtype for p in model.to("cpu").float().parameters()} == {torch.float32}
