"""The process of one state of the repository in `predictions`: it predicts what is asked on stdin, answers on stdout.

Usage: `prediction_worker.py FILE`, a dataset. A request is a line of JSON: Newton steps, and how many predictions of
the first test scene are made one after another. It is run as a file, since the other state need not have it.
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
        truth = dataset.load("test", 0)
    for line in sys.stdin:
        newton_steps, count = json.loads(line)
        # New scenes, which keep nothing of the calls before.
        scenes = [dataclasses.replace(truth.scene) for _ in range(count)]
        motion, effort = ast_sim.Motion(truth.position), ast_sim.Effort(0, newton_steps)
        clock, processor = time.perf_counter(), time.process_time()
        answers = [run.predict(scene, motion, frames=-1, effort=effort) for scene in scenes]
        clock, processor = time.perf_counter() - clock, time.process_time() - processor
        position = answers[-1].position.ravel().tolist()
        told = {"clock": clock / count, "processor": processor / count, "position": position}
        print(json.dumps(told), file=out, flush=True)


if __name__ == "__main__":
    main()
