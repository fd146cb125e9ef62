"""Answers and trainings whose dense layers multiply in bfloat16, where the processor is faster so."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import ast_sim
from ast_sim.ops.library import configuration
from ast_sim.support.errors import ConfigError

FASTER = configuration()["bfloat16"] is not None


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("plates") / "plates.h5"
    return ast_sim.generate("deforming_plate", path, train=4, valid=1, test=1, nodes=200, frames=21, keep=(12,)).path


def told(messages: list[warnings.WarningMessage]) -> bool:
    return any("no faster in bfloat16" in str(one.message) for one in messages)


def test_an_answer_hardly_differs_and_does_not_depend_on_threads(data):
    run = ast_sim.example_run("plates")
    with ast_sim.Dataset(data) as dataset:
        truth = dataset["test"][0]
    plain = run.predict(truth, frames=[1], effort=ast_sim.Effort())
    answers = []
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always")
            answers.append(run.predict(truth, frames=[1], effort=ast_sim.Effort(precision="bfloat16")))
        assert told(messages) != FASTER
    torch.set_num_threads(before)
    assert np.array_equal(answers[0].position, answers[1].position)
    apart = np.linalg.norm(answers[0].displacement - plain.displacement) / np.linalg.norm(plain.displacement)
    assert (0 < apart < 0.03) if FASTER else apart == 0
    exact = run.predict(truth, frames=[1], effort=replace(ast_sim.Effort.exact(), precision="bfloat16"))
    assert exact.errors(truth)["displacement"] < 1e-3


def test_a_training_keeps_its_precision(data, tmp_path):
    last: dict[str, float] = {}
    for precision in ("float32", "bfloat16"):
        with warnings.catch_warnings(record=True) as messages:
            warnings.simplefilter("always")
            run = ast_sim.train(
                data, tmp_path / precision, steps=6, batch_size=2, validate_every=6, processes=1, progress=False,
                precision=precision,
            )  # fmt: skip
        assert told(messages) == (precision == "bfloat16" and not FASTER)
        assert ast_sim.Run(run.path).settings.train.precision == precision
        lines = (run.path / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        last[precision] = next(line["loss"] for line in map(json.loads, lines) if "loss" in line)
    apart = abs(last["bfloat16"] / last["float32"] - 1)
    assert (0 < apart < 0.02) if FASTER else apart == 0, last


def test_an_unknown_precision_is_refused(data, tmp_path):
    with pytest.raises(ConfigError, match=r"train\.precision"):
        ast_sim.train(data, tmp_path / "run", steps=1, precision="float16")
    assert not (tmp_path / "run").exists()
