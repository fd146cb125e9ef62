"""What every test shares: the debug mode of the binding is on, a test has one thread, and long tests come first."""

import os
from pathlib import Path

os.environ.setdefault("AST_SIM_DEBUG", "1")
# Small scenes gain nothing from threads, and lose where tests run side by side. Tests of threads set their own number.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # a thread that waits leaves its core to the other tests

# Files with a test or fixture of more than about 15 s: first, so that in the end no process waits for another's test.
LONG = (
    "inference/test_new_scene.py",
    "training/test_processes.py",
    "benchmarks/test_study.py",
    "benchmarks/test_whole_steps.py",
    "benchmarks/test_coverage_study.py",
    "test_command_lines.py",
    "test_examples.py",
    "docs/test_new_model.py",
    "training/test_train_kills.py",
    "benchmarks/test_busy.py",
    "simulate/jobs/test_generate_kills.py",
)


def pytest_collection_modifyitems(items):
    here = Path(__file__).parent
    place = {here / name: number for number, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path, len(LONG)))
