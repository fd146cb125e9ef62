"""The frames that jumps start from, where the load path counts: sources of given motions, and what training makes
of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import toy
from data_samples import mesh_graph

from ast_sim.batches.carry import Carrier
from ast_sim.batches.mirror_and_shift import Placement
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.scheme import Scheme
from ast_sim.batches.training_corrections import JumpPool
from ast_sim.batches.turning_points import jump_sources
from ast_sim.dataset.reader import Dataset
from ast_sim.named_field import NamedField, Output

FIELDS = (("PEEQ", "node", 1, ""), ("flow", "element", 2, ""))
HISTORY = (Output("stress", "node", 1, "Pa"), *(Output(*one) for one in FIELDS))


@pytest.mark.parametrize(
    ("places", "sources"),
    [
        ([0, 1, 2, 3, 2, 1, 0], [0, 0, 0, 0, 3, 3, 3]),  # there and back
        ([0, 1, 2, 3], [0, 0, 0, 0]),
        ([0, 2, 1, 3, 0], [0, 0, 1, 2, 3]),  # turns in each frame
        ([0, 2, 2, 2, 1], [0, 0, 0, 0, 3]),  # waits, then turns back
        ([0, 2, 2, 3], [0, 0, 0, 0]),  # waits and goes on
        ([0, 2, 2.000001, 2, 3], [0, 0, 0, 0, 0]),  # trembles by less than rounding
        ([0, 0, -1, 0], [0, 0, 0, 2]),
        ([1, 1], [0, 0]),
    ],
)
def test_a_jump_starts_where_the_motion_turned_back_last(places, sources):
    position = np.zeros((len(places), 3, 3), np.float32)
    position[:, 1, 0] = places
    position[:, 2, 0] = np.arange(len(places)) % 2  # a free node may do what it likes
    prescribed = np.array([True, True, False])
    assert jump_sources(position, prescribed).tolist() == sources


def test_all_prescribed_nodes_count_together():
    position = np.zeros((3, 2, 3), np.float32)
    position[:, 0, 0] = [0, 2, 4]
    position[:, 1, 1] = [0, 1, 0]
    both = np.array([True, True])
    assert jump_sources(position, both).tolist() == [0, 0, 0]  # 2 * 2 outweighs 1 * -1
    position[:, 1, 1] *= 3
    assert jump_sources(position, both).tolist() == [0, 0, 1]
    position[2, 0, 0], position[2, 1] = 2, (0, 3, 1)  # one stands, the other turns off to the side
    assert jump_sources(position, both).tolist() == [0, 0, 0]


@pytest.fixture
def dataset(tmp_path):
    """Plates that are pressed until frame 2 or 3 of 7 and let go, with fields at nodes and in elements."""
    with toy.DatasetWriter(tmp_path / "d.h5", toy.info()) as writer:
        for seed, turn in enumerate((2, 3)):
            truth = toy.plate(seed)
            depth = np.interp(np.arange(7), [0, turn, 6], [0, 1, 0])
            deepest = truth.position[3] - truth.position[0]
            position = (truth.position[0] + depth[:, None, None] * deepest).astype(np.float32)
            values = np.arange(7 * truth.scene.num_nodes, dtype=np.float32).reshape(7, -1, 1)
            flow = np.ones((7, truth.scene.num_elements, 2), np.float32) * np.arange(7, dtype=np.float32)[:, None, None]
            fields = {"PEEQ": NamedField(values, "node"), "flow": NamedField(flow, "element")}
            writer.add("train", replace(truth, position=position, fields=fields))
    with Dataset(tmp_path / "d.h5") as dataset:
        yield dataset


def sampler(dataset, history=HISTORY, **changes) -> PairSampler:
    options = {"batch_size": 2, "seed": 0, "noise": 0.0, "gamma": 1.0, "fields": FIELDS}
    scheme = Scheme(jumps=True, history=history)
    return PairSampler(dataset, "train", make_graph=mesh_graph, scheme=scheme, **{**options, **changes})


def test_a_pair_has_the_true_source_and_what_is_known_there(dataset):
    batch, target = sampler(dataset, batch_size=12).batch(0)
    bounds = batch.graph.node_offsets.tolist()
    assert sorted(batch.names) == sorted(f"train/{i:06d} frame {t}" for i in (0, 1) for t in range(1, 7))
    for name, first, last in zip(batch.names, bounds, bounds[1:], strict=False):
        index, frame, rows = int(name[6:12]), int(name.split()[-1]), slice(first, last)
        truth = dataset.load("train", index, ["PEEQ"])
        turn = (2, 3)[index]
        source = turn if frame > turn else 0
        assert np.array_equal(batch.source[rows], truth.position[source])
        np.testing.assert_array_equal(batch.history[rows, :1], truth.stress[source])
        np.testing.assert_array_equal(batch.history[rows, 1:2], truth.fields["PEEQ"].values[source])
        np.testing.assert_allclose(batch.history[rows, 2:], source)  # the mean of equal elements
        start = Carrier(truth.scene)(truth.position[source], truth.position[frame])
        reached = batch.position[rows] + target.motion[rows]
        np.testing.assert_allclose(reached, truth.position[frame], rtol=0, atol=1e-7)
        off, missing = batch.position[rows].numpy() - truth.position[frame], start - truth.position[frame]
        share = np.sum(off * missing) / max(np.sum(missing * missing), 1e-30)
        np.testing.assert_allclose(off, share * missing, rtol=0, atol=2e-7)


def test_without_a_history_all_jumps_start_from_the_first_frame(dataset):
    draws = sampler(dataset, history=None)
    batch, _ = draws.batch(0)
    assert batch.source is None and batch.history is None
    assert {draws.source(index, frame) for index in (0, 1) for frame in range(7)} == {0}


def test_on_a_way_that_never_turns_back_a_history_changes_no_draw(tmp_path):
    path = toy.write(tmp_path / "d.h5", (2, 0, 0))
    with Dataset(path) as dataset:
        frames, num_frames = dataset.frames, dataset.num_frames
        dataset.frames = lambda split, index, start, stop: frames(split, index, start, min(stop, 4))
        dataset.num_frames = lambda split, index: min(num_frames(split, index), 4)  # the block goes down until frame 3
        history = (Output("stress", "node", 1, "Pa"),)
        pools = [JumpPool(sampler(dataset, fields=(), history=one), 8, 2, largest=1.0) for one in (history, None)]
        for step in range(40):
            (known, target), (plain, same) = (pool.batch(step % 4) for pool in pools)
            assert known.names == plain.names and torch.equal(known.position, plain.position)
            assert torch.equal(target.motion, same.motion) and plain.source is None
            for pool in pools:
                pool.advance(step % 4, 1e-3 * torch.ones_like(known.position))


def test_the_source_is_mirrored_and_moved_with_the_scene(dataset):
    batch, _ = sampler(dataset).batch(0)
    placement = Placement(np.float32([-1, 1, 1]), np.float32([0.1, 0, 0]), np.float32([0, 0.2, 0]))
    placed = batch.placed(placement)
    way, there = batch.position - batch.source, placed.position - placed.source
    np.testing.assert_allclose(there, way * torch.tensor([-1.0, 1, 1]), rtol=0, atol=1e-6)
    np.testing.assert_allclose(placed.source[:, 1], batch.source[:, 1] + 0.2, rtol=0, atol=1e-6)
    assert torch.equal(placed.history, batch.history)


def test_half_of_the_jumps_from_a_turn_start_from_the_models_own_answer(dataset):
    """A model that is off by a known error everywhere, which differs from scene to scene."""
    pool, starts = JumpPool(sampler(dataset), 8, calls=1, largest=1.0), []
    for step in range(400):
        number = step % 4
        batch, target = pool.batch(number)
        bounds = batch.graph.node_offsets.tolist()
        places = list(pool._places(number))
        for row, place in enumerate(places):
            guess, rows = pool._going[place], slice(bounds[row], bounds[row + 1])
            truth = dataset.load("train", guess.index)
            free = ~truth.scene.prescribed
            off = (batch.source[rows].numpy() - truth.position[guess.source])[free]
            starts.append((guess.source, guess.frame, guess.source_error is not None))
            own = np.float32([0.001, 0, 0]) if guess.source_error is not None else 0
            np.testing.assert_allclose(off, np.broadcast_to(own, off.shape), rtol=0, atol=1e-7)
            reached = (batch.position[rows] + target.motion[rows])[free]
            np.testing.assert_allclose(reached, truth.position[guess.frame][free], rtol=0, atol=1e-7)
        error = np.float32([0.001, 0, 0]) * ~batch.graph.prescribed.numpy()[:, None]
        pool.advance(number, torch.from_numpy(error))
    after = [own for source, frame, own in starts if source in (2, 3) and frame > source]
    assert 0.3 < np.mean(after) < 0.6
    assert not any(own for source, _, own in starts if source == 0)


def test_a_pool_that_is_restored_goes_on_from_the_same_answers(dataset):
    def advanced(pool, steps):
        seen = []
        for step in steps:
            batch, _ = pool.batch(step % 4)
            seen.append((batch.names, batch.position.clone(), batch.source.clone()))
            pool.advance(step % 4, 1e-3 * (~batch.graph.prescribed)[:, None].float() * torch.ones(3))
        return seen

    whole, stopped, resumed = (JumpPool(sampler(dataset), 8, calls=2, largest=1.0) for _ in range(3))
    expected = advanced(whole, range(60))[37:]
    advanced(stopped, range(37))
    assert any("source_error" in key for key in stopped.state())
    resumed.restore(stopped.state())
    for (names, *tensors), (same, *others) in zip(expected, advanced(resumed, range(37, 60)), strict=True):
        assert names == same
        assert all(torch.equal(*pair) for pair in zip(tensors, others, strict=True))
