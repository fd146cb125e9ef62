"""A worker process: makes the samples that it is told to, one at a time.

`python -m ast_sim.simulate.worker FOLDER FAMILY SEED NODES` reads lines "split index" from its standard input and
answers each with a line of JSON when the sample is in its file, until the input ends. It is started afresh by
`generate`, with one thread for all libraries, and never imports torch: two OpenMP runtimes in one process hang or slow
each other down.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from pathlib import Path

from ast_sim.simulate.samples import make_sample, sample_path, save_sample


def main() -> None:
    """Serve until the standard input ends."""
    folder, family, seed, nodes = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    parent = os.getppid()
    # Answers go to the real standard output, which nothing else may write to.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    for line in sys.stdin:
        split, index = line.split()
        try:
            trajectory = make_sample(family, seed, split, int(index), nodes)
            if os.getppid() != parent:
                return  # the parent was killed: its folder may belong to another run by now
            save_sample(sample_path(folder, split, int(index)), trajectory)
            answer = {"status": trajectory.attributes["status"]}
        except Exception as error:
            fatal = isinstance(error, OSError)  # a full or unwritable disk fails all samples alike
            answer = {"error": f"{type(error).__name__}: {error}", "fatal": fatal, "traceback": traceback.format_exc()}
        print(json.dumps(answer), file=answers)


if __name__ == "__main__":
    main()
