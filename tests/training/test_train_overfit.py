"""The model can learn: one trajectory, without noise, is known by heart after a few hundred steps."""

import numpy as np
import toy

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.evaluation.evaluate import one_step_predictions
from ast_sim.named_field import STRESS
from ast_sim.runs.folder import RunFolder
from ast_sim.training.configure import configure
from ast_sim.training.start import start_training


def test_overfitting_one_trajectory_brings_the_one_step_error_below_2_percent_of_the_mean_increment(tmp_path):
    data = toy.write(tmp_path / "one.h5", counts=(1, 0, 0))
    settings = [
        "train.steps=500", "train.batch_size=6", "train.peak_rate=1e-3", "train.noise=0.0", "model.jumps=false",
        "model.hidden=32", "model.d_token=32", "model.L_SA=2",
    ]  # fmt: skip
    start_training(tmp_path / "run", configure(data, "tiny", settings))
    model = RunFolder(tmp_path / "run").load_model()
    with Dataset(data) as dataset:
        truth = dataset.load("train", 0)
    predicted, fields = one_step_predictions(model, truth, "train/000000")
    normal = ~truth.scene.prescribed
    position = truth.position[:, normal].astype(np.float64)
    error = np.linalg.norm(predicted[:, normal] - position[1:], axis=2).mean()
    increment = np.linalg.norm(np.diff(position, axis=0), axis=2).mean()
    assert error < 0.02 * increment
    body = truth.scene.node_type != 1
    stress = fields[STRESS]
    wrong = np.abs(stress[:, body] - truth.stress[1:, body]).mean()
    assert wrong < 0.1 * np.abs(truth.stress[1:, body] - truth.stress[1:, body].mean()).mean()
