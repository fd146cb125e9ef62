"""The study of extremes: a few of its questions, to the run that comes with the package and to a model of two steps."""

import json

import numpy as np
import pytest
import torch

import ast_sim
from benchmarks.robustness import extremes


@pytest.fixture
def few(monkeypatch, tmp_path, one_thread):
    def cases(folder):
        truth = extremes._plate(folder, 100)
        scene, motion = truth.scene, truth.position
        yield extremes.Case("as it is", "as it is", scene, motion, motion[-1])
        shift = np.float32([0, 0, 1e6])
        moved = ast_sim.Scene(scene.rest_position + shift, scene.elements, scene.node_type, scene.body)
        yield extremes.Case("place", "far away", moved, motion + shift, motion[-1] + shift)
        lost = motion.copy()
        lost[-1, np.flatnonzero(scene.prescribed)[0]] = np.nan
        yield extremes.Case("motion", "no number", scene, lost)

    monkeypatch.setattr(extremes, "_cases", cases)
    monkeypatch.setattr(extremes, "OTHERS", {"transolver": "Transolver"})
    monkeypatch.setattr(extremes, "TRAINING", {**extremes.TRAINING, "nodes": 100, "train": 4, "valid": 1})
    monkeypatch.setattr(extremes, "STEPS", 2)
    monkeypatch.setattr(extremes, "RESULTS", tmp_path / "extremes.json")
    monkeypatch.setattr(extremes, "PAGE", tmp_path / "extremes.md")
    return tmp_path


def test_each_model_is_asked_and_shown(few):
    extremes.main(["--folder", str(few)])
    usual, far, lost = json.loads(extremes.RESULTS.read_text())["cases"]
    assert usual["one call"]["outcome"] == "warned" and "nodes; in training" in usual["one call"]["words"]
    assert 0 < usual["Newton steps"]["error"] < 0.05 < usual["transolver"]["error"]
    for by in ("one call", "Newton steps", "transolver"):
        assert far[by]["outcome"] == "refused" and "from the origin" in far[by]["words"]
        assert lost[by]["outcome"] == "refused" and "nan" in lost[by]["words"]
    text = extremes.PAGE.read_text()
    assert f"| as it is | Newton steps | {usual['Newton steps']['outcome']} | " in text
    assert "| question | Transolver |" in text and "\n| far away | refused |\n" in text


def test_a_question_that_takes_too_much_memory_is_told(few, monkeypatch):
    def predict(*_, **__):
        torch.empty(2**40)

    case = next(extremes._cases(few))
    monkeypatch.setattr(ast_sim.Run, "predict", predict)
    with extremes._memory_limit(2**36):
        outcome = extremes.outcome_of(ast_sim.example_run("plates"), case, ast_sim.Effort())
    assert outcome["outcome"] == "no memory" and "allocate memory" in outcome["words"]
