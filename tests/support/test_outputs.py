"""What an output may replace: every writer of the package, on links, folders, pipes and devices."""

import os
import re
import signal
import stat
import subprocess
import sys

import pytest
import toy

from ast_sim.dataset.reader import Dataset
from ast_sim.importers.convert import convert
from ast_sim.simulate.jobs.generate import generate
from ast_sim.support import disk
from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError
from ast_sim.view import export, picture
from ast_sim.view.dataset_page import gallery

TRUTH = toy.plate()


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A dataset and a simulation that can be converted."""
    folder = tmp_path_factory.mktemp("source")
    export.write(folder / "case.pvd", TRUTH)
    return toy.write(folder / "toy.h5", (1, 0, 0)), folder / "case.pvd"


WRITERS = {
    "dataset.h5": lambda path, source: toy.write(path, (1, 0, 0)),
    "converted.h5": lambda path, source: convert(source[1], path, splits={"train": 1.0}),
    "generated.h5": lambda path, source: generate(
        "deforming_plate", path, train=1, valid=0, test=0, nodes=80, frames=3
    ),
    "report.html": lambda path, source: gallery.write(path, source[0]),
    "picture.png": lambda path, source: picture.write(path, TRUTH, TRUTH, "ast"),
    "figures.json": lambda path, source: write_json(path, {"error": 1.0}),
    "scene.pvd": lambda path, source: export.write(path, TRUTH),
    "scene.vtkhdf": lambda path, source: export.write(path, TRUTH),
}
every_writer = pytest.mark.parametrize("name", WRITERS)


@every_writer
@pytest.mark.parametrize("kind", ["pipe", "folder", "device"])
def test_what_is_no_regular_file_stays(tmp_path, source, name, kind):
    path = tmp_path / name
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        try:
            os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 3))  # as /dev/null
        except PermissionError:
            pytest.skip("only root makes devices")
    before = os.stat(path)
    with pytest.raises(AstSimError, match=f"{name} is a .*: name a"):
        WRITERS[name](path, source)
    after = os.stat(path)
    assert (after.st_mode, after.st_ino) == (before.st_mode, before.st_ino)
    assert os.listdir(tmp_path) == [name]


@every_writer
@pytest.mark.parametrize("there", [True, False], ids=["to a file", "to no file yet"])
def test_a_link_stays_and_its_file_is_written(tmp_path, source, name, there):
    (tmp_path / "store").mkdir()
    target = tmp_path / "store" / name
    if there and name != "generated.h5":  # `generate` refuses other data
        target.write_bytes(b"old")
    (tmp_path / name).symlink_to(target)
    WRITERS[name](tmp_path / name, source)
    assert (tmp_path / name).is_symlink()
    assert target.is_file() and target.stat().st_size > 10
    if name.endswith(".h5"):
        with Dataset(target) as dataset:
            assert dataset.count("train") == 1
    assert not [left for left in os.listdir(tmp_path) + os.listdir(target.parent) if left.startswith(".")]


KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
import test_outputs
from pathlib import Path

name, folder = sys.argv[2:4]
killed = lambda *arguments, **options: os.kill(os.getpid(), signal.SIGKILL)
os.replace = os.fsync = Path.rename = killed
test_outputs.WRITERS[name](Path(folder) / name, (Path(sys.argv[4]), Path(sys.argv[5])))
"""


@pytest.mark.parametrize("name", ["dataset.h5", "report.html", "figures.json", "scene.pvd", "scene.vtkhdf"])
def test_the_next_process_removes_what_a_killed_one_left(tmp_path, source, name):
    words = [sys.executable, "-c", KILLED, os.path.dirname(__file__), name, str(tmp_path), *map(str, source)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run(words, env=environment).returncode == -signal.SIGKILL
    (left,) = (path for path in tmp_path.iterdir() if path.name.endswith(".tmp"))

    def write_again():
        disk._remove_leftovers.cache_clear()  # as in a new process
        WRITERS[name](tmp_path / name, source)

    write_again()
    assert left.exists()  # it is younger than a minute: its process may run where this one is not seen
    os.utime(left, (0, 0))
    others = [tmp_path / re.sub(r"-\d+-", f"-{os.getpid()}-", left.name), tmp_path / ".another.tmp"]
    others.append(tmp_path / re.sub(r"[0-9a-f]{8}-", "00000000-", left.name, count=1))
    for path in others:  # of a process that runs, of another program, of another machine
        path.write_bytes(b"")
        os.utime(path, (0, 0))
    write_again()
    assert not left.exists() and all(path.exists() for path in others)
