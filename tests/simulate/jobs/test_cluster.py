"""Generation by a Dask cluster of real processes: a worker that is killed, a scheduler that is not there."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading

import psutil
import pytest
from processes import environment, is_running, paused_process, wait_for

from ast_sim.simulate.jobs import cluster
from ast_sim.simulate.jobs.display import SceneProgress
from ast_sim.simulate.jobs.generate import generate
from ast_sim.simulate.jobs.recipe import recorded
from ast_sim.support.errors import AstSimError, ConfigError, MissingExtra, SimulationError

COUNTS = {"train": 2, "valid": 0, "test": 1}
SETTINGS = {"seed": 5, "nodes": 80, "frames": 9, "progress": False}


def start(program: str, *arguments: str, **stop) -> subprocess.Popen:
    """`dask scheduler` or `dask worker`; its threads are not the solver's."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments]
    variables = environment(**stop, OMP_NUM_THREADS="2")
    return subprocess.Popen(command, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def start_scheduler(folder) -> tuple[subprocess.Popen, str]:
    """A scheduler without workers, and its address."""
    file = folder / "scheduler.json"
    process = start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    wait_for(lambda: file.exists() and file.read_text().strip().endswith("}"), "the scheduler did not start")
    return process, json.loads(file.read_text())["address"]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler without workers."""
    process, address = start_scheduler(tmp_path_factory.mktemp("scheduler"))
    yield address
    process.kill()
    process.wait()


@pytest.fixture
def workers(scheduler, tmp_path, request):
    """Two workers of one thread, without a nanny: one that is killed stays dead. A parameter is a moment to stop at."""
    arguments = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(tmp_path / "dask"))
    stop = {"pause": request.param, "mark": tmp_path / "mark"} if hasattr(request, "param") else {}
    found = [start("worker", scheduler, *arguments, **stop) for _ in range(2)]
    yield found
    for process in found:
        process.kill()
        process.wait()


def lines(folder) -> list[dict]:
    try:
        return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    except (OSError, ValueError):
        return []


def running(folder) -> list[int]:
    """Processes that were at a sample so far."""
    return [int(line["where"].rpartition(" ")[2]) for line in lines(folder) if line["state"] == "running"]


@pytest.mark.parametrize("workers", ["solving"], indirect=True)
def test_a_killed_worker_costs_nothing_and_the_bytes_are_the_same_as_on_one_machine(scheduler, workers, tmp_path):
    out, folder = tmp_path / "plates.h5", tmp_path / "plates.h5.parts"
    solver, manifest = [], []

    def kill_a_worker():
        solver.append(paused_process(tmp_path / "mark"))  # in the middle of a sample
        wait_for(lambda: solver[0] in running(folder), "the sample is not in the manifest")
        manifest.append(open(folder / "manifest.jsonl"))  # noqa: SIM115 (to be read when the folder is removed)
        dask_worker = psutil.Process(solver[0]).ppid()
        assert dask_worker in [process.pid for process in workers]
        os.kill(dask_worker, signal.SIGKILL)

    killer = threading.Thread(target=kill_a_worker)
    killer.start()
    generate("deforming_plate", out, **COUNTS, scheduler=scheduler, **SETTINGS)
    killer.join()
    wait_for(lambda: not is_running(solver[0]), "the solver outlived its Dask worker")
    with manifest[0] as file:
        history = [json.loads(line) for line in file]
    killed = next(line["sample"] for line in history if line.get("where", "").endswith(f" {solver[0]}"))
    for name in ("train/000000", "train/000001", "test/000000"):
        begun = ["running"] * (2 if name == killed else 1)
        assert [line["state"] for line in history if line["sample"] == name] == ["pending", *begun, "done"]
    assert (tmp_path / "resumed").exists()  # the other worker sees the folder and went on from the last frame
    assert not folder.exists()
    generate("deforming_plate", tmp_path / "here.h5", **COUNTS, **SETTINGS)
    assert out.read_bytes() == (tmp_path / "here.h5").read_bytes()


def test_solvers_end_when_the_generator_is_killed(scheduler, workers, tmp_path):
    folder = tmp_path / "plates.h5.parts"
    script = (
        "from ast_sim.simulate.jobs.generate import generate;"
        f"generate('deforming_plate', 'plates.h5', train=1, valid=0, test=0, nodes=2000, scheduler={scheduler!r})"
    )
    with subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, env=environment()) as process:
        wait_for(lambda: running(folder), "the sample never began")
        (solver,) = running(folder)
        assert is_running(solver)
        process.kill()
    wait_for(lambda: not is_running(solver), "the solver goes on for nobody")
    assert all(process.poll() is None for process in workers)


def test_a_scheduler_that_goes_away_is_one_clear_error(tmp_path, monkeypatch, capfd):
    process, address = start_scheduler(tmp_path)
    line = SceneProgress.line

    def kill_the_scheduler(bar, text):
        if "has no workers yet: waiting for them" in text:  # the client is connected
            process.kill()
            process.wait()
        line(bar, text)

    monkeypatch.setattr(SceneProgress, "line", kill_the_scheduler)
    with pytest.raises(AstSimError, match=f"scheduler at {address} went away. The finished samples are kept") as caught:
        generate("deforming_plate", tmp_path / "plates.h5", **COUNTS, scheduler=address, **SETTINGS)
    assert type(caught.value) is AstSimError
    assert process.returncode == -signal.SIGKILL
    assert "Traceback" not in capfd.readouterr().err


def test_a_worker_that_is_set_up_differently_is_refused(scheduler, workers, tmp_path, monkeypatch):
    def older(recipe):
        return {**recorded(recipe), "versions": {**recorded(recipe)["versions"], "numpy": "1.0"}}

    monkeypatch.setattr(cluster, "recorded", older)
    message = r"train/000000: the worker is set up differently: versions: numpy [2-9].* on the worker, 1.0 at the cli"
    with pytest.raises(SimulationError, match=message):
        generate("deforming_plate", tmp_path / "a.h5", train=1, valid=0, test=0, scheduler=scheduler, **SETTINGS)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:{port}", "nowhere"])
def test_a_scheduler_that_cannot_be_reached(tmp_path, monkeypatch, address):
    monkeypatch.setattr(cluster, "SECONDS_TO_CONNECT", 0.5)
    with socket.socket() as taken:  # bound, but nobody listens
        taken.bind(("127.0.0.1", 0))
        address = address.format(port=taken.getsockname()[1])
        with pytest.raises(ConfigError, match=f"the scheduler at {address} cannot be reached within 0.5 s"):
            generate("deforming_plate", tmp_path / "a.h5", train=1, valid=0, test=0, scheduler=address, **SETTINGS)


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r'distributed .*: pip install "ast_sim\[cluster\]"'):
        generate(
            "deforming_plate", tmp_path / "a.h5", train=1, valid=0, test=0, scheduler="tcp://127.0.0.1:8786", **SETTINGS
        )
