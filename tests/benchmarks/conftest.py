"""What tests of studies share."""

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from checks import made_once

from ast_sim.inference import effort
from benchmarks.studies import coverage, jumps, shipped


@pytest.fixture
def one_thread(monkeypatch):
    """The study changes the threads of this process and of others; they are set back."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def choose_among_few_efforts(patch: pytest.MonkeyPatch) -> None:
    """By one call, Newton steps, the solver where they move far, and the solver: four in place of eight."""
    patch.setattr(effort, "CHOSEN_STEPS", (0, effort.MOST_NEWTON_STEPS))
    patch.setattr(effort, "CHOSEN_MOVES", effort.CHOSEN_MOVES[:1])


@pytest.fixture
def few_efforts(monkeypatch):
    choose_among_few_efforts(monkeypatch)


@pytest.fixture(scope="session")
def shipped_plates(tmp_path_factory) -> Path:
    """What makes the shipped run of plates has run, on plates of 100 nodes: the folder of `plates.ast`, of `data` with
    scenes and run, and of `told.txt` with what was printed."""

    def make(folder: Path) -> None:
        row = replace(
            jumps.ROWS["plates400_long"], data="small", nodes=100, frames=3, keep=None, train=30, valid=1, test=1,
            steps=4, settings={"mirror": ("x", "y"), "corrections": 0, "batch_size": 2, "statistics_pairs": 4},
        )  # fmt: skip
        small = {"family": "deforming_plate", "nodes": 100, "frames": 3}
        scenes = replace(coverage.ROWS["plates"], generate=small, calibration=24)
        with pytest.MonkeyPatch.context() as patch, open(folder / "told.txt", "w") as told:
            patch.setitem(jumps.ROWS, "plates400_long", row)
            patch.setitem(coverage.ROWS, "plates", scenes)
            patch.setattr(shipped, "SHIPPED", folder)
            choose_among_few_efforts(patch)
            with contextlib.redirect_stdout(told):
                shipped.main(["plates", "--folder", str(folder / "data")])

    return made_once(tmp_path_factory, "shipped_plates", make)
