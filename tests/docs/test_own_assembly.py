"""An engineer follows docs/how-to/own-assembly.md line by line, with a coarse mesh and a short training."""

import csv
import os
import re
import shutil
from pathlib import Path

import forked
import pytest
from docs.test_pages import FOLLOWED, ROOT, blocks, calls_of, page_name, with_blocks

from ast_sim.cli import main
from ast_sim.scene import NodeType

PAGE = ROOT / "docs" / "how-to" / "own-assembly.md"
# What makes the walk short: every text must stand on the page.
SHORTER = {
    "[2, 3, 4, 5, 6, 7]": "[2, 7]",
    "[1e6, 2e6, 4e6]": "[1e6, 4e6]",
    "size = 5.0": "size = 8.0",
    "train=100, valid=8, test=10": "train=4, valid=1, test=1, workers=1, progress=False",
    "steps=2000)": "steps=20, validate_every=20, checkpoint_every=20)",
}
SHORTER_CALL = {"travel=2:7:6": "travel=2:7:2", "bumper.young=1e6,2e6,4e6": "bumper.young=1e6,4e6"}


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> tuple[Path, str]:
    """The folder in which all Python of the page has run as one program, and what it printed."""
    assert PAGE in with_blocks(("python",)) and page_name(PAGE).rsplit("/")[-1] in FOLLOWED
    folder, lines = tmp_path_factory.mktemp("walk"), []
    for block in blocks(PAGE.read_text(encoding="utf-8")):
        if block.kind == "python":
            lines += [""] * (block.line - len(lines)) + block.text.splitlines()
    program = "\n".join(lines)
    for long, short in SHORTER.items():
        assert long in program, long
        program = program.replace(long, short)
    (folder / "page.py").write_text(program)
    done = forked.run(["page.py"], cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_the_python_of_the_page_gives_answers(walk):
    folder, printed = walk
    assert re.search(r"^\S+ N, \S+ MPa at z = \S+ mm$", printed, re.M)
    rows = list(csv.DictReader((folder / "force.csv").open()))
    assert not [row["notes"] for row in rows if "travel is" in row.get("notes", "")]  # within the range of the training
    assert len(rows) == 4 and {row["skew"] for row in rows} == {"0.0"}
    assert [float(row["travel_of_nodes"]) for row in rows[::2]] == pytest.approx([2, 7], abs=1e-4)
    for name in ("bumper.step", "ram.step", "study.h5", "answer.vtkhdf", "force.png"):
        assert (folder / name).stat().st_size > 0, name


def test_the_scenes_are_the_same_as_on_the_page(walk):
    from ast_sim.dataset.reader import Dataset

    with Dataset(walk[0] / "study.h5") as data:
        truth, info = data["train"][0], data.info
    scene = truth.scene
    assert info.length_unit == "mm" and truth.num_frames == 4
    assert (scene.rest_position[scene.node_type == NodeType.HANDLE, 2] == 0).all()
    assert scene.rest_position[scene.node_type == NodeType.OBSTACLE, 2].min() == pytest.approx(16.5)
    assert 2 <= truth.attributes["parameter travel"] <= 7 and truth.attributes["reaction"][-1] > 0


def test_the_commands_of_the_page_run(walk, tmp_path, capfd):
    """In a copy of the folder, after the Python; whole trainings and reports are not repeated."""
    folder = tmp_path / "walk"
    shutil.copytree(walk[0], folder)
    ran, start = [], os.getcwd()
    os.chdir(folder)
    try:
        for call in calls_of(blocks(PAGE.read_text(encoding="utf-8"))):
            capfd.readouterr()
            call = [SHORTER_CALL.get(word, word) for word in call]
            assert main([*call, *(["--overwrite"] if "--out" in call else [])]) == 0, call
            ran.append((call[0], capfd.readouterr().out))
    finally:
        os.chdir(start)
    assert [name for name, _ in ran] == ["generate", "predict", "sweep"]
    look, answer, sweep = (out for _, out in ran)
    assert "bumper and ram: 0.5 mm apart" in look and (folder / "SPEC.look.png").exists()
    assert re.search(r"^frame 3: travel_of_nodes 4.2 mm, reaction \S+ N, largest_stress \S+ Pa$", answer, re.M)
    assert sweep.startswith("force.csv: 4 rows")
