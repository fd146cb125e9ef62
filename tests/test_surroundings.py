"""Calls within a program that has changed torch or NumPy for itself: they give the bits of the plain call, and leave
what the program has set as it was."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import pytest
import torch
import toy
from meshes import plate_and_punch

import ast_sim
from ast_sim import Effort
from ast_sim.support.errors import TrainingError

PRESS = {1: (0, 0, -0.01)}
SMALL = {
    "ast": {"hidden": 16, "d_token": 16, "heads": 1, "head_dim": 16, "L_SA": 1, "L_cell": 3},
    "transolver": {"hidden": 16, "heads": 2, "slices": 4, "blocks": 1},
    "mgn": {"hidden": 16},
    "bsms": {"hidden": 16},
    "hcmt": {"hidden": 16},
}


@contextmanager
def default_dtype(dtype):
    torch.set_default_dtype(dtype)
    try:
        yield
        assert torch.get_default_dtype() == dtype
    finally:
        torch.set_default_dtype(torch.float32)


@contextmanager
def bfloat16_products():
    torch.set_float32_matmul_precision("medium")
    try:
        yield
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision("highest")


SURROUNDINGS = {
    "float64": lambda: default_dtype(torch.float64),
    "bfloat16": lambda: default_dtype(torch.bfloat16),
    "another device": lambda: torch.device("meta"),
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "no gradients": torch.no_grad,
    "inference mode": torch.inference_mode,
    "products in bfloat16": bfloat16_products,
    "errors of NumPy": lambda: np.errstate(all="raise"),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return toy.write(tmp_path_factory.mktemp("surroundings") / "toy.h5", (3, 2, 2))


@pytest.fixture(scope="module")
def scene():
    mesh = plate_and_punch((0.48, 0.32, 0.03), (11, 8, 2), 0.008)
    return ast_sim.read_scene(mesh, obstacles=[1], clamps=["0:xmin,xmax"]).scene


@pytest.fixture(scope="module")
def plain(data, scene, tmp_path_factory):
    """The bits of the plain calls, by name."""
    folder = tmp_path_factory.mktemp("plain")
    calls = {effort: answered(scene, effort) for effort in (Effort(), Effort(newton_steps=1), Effort.exact())}
    return calls | {model: trained(data, folder / model, model) for model in SMALL} | {"loop": own_loop(data)}


def answered(scene, effort):
    answer = ast_sim.example_run("plates").predict(scene, PRESS, num_frames=2, effort=effort)
    return [answer.position, answer.stress, answer.reaction(), answer.band(), answer.p_value]


def trained(data, out, model):
    quick = {"steps": 1, "batch_size": 2, "statistics_pairs": 2, "validate_scenes": 1}
    run = ast_sim.train(data, out, model=model, model_settings=SMALL[model], progress=False, **quick)
    return [values.numpy() for values in run.model.state_dict().values()]


def own_loop(data):
    """One step of a loop of one's own; gradients, autocast and products are the caller's there."""
    torch.manual_seed(0)
    with ast_sim.Dataset(data) as dataset, torch.inference_mode(False):
        model = ast_sim.new_model(dataset, model_settings=SMALL["ast"])
        pairs = model.pairs(dataset)
        batch, target = pairs.collate([pairs[3], pairs[1]])
        losses = model.loss(model(batch), batch, target)
        losses["loss"].backward()
        return [batch.position.numpy(), losses["loss"].detach().numpy(), next(model.parameters()).grad.numpy()]


def same(one, other):
    for first, second in zip(one, other, strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("around", SURROUNDINGS)
def test_answers_and_trainings_are_the_same(plain, data, scene, tmp_path, around):
    with SURROUNDINGS[around]():
        for effort in (Effort(), Effort.exact() if around == "errors of NumPy" else Effort(newton_steps=1)):
            same(answered(scene, effort), plain[effort])
        for model in SMALL if around in ("float64", "another device") else list(SMALL)[:2]:
            same(trained(data, tmp_path / model, model), plain[model])
        if around in ("float64", "another device", "inference mode"):
            same(own_loop(data), plain["loop"])


def test_two_threads_do_not_train_at_once(data, tmp_path):
    begun, end = threading.Event(), threading.Event()

    def hold(*_):
        begun.set()
        end.wait()

    quick = {"steps": 1, "batch_size": 2, "model_settings": SMALL["ast"]}
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(ast_sim.train, data, tmp_path / "first", progress=hold, **quick)
        begun.wait()
        with pytest.raises(TrainingError, match="another thread of this process trains, .*: train one after the other"):
            ast_sim.train(data, tmp_path / "second", progress=False, **quick)
        end.set()
        assert first.result().step == 1 and not (tmp_path / "second").exists()
    ast_sim.train(data, tmp_path / "second", progress=False, **quick)


def test_random_numbers_of_a_program_go_on_after_a_training(data, tmp_path):
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    first = trained(data, tmp_path / "first", "ast")  # which opens the run, too
    assert torch.equal(torch.rand(3), expected)
    same(first, trained(data, tmp_path / "second", "ast"))
