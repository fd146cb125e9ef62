"""When a model of a specification pays: real scenes, a real training of a few steps."""

import dataclasses

import pytest
from simulate.own_assembly.assemblies import write_assembly

import ast_sim
from ast_sim.planning.worth import Worth
from ast_sim.support.errors import AstSimError, ConfigError

WORTH = Worth(
    spec="SPEC.toml", minutes=10.0, steps=1000, scenes=100, workers=2, solve_seconds=6.0, answer_seconds=0.5,
    step_seconds=0.6, command="ast-sim generate",
)  # fmt: skip


def test_a_model_pays_when_it_has_saved_the_seconds_of_its_making():
    """100 scenes of 6 s and 600 s of training are 1,200 s; an answer saves 5.5 s: 218.2 questions."""
    assert WORTH.pays_after == 219
    assert "the model pays after 219 questions; for fewer the solver alone is the better choice" in str(WORTH)
    assert "these scenes take 5 min 00 s on 2 cores" in str(WORTH)


def test_a_model_that_is_no_faster_never_pays():
    slow = dataclasses.replace(WORTH, answer_seconds=6.0)
    assert slow.pays_after is None
    assert "a model does not pay: the solver is as fast" in str(slow)


def test_of_a_specification(tmp_path, monkeypatch):
    spec = write_assembly(tmp_path)
    found = ast_sim.worth(spec, tmp_path / "worth", 2.0)
    with ast_sim.Dataset(tmp_path / "worth" / "scenes.h5") as dataset:
        assert (dataset.count("train"), dataset.count("valid")) == (3, 1)
    assert found.solve_seconds > 0 and found.answer_seconds > 0
    assert found.steps == int(120 / found.step_seconds)
    assert found.scenes == max(4, -(-found.steps * 8 // (16 * 2)))  # 8 scenes a step; 2 frames of a scene are answered
    assert f"--count {found.scenes}" in found.command
    monkeypatch.setattr("ast_sim.training.loop.Training.advance", lambda *_: pytest.fail("trained again"))
    again = ast_sim.worth(spec, tmp_path / "worth", 2.0)
    assert (again.scenes, again.solve_seconds) == (found.scenes, found.solve_seconds)


def test_a_specification_with_a_mistake_is_refused(tmp_path):
    spec = write_assembly(tmp_path)
    spec.write_text(spec.read_text().replace("young", "yuong"))
    with pytest.raises(AstSimError, match="parts.block.young is missing"):
        ast_sim.worth(spec, tmp_path / "worth", 2.0)


def test_minutes_without_a_training_are_refused(tmp_path, monkeypatch):
    """0.001 minutes were 0 steps, and "the model pays after 7 questions"."""
    spec = write_assembly(tmp_path)
    with pytest.raises(
        ConfigError, match=r"0.001 minutes are too few: a training would have [01] steps? of .* than 20"
    ):
        ast_sim.worth(spec, tmp_path / "worth", 0.001)
