"""How a model predicts: what each frame starts from, which frames are computed, and what follows from it."""

import numpy as np
import pytest

from ast_sim.batches.scheme import Scheme
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.mgn import MODEL

# One prescribed node goes down, up, and down again; the other node is free, and what it does is not read.
HEIGHTS = np.array([0.0, -1.0, -2.0, -1.0, 0.0, -1.0])
POSITION = np.zeros((6, 2, 3))
POSITION[:, 0, 2] = HEIGHTS
POSITION[:, 1, 2] = [0, 5, 0, 5, 0, 5]
PRESCRIBED = np.array([True, False])


@pytest.mark.parametrize(
    "scheme, sources, computed",
    [
        (Scheme(jumps=False), [-1, 0, 1, 2, 3, 4], [1, 2, 3, 4, 5]),
        (Scheme(jumps=False, given_frames=2), [-1, 0, 1, 2, 3, 4], [2, 3, 4, 5]),
        (Scheme(jumps=True), [0, 0, 0, 0, 0, 0], [5]),
        (Scheme(jumps=True, history=()), [0, 0, 0, 2, 2, 4], [2, 4, 5]),
    ],
)
def test_the_frames_that_the_last_one_needs(scheme, sources, computed):
    assert scheme.sources(POSITION, PRESCRIBED).tolist() == sources
    assert scheme.computed([5], scheme.sources(POSITION, PRESCRIBED)) == computed
    assert scheme.computed([0], scheme.sources(POSITION, PRESCRIBED)) == []  # it is given


def test_what_follows_from_it():
    steps, jumps, path = Scheme(False), Scheme(True), Scheme(True, history=())
    assert [one.corrects for one in (steps, jumps, path)] == [False, True, True]
    assert [one.errors_add_up for one in (steps, jumps, path)] == [True, False, False]
    assert [one.needs_each_frame for one in (steps, jumps, path)] == [True, False, False]
    assert [one.follows_motion for one in (steps, jumps, path)] == [True, False, True]


def test_a_model_tells_its_scheme():
    known = {"columns": ("young", "poisson", "yield_stress"), "tetrahedra": True, "mesh_spacing": 1.0}
    settings = MODEL.presets["tiny"].model
    assert settings.resolve(DataFacts(mesh_spacing=1.0)).scheme == Scheme(True)
    assert settings.resolve(DataFacts("dynamic", mesh_spacing=1.0)).scheme == Scheme(False, given_frames=2)
    assert settings.resolve(DataFacts(**known)).scheme == Scheme(True, history=())
