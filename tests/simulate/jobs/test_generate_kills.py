"""Kill -9 of the generator at chosen moments, then the same command again: the same bytes as without the kill."""

import signal
import subprocess
import sys

import pytest
from processes import environment, is_running, paused_process, wait_for

from ast_sim.simulate.jobs.generate import generate

COUNTS = {"train": 1, "valid": 0, "test": 1}
SETTINGS = {"seed": 5, "nodes": 80, "frames": 9, "progress": False}
SCRIPT = (
    "from ast_sim.simulate.jobs.generate import generate;"
    f"generate('deforming_plate', 'plates.h5', workers=1, **{COUNTS!r}, **{SETTINGS!r})"
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> bytes:
    out = tmp_path_factory.mktemp("undisturbed") / "plates.h5"
    generate("deforming_plate", out, **COUNTS, workers=1, **SETTINGS)
    return out.read_bytes()


def generator(folder, pause="") -> subprocess.Popen:
    """A process that generates in the folder and stops at the moment `pause`."""
    return subprocess.Popen([sys.executable, "-c", SCRIPT], cwd=folder, env=environment(pause, folder / "mark"))


@pytest.mark.parametrize("moment", ["drawing", "solving", "stored", "merging", "merged", "removing"])
def test_a_killed_run_goes_on_to_the_same_bytes(undisturbed, tmp_path, moment):
    out, folder, mark = tmp_path / "plates.h5", tmp_path / "plates.h5.parts", tmp_path / "mark"
    with generator(tmp_path, moment) as process:
        paused = paused_process(mark)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    wait_for(lambda: not is_running(paused), "a worker outlived the generator")
    assert out.exists() == (moment in ("merged", "removing"))
    assert len(list(folder.glob("*.npz"))) == {"stored": 1, "merging": 2, "merged": 2}.get(moment, 0)
    assert len(list(folder.glob("*.checkpoint"))) == (moment in ("solving", "stored"))
    assert bool(list(tmp_path.glob(".plates.h5.*.tmp"))) == (moment == "merging")
    mark.unlink()
    with generator(tmp_path) as process:
        assert process.wait() == 0
    assert out.read_bytes() == undisturbed
    resumed = tmp_path / "resumed"
    assert resumed.exists() == (moment == "solving")  # it went on from its last frame
    resumed.unlink(missing_ok=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plates.h5", "plates.h5.seconds.json"]
