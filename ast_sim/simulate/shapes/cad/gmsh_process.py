"""Solids and CAD files are meshed by gmsh, in a process of its own.

gmsh crashes and hangs on bad geometry, so every call goes to `cad_worker` with a limit on its processor time. Processor
time, unlike the time on the clock, does not depend on what else the machine does. The same request therefore gives the
same mesh, or the same failure. Legend: N nodes, E tetrahedra.
"""

from __future__ import annotations

import functools
import importlib.util
import io
import json
import signal
import subprocess
import sys
from typing import Any

import numpy as np

from ast_sim.simulate.shapes.parts import Part, oriented
from ast_sim.support.environment import SINGLE_THREAD, of_child
from ast_sim.support.errors import MissingExtra, SimulationError

MESHING_MODULE = "ast_sim.simulate.shapes.cad.cad_worker"
WORKER = [sys.executable, "-P", "-m", MESHING_MODULE]
START_SECONDS = 60  # limit on the processor time in which gmsh starts and builds the geometry
NODES_PER_SECOND = 200  # slowest meshing allowed; both limits are ten times the usual time
OWN_SECONDS = 600  # limit where the size of the elements, and so the number of nodes, is the user's
PATIENCE = 30  # on the clock this many times the limit may pass: then gmsh sleeps and is stopped


class MeshingFailed(SimulationError):
    """gmsh refused a part, crashed on it or took too long. It would do so again. The text says which."""


class Crashed(MeshingFailed):
    """gmsh crashed on a part. `said` is the last line that it wrote."""

    def __init__(self, text: str, said: str) -> None:
        super().__init__(text)
        self.said = said


@functools.cache
def gmsh_version() -> str | None:
    """The version of gmsh, or None if it is not installed.

    Raises:
        MissingExtra: gmsh is installed but does not start, because its system libraries are missing.
    """
    if importlib.util.find_spec("gmsh") is None:
        return None
    try:
        return str(_ask({"parts": [], "nodes": 0}, START_SECONDS)["version"])
    except MeshingFailed as error:
        raise MissingExtra(
            f"gmsh is installed but does not start ({error}); on Debian and Ubuntu it needs:"
            " apt install libglu1-mesa libgl1 libxft2 libxcursor1 libxinerama1 libxrender1 libxfixes3"
        ) from error


def mesh_parts(requests: list[dict[str, Any]], names: list[str], nodes: int, seconds: int | None = None) -> list[Part]:
    """Mesh parts with one element size.

    Args:
        requests: one for each part: {"solid": steps of the grammar}, {"step": path} or {"stl": path}. A part from a
            file is scaled to a diagonal of one.
        names: names of the parts.
        nodes: wanted number of nodes of all parts together. The mesh meets it within about a tenth.
        seconds: limit on the processor time, a whole number. If None, the limit follows from the number of nodes.

    Raises:
        MeshingFailed: gmsh cannot mesh a part, crashes on it or works on it too long.
        SimulationError: gmsh was killed, or sleeps. Another attempt may go well.
    """
    answer = _ask({"parts": requests, "nodes": nodes}, seconds or START_SECONDS + nodes // NODES_PER_SECOND)
    result = []
    for i, name in enumerate(names):
        position, elements = answer[f"position_{i}"], answer[f"elements_{i}"]
        result.append(Part(position, oriented(position, elements), name))
    return result


def mesh_own_scale(requests: list[dict[str, Any]]) -> list[dict[str, np.ndarray]]:
    """Mesh parts in the coordinates of their files, each with its own element size.

    Args:
        requests: one for each part, as `ast_sim.simulate.shapes.cad.own_scale` describes them.

    Returns:
        For each part `position` [N,3], `elements` [E,4] or [F,3], `notes` (texts: what was mended), `factor` (the size
        of its elements over the wanted one), `failure` (a text: why the first attempt to mesh it failed; empty if it
        did not), and `group NAME`: the numbers of the nodes of each named group.

    Raises:
        MeshingFailed, SimulationError: as `mesh_parts`; the text names the part or the parts.
    """
    names = " or ".join(dict.fromkeys(part["name"] for part in requests))
    try:
        answer = _past_crashes(requests)
    except MeshingFailed as error:
        named = any(str(error).startswith(part["name"]) for part in requests)
        raise error if named else MeshingFailed(f"{names}: {error}") from error
    meshes: list[dict[str, np.ndarray]] = [{} for _ in requests]
    for key, array in answer.items():
        kind, _, rest = key.removeprefix("own_").partition("_")
        number, _, name = rest.partition("_")
        if key.startswith("own_"):
            meshes[int(number)][f"group {name}" if kind == "group" else kind] = array
    return meshes


def _past_crashes(requests: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """The answer of gmsh. If it crashes in one of the attempts to mesh a part, the next process begins behind it."""
    requests = [dict(request) for request in requests]
    while True:
        try:
            return _ask({"parts": [], "nodes": 0, "own": requests}, OWN_SECONDS)
        except Crashed as error:
            name, _, number = error.said.rpartition(": attempt ")
            tried = [request for request in requests if request["name"] == name and number.isdigit()]
            if not tried or int(number) < tried[0].get("first", 0):
                raise
            tried[0]["first"] = int(number) + 1


def _ask(request: dict[str, Any], seconds: int) -> dict[str, np.ndarray]:
    try:
        done = subprocess.run(
            WORKER,
            input=json.dumps({**request, "seconds": seconds}).encode(),
            capture_output=True,
            timeout=PATIENCE * seconds,
            env=of_child(**SINGLE_THREAD),
        )
    except subprocess.TimeoutExpired:
        raise SimulationError(f"gmsh did not answer within {PATIENCE * seconds} s and was stopped") from None
    last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
    if done.returncode == -signal.SIGXCPU:
        raise MeshingFailed(f"gmsh did not finish within {seconds} s of processor time and was stopped")
    if done.returncode == -signal.SIGKILL:
        raise SimulationError("gmsh was killed by SIGKILL, perhaps because memory ran out: use fewer workers or nodes")
    if done.returncode < 0:
        raise Crashed(f"gmsh crashed ({signal.Signals(-done.returncode).name}): {last}", last)
    if done.returncode:
        raise MeshingFailed(last)
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as file:
        return dict(file)
