"""Which models have a derivative with respect to positions; README.md says so."""

import warnings
from dataclasses import replace

import pytest
import toy
from graph_models import made

from ast_sim.models.data_facts import DataFacts
from ast_sim.models.registry import find_preset

MODELS = ["ast", "transolver", "mgn", "bsms", "hcmt"]


@pytest.mark.parametrize("dynamic", [False, True], ids=["quasi-static", "dynamic"])
@pytest.mark.parametrize("name", MODELS)
def test_all_models_but_the_ones_with_proximity_have_one(name, dynamic):
    facts = DataFacts.of(toy.info(dynamic, stress=False), (), 0.1)
    config = find_preset(name, "tiny").model.resolve(facts)
    model, batch = made(config, 0)
    model.eval()
    position = batch.position.clone().requires_grad_()
    moved = replace(batch, position=position)
    if "proximity" in config.node_inputs:
        assert (name, dynamic) in (("ast", False), ("transolver", False))
        with pytest.raises(ValueError, match="proximity: it has no derivatives"):
            model(moved)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model(moved).motion.square().sum().backward()
    assert position.grad.isfinite().all() and position.grad.abs().max() > 0
