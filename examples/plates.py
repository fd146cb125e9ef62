"""From nothing to a prediction: simulate plates with the bundled contact solver, train, predict a plate not seen.

    python examples/plates.py [FOLDER]

takes about three minutes on two cores and prints the error of the prediction beside the error of holding still. Both
are relative to the simulations, whose mesh of linear elements is too stiff: 11 % of the displacement and 96 % of the
force. Where forces count, `examples/snap_hook` and `examples/bumper` are the pattern.
"""

import sys
from pathlib import Path

import numpy as np

import ast_sim


def main(folder: Path, scenes: int = 24, nodes: int = 400, steps: int = 1500) -> dict[str, float]:
    """Simulate, train and predict; root mean square errors in metres over the free nodes of the test plate."""
    data = folder / "plates.h5"
    ast_sim.generate("deforming_plate", data, train=scenes, valid=2, test=1, nodes=nodes, frames=41)
    run = ast_sim.train(data, folder / "run", steps=steps)
    with ast_sim.Dataset(data) as dataset:
        truth = dataset["test"][0]
    answer = run.predict(truth)
    free = ~truth.scene.prescribed
    error = answer.position - truth.position
    displacement = truth.position - truth.position[0]
    return {
        "model": float(np.sqrt(np.mean(error[1:, free] ** 2))),
        "hold_still": float(np.sqrt(np.mean(displacement[1:, free] ** 2))),
    }


if __name__ == "__main__":  # the solver's workers are new processes that import this file
    errors = main(Path(sys.argv[1] if len(sys.argv) > 1 else "plates"))
    print(f"error {1000 * errors['model']:.2f} mm, holding still {1000 * errors['hold_still']:.2f} mm")
