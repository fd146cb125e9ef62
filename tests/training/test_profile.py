"""The profile of a step: what is counted, that the times add up, and that training is left as it was."""

import pytest
import torch
import toy

from ast_sim.cli import main
from ast_sim.ops import library, segment_sum
from ast_sim.runs import checkpoint
from ast_sim.training import start as train
from ast_sim.training.profile import profile, table


def test_kernels_and_ops_are_counted_and_times_add_up():
    x = torch.randn(64, 8, requires_grad=True)
    order, offsets = torch.arange(64), torch.tensor([0, 10, 64])
    core = library._C

    def step() -> None:
        for _ in range(2):
            segment_sum(x @ torch.eye(8), order, offsets).square().sum().backward()

    found = profile(step, 5)
    assert library._C is core
    calls = {entry.name: entry.calls for entry in found.entries}
    assert calls["segment_sum"] == 2 and calls["segment_spread"] == 2
    assert calls["aten::mm"] == 4  # forward, and the gradient of x
    assert sum(entry.seconds for entry in found.entries) == pytest.approx(found.seconds, rel=0.05)
    assert sum(found.share(kind) for kind in ("kernel", "torch", "binding", "autograd", "python")) == pytest.approx(
        1, rel=0.05
    )
    assert min(entry.seconds for entry in found.entries) >= 0
    lines = table(found).splitlines()
    assert len(lines) == 3 + len(found.entries) and lines[-1].startswith("in all")


def test_an_error_in_a_step_leaves_the_core_as_it_was():
    core, calls = library._C, []

    def step() -> None:
        calls.append(None)
        if len(calls) > 5:
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        profile(step, 2)
    assert library._C is core


def test_a_profiled_run_is_trained_as_if_it_had_not_been(tmp_path, capsys):
    data = toy.write(tmp_path / "toy.h5")
    settings = ["--set", "train.steps=4", "--set", "train.validate_every=4"]
    assert main(["train", str(data), "--out", str(tmp_path / "a"), *settings, "--profile", "2"]) == 0
    assert "attention_block_backward" in capsys.readouterr().out
    assert checkpoint.latest(tmp_path / "a") is None
    assert main(["train", "--out", str(tmp_path / "a"), "--resume"]) == 0
    train.start_training(tmp_path / "b", train.configure(data, "tiny", settings[1::2]))
    weights = [checkpoint.load(checkpoint.latest(tmp_path / name))[0] for name in "ab"]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
