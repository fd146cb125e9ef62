"""A Gaussian process beside a run: what it learns, from which scenes, and where it does not apply."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import toy
from simulate.own_assembly.assemblies import write_assembly

import ast_sim
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.evaluation.gaussian_process import (
    features,
    gaussian_process,
    modal_process,
    process_beside,
)


def test_a_gaussian_process_takes_numbers_and_names():
    known = [{"a": 1.0, "b": "x", "c": 2.0}, {"a": 3.0, "b": "y", "c": 2.0}]
    assert features(known, known).tolist() == [[-1, 1, 0], [1, 0, 1]]
    assert features([{"a": 2.0, "b": "y", "c": 9.0}], known).tolist() == [[0, 0, 1]]


@pytest.mark.parametrize("law", [lambda x: 3 + np.sin(x[:, 0]) + x[:, 1], lambda x: np.exp(3 * x[:, 0] - x[:, 1])])
def test_a_gaussian_process_learns_a_smooth_law(law):
    points = np.random.default_rng(0).uniform(-1, 1, (70, 2))
    said = gaussian_process(points[:50], law(points[:50]))(points[50:])
    np.testing.assert_allclose(said, law(points[50:]), rtol=0.02)


def test_vectors_follow_from_their_modes():
    points = np.random.default_rng(1).uniform(-1, 1, (40, 2))
    shapes = np.random.default_rng(2).normal(size=(2, 30))
    values = np.stack([2 + np.sin(points[:, 0]), 0.3 * points[:, 1] ** 2], axis=1) @ shapes
    said = modal_process(points[:30], values[:30].astype(np.float32))(points[30:])
    off = np.linalg.norm(said - values[30:], axis=1) / np.linalg.norm(values[30:], axis=1)
    assert said.shape == (10, 30) and np.median(off) < 0.01


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """Blocks that a punch presses, as our solver solved them on one mesh, and a run of a few steps."""
    folder = tmp_path_factory.mktemp("pressed")
    spec = write_assembly(folder)
    data = folder / "study.h5"
    ast_sim.generate("assembly", data, spec=spec, train=12, valid=1, test=2, workers=1, progress=False)
    run = ast_sim.train(data, folder / "run", steps=2, validate_every=2, checkpoint_every=2, progress=False)
    return data, run


def copied(source, path, change):
    """The dataset with other trajectories: `change` makes one of each."""
    with ast_sim.Dataset(source) as dataset, DatasetWriter(path, dataset.info) as writer:
        for split, count in dataset.splits.items():
            for index in range(count):
                writer.add(split, change(dataset[split][index]))
    return path


def without_parameters(truth):
    kept = {key: value for key, value in truth.attributes.items() if not key.startswith("parameter ")}
    return replace(truth, attributes=kept)


def test_it_stands_beside_the_run_where_a_specification_has_drawn_the_scenes(pressed):
    data, run = pressed
    by_quantity = ast_sim.trade(run, data, solver_seconds=1.0, progress=False).by_quantity
    for quantity, most in (("displacement", 0.02), ("reaction", 0.1), ("stress", 0.1)):
        figures = by_quantity[quantity]
        (side,) = figures.others
        (setting,) = side.settings
        assert (side.name, setting.name) == ("Gaussian process", "12 training scenes, 2 inputs")
        assert figures.no_process == "" and max(setting.errors) < most < figures.run[0].errors[0]
        assert 0 < max(setting.seconds) < 0.1
    assert "Gaussian process: " in str(by_quantity["reaction"].lines()[1])


def test_on_one_mesh_it_needs_no_specification(pressed, tmp_path):
    data, run = pressed
    told = []
    with ast_sim.Dataset(copied(data, tmp_path / "bare.h5", without_parameters)) as dataset:
        process = process_beside(run.model, dataset, "test", [0, 1], told.append)
    assert process.name == "12 training scenes, 2 inputs"  # where the punch is, and how stiff the block
    assert told == ["a Gaussian process learns displacement, reaction, stress of 12 training scenes"]
    assert max(process.errors["displacement"]) < 0.02 and max(process.errors["reaction"]) < 0.1


def test_with_parameters_but_meshes_of_their_own_it_gives_no_displacement(tmp_path):
    """Toy plates have one of two meshes; the stress follows a law."""

    def drawn(truth):
        low = 1.0 + truth.attributes["seed"] / 10
        return replace(truth, stress=truth.stress * np.float32(low), attributes={"parameter low": low})

    data = copied(toy.write(tmp_path / "toy.h5", (12, 0, 1)), tmp_path / "drawn.h5", drawn)
    model = toy.LinearSimulator(toy.config(toy.info()))
    with ast_sim.Dataset(data) as dataset:
        process = process_beside(model, dataset, "test", [0], str)
    assert list(process.errors) == ["stress"] and max(process.errors["stress"]) < 0.1
    assert process.why_not("displacement") == "each scene has a mesh of its own" and process.why_not("stress") == ""
    assert process.sides("displacement")[0].settings[0].errors == (math.inf,)


@pytest.mark.parametrize(
    ("counts", "why"),
    [
        ((12, 0, 1), "each scene has a mesh of its own, and no specification has drawn parameters"),
        ((3, 0, 1), "it needs at least 10 training scenes, and the dataset has 3"),
    ],
)
def test_where_it_does_not_apply_it_says_why(tmp_path, counts, why):
    model = toy.LinearSimulator(toy.config(toy.info()))
    with ast_sim.Dataset(toy.write(tmp_path / "toy.h5", counts)) as dataset:
        process = process_beside(model, dataset, "test", [0], str)
    assert process.sides("stress") == () and process.why_not("stress") == process.why_not("displacement") == why


def test_scenes_that_do_not_differ_teach_nothing(pressed, tmp_path):
    data, run = pressed
    with ast_sim.Dataset(data) as dataset:
        first = without_parameters(dataset["train"][0])
    with ast_sim.Dataset(copied(data, tmp_path / "same.h5", lambda _: first)) as dataset:
        process = process_beside(run.model, dataset, "test", [0], str)
    assert process.missing == "nothing that describes a scene differs in the training scenes"


def test_without_scikit_learn_it_says_what_to_install(pressed, monkeypatch):
    data, run = pressed
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with ast_sim.Dataset(data) as dataset:
        process = process_beside(run.model, dataset, "test", [0], str)
    assert process.errors == {} and 'pip install "ast_sim[compare]"' in process.missing
