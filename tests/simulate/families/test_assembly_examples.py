"""The two products of the examples: what a user finds in the repository is meshed by gmsh and solved to the end."""

from pathlib import Path

import numpy as np
import pytest

from ast_sim.scene import NodeType
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.mark.parametrize(
    ("product", "nodes", "moving", "hold"),
    [("bumper", 400, 1, NodeType.OBSTACLE), ("snap_hook", 400, 0, NodeType.HANDLE)],
)
def test_an_example_is_solved(product, nodes, moving, hold):
    spec = read_spec(EXAMPLES / product / "SPEC.toml")
    assembly.check_spec(spec, None, spec.frames)
    drawn = assembly.scene_of(spec, completed(spec.parameters, {}), nodes, 3)
    scene = drawn.case.scene
    assert scene.num_nodes == pytest.approx(nodes, rel=0.15)
    found = assembly.in_newton(assembly.solve(drawn.case), spec.unit)
    assert found.attributes["status"] == "complete" and found.attributes["min_gap"] > 0
    moved = np.linalg.norm(found.position[-1] - found.position[0], axis=1)
    travel = completed(spec.parameters, {})["travel"]
    driven = (scene.body == moving) & (scene.node_type == hold)
    assert moved[driven] == pytest.approx(travel, rel=1e-5)
    assert moved[scene.node_type == NodeType.NORMAL].max() > 0.3 * travel
    assert found.attributes["reaction"][-1] > 1  # newton
