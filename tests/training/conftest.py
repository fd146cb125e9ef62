"""What several tests of trainings share."""

import pytest
import toy

from ast_sim.models import registry
from ast_sim.training import loop


@pytest.fixture
def linear(monkeypatch):
    """The linear model in the place of AST."""
    monkeypatch.setattr(loop, "build_model", toy.LinearSimulator)
    monkeypatch.setattr(registry, "build_model", toy.LinearSimulator)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A dataset of the toy."""
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")
