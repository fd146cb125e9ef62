"""CalculiX beside the run of the clip: on coarser meshes, with larger increments, and on a finer mesh."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ast_sim.mechanics.case import NEARBY
from ast_sim.simulate.calculix.deck import Increments
from ast_sim.simulate.calculix.solve import YIELDING, CalculixSettings, quasi_static
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.parameters import Values
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.disk import write_json
from ast_sim.support.errors import SimulationError
from benchmarks.studies.clip_outcome import LAST, SPEC, TURN, true_outcome

# Test scenes by which no setting of the run was chosen; `examples/clip/test_scenes.h5` holds them, too.
SCENES = tuple(f"test/{index:06d}" for index in range(16, 26))
TIMEOUT = 600.0  # seconds; the search for contact of CalculiX 2.20 does not end on some meshes


@dataclass(frozen=True)
class Variant:
    """Settings of CalculiX, and the size of its mesh.

    Attributes:
        name: what it is called.
        share: of the nodes of the dataset's meshes.
        increments: of a load step. A step is a frame; with `two_frames` there are two, the ram's way out and back.
        scenes: how many of `SCENES` are solved so.
    """

    name: str
    share: float
    increments: Increments = YIELDING[0]
    two_frames: bool = False
    scenes: int = len(SCENES)


_HALVES, _EIGHTHS = Increments(1.0, 0.5, 0.1), Increments(1.0, 0.125, 0.05)
OWN = "own mesh, as in the dataset"  # the name of what needs no other solve
FINER = Variant("finer mesh", 2.4, _EIGHTHS, two_frames=True, scenes=3)
VARIANTS = (
    FINER,
    Variant("5/7 of the nodes, two steps of 4 increments", 5 / 7, YIELDING[0], True),
    Variant("1/2 of the nodes, as in the dataset", 1 / 2),
    Variant("1/4 of the nodes, two steps of 2 increments", 1 / 4, _HALVES, True),
)


def solved(drawn: Sequence[Values], nodes: int, file: Path) -> dict[str, list[dict[str, Any]]]:
    """For each variant, by its name, what it gave in the first of the scenes.

    Args:
        drawn: the parameters of the scenes.
        nodes: about how many nodes the meshes of the dataset have.
        file: what is there already is not solved again.
    """
    results: dict[str, list[dict[str, Any]]] = json.loads(file.read_text()) if file.exists() else {}
    spec = read_spec(SPEC)
    for scene, values in enumerate(drawn):
        for variant in VARIANTS:
            known = results.setdefault(variant.name, [])
            if len(known) == scene < variant.scenes:
                known.append(_solved(variant, spec, values, nodes))
                write_json(file, results)
    return results


def _solved(variant: Variant, spec: AssemblySpec, values: Values, nodes: int) -> dict[str, Any]:
    """The nodes, the outcome and the processor seconds of the first solve that ends, and why the solves before it
    failed. If a mesh fails, others of nearly that size are tried, as a user would do; failed solves cost nothing."""
    failures = []
    for nearby in NEARBY:
        try:
            case = assembly.scene_of(spec, values, round(nearby * variant.share * nodes), LAST + 1).case
            case = case.keeping((TURN, LAST)) if variant.two_frames else case
            answer = quasi_static(case, CalculixSettings((variant.increments,), TIMEOUT))
        except SimulationError as error:
            failures.append(str(error))
            continue
        if answer.attributes["status"] == "complete":
            seconds = sum(answer.attributes["solve_seconds"])
            outcome = true_outcome(assembly.in_newton(answer, spec.unit))
            return {"nodes": case.scene.num_nodes, **outcome._asdict(), "seconds": seconds, "failures": failures}
        failures.append(str(answer.attributes["stopped_by"]))
    return {"failures": failures}
