"""The demonstration at its smallest: real simulations, a few steps of training, every file, the same numbers again."""

import json
import shutil
from dataclasses import replace

import pytest
from chosen_figures import NO_DEEPEST, evaluation

from ast_sim import demo
from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.demo import FULL, KEPT, QUICK, Size, headlines
from ast_sim.figures import Beside
from ast_sim.runs.train_config import TrainConfig

TINY = Size(train=1, valid=1, test=1, steps=4)
NODES = 100
FILES = (
    "first.png",
    "report.html",
    "prediction.pvd",
    "picture.png",
    "evaluation.json",
    "data.h5",
    "unseen.h5",
    "run/config.toml",
)


def make_tiny(patch: pytest.MonkeyPatch, size: Size = TINY) -> None:
    """Few steps on small plates."""
    patch.setattr(demo, "QUICK", size)
    patch.setattr(demo, "NODES", NODES)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a demonstration."""
    folder = tmp_path_factory.mktemp("demo") / "demo"
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        assert main(["demo", "--quick", "--out", str(folder)]) == 0
    return folder


def figures(folder) -> dict:
    """The evaluation without what a clock or a place decides."""
    found = json.loads((folder / "evaluation.json").read_text())
    for scene in found["scenes"]:
        del scene["model_seconds_per_step"], scene["solver_seconds_per_step"]
    return {**{key: found[key] for key in ("scenes", "errors", "failures")}, "step": found["origin"]["step"]}


def test_everything_is_made(made):
    for name in FILES:
        assert (made / name).stat().st_size > 0, name
    assert all((made / name).read_bytes().startswith(b"\x89PNG") for name in ("first.png", "picture.png"))
    with Dataset(made / "data.h5") as dataset:
        assert dataset.splits == {"train": 1, "valid": 1, "test": 0, "calibration": 0}
        assert dataset["train"][0].num_frames == 1 + len(KEPT)
    with Dataset(made / "unseen.h5") as dataset:
        assert (
            dataset.splits == {"train": 0, "valid": 0, "test": 1, "calibration": 0}
            and dataset["test"][0].num_frames == 41
        )
    found = json.loads((made / "evaluation.json").read_text())
    assert found["origin"]["command"] == f"ast-sim demo --out {made} --quick --seed 0"
    assert (found["speedup"] is None) == (found["threads"] > 1)
    assert found["origin"]["step"] in (1, 2, 3, 4)


def test_again_in_the_same_folder_reuses_the_parts_and_other_settings_are_refused(made, monkeypatch, capsys):
    make_tiny(monkeypatch)
    before = figures(made)
    weights = (made / "run" / "checkpoints" / "step-4" / "manifest.json").read_bytes()
    assert main(["demo", "--quick", "--out", str(made)]) == 0
    shown = capsys.readouterr().out
    assert "going on after step 4" in shown
    for name in FILES[:5]:
        assert str(made / name) in shown
    assert "of the displacement by one call of the model in" in shown
    assert figures(made) == before
    assert (made / "run" / "checkpoints" / "step-4" / "manifest.json").read_bytes() == weights
    assert main(["demo", "--quick", "--out", str(made), "--seed", "1"]) == 2
    assert "first.h5 exists and holds other data" in capsys.readouterr().err
    make_tiny(monkeypatch, replace(TINY, steps=5))
    assert main(["demo", "--quick", "--out", str(made)]) == 2
    assert "train.steps = 4, not 5" in capsys.readouterr().err


def test_the_same_seed_gives_the_same_numbers_elsewhere(made, tmp_path, monkeypatch):
    make_tiny(monkeypatch)
    (tmp_path / "again").mkdir()
    for name in ("data.h5", "unseen.h5"):  # that scenes are the same again is tested with the solver
        shutil.copy(made / name, tmp_path / "again")
    demo.demo(tmp_path / "again", quick=True)
    assert figures(tmp_path / "again") == figures(made)


def test_headlines_are_shares_of_the_trivial_predictors():
    deepest = replace(
        NO_DEEPEST,
        relative_error=0.0712,
        seconds=0.0251,
        after_calls=(0.16,),
        after_newton_steps=(0.0712,),
        stress_share=0.5,
        largest_stress=0.08,
        solver=Beside(scenes=3, seconds=0.06, model_seconds=0.025, ratio=2.4),
        cheapest=Beside(scenes=2, seconds=0.03, model_seconds=0.025, ratio=1.2),
    )
    assert headlines(evaluation({"a": 1e-3, "b": None}, deepest=deepest)) == [
        "displacement error over whole rollouts: 0.00143 m, 22 % of the error of holding still",
        "stress error over whole rollouts: 6.78e+03 Pa, 60 % of the error of each frame's true mean",
        "1 of 2 rollouts failed",
        "the deepest frame at once: error 7.12 % of the displacement, 25.1 ms in the median, on one thread",
        "  after each call, and each Newton step: 16, 7.12 %",
        "  stress: 0.50 of the error of the frame's true mean; the largest is 8 % off",
        "  the solver for this frame: 60 ms, 2.4 times as long (medians of 3 scenes, one thread)",
        "  its fastest setting that is as accurate: 30 ms, 1.2 times as long (medians of 2 scenes, one thread)",
    ]


def test_the_sizes_of_the_demonstration():
    assert (FULL.train, FULL.valid, FULL.test) == (1300, 8, 10)
    assert FULL.valid <= TrainConfig().validate_scenes  # a training looks at no others
    assert QUICK.train < FULL.train and QUICK.steps < FULL.steps
