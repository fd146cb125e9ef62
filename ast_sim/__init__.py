"""Learned simulation of deforming bodies in contact, by Adaptive Spatial Tokenization (AST), on a CPU.

    import ast_sim

    if __name__ == "__main__":  # the generator starts worker processes
        ast_sim.generate("deforming_plate", "plates.h5", train=100, nodes=400, frames=41)
        run = ast_sim.train("plates.h5", "run", steps=4000)
        with ast_sim.Dataset("plates.h5") as data:
            truth = data["test"][0]
        answer = run.predict(truth)  # or a new scene, without truth: run.predict(scene, {1: (0, 0, -0.01)})
        print(answer.position.shape, answer.stress.max(), answer.seconds)
        run.evaluate().report("page.html")

Make a dataset: `generate`, `convert` with `FieldNames`, or your own simulations with `Scene`, `Trajectory`,
`DatasetInfo`, `DatasetWriter`. Read it: `Dataset`. Train: `train`, or `new_model` with a loop of your own. Predict and
evaluate: `Run`, `Answer`, `Evaluation`. Scenes from a mesh: `read_scene`. Motions: `RigidMotion` and `Motion`. Errors
that you can act on: `AstSimError` and its kinds, such as `RolloutError`, which has the answer so far.

A name is imported when it is first used, so `import ast_sim` alone does not load torch.
"""

import os
import sys
import warnings

import lazy_loader

__version__ = "0.1.0"

# At the end of a parallel loop, a thread of OpenMP spins until the others are there, 300,000 turns unless told
# otherwise. Beside busy processes it may spin for longer than its turn on the core lasts, and every loop then costs
# milliseconds. After 10,000 turns, long enough between two loops of a small scene, a thread sleeps. OpenMP reads the
# variable when torch is imported.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & set(os.environ):
    if "torch" in sys.modules:
        warnings.warn(
            "torch was imported before ast_sim: beside other busy processes it may be many times slower. Import ast_sim"
            " first, or set GOMP_SPINCOUNT=10000",
            stacklevel=2,
        )
    else:
        os.environ["GOMP_SPINCOUNT"] = "10000"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
