"""The optimizers on one vector against torch's on a list of parameters."""

import pytest
import torch
from torch import nn

from ast_sim.training.muon import Muon
from ast_sim.training.optimizer import Optimizer


def model() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.Linear(7, 2), nn.LayerNorm(2))


def loss(net: nn.Module, step: int) -> torch.Tensor:
    x = torch.randn(11, 5, generator=torch.Generator().manual_seed(step))
    return (10 * net(x).cos()).square().sum()


@pytest.mark.parametrize("largest", [1e-2, 1e6])
def test_it_is_adamw_with_a_clipped_gradient(largest):
    ours, theirs = model(), model()
    mine = Optimizer(ours)
    adam = torch.optim.AdamW(theirs.parameters(), lr=0.0, weight_decay=0.0)
    for step in range(20):
        rate = 1e-2 / (1 + step)
        mine.zero_gradient()
        loss(ours, step).backward()
        norm = mine.clip(largest)
        mine.step(rate)
        adam.zero_grad()
        loss(theirs, step).backward()
        expected = nn.utils.clip_grad_norm_(theirs.parameters(), largest)
        assert norm == pytest.approx(float(expected), rel=1e-4)
        adam.param_groups[0]["lr"] = rate
        adam.step()
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def wide() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(5, 16), nn.Tanh(), nn.Linear(16, 24), nn.Tanh(), nn.Linear(24, 2), nn.LayerNorm(2))


def test_muon_moves_the_matrices_inside_and_adamw_the_rest():
    ours, theirs = wide(), wide()
    mine, adam = Optimizer(ours, "muon"), torch.optim.AdamW(theirs.parameters(), lr=1e-2, weight_decay=0.0)
    start = ours[2].weight.detach().clone()
    loss(ours, 0).backward()
    mine.step(1e-2)
    loss(theirs, 0).backward()
    adam.step()
    for (name, a), b in zip(ours.named_parameters(), theirs.parameters(), strict=True):
        if name != "2.weight":
            torch.testing.assert_close(a, b, rtol=0, atol=1e-6)
    # Its singular values are about 1 (0.7 to 1.2 by the iteration), times the rate and 0.2 sqrt of the longer side.
    moved = torch.linalg.svdvals((start - ours[2].weight).detach() / (1e-2 * 0.2 * 24**0.5))
    assert 0.6 < moved[0] < 1.3 and moved[3] > 0.6


def test_muon_takes_the_steps_of_torch():
    """On gradients whose singular values stand out of the rounding of bfloat16, in which torch's iterates."""
    values, generator = torch.zeros(2 * 16 * 24 + 24 * 16), torch.Generator().manual_seed(0)
    shapes = [(16, 24), (16, 24), (24, 16)]
    theirs = [torch.nn.Parameter(torch.zeros(shape)) for shape in shapes]
    gradients = torch.zeros_like(values)
    mine, torchs = Muon(values, gradients, shapes), torch.optim.Muon(
        theirs, lr=1e-2, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"
    )  # fmt: skip
    for _ in range(5):
        parts = [torch.linalg.qr(torch.randn(24, 16, generator=generator))[0] for _ in shapes]
        parts = [part if shape == (24, 16) else part.mT for part, shape in zip(parts, shapes, strict=True)]
        gradients.copy_(torch.cat([part.flatten() for part in parts]))
        for parameter, part in zip(theirs, parts, strict=True):
            parameter.grad = part.clone()
        mine.step(1e-2)
        torchs.step()
    moved = torch.cat([parameter.detach().flatten() for parameter in theirs])
    assert (values - moved).norm() < 0.02 * moved.norm()


def test_gradients_add_up_until_they_are_cleared_and_what_has_none_stays():
    net = nn.ModuleList([nn.Linear(3, 1), nn.Linear(2, 1)])
    optimizer = Optimizer(net)
    before = net[1].weight.clone()
    for _ in range(2):
        net[0](torch.ones(1, 3)).sum().backward()
    assert net[0].weight.grad.tolist() == [[2.0, 2.0, 2.0]]
    assert optimizer.clip(100.0) == 4.0  # three weights and a bias, 2 each
    optimizer.step(0.1)
    assert torch.equal(net[1].weight, before)
    optimizer.zero_gradient()
    assert net[0].weight.grad.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_restoring_continues_in_the_same_bits(name):
    net = wide()
    optimizer = Optimizer(net, name)
    assert optimizer.state() == {}

    def steps(net, optimizer, first, last) -> None:
        for step in range(first, last):
            optimizer.zero_gradient()
            loss(net, step).backward()
            optimizer.step(1e-2)

    steps(net, optimizer, 0, 3)
    weights = {key: value.clone() for key, value in net.state_dict().items()}
    state = {key: value.clone() for key, value in optimizer.state().items()}
    steps(net, optimizer, 3, 6)
    other = wide()
    resumed = Optimizer(other, name)
    other.load_state_dict(weights)
    resumed.restore(state)
    steps(other, resumed, 3, 6)
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), other.parameters(), strict=True))


def test_a_gradient_that_is_not_finite_shows_in_the_norm():
    net = nn.Linear(2, 1)
    optimizer = Optimizer(net)
    (net(torch.ones(1, 2)) * float("nan")).sum().backward()
    assert optimizer.clip(1.0) != optimizer.clip(1.0)
