"""Where the time of a training step of `tiny` on plates of 400 nodes goes, on one thread.

`python -m benchmarks.steps.parts [--data FILE]`. It tells the processor time of a step by the number of scenes, and so
the part that no scene causes; the nodes of autograd by name; the calls and milliseconds of each op by name. Without a
file it simulates 16 plates. All scenes are in the cache before anything is timed.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch

import ast_sim
from ast_sim.simulate.jobs.generate import generate
from ast_sim.training import profile
from ast_sim.training.loop import Training
from benchmarks.steps.before_after import SETTINGS
from benchmarks.steps.step_worker import Setup, counts, events, nodes, training_of

SCENES = 16  # that are simulated: twice the largest batch
WARM = 20  # steps before anything is timed


def processor_ms(training: Training, steps: int) -> list[float]:
    """The processor time of each step, all threads of this process together."""
    samples = []
    for _ in range(steps):
        start = time.process_time()
        training.advance()
        samples.append(1e3 * (time.process_time() - start))
    return samples


def fixed_part(milliseconds: dict[int, float]) -> tuple[float, float]:
    """Of a straight line through the times by the number of scenes: its value at no scene, and what a scene adds."""
    each, fixed = statistics.linear_regression(list(milliseconds), list(milliseconds.values()))
    return fixed, each


def by_scenes(setup: Setup, batches: list[int], steps: int) -> None:
    """Print the processor time of a step by the number of scenes."""
    medians = {}
    for batch in batches:
        with training_of(setup._replace(settings=[*setup.settings, f"train.batch_size={batch}"])) as training:
            processor_ms(training, WARM)
            samples = processor_ms(training, steps)
        medians[batch] = statistics.median(samples)
        print(f"{batch} scenes: {medians[batch]:.1f} ms of processor time in the median, {min(samples):.1f} at least")
    fixed, each = fixed_part(medians)
    print(f"of the medians: {fixed:.1f} ms whatever the scenes, and {each:.1f} for each\n")


def by_name(setup: Setup, steps: int) -> None:
    """Print what a step of the largest batch runs, and the time of each of its parts."""
    with training_of(setup) as training:
        processor_ms(training, WARM)
        print(", ".join(f"{count} {name}" for name, count in counts(training.advance).items()))
        of_autograd = sorted(nodes(events(training.advance)).items(), key=lambda item: -item[1])
        print("nodes of autograd: " + ", ".join(f"{count} {name}" for name, count in of_autograd) + "\n")
        print(profile.table(profile.profile(training.advance, steps)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, metavar="FILE", help="a dataset with few training scenes")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 8], help="scenes of a step (1 4 8)")
    parser.add_argument("--steps", type=int, default=40, help="that are timed (%(default)s)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    ast_sim.keep_memory()
    with tempfile.TemporaryDirectory() as folder:
        data = arguments.data or Path(folder) / "plates.h5"
        if arguments.data is None:
            generate("deforming_plate", data, train=SCENES, valid=0, test=1, seed=0, nodes=400, frames=41)
        setup = Setup(str(data), "ast", "tiny", SETTINGS, folder)
        by_scenes(setup, arguments.batches, arguments.steps)
        by_name(setup, arguments.steps)


if __name__ == "__main__":
    main()
