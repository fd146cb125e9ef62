"""What several tests of trainings share."""

import pytest
import toy

from ast_sim.runs import folder as run_folder
from ast_sim.training import loop


@pytest.fixture
def linear(monkeypatch):
    """The linear model in the place of AST."""
    monkeypatch.setattr(loop, "build_model", toy.LinearSimulator)
    monkeypatch.setattr(run_folder, "build_model", toy.LinearSimulator)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A dataset of the toy."""
    return toy.write(tmp_path_factory.mktemp("data") / "toy.h5")
