"""The pool of rollouts: states are what the model made of them, targets lead back, draws follow from the seed."""

from collections import Counter

import pytest
import torch
from checks import assert_mirroring_turns_errors_back
from data_samples import block, mesh_graph, trajectory, write

from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.scheme import Scheme
from ast_sim.batches.training_rollouts import SHARE, RolloutPool
from ast_sim.dataset.reader import Dataset

NOISE, LARGEST = 1e-3, 4e-3


@pytest.fixture
def dataset(tmp_path):
    """Three trajectories of different meshes with 5, 1 and 4 frames: the second has no pair."""
    members = [trajectory(block(2 - i % 2, 1, 1), frames, seed=i) for i, frames in enumerate((5, 1, 4))]
    with Dataset(write(tmp_path / "d.h5", {"train": members})) as dataset:
        yield dataset


def pool(dataset, **changed) -> RolloutPool:
    options = {
        "batch_size": 4,
        "seed": 0,
        "noise": NOISE,
        "mirror": ("x", "y"),
        "scheme": Scheme(False),
        "gamma": 1.0,
        **changed,
    }
    return RolloutPool(PairSampler(dataset, "train", make_graph=mesh_graph, **options), 8, LARGEST)


def residual(target, number: int, scale: float = NOISE) -> torch.Tensor:
    return scale * torch.randn(target.motion.shape, generator=torch.Generator().manual_seed(number))


def run(pool: RolloutPool, numbers, scale: float = NOISE) -> list:
    found = []
    for number in numbers:
        batch, target = pool.batch(number)
        found.append((batch, target))
        pool.advance(number, residual(target, number, scale) * normal(batch)[:, None])
    return found


def normal(batch) -> torch.Tensor:
    return torch.zeros(len(batch.position)).index_fill_(0, batch.graph.normal_nodes, 1.0)


def frame(name: str) -> tuple[int, int]:
    words = name.split()
    return int(words[0].split("/")[1]), int(words[-1])


@pytest.mark.parametrize("dynamic, least", [(False, 40), (True, 20)])
@pytest.mark.parametrize("gamma", [1.0, 0.3])
def test_the_state_is_where_the_model_led_and_the_target_leads_back(dataset, dynamic, least, gamma):
    """With inertia a state is two positions, each with the error that it had when it was the newest."""
    rolls, stays = pool(dataset, mirror=(), scheme=Scheme(False, 1 + dynamic), gamma=gamma), 1 - gamma
    last: dict[int, tuple] = {}
    went_on = 0
    for number in range(24):
        batch, target = rolls.batch(number)
        left = residual(target, number) * normal(batch)[:, None]
        rows = batch.graph.node_offsets.tolist()
        for k, name in enumerate(batch.names):
            part = slice(rows[k], rows[k + 1])
            index, t = frame(name)
            truth = torch.tensor(dataset.load("train", index).position)
            position, free = batch.position[part], normal(batch)[part] > 0
            place, error = number % 2 * 4 + k, position - truth[t]
            led = before = torch.zeros_like(error)
            if place in last and last[place][0] == (index, t - 1):
                _, before, led = last[place]
                went_on += 1
            white, share = error - led, SHARE if place in last else 1
            assert not white[~free].any() and 0 < float(white[free].abs().max()) < 5 * NOISE * share
            reached = position + target.motion[part]
            if dynamic:
                assert t > 0
                previous = batch.previous_position[part]
                torch.testing.assert_close(previous - truth[t - 1], before, rtol=0, atol=1e-6)
                assert before.any() or torch.equal(previous, truth[t - 1])
                reached += position - previous
            # Noise is undone by the share gamma; with inertia what was there before it comes back as by a spring.
            back = 2 * stays * led - stays**2 * before if dynamic else stays * led
            after = (reached - truth[t + 1])[free]
            torch.testing.assert_close(after, (stays * white + back)[free], rtol=0, atol=1e-6)
            last[place] = ((index, t), error, (reached - truth[t + 1]) * free[:, None] + left[part])
        rolls.advance(number, left)
    assert went_on > least


def test_with_inertia_a_faultless_model_leads_an_error_back_without_overshoot(tmp_path):
    """After an error e of a scene that had none come 2 r e, 3 r^2 e, 4 r^3 e, as of a critically damped spring."""
    r, kick, found = 0.7, 1e-3, {}
    with Dataset(write(tmp_path / "long.h5", {"train": [trajectory(block(1, 1, 1), 12)]})) as dataset:
        rolls = pool(dataset, mirror=(), scheme=Scheme(False, given_frames=2), gamma=1 - r, noise=1e-12)
        truth = torch.tensor(dataset.load("train", 0).position)
        for number in range(0, 60, 2):  # at least one scene from its beginning to its end
            batch, target = rolls.batch(number)
            free, (_, t) = normal(batch)[: len(truth[0])] > 0, frame(batch.names[0])
            found[t] = float((batch.position[: len(free)] - truth[t])[free].mean())
            rolls.advance(number, torch.full(target.motion.shape, kick if t == 1 else 0.0))
    assert [found[t] for t in range(2, 6)] == pytest.approx(
        [kick, 2 * r * kick, 3 * r**2 * kick, 4 * r**3 * kick], rel=1e-3
    )


def test_mirroring_turns_errors_back(dataset):
    """Mirrored and not, the same scene has the same errors: the errors of the state are told from the truth."""
    assert_mirroring_turns_errors_back(
        pool(dataset, mirror=()),
        pool(dataset),
        lambda number, batch, target: residual(target, number) * normal(batch)[:, None],
    )


def test_each_scene_runs_to_its_end_and_all_pairs_are_as_frequent(dataset):
    seen: dict[int, list] = {place: [] for place in range(8)}
    for number, (batch, _) in enumerate(run(pool(dataset), range(400))):
        for k, name in enumerate(batch.names):
            seen[number % 2 * 4 + k].append(frame(name))
    last = {0: 3, 2: 2}  # the last frame that has one after it; the scene between has none
    for frames in seen.values():
        for (index, t), (next_index, next_t) in zip(frames, frames[1:], strict=False):
            assert (next_index, next_t) == (index, t + 1) if t < last[index] else next_t == 0
    assert len({frames[0] for frames in seen.values()}) > 3
    count = Counter(pair for frames in seen.values() for pair in frames)
    assert len(count) == 7 and max(count.values()) <= 1600 / 7 * 1.05 and min(count.values()) >= 1600 / 7 * 0.95


def test_from_a_state_too_far_off_it_goes_on_with_white_noise(dataset):
    for error, share in ((0.99 * LARGEST, SHARE), (1.01 * LARGEST, 1)):
        rolls = pool(dataset, mirror=())
        before, target = rolls.batch(0)
        rolls.advance(0, torch.full(target.motion.shape, error))
        after, _ = rolls.batch(2)
        led = error if share == SHARE else 0.0
        rows = after.graph.node_offsets.tolist()
        went_on = 0
        for k, (name, next_name) in enumerate(zip(before.names, after.names, strict=True)):
            (index, t), (next_index, next_t) = frame(name), frame(next_name)
            if (next_index, next_t) != (index, t + 1):
                continue
            part = slice(rows[k], rows[k + 1])
            truth = torch.tensor(dataset.load("train", index).position)[next_t]
            white = (after.position[part] - truth - led)[normal(after)[part] > 0]
            assert 0.6 * share * NOISE < float(white.std()) < 1.5 * share * NOISE
            assert float(white.mean().abs()) < 0.5 * share * NOISE
            went_on += 1
        assert went_on


@pytest.mark.parametrize("dynamic", [False, True])
def test_it_goes_on_from_its_state_with_the_same_bits(dataset, dynamic):
    whole = run(pool(dataset, scheme=Scheme(False, 1 + dynamic)), range(20))[11:]
    first = pool(dataset, scheme=Scheme(False, 1 + dynamic))
    run(first, range(11))
    first.batch(11)  # begun ahead, as in training
    again = pool(dataset, scheme=Scheme(False, 1 + dynamic))
    again.restore(first.state())
    for (a, x), (b, y) in zip(whole, run(again, range(11, 20)), strict=True):
        assert a.names == b.names and torch.equal(a.position, b.position) and torch.equal(x.motion, y.motion)
        assert not dynamic or torch.equal(a.previous_position, b.previous_position)


def test_two_parts_are_the_whole(dataset):
    whole, parts = pool(dataset), [pool(dataset, part=(i, 2)) for i in range(2)]
    for number in range(10):
        batch, target = whole.batch(number)
        halves = [part.batch(number) for part in parts]
        assert batch.names == [name for half, _ in halves for name in half.names]
        assert torch.equal(batch.position, torch.cat([half.position for half, _ in halves]))
        error, rows = residual(target, number) * normal(batch)[:, None], len(halves[0][0].position)
        whole.advance(number, error)
        for part, rest in zip(parts, (error[:rows], error[rows:]), strict=True):
            part.advance(number, rest)
    states = [part.state() for part in parts]
    assert not set(states[0]) & set(states[1]) and {**states[0], **states[1]}.keys() == whole.state().keys()
    for part, state in zip(parts, states, strict=True):
        part.restore({**states[0], **states[1]})
        assert part.state().keys() == state.keys()


def test_another_seed_draws_other_scenes(dataset):
    draws = [[batch.names for batch, _ in run(pool(dataset, seed=seed), range(6))] for seed in (0, 0, 1)]
    assert draws[0] == draws[1] != draws[2]
