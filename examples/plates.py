"""From nothing to a prediction: generate plates with the bundled contact FEM, train on them, predict an unseen one.

    python examples/plates.py [FOLDER]

takes about three minutes on two cores and prints the error of the prediction beside that of holding still.
"""

import sys
from pathlib import Path

import numpy as np

from ast_sim.data.scene import NodeType
from ast_sim.results import open_run, predict
from ast_sim.simulate.generate import generate
from ast_sim.train import configure, train


def main(folder: Path, scenes: int = 24, nodes: int = 400, steps: int = 1500) -> dict[str, float]:
    """Generate, train and predict; root mean square errors in metres over the free nodes of the test plate."""
    data, run = folder / "plates.h5", folder / "run"
    counts = {"train": scenes, "valid": 2, "test": 1}
    generate("deforming_plate", data, counts, seed=0, nodes=nodes, frames=41, workers=2)
    train(run, configure(data, "tiny", [f"train.steps={steps}"]))
    with open_run(run, data) as trained:
        truth, prediction = predict(trained, "test", 0)
    free = truth.scene.node_type == NodeType.NORMAL
    error = prediction.position - truth.position
    displacement = truth.position - truth.position[0]
    return {
        "model": float(np.sqrt(np.mean(error[1:, free] ** 2))),
        "hold_still": float(np.sqrt(np.mean(displacement[1:, free] ** 2))),
    }


if __name__ == "__main__":  # the generator's workers are new processes that import this file
    errors = main(Path(sys.argv[1] if len(sys.argv) > 1 else "plates"))
    print(f"error {1000 * errors['model']:.2f} mm, holding still {1000 * errors['hold_still']:.2f} mm")
