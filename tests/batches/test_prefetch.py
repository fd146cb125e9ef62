"""Batches drawn ahead are the sampler's, in any order, and errors come with the batch that they belong to."""

import threading
from dataclasses import replace

import pytest
import torch
from data_samples import mesh_graph, trajectory, write
from meshes import two_tetrahedra

from ast_sim.batches.pairs import PairSampler
from ast_sim.batches.prefetch import Ahead
from ast_sim.batches.scheme import Scheme
from ast_sim.dataset.reader import Dataset
from ast_sim.support.errors import DatasetError

OPTIONS = {
    "batch_size": 2,
    "seed": 3,
    "noise": 0.1,
    "make_graph": mesh_graph,
    "scheme": Scheme(False),
    "gamma": 1.0,
}


@pytest.fixture
def dataset(tmp_path):
    with Dataset(write(tmp_path / "d.h5", {"train": [trajectory(two_tetrahedra(), 6, seed=1)]})) as dataset:
        yield dataset


def test_batches_are_the_samplers_in_any_order(dataset):
    with Ahead(PairSampler(dataset, "train", **OPTIONS)) as ahead:
        for step in (0, 1, 2, 2, 7, 0, 1):
            batch, target = ahead.batch(step)
            expected, expected_target = PairSampler(dataset, "train", **OPTIONS).batch(step)
            assert batch.names == expected.names
            assert torch.equal(batch.position, expected.position) and torch.equal(target.motion, expected_target.motion)


def test_the_next_batch_is_made_while_the_caller_is_busy(dataset):
    with Ahead(PairSampler(dataset, "train", **OPTIONS)) as ahead:
        ahead.batch(4)
        ahead.wait()
        assert ahead._next[5].done() and len(ahead._next[5].result()[0].names) == 2


def test_the_thread_prepares_each_batch(dataset):
    by: list[str] = []

    def prepare(batch):
        by.append(threading.current_thread().name)
        return replace(batch, names=[*batch.names, "prepared"])

    with Ahead(PairSampler(dataset, "train", **OPTIONS), prepare) as ahead:
        assert ahead.batch(0)[0].names[-1] == ahead.batch(1)[0].names[-1] == "prepared"
    assert len(by) >= 2 and all(name.startswith("sampler") for name in by)


def test_an_error_comes_with_its_batch_and_the_thread_ends(dataset):
    class Broken:
        def batch(self, step: int) -> tuple[int, str]:
            if step == 1:
                raise DatasetError("unreadable")
            return step, "target"

    with Ahead(Broken()) as ahead:
        assert ahead.batch(0) == (0, "target")
        ahead.wait()
        with pytest.raises(DatasetError, match="unreadable"):
            ahead.batch(1)
        assert ahead.batch(2) == (2, "target")
    assert not any(thread.name.startswith("sampler") for thread in threading.enumerate())
