"""The sampler: every pair once an epoch, noise where and as strong as wanted, targets by hand."""

import math
import weakref

import numpy as np
import pytest
import torch
from data_samples import block, mesh_graph, trajectory, write
from meshes import two_tetrahedra

from ast_sim.batches import pairs
from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.scheme import Scheme
from ast_sim.dataset.reader import Dataset
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.support.byte_cache import array_bytes
from ast_sim.support.errors import DatasetError


@pytest.fixture
def dataset(tmp_path):
    """Three trajectories of different meshes with 5, 2 and 4 frames: 4 + 1 + 3 pairs."""
    members = [
        trajectory(block(2, 1, 1), 5, seed=1, stress="node"),
        trajectory(two_tetrahedra(), 2, seed=2, stress="node"),
        trajectory(block(1, 1, 1), 4, seed=3, stress="node"),
    ]
    with Dataset(write(tmp_path / "d.h5", {"train": members}, stress_location="node")) as dataset:
        yield dataset


def sampler(dataset, **changes) -> PairSampler:
    options = {
        "batch_size": 4,
        "seed": 0,
        "noise": 0.0,
        "make_graph": mesh_graph,
        "scheme": Scheme(False),
        "gamma": 1.0,
    }
    return PairSampler(dataset, "train", **{**options, **changes})


def names(sampler, steps) -> list[str]:
    return [name for step in steps for name in sampler.batch(step)[0].names]


PAIRS = sorted(
    [f"train/000000 frame {t}" for t in range(4)]
    + ["train/000001 frame 0"]
    + [f"train/000002 frame {t}" for t in range(3)]
)


def test_each_epoch_has_every_pair_once_in_a_new_order(dataset):
    draws = sampler(dataset)
    assert draws.num_pairs == 8
    first, second = names(draws, (0, 1)), names(draws, (2, 3))
    assert sorted(first) == sorted(second) == PAIRS and first != second
    # The sequence does not depend on how it is cut into batches; batches may reach into the next epoch.
    assert names(sampler(dataset, batch_size=3), range(6))[:16] == first + second
    assert names(sampler(dataset, batch_size=16), [0]) == first + second
    assert names(sampler(dataset, seed=1), (0, 1)) != first


def test_pairs_of_the_first_scenes_alone(dataset):
    draws = sampler(dataset, scenes=2, batch_size=5)
    assert draws.num_pairs == 5
    assert sorted(names(draws, [0])) == PAIRS[:5]


def test_inertia_needs_a_frame_before(dataset):
    draws = sampler(dataset, scheme=Scheme(False, given_frames=2), gamma=0.1, batch_size=5)
    expected = [f"train/000000 frame {t}" for t in (1, 2, 3)] + [f"train/000002 frame {t}" for t in (1, 2)]
    assert draws.num_pairs == 5 and sorted(names(draws, [0])) == expected


def parts(batch):
    """(name, slice of nodes) of each scene."""
    offsets = batch.graph.node_offsets.tolist()
    return [(name, slice(a, b)) for name, a, b in zip(batch.names, offsets, offsets[1:], strict=False)]


def frame_of(name: str) -> tuple[int, int]:
    return int(name[6:12]), int(name.rpartition(" ")[2])


def test_without_noise_everything_is_as_in_the_file(dataset):
    draws = sampler(dataset)
    for step in range(2):
        batch, target = draws.batch(step)
        assert batch.previous_position is None
        for name, nodes in parts(batch):
            index, t = frame_of(name)
            truth = dataset.load("train", index)
            position, prescribed = truth.position, truth.scene.prescribed
            assert np.array_equal(batch.position[nodes], position[t])
            assert np.array_equal(target.motion[nodes], position[t + 1] - position[t])
            expected = np.where(prescribed[:, None], position[t + 1] - position[t], 0)
            assert prescribed.any() and np.array_equal(batch.boundary_motion[nodes], expected)
            assert np.array_equal(batch.stress[nodes], truth.stress[t])
            assert np.array_equal(target.fields["stress"][nodes], truth.stress[t + 1])
            assert np.array_equal(batch.graph.rest_position[nodes], truth.scene.rest_position)
            for tensor in (batch.position, batch.boundary_motion, target.motion, target.fields["stress"]):
                assert tensor.dtype == torch.float32


@pytest.mark.parametrize("gamma", [1.0, 0.1, 0.0])
def test_the_increment_undoes_the_share_gamma_of_the_noise(dataset, gamma):
    for step in range(2):
        clean, clean_target = sampler(dataset).batch(step)
        noisy, target = sampler(dataset, noise=0.02, gamma=gamma).batch(step)
        noise = noisy.position - clean.position
        # p_t + n + motion = p_{t+1} + (1 - gamma) n
        torch.testing.assert_close(
            noisy.position + target.motion,
            clean.position + clean_target.motion + (1 - gamma) * noise,
            rtol=0,
            atol=1e-6,
        )
        assert noise.abs().max() > 0.02
        assert torch.equal(target.motion[noisy.graph.prescribed], clean_target.motion[noisy.graph.prescribed])
        assert torch.equal(noisy.boundary_motion, clean.boundary_motion)


@pytest.mark.parametrize("gamma", [1.0, 0.1])
def test_the_acceleration_with_noise(dataset, gamma):
    options = {"scheme": Scheme(False, given_frames=2), "batch_size": 5}
    clean, _ = sampler(dataset, **options).batch(0)
    noisy, target = sampler(dataset, noise=0.02, gamma=gamma, **options).batch(0)
    assert torch.equal(noisy.previous_position, clean.previous_position)  # the noise is on p_t alone
    noise = noisy.position - clean.position
    for name, nodes in parts(noisy):
        index, t = frame_of(name)
        position = torch.from_numpy(dataset.load("train", index).position.copy())
        assert torch.equal(noisy.previous_position[nodes], position[t - 1])
        # 2 p_t - p_{t-1} + a = p_{t+1} + (1 - gamma) n, with the noisy p_t
        reached = 2 * noisy.position[nodes] - noisy.previous_position[nodes] + target.motion[nodes]
        torch.testing.assert_close(reached, position[t + 1] + (1 - gamma) * noise[nodes], rtol=0, atol=1e-6)


def test_a_hand_calculation(tmp_path):
    """One node moves 1 -> 3 -> 4 in x: increment 1, acceleration -1; noise n = p' - p_t shifts them by hand."""
    scene = two_tetrahedra(node_type=np.array([NodeType.HANDLE, 0, 0, 0, 0], np.uint8))
    position = np.repeat(scene.rest_position[None], 3, axis=0)
    position[:, 4] = [[1, 1, 1], [3, 1, 1], [4, 1, 1]]
    with Dataset(write(tmp_path / "d.h5", {"train": [Trajectory(scene, position)]})) as dataset:
        draws = sampler(dataset, scheme=Scheme(False, given_frames=2), noise=0.5, gamma=0.1, batch_size=1)
        batch, target = draws.batch(0)
        n = float(batch.position[4, 0]) - 3
        assert abs(n) > 1e-3
        assert float(batch.previous_position[4, 0]) == 1
        assert float(target.motion[4, 0]) == pytest.approx(-1 - 1.1 * n, abs=1e-5)
        draws = sampler(dataset, noise=0.5, gamma=0.1, batch_size=2)
        batch, target = draws.batch(0)
        at = batch.names.index("train/000000 frame 1")
        n = float(batch.position[5 * at + 4, 0]) - 3
        assert float(target.motion[5 * at + 4, 0]) == pytest.approx(1 - 0.1 * n, abs=1e-5)


def test_noise_is_white_gaussian_on_normal_nodes_only(tmp_path):
    scene = block(9, 9, 9)
    still = Trajectory(scene, np.repeat(scene.rest_position[None], 21, axis=0))
    with Dataset(write(tmp_path / "d.h5", {"train": [still]})) as dataset:
        draws = sampler(dataset, noise=0.003, batch_size=20)
        batch, target = draws.batch(0)
        noise = (batch.position - batch.graph.rest_position).reshape(20, 1000, 3)
        assert torch.equal(noise[:, scene.prescribed], torch.zeros(20, 100, 3))
        # The float32 coordinates round the noise by up to 5e-7.
        noise = noise[:, ~scene.prescribed].double() / 0.003
        count = noise.numel()
        assert abs(float(noise.mean())) < 4 / count**0.5
        assert abs(float((noise**2).mean()) - 1) < 4 * (2 / count) ** 0.5
        assert abs(float((noise**4).mean()) - 3) < 4 * (96 / count) ** 0.5
        for axis in range(3):  # between frames, between neighbouring nodes, between coordinates
            product = noise * noise.roll(1, dims=axis)
            assert abs(float(product.mean())) < 4 / count**0.5


def test_the_noise_of_a_pair_does_not_depend_on_its_batch(dataset):
    alone = sampler(dataset, noise=0.01, batch_size=1)
    together = sampler(dataset, noise=0.01, batch_size=8)
    whole, whole_target = together.batch(0)
    found = {}
    for step in range(8):
        batch, target = alone.batch(step)
        found[batch.names[0]] = (batch, target)
    for name, nodes in parts(whole):
        batch, target = found[name]
        assert torch.equal(whole.position[nodes], batch.position)
        assert torch.equal(whole_target.motion[nodes], target.motion)
    # Another epoch, or another seed, has other noise on the same pair.
    again, _ = together.batch(1)
    other, _ = sampler(dataset, noise=0.01, batch_size=8, seed=9).batch(0)
    for batch in (again, other):
        for name, nodes in parts(batch):
            assert not torch.equal(batch.position[nodes], found[name][0].position)


def test_a_batch_is_a_pure_function_of_seed_and_step(dataset):
    one, other = sampler(dataset, noise=0.01), sampler(dataset, noise=0.01)
    for step in (5, 0, 1000, 0):
        torch.manual_seed(step)
        np.random.seed(step)
        first, first_target = one.batch(step)
        second, second_target = other.batch(step)
        assert first.names == second.names
        assert torch.equal(first.position, second.position)
        assert torch.equal(first_target.motion, second_target.motion)


def test_what_a_batch_holds_is_its_own(dataset):
    draws = sampler(dataset)
    batch, target = draws.batch(0)
    batch.position.fill_(7)
    target.motion.fill_(7)
    batch, target = draws.batch(0)
    assert not (batch.position == 7).any() and not (target.motion == 7).any()
    assert not (dataset.load("train", 0).position == 7).any()


def mirror_of(dataset, name: str, nodes: slice, batch) -> np.ndarray:
    """[3]: the signs of the mirroring of a scene, found in its rest positions."""
    rest = dataset.load("train", frame_of(name)[0]).scene.rest_position
    middle = (rest.min(0) + rest.max(0)) / 2
    there = batch.graph.rest_position[nodes].numpy()
    signs = np.where((there == rest).all(0), 1, -1)
    assert np.allclose(there, middle + signs * (rest - middle), rtol=0, atol=1e-6)
    return signs


@pytest.mark.parametrize("dynamic", [False, True])
def test_a_mirrored_pair_is_the_mirror_image_of_the_pair(dataset, dynamic):
    options = {
        "noise": 0.02,
        "scheme": Scheme(False, 1 + dynamic),
        "gamma": 0.3,
        "batch_size": 5 if dynamic else 8,
    }
    drawn = set()
    for step in range(8):
        plain, aim = sampler(dataset, **options).batch(step)
        batch, target = sampler(dataset, mirror=("x", "z"), **options).batch(step)
        assert batch.names == plain.names
        for name, nodes in parts(batch):
            signs = mirror_of(dataset, name, nodes, batch)
            rest, moved = plain.graph.rest_position[nodes], batch.graph.rest_position[nodes]
            s = torch.from_numpy(signs).float()
            torch.testing.assert_close(
                batch.position[nodes] - moved, s * (plain.position[nodes] - rest), rtol=0, atol=1e-6
            )
            assert torch.equal(batch.boundary_motion[nodes], s * plain.boundary_motion[nodes])
            assert torch.equal(target.motion[nodes], s * aim.motion[nodes])
            if dynamic:
                torch.testing.assert_close(
                    batch.previous_position[nodes] - moved,
                    s * (plain.previous_position[nodes] - rest), rtol=0, atol=1e-6,
                )  # fmt: skip
            drawn.add(tuple(signs))
        assert torch.equal(batch.stress, plain.stress) and torch.equal(target.fields["stress"], aim.fields["stress"])
    assert drawn == {(1, 1, 1), (-1, 1, 1), (1, 1, -1), (-1, 1, -1)}


def test_the_mirroring_of_a_pair_does_not_depend_on_its_batch(dataset):
    options = {"mirror": ("x", "y", "z"), "noise": 0.02}
    one, large = sampler(dataset, batch_size=1, **options), sampler(dataset, batch_size=8, **options)
    batch, target = large.batch(1)
    for step, (name, nodes) in enumerate(parts(batch), start=8):
        alone, aim = one.batch(step)
        assert alone.names == [name]
        assert torch.equal(alone.position, batch.position[nodes]) and torch.equal(aim.motion, target.motion[nodes])
        assert torch.equal(alone.graph.rest_position, batch.graph.rest_position[nodes])


def test_half_of_the_pairs_are_mirrored_along_an_axis(dataset):
    draws = sampler(dataset, mirror=("y",), batch_size=8)
    signs = np.array([
        [mirror_of(dataset, name, nodes, batch) for name, nodes in parts(batch)]
        for batch, _ in map(draws.batch, range(50))
    ])  # fmt: skip
    assert (signs[:, :, [0, 2]] == 1).all()
    mirrored = signs[:, :, 1] == -1
    assert abs(mirrored.sum() - 200) < 4 * 10  # 400 fair draws: a standard deviation of 10
    # Eight draws agree in one of 128 batches.
    assert sum(of_batch.all() or not of_batch.any() for of_batch in mirrored) <= 5


@pytest.mark.parametrize("dynamic", [False, True])
def test_a_moved_pair_is_the_pair_elsewhere(dataset, dynamic):
    options = {
        "noise": 0.02,
        "scheme": Scheme(False, 1 + dynamic),
        "gamma": 0.3,
        "batch_size": 5 if dynamic else 8,
    }
    plain, moved, shifts = sampler(dataset, **options), sampler(dataset, shift=0.25, **options), []
    for step in range(40):
        (batch, target), (there, aim) = plain.batch(step), moved.batch(step)
        assert there.names == batch.names
        for _, nodes in parts(batch):
            way = there.graph.rest_position[nodes] - batch.graph.rest_position[nodes]
            shifts.append(way[0])
            states = [(there.position, batch.position)] + [(there.previous_position, batch.previous_position)] * dynamic
            for one, other in states:
                torch.testing.assert_close(one[nodes], other[nodes] + way[0], rtol=0, atol=1e-6)
            torch.testing.assert_close(way, way[0].expand_as(way), rtol=0, atol=1e-6)
        assert torch.equal(there.graph.rest_edges, batch.graph.rest_edges)
        assert torch.equal(there.boundary_motion, batch.boundary_motion)
        assert torch.equal(target.motion, aim.motion) and torch.equal(target.fields["stress"], aim.fields["stress"])
    drawn = torch.stack(shifts)
    assert drawn.abs().max() <= 0.25 + 1e-6 and (drawn.abs().amax(0) > 0.23).all()
    # Each coordinate has a standard deviation of 0.25 / sqrt(3), and the mean of n draws one of that over sqrt(n).
    assert (drawn.mean(0).abs() < 4 * 0.25 / math.sqrt(3 * len(drawn))).all()
    assert torch.corrcoef(drawn.T).fill_diagonal_(0).abs().max() < 4 / math.sqrt(len(drawn))


def test_the_place_of_a_pair_does_not_depend_on_its_batch(dataset):
    one, large = (sampler(dataset, batch_size=size, shift=0.1) for size in (1, 8))
    batch, _ = large.batch(1)
    for step, (_, nodes) in enumerate(parts(batch), start=8):
        assert torch.equal(one.batch(step)[0].graph.rest_position, batch.graph.rest_position[nodes])


def test_a_plane_scene_keeps_its_plane(tmp_path):
    scene = Scene(
        rest_position=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        elements=np.array([[0, 1, 2]], np.int32),
        node_type=np.zeros(3, np.uint8),
        body=np.zeros(3, np.int32),
    )
    flat = Trajectory(scene, np.stack([scene.rest_position, 2 * scene.rest_position]))
    bent = Trajectory(scene, flat.position + np.array([[[0, 0, 0]], [[0, 0, 1]]], np.float32))
    with Dataset(write(tmp_path / "d.h5", {"train": [flat, bent]})) as dataset:
        batch, _ = sampler(dataset, noise=0.1, batch_size=2).batch(0)
        for name, nodes in parts(batch):
            noise = batch.position[nodes] - batch.graph.rest_position[nodes]
            assert (noise[:, :2] != 0).all()
            assert bool((noise[:, 2] == 0).all()) == (frame_of(name)[0] == 0)
        batch, _ = sampler(dataset, shift=0.1, batch_size=2).batch(0)
        for name, nodes in parts(batch):
            place = batch.graph.rest_position[nodes]
            assert (place[0, :2] != 0).all() and bool((place[:, 2] == 0).all()) == (frame_of(name)[0] == 0)


def test_only_plane_scenes_are_read_whole_before_their_pairs(dataset, monkeypatch):
    read, frames = [], Dataset.frames

    def recorded(self, split, index, start, stop):
        read.append(stop - start)
        return frames(self, split, index, start, stop)

    monkeypatch.setattr(Dataset, "frames", recorded)
    sampler(dataset, batch_size=8).batch(0)
    assert read == [1, 1] * 8


def test_members_that_were_not_used_for_longest_are_let_go(dataset, monkeypatch):
    plenty = sampler(dataset, noise=0.1, batch_size=1)
    wanted = [plenty.batch(step) for step in range(16)]
    assert plenty._members.held == sum(array_bytes(plenty._member(index)) for index in range(3))
    unused = sampler(dataset, noise=0.1, batch_size=1)
    sizes = [array_bytes(unused._member(index)) for index in range(3)]  # graphs grow when they are used
    monkeypatch.setattr(pairs, "cache_bytes", lambda: sum(sizes) - 1)
    tight = sampler(dataset, noise=0.1, batch_size=1)
    first = weakref.ref(tight._member(0))
    assert [tight.num_nodes(index) for index in (1, 2)] == [5, 8] and first() is None
    assert tight._members.held == sizes[1] + sizes[2]
    for step, (batch, target) in enumerate(wanted):
        again, reached = tight.batch(step)
        assert again.names == batch.names and tight._members.held < plenty._members.held
        assert torch.equal(again.position, batch.position) and torch.equal(reached.motion, target.motion)
        assert torch.equal(again.graph.edges.senders, batch.graph.edges.senders)


def test_a_split_without_pairs_is_an_error(tmp_path):
    single = trajectory(block(1, 1, 1), 1)
    with Dataset(write(tmp_path / "d.h5", {"train": [single]})) as dataset:
        with pytest.raises(DatasetError, match="train has no trajectory of at least 2 frames"):
            sampler(dataset)
        with pytest.raises(DatasetError, match="train has no trajectory of at least 3 frames"):
            sampler(dataset, scheme=Scheme(False, given_frames=2))
