"""The process of one state of the repository in `predictions`: it predicts what is asked on stdin, answers on stdout.

Usage: `prediction_worker.py FILE`, a dataset. A request is a line of JSON: the number of a test scene and Newton steps.
It is run as a file, since the other state need not have it.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import warnings

import ast_sim


def main() -> None:
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # plates of other sizes than in training
    out, sys.stdout = sys.stdout, sys.stderr
    run = ast_sim.example_run("plates")
    with ast_sim.Dataset(sys.argv[1]) as dataset:
        truths = [dataset.load("test", index) for index in range(dataset.count("test"))]
    for line in sys.stdin:
        index, newton_steps = json.loads(line)
        scene = dataclasses.replace(truths[index].scene)  # a new one, which keeps nothing of the calls before
        motion, effort = ast_sim.Motion(truths[index].position), ast_sim.Effort(0, newton_steps)
        clock, processor = time.perf_counter(), time.process_time()
        answer = run.predict(scene, motion, frames=-1, effort=effort)
        told = {"clock": time.perf_counter() - clock, "processor": time.process_time() - processor}
        print(json.dumps({**told, "position": answer.position.ravel().tolist()}), file=out, flush=True)


if __name__ == "__main__":
    main()
