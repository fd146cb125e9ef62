"""Frames for a DataLoader of torch: every pair once, as in the file; and batches as the models of this package want."""

import math

import numpy as np
import pytest
import torch
import toy
from torch import nn
from torch.utils.data import DataLoader

from ast_sim import Dataset, NodeType, new_model
from ast_sim.support.errors import ConfigError, DatasetError


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    with Dataset(toy.write(tmp_path_factory.mktemp("frame_pairs") / "toy.h5", (3, 0, 1))) as dataset:
        yield dataset


def test_every_pair_is_an_item_as_in_the_file(data):
    pairs = data.torch("train")
    assert len(pairs) == 3 * 6
    seen = set()
    for item in pairs:  # ends by itself
        index, frame = int(item["trajectory"]), int(item["frame"])
        seen.add((index, frame))
        truth = data["train"][index]
        for name in ("rest_position", "node_type", "body", "elements"):
            assert np.array_equal(item[name].numpy(), getattr(truth.scene, name)), name
        for name in ("position", "stress"):
            assert np.array_equal(item[name].numpy(), getattr(truth, name)[frame - 1])
            assert np.array_equal(item[f"next_{name}"].numpy(), getattr(truth, name)[frame])
        assert "material" not in item and "previous_position" not in item
    assert seen == {(index, frame) for index in range(3) for frame in range(1, 7)}
    with pytest.raises(DatasetError, match="no trajectory of valid has 2 frames"):
        data.torch("valid")


def test_with_inertia_an_item_has_the_frame_before(tmp_path):
    with Dataset(toy.write(tmp_path / "dynamic.h5", (1, 0, 0), dynamic=True)) as dataset:
        pairs = dataset.torch("train")
        position = dataset["train"][0].position
        assert len(pairs) == 5
        for item, frame in zip(pairs, range(2, 7), strict=True):
            three = [item[name].numpy() for name in ("previous_position", "position", "next_position")]
            assert np.array_equal(three, position[frame - 2 : frame + 1])


def test_a_batch_has_the_rows_of_its_items(data):
    pairs = data.torch("train")
    (batch,) = DataLoader(pairs, batch_size=len(pairs), collate_fn=pairs.collate)
    start = 0
    for number, item in enumerate(pairs):
        nodes = (batch["scene"] == number).nonzero()[:, 0]
        assert nodes.tolist() == list(range(start, start + len(item["position"])))
        for name in ("position", "next_position", "stress", "next_stress", "node_type"):
            assert torch.equal(batch[name][nodes], item[name]), name
        start += len(nodes)
    corners = batch["rest_position"][batch["elements"]]
    assert torch.equal(corners, torch.cat([item["rest_position"][item["elements"]] for item in pairs]))
    assert batch["frame"].tolist() == 3 * [1, 2, 3, 4, 5, 6]


def test_a_network_of_ones_own_learns(data):
    """A network that has nothing to do with this package: the motion of a node from where it lies and what moves."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(7, 32), nn.Tanh(), nn.Linear(32, 3))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
    pairs = data.torch("train")
    losses = []
    for _ in range(40):
        for batch in DataLoader(pairs, batch_size=6, shuffle=True, collate_fn=pairs.collate):
            motion = 100 * (batch["next_position"] - batch["position"])
            free = batch["node_type"] == NodeType.NORMAL
            given = torch.zeros(len(pairs), 1).index_add_(0, batch["scene"][~free], motion[~free, 2:], alpha=1 / 8)[
                batch["scene"]
            ]
            said = network(torch.cat([batch["rest_position"], batch["position"], given], dim=1))
            loss = (said - motion)[free].square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    assert np.mean(losses[-3:]) < 0.2 * np.mean(losses[:3])


def equal(first, second) -> bool:
    """Whether two batches of a model, with their targets, have the same bits."""
    (one, goal), (other, aim) = first, second
    tensors = [
        (one.position, other.position),
        (one.boundary_motion, other.boundary_motion),
        (one.graph.rest_edges, other.graph.rest_edges),
        (one.graph.elements, other.graph.elements),
        (goal.motion, aim.motion),
        *((goal.fields[name], aim.fields[name]) for name in goal.fields),
    ]
    return one.names == other.names and all(torch.equal(*both) for both in tensors)


def test_a_loader_makes_the_batches_of_the_model(data):
    """Without noise they are the batches that the training itself would make of these pairs."""
    model = new_model(data, "mgn", model_settings={"hidden": 8, "blocks": 1, "jumps": False})
    pairs = model.pairs(data)
    order = [4, 17, 0, 9]
    (batch,) = DataLoader(pairs, batch_size=4, sampler=order, collate_fn=pairs.collate)
    assert batch[0].names == [f"train/{number // 6:06d} frame {number % 6}" for number in order]
    same = pairs.assemble([pairs._pair(0, number) for number in order])
    assert equal(batch, same)


def test_noise_is_new_at_each_call_and_follows_the_seed_of_torch(data):
    model = new_model(data, "mgn", model_settings={"hidden": 8, "blocks": 1, "jumps": False})
    pairs = model.pairs(data, noise=0.01)
    torch.manual_seed(3)
    first, second = pairs[5], pairs[5]
    torch.manual_seed(3)
    assert equal(pairs[5], first) and not equal(second, first)
    free = first[0].graph.normal_nodes
    noise = (first[0].position - second[0].position)[free]
    assert math.isclose(noise.std(), 0.01 * math.sqrt(2), rel_tol=0.2)


@pytest.mark.parametrize("model", ["ast", "mgn"])
def test_a_model_learns_from_a_loader(data, model):
    torch.manual_seed(0)
    trained = new_model(data, model)
    pairs = trained.pairs(data)
    optimizer = torch.optim.AdamW(trained.parameters(), lr=1e-3)
    losses = []
    for _ in range(15):
        for batch, target in DataLoader(pairs, batch_size=6, shuffle=True, collate_fn=pairs.collate):
            loss = trained.loss(trained(batch), batch, target)["loss"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_processes_of_a_loader_give_the_same_batches(data, start):
    own = data.torch("train")
    model = new_model(data)
    for pairs in (own, model.pairs(data)):
        options = {"batch_size": 5, "collate_fn": pairs.collate}
        alone = list(DataLoader(pairs, **options))
        together = list(DataLoader(pairs, **options, num_workers=2, multiprocessing_context=start))
        assert len(alone) == len(together) == 4
        for one, other in zip(alone, together, strict=True):
            if pairs is own:
                assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
            else:
                assert one[0].names == other[0].names and torch.equal(one[0].graph.elements, other[0].graph.elements)


def test_what_is_no_pair_is_refused_by_name(data, tmp_path):
    model, items = new_model(data, "mgn"), data.torch("train")
    pairs = model.pairs(data)
    for wrong, told in (("plates.h5", "'plates.h5'"), (None, "None"), (data["train"], "of the type Split")):
        with pytest.raises(ConfigError, match=f"dataset is {told}; it must be an open ast_sim.Dataset"):
            model.pairs(wrong)
    for made, one, kind in ((items, items[0], "item of FramePairs"), (pairs, pairs[0], "pair of a batch and a target")):
        for wrong, told in (
            ([], f"items is empty; a batch needs one {kind} or more"),
            (None, f"items is None; it must be a list of {kind}s"),
            (one if isinstance(one, dict) else 5, f"; it must be a list of {kind}s"),
            ([1], f"item 0 is 1; it must be one {kind}"),
            ([one, None], f"item 1 is None; it must be one {kind}"),
        ):
            with pytest.raises(ConfigError, match=told):
                made.collate(wrong)
        for number in (10**6, -19):
            with pytest.raises(IndexError, match=f"there is no item {number}: there are 18"):
                made[number]
        assert "pairs: 18, split: train, file: toy.h5)" in repr(made)
    without = {name: values for name, values in items[0].items() if name != "stress"}
    for other in (without, {"a": torch.zeros(1)}, {**items[0], "elements": torch.zeros(2, 10)}):
        with pytest.raises(ConfigError, match="item 1 is no item of FramePairs, or of another dataset than item 0"):
            items.collate([items[0], other])
    with pytest.raises(ConfigError, match="item 0 is of the type tuple; it must be one pair of a batch and a target"):
        pairs.collate([pairs[0][::-1]])
    assert torch.equal(items[-1]["position"], items[17]["position"])
