"""The solver's seconds beside a dataset: kept apart from what is reproducible, and trusted only where they belong."""

import json

import pytest
from data_samples import block, trajectory, write

from ast_sim.data.file import Dataset
from ast_sim.data.seconds import SolverSeconds, processor, read_seconds, seconds_path, split_seconds, write_seconds

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


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"generator": ', "is damaged"),
        ("[" * 100000, "is damaged"),
        ("[]", "is damaged"),
        (json.dumps({"generator": GENERATOR, "samples": {"train/000000": {"solve_seconds": ["x"]}}}), "is damaged"),
        ('{"generator": {}, "samples": {"train/000000": {"solve_seconds": [NaN]}}}', "is damaged"),
        (json.dumps({"generator": {**GENERATOR, "seed": 4}, "samples": {}}), "belongs to another dataset"),
    ],
)
def test_seconds_that_do_not_belong_are_unknown(path, content, message):
    seconds_path(path).write_text(content)
    with pytest.warns(UserWarning, match=rf"d\.h5\.seconds\.json {message}.*: the solver's seconds are not known"):
        assert read(path) == SolverSeconds()
