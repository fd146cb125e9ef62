"""From nothing to a prediction: simulate rubber bumpers with the bundled contact solver, train, predict one not seen.

    python examples/first_run.py [FOLDER]

takes about ten minutes on two cores and prints how far shape and force of the predicted bumper are from its simulation.
The mesh of the simulation makes the force up to 3 % wrong (docs/results/example_meshes.md).
"""

import sys
from pathlib import Path

import ast_sim

SPEC = Path(__file__).parent / "bumper" / "SPEC.toml"


def main(folder: Path, scenes: int = 24, steps: int = 600, nodes: int | None = None) -> dict[str, float]:
    """Simulate, train and predict; the errors of the test scene in its deepest frame, each over the true value."""
    data = folder / "bumpers.h5"
    ast_sim.generate("assembly", data, spec=SPEC, train=scenes, valid=2, test=1, nodes=nodes)
    run = ast_sim.train(data, folder / "run", steps=steps)
    with ast_sim.Dataset(data) as dataset:
        truth = dataset["test"][0]
    return run.predict(truth).errors(truth)


if __name__ == "__main__":  # the solver's workers are new processes that import this file
    errors = main(Path(sys.argv[1] if len(sys.argv) > 1 else "bumpers"))
    print(f"error of the shape {errors['displacement']:.1%}, of the force {errors['reaction']:.1%}")
