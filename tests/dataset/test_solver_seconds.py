"""The solver's seconds beside a dataset: kept apart from what is reproducible, and trusted only where they belong."""

import json
import random
import warnings

import pytest
from data_samples import block, trajectory, write

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import SolverSeconds, read_seconds, seconds_path, split_seconds, write_seconds
from ast_sim.support.provenance import processor

GENERATOR = {"family": "test", "seed": 3, "counts": {"train": 1}}


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "d.h5", {"train": [trajectory(block(1, 1, 1), 2)]}, generator=GENERATOR)


def read(path):
    with Dataset(path) as dataset:
        return read_seconds(dataset)


def test_clocks_are_told_from_what_is_reproducible():
    kept, seconds = split_seconds({"solve_seconds": [0.5], "draw_seconds": 1.0, "seed": 3, "seconds": 2})
    assert kept == {"seed": 3, "seconds": 2} and seconds == {"solve_seconds": [0.5], "draw_seconds": 1.0}


def test_seconds_are_read_where_they_belong(path, recwarn):
    assert read(path) == SolverSeconds()
    samples = {"train/000000": {"solve_seconds": [0.25, 1e-9], "processor": processor()}}
    write_seconds(path, GENERATOR, samples)
    assert sorted(member.name for member in path.parent.iterdir()) == ["d.h5", "d.h5.seconds.json"]
    assert read(path) == SolverSeconds({"train/000000": [0.25, 1e-9]}, (processor(),))
    assert len(recwarn) == 0 and processor()


SAMPLES = {"train/000000": {"solve_seconds": [0.25, 0.5], "processor": "a"}}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"generator": ', "is damaged"),
        ("[" * 100000, "is damaged"),
        ("[]", "is damaged"),
        (json.dumps({"generator": GENERATOR, "samples": SAMPLES}), "is damaged .*sha256"),
        (json.dumps({"generator": GENERATOR, "samples": SAMPLES, "sha256": "0" * 64}), "is damaged .*does not fit"),
    ],
)
def test_damaged_seconds_are_unknown(path, content, message):
    seconds_path(path).write_text(content)
    with pytest.warns(UserWarning, match=rf"d\.h5\.seconds\.json {message}.*: the solver's seconds are not known"):
        assert read(path) == SolverSeconds()


@pytest.mark.parametrize(
    ("name", "seconds", "message"),
    [
        ("train/000000", [-0.5, 1.0], "has times of train/000000 that are below 0 or not finite"),
        ("train/000000", [0.5, float("nan")], "has times of train/000000 that are below 0 or not finite"),
        ("train/000000", [0.0, 0.0], "says that train/000000 took no time"),
        ("train/000000", [0.5], "has 1 time of train/000000, which has 2 frames"),
        ("train/000001", [0.5, 0.5], "has 2 times of train/000001, which has no frames"),
        ("train/000000", ["x"], "is damaged"),
    ],
)
def test_nonsense_is_unknown_although_its_hash_fits(path, name, seconds, message):
    write_seconds(path, GENERATOR, {name: {"solve_seconds": seconds}})
    with pytest.warns(UserWarning, match=rf"d\.h5\.seconds\.json {message}.*: the solver's seconds are not known"):
        assert read(path) == SolverSeconds()


def test_seconds_of_another_dataset_are_unknown(path):
    write_seconds(path, {**GENERATOR, "seed": 4}, SAMPLES)
    with pytest.warns(UserWarning, match="belongs to another dataset: the solver's seconds are not known"):
        assert read(path) == SolverSeconds()


def test_no_flipped_bit_and_no_truncation_of_the_seconds_is_believed(path):
    write_seconds(path, GENERATOR, SAMPLES)
    intact, content, draw = read(path), seconds_path(path).read_bytes(), random.Random(0)
    damages = [content[: draw.randrange(len(content) - 1)] for _ in range(50)]
    for _ in range(200):
        place = draw.randrange(len(content))
        damages.append(content[:place] + bytes([content[place] ^ 1 << draw.randrange(8)]) + content[place + 1 :])
    for damaged in damages:
        seconds_path(path).write_bytes(damaged)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert read(path) == (SolverSeconds() if told else intact)
