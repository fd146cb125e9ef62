"""The pool of jumps: guesses are what the model made of them, targets lead to the truth, draws follow from the seed."""

from collections import Counter

import numpy as np
import pytest
import torch
from checks import assert_mirroring_turns_errors_back
from data_samples import block, mesh_graph, trajectory, write

from ast_sim.batches import training_corrections
from ast_sim.batches.carry import Carrier
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.scheme import Scheme
from ast_sim.batches.training_corrections import LEAST, UNSEEN, JumpPool
from ast_sim.dataset.reader import Dataset

CALLS, LARGEST = 3, 1.0


@pytest.fixture
def dataset(tmp_path):
    """Three trajectories of different meshes with 5, 1 and 4 frames: the second has no frame to predict."""
    members = [trajectory(block(2 - i % 2, 1, 1), frames, seed=i) for i, frames in enumerate((5, 1, 4))]
    with Dataset(write(tmp_path / "d.h5", {"train": members})) as dataset:
        yield dataset


def pool(dataset, calls=CALLS, largest=LARGEST, **changed) -> JumpPool:
    options = {
        "batch_size": 4,
        "seed": 0,
        "noise": 0.0,
        "mirror": ("x", "y"),
        "scheme": Scheme(jumps=True),
        "gamma": 1.0,
    }
    sampler = PairSampler(dataset, "train", make_graph=mesh_graph, **{**options, **changed})
    return JumpPool(sampler, 8, calls, largest)


def residual(batch, number: int, scale: float = 1e-3) -> torch.Tensor:
    drawn = torch.randn(batch.position.shape, generator=torch.Generator().manual_seed(number))
    return scale * drawn * ~batch.graph.prescribed[:, None]


def run(pool: JumpPool, numbers) -> list:
    found = []
    for number in numbers:
        batch, target = pool.batch(number)
        found.append((batch, target, pool.weights(number, pool.errors(number, target))))
        pool.advance(number, residual(batch, number))
    return found


def scenes(batch, values):
    return values.split(batch.graph.node_offsets.diff().tolist())


def numbers_of(name: str) -> tuple[int, int]:
    words = name.split()
    return int(words[0].split("/")[1]), int(words[-1])


def test_a_jump_starts_from_a_frame_carried_along_and_then_from_the_answer_before(dataset, monkeypatch):
    monkeypatch.setattr(training_corrections, "ELSEWHERE", 0.0)
    jumps, before, first_calls, corrections = pool(dataset, mirror=()), {}, 0, 0
    for number in range(60):
        batch, target = jumps.batch(number)
        left = residual(batch, number)
        parts = zip(batch.names, scenes(batch, batch.position), scenes(batch, target.motion), strict=True)
        for place, (name, position, motion) in enumerate(parts, number % 2 * 4):
            index, frame = numbers_of(name)
            truth = dataset.load("train", index)
            torch.testing.assert_close(position + motion, torch.tensor(truth.position[frame]), rtol=0, atol=1e-6)
            held = truth.scene.prescribed
            assert np.array_equal(position[held], truth.position[frame][held])
            call = jumps._going[place].call
            if call:
                assert call < CALLS and before[place][:2] == (name, call - 1)
                torch.testing.assert_close(motion, -before[place][2], rtol=0, atol=1e-6)
                corrections += 1
            else:
                first_calls += 1
                start = Carrier(truth.scene)(truth.position[0], truth.position[frame])
                assert np.array_equal(position, start)
            before[place] = (name, call, scenes(batch, left)[place % 4])
        jumps.weights(number, jumps.errors(number, target))
        jumps.advance(number, left)
    assert first_calls > 60 and corrections > 100


def test_some_jumps_start_from_a_later_frame(dataset, monkeypatch):
    monkeypatch.setattr(training_corrections, "ELSEWHERE", 1.0)
    jumps, sources = pool(dataset, calls=1, mirror=()), Counter()
    for number in range(100):
        batch, target = jumps.batch(number)
        for name, position in zip(batch.names, scenes(batch, batch.position), strict=True):
            index, frame = numbers_of(name)
            truth, carry = dataset.load("train", index), Carrier(dataset.load("train", index).scene)
            starts = [np.array_equal(position, carry(truth.position[s], truth.position[frame])) for s in range(frame)]
            assert sum(starts) == 1
            sources[starts.index(True)] += 1
        jumps.weights(number, jumps.errors(number, target))
        jumps.advance(number, torch.zeros_like(batch.position))
    assert set(sources) == {0, 1, 2, 3}


def test_all_frames_and_all_scenes_are_drawn_and_each_jump_gets_its_calls(dataset):
    seen: dict[int, list[str]] = {place: [] for place in range(8)}
    for number, (batch, _, _) in enumerate(run(pool(dataset, mirror=()), range(400))):
        for k, name in enumerate(batch.names):
            seen[number % 2 * 4 + k].append(name)
    count = Counter(name for names in seen.values() for name in names)
    assert {numbers_of(name) for name in count} == {(0, f) for f in (1, 2, 3, 4)} | {(2, f) for f in (1, 2, 3)}
    per_scene = Counter(numbers_of(name)[0] for name in count.elements())
    assert per_scene[0] == pytest.approx(800, rel=0.05)


def test_each_call_weighs_by_the_error_that_it_leaves(dataset):
    """The weight is one over the mean square error that the call leaves, relative to the first; the last call counts as
    if it left what it finds, and calls that nobody has seen yet have a guess."""
    jumps = pool(dataset, calls=3, mirror=())
    squares: dict[int, float] = {}
    for number in range(200):
        batch, target = jumps.batch(number)
        calls = [jumps._going[place].call for place in jumps._places(number)]
        free = scenes(batch, ~batch.graph.prescribed)
        for call, motion, rows in zip(calls, scenes(batch, target.motion), free, strict=True):
            square = float(motion[rows].square().mean())
            squares[call] = square if call not in squares else 0.99 * squares[call] + 0.01 * square
        left = [squares.get(min(call + 1, 2), UNSEEN**2 * squares[0]) for call in range(3)]
        expected = [1 / max(left[call] / left[0], LEAST**2) for call in calls]
        np.testing.assert_allclose(jumps.weights(number, jumps.errors(number, target)), expected, rtol=1e-4)
        by_node = np.repeat([4.0**-call for call in calls], [len(rows) for rows in free])
        jumps.advance(number, residual(batch, number) * torch.tensor(by_node, dtype=torch.float32)[:, None])
    assert squares[1] < 0.1 * squares[0] and 0.04 < squares[2] / squares[1] < 0.09


def test_a_guess_too_far_off_is_given_up(dataset):
    for error, kept in ((0.9, True), (1.1, False)):
        jumps = pool(dataset, mirror=(), calls=100)
        batch, target = jumps.batch(0)
        jumps.weights(0, jumps.errors(0, target))
        jumps.advance(0, error * LARGEST / 3**0.5 * torch.ones_like(batch.position) * 3**0.5)
        after, _ = jumps.batch(2)
        assert (after.names == batch.names) is kept


def test_it_goes_on_from_its_state_with_the_same_bits(dataset):
    whole = run(pool(dataset), range(20))[11:]
    first = pool(dataset)
    run(first, range(11))
    first.batch(11)  # begun ahead, as in training
    again = pool(dataset)
    again.restore(first.state())
    for (a, x, v), (b, y, w) in zip(whole, run(again, range(11, 20)), strict=True):
        assert a.names == b.names and torch.equal(a.position, b.position)
        assert torch.equal(x.motion, y.motion) and torch.equal(v, w)


def test_two_parts_are_the_whole(dataset):
    whole, parts = pool(dataset), [pool(dataset, part=(i, 2)) for i in range(2)]
    for number in range(10):
        batch, target = whole.batch(number)
        halves = [part.batch(number) for part in parts]
        assert batch.names == [name for half, _ in halves for name in half.names]
        assert torch.equal(batch.position, torch.cat([half.position for half, _ in halves]))
        error, rows = residual(batch, number), len(halves[0][0].position)
        errors = [part.errors(number, half) for part, (_, half) in zip(parts, halves, strict=True)]
        weights = [part.weights(number, errors[0] + errors[1]) for part in parts]
        assert torch.equal(whole.weights(number, whole.errors(number, target)), torch.cat(weights))
        whole.advance(number, error)
        for part, rest in zip(parts, (error[:rows], error[rows:]), strict=True):
            part.advance(number, rest)
    states = [part.state() for part in parts]
    assert set(states[0]) & set(states[1]) == {"squares"} and torch.equal(states[0]["squares"], states[1]["squares"])
    for part, state in zip(parts, states, strict=True):
        part.restore({**states[0], **states[1]})
        assert part.state().keys() == state.keys()


def test_mirroring_turns_errors_back(dataset):
    """Mirrored and not, the same scene has the same guesses."""
    assert_mirroring_turns_errors_back(
        pool(dataset, mirror=()), pool(dataset), lambda number, batch, _: residual(batch, number)
    )
