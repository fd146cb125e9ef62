"""Generation by a Dask cluster of real processes: a worker that is killed, a scheduler that is not there."""

import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading

import psutil
import pytest
from test_generate_kills import is_running, wait_for

import ast_sim
from ast_sim.errors import MissingExtra, SimulationError
from ast_sim.simulate import cluster
from ast_sim.simulate.generate import generate
from ast_sim.simulate.settings import recorded

COUNTS = {"train": 2, "test": 1}
SETTINGS = {"seed": 5, "nodes": 80, "frames": 9, "progress": False}
ROOT = pathlib.Path(ast_sim.__file__).parent.parent


def environment(**changes: str) -> dict[str, str]:
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, **changes}


def start(program: str, *arguments: str) -> subprocess.Popen:
    """`dask scheduler` or `dask worker`; its threads are not those of the solver."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments]
    variables = environment(OMP_NUM_THREADS="2")
    return subprocess.Popen(command, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler without workers."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    process = start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    wait_for(lambda: file.exists() and file.read_text().strip().endswith("}"), "the scheduler did not start")
    yield json.loads(file.read_text())["address"]
    process.kill()
    process.wait()


@pytest.fixture
def workers(scheduler, tmp_path):
    """Two workers of one thread, without a nanny: one that is killed stays dead."""
    folder = str(tmp_path / "dask")
    arguments = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", folder)
    found = [start("worker", scheduler, *arguments) for _ in range(2)]
    yield found
    for process in found:
        process.kill()
        process.wait()


def lines(folder) -> list[dict]:
    try:
        return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    except (OSError, ValueError):
        return []


def running(folder, sample="train/000000") -> list[int]:
    """Processes that were at the sample so far."""
    found = [line for line in lines(folder) if line["sample"] == sample and line["state"] == "running"]
    return [int(line["where"].rpartition(" ")[2]) for line in found]


def test_a_killed_worker_costs_nothing_and_the_bytes_are_those_of_one_machine(scheduler, workers, tmp_path):
    out, folder = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    killed, manifest = [], []

    def kill_a_worker():
        wait_for(lambda: running(folder), "the sample never began")
        manifest.append(open(folder / "manifest.jsonl"))  # noqa: SIM115 (to be read when the folder is removed)
        (solver,) = running(folder)
        killed.extend([psutil.Process(solver).ppid(), solver])
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill_a_worker)
    killer.start()
    generate("deforming_plate", out, COUNTS, scheduler=scheduler, **SETTINGS)
    killer.join()
    assert killed[0] in [process.pid for process in workers]
    wait_for(lambda: not is_running(killed[1]), "the solver outlived its Dask worker")
    with manifest[0] as file:
        history = [json.loads(line) for line in file]
    states = [line["state"] for line in history if line["sample"] == "train/000000"]
    assert states == ["pending", "running", "running", "done"]  # begun twice, there once
    assert sorted(line["sample"] for line in history if line["state"] == "done") == sorted(
        f"{split}/{index:06d}" for split, count in COUNTS.items() for index in range(count)
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dask", "plates.h5", "plates.h5.seconds.json"]
    generate("deforming_plate", tmp_path / "here.h5", COUNTS, **SETTINGS)
    assert out.read_bytes() == (tmp_path / "here.h5").read_bytes()


def test_solvers_end_when_the_generator_is_killed(scheduler, workers, tmp_path):
    folder = tmp_path / "plates.h5.parts"
    script = (
        "from ast_sim.simulate.generate import generate;"
        f"generate('deforming_plate', 'plates.h5', {{'train': 1}}, nodes=2000, scheduler={scheduler!r})"
    )
    with subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, env=environment()) as process:
        wait_for(lambda: running(folder), "the sample never began")
        (solver,) = running(folder)
        assert is_running(solver)
        process.kill()
    wait_for(lambda: not is_running(solver), "the solver goes on for nobody")
    assert all(process.poll() is None for process in workers)


def test_a_worker_that_is_set_up_differently_is_refused(scheduler, workers, tmp_path, monkeypatch):
    def older(recipe):
        return {**recorded(recipe), "versions": {**recorded(recipe)["versions"], "numpy": "1.0"}}

    monkeypatch.setattr(cluster, "recorded", older)
    message = r"train/000000: the worker is set up differently: versions: numpy [2-9].* on the worker, 1.0 at the cli"
    with pytest.raises(SimulationError, match=message):
        generate("deforming_plate", tmp_path / "a.h5", {"train": 1}, scheduler=scheduler, **SETTINGS)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{port}", "nowhere"])
def test_a_scheduler_that_cannot_be_reached(tmp_path, monkeypatch, address):
    monkeypatch.setattr(cluster, "SECONDS_TO_CONNECT", 0.5)
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        address = address.format(port=taken.getsockname()[1])
        with pytest.raises(SimulationError, match=f"the scheduler at {address} cannot be reached within 0.5 s"):
            generate("deforming_plate", tmp_path / "a.h5", {"train": 1}, scheduler=address, **SETTINGS)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r'distributed .*: pip install "ast_sim\[cluster\]"'):
        generate("deforming_plate", tmp_path / "a.h5", {"train": 1}, scheduler="tcp://127.0.0.1:8786", **SETTINGS)
