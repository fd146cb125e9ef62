"""The example of README.md runs as it stands, with smaller numbers, and leaves what it says."""

import re
from pathlib import Path

import forked

from ast_sim import Dataset

ROOT = Path(__file__).parents[2]
SMALLER = {'"train": 600, "valid": 8, "test": 10': '"train": 2, "valid": 1, "test": 1', "nodes=400": "nodes=80"}
SMALLER |= {"minutes=5": "steps=3", "(14, 24, 34)": "(3, 5, 7)"}


def test_the_example_runs(tmp_path):
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    for large, small in {**SMALLER, "frames=41": "frames=9"}.items():
        assert block.count(large) == 1, large
        block = block.replace(large, small)
    (tmp_path / "example.py").write_text(block, encoding="utf-8")
    done = forked.run(["example.py"], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    shape = re.search(r"\((\d+), (\d+), 3\) ", done.stdout)
    assert shape is not None, done.stdout
    with Dataset(tmp_path / "plates.h5") as data:
        assert int(shape[2]) == data["test"][0].scene.num_nodes
    for name in ("answer.vtkhdf", "page.html", "run/scope.toml"):
        assert (tmp_path / name).stat().st_size > 0
