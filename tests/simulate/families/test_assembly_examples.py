"""The products of the examples: what a user finds in the repository is meshed by gmsh, two are solved to the end, and
nothing looks wrong in any of them."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

from ast_sim.dataset.contents import describe_dataset
from ast_sim.plausibility.topology import at_rest
from ast_sim.scene import NodeType
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import read_spec

EXAMPLES = Path(__file__).parents[3] / "examples"

# What a mesh generator may say of a mesh that is as it should be: whether it does depends on its version.
AS_IT_SHOULD_BE = r".*: \d+ slivers? mended"


def checked(product):
    """The specification of a product; the check of all its scenes has warned of nothing."""
    spec = read_spec(EXAMPLES / product / "SPEC.toml")
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        assembly.check_spec(spec, None, spec.frames)
    told = [str(one.message) for one in warned if issubclass(one.category, UserWarning)]
    assert [one for one in told if not re.fullmatch(AS_IT_SHOULD_BE, one)] == []
    return spec


@pytest.mark.parametrize(
    ("product", "nodes", "moving", "hold"),
    [("bumper", 400, 1, NodeType.OBSTACLE), ("snap_hook", 400, 0, NodeType.HANDLE)],
)
def test_an_example_is_solved(product, nodes, moving, hold):
    spec = checked(product)
    drawn = assembly.scene_of(spec, completed(spec.parameters, {}), nodes, 3)
    scene = drawn.case.scene
    assert at_rest(scene) == []
    assert scene.num_nodes == pytest.approx(nodes, rel=0.15)
    found = assembly.in_newton(assembly.solve(drawn.case), spec.unit)
    assert found.attributes["status"] == "complete" and found.attributes["min_gap"] > 0
    moved = np.linalg.norm(found.position[-1] - found.position[0], axis=1)
    travel = completed(spec.parameters, {})["travel"]
    driven = (scene.body == moving) & (scene.node_type == hold)
    assert moved[driven] == pytest.approx(travel, rel=1e-5)
    assert moved[scene.node_type == NodeType.NORMAL].max() > 0.3 * travel
    assert found.attributes["reaction"][-1] > 1  # newton


def test_nothing_looks_wrong_in_the_clip():
    """In the scenes of the specification, meshed and not solved."""
    spec = checked("clip")
    case = assembly.scene_of(spec, completed(spec.parameters, {}), None, spec.frames).case
    assert at_rest(case.scene) == []


def test_nothing_looks_wrong_in_the_test_scenes_of_the_clip():
    """As `info` looks at them, which looks for more than a training does."""
    assert describe_dataset(EXAMPLES / "clip" / "test_scenes.h5")["looks_wrong"] == []


def test_every_product_is_tested():
    assert {path.parent.name for path in EXAMPLES.glob("*/SPEC.toml")} == {"bumper", "snap_hook", "clip"}
