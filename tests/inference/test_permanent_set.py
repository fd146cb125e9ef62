"""What stays of a body that yields, as an answer says it: which bodies, in which frame, and where nothing stays."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import toy

from ast_sim import Material
from ast_sim.inference.answer import Answer
from ast_sim.inference.quantities.forces_and_figures import told_sets
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.permanent_set import BACK, OFFSET
from ast_sim.mechanics.physics_check import Law
from ast_sim.named_field import REACTION, NamedField
from ast_sim.scene import NodeType

PLATE, BLOCK, LAST = 0, 1, 6
METAL = Law(Material(("young", "poisson", "yield_stress")), 0.0)
DENT = np.array([0.003, 0.004, 0.0])  # of two nodes; its length is 0.005


def pressed(frames=tuple(range(LAST + 1)), stress=3e8, node_type=None):
    """An answer in which a block presses a plate until frame 3 and is back in frame 6; two free nodes keep a dent."""
    truth = toy.plate(0)
    elements = truth.scene.deforming_elements[:, None]
    scene = replace(truth.scene, material=np.float32([2e11, 0.3, stress]) * elements)
    if node_type is not None:
        scene = replace(scene, node_type=node_type(scene))
    position = truth.position.copy()
    dented = np.flatnonzero(~scene.prescribed & (scene.body == PLATE))[:2]
    position[LAST, dented] += DENT.astype(np.float32)
    forces = NamedField(np.zeros((len(frames), scene.num_nodes, 3), np.float32), "node", "N")
    return Answer(
        "scene",
        scene,
        position[list(frames)],
        None,
        1,
        [],
        info=toy.info(),
        frames=frames,
        driven=Driven.of(scene, position),
        law=METAL,
        fields={REACTION: forces},
    )


@pytest.mark.parametrize("frames", [tuple(range(LAST + 1)), (LAST,), (LAST, 3)])
def test_it_is_the_largest_and_the_mean_displacement_that_is_left(frames, tmp_path):
    answer = pressed(frames)
    free = (answer.scene.body == PLATE) & ~answer.scene.prescribed
    (one,) = answer.permanent_set()
    assert (one.frame, one.body) == (LAST, PLATE)
    assert one.largest == pytest.approx(0.005, rel=1e-4) and one.mean == pytest.approx(0.01 / free.sum(), rel=1e-4)
    on_average = f"{0.01 / free.sum():.3g} m on average over its free nodes (frame {LAST})"
    assert told_sets(answer) == [f"permanent set of body 0: 0.005 m at most, {on_average}"]
    assert "permanent set: 0.005 m" in repr(answer)
    answer.save_forces(tmp_path / "forces.csv")
    answer.save(tmp_path / "answer.csv")
    forces, figures = (list(csv.DictReader((tmp_path / name).open())) for name in ("forces.csv", "answer.csv"))
    assert len(forces) == 2 * len(frames) and len(figures) == len(frames)
    kept = [row for row in forces if row["permanent_set"]]
    assert [(row["frame"], row["body"]) for row in kept] == [(str(LAST), str(PLATE))]
    assert (float(kept[0]["permanent_set"]), float(kept[0]["mean_permanent_set"])) == one[2:]
    assert {row["frame"]: row["permanent_set"] for row in figures if row["permanent_set"]} == {
        str(LAST): str(one.largest)
    }


def test_a_body_without_prescribed_nodes_has_one_and_a_row_of_its_own(tmp_path):
    """A blank between tools."""
    answer = pressed(node_type=lambda scene: np.where(scene.body == PLATE, 0, scene.node_type).astype(np.uint8))
    (one,) = answer.permanent_set()
    assert one.body == PLATE and one.largest > 0.0049
    answer.save_forces(tmp_path / "forces.csv")
    *others, last = csv.DictReader((tmp_path / "forces.csv").open())
    assert {row["body"] for row in others} == {str(BLOCK)} and not any(row["permanent_set"] for row in others)
    assert (last["frame"], last["body"], last["force_x"]) == (str(LAST), str(PLATE), "")
    assert float(last["permanent_set"]) == one.largest


@pytest.mark.parametrize("frames", [(0,), (0, 1, 2, 3), (5, 2)])
def test_there_is_none_before_the_tool_is_back(frames, tmp_path):
    answer = pressed(frames)
    assert answer.permanent_set() == told_sets(answer) == [] and "permanent set" not in repr(answer)
    answer.save_forces(tmp_path / "forces.csv")
    assert "permanent" not in (tmp_path / "forces.csv").read_text()
    assert all("permanent_set" not in row for row in answer.figures())


@pytest.mark.parametrize("share", [0.5, 2])
def test_back_is_a_thousandth_of_the_way(share):
    answer = pressed()
    block = answer.scene.body == BLOCK
    way = np.abs(answer.position[:, block] - answer.scene.rest_position[block]).max()
    answer.position[LAST, block, 2] += share * BACK * way
    assert len(answer.permanent_set()) == (share < 1)


def test_all_prescribed_nodes_must_be_back():
    answer = pressed()
    held = np.flatnonzero(answer.scene.prescribed & (answer.scene.body == PLATE))
    answer.position[LAST, held[0], 0] += 0.01
    assert not answer.permanent_set()


def test_bodies_that_do_not_yield_have_none():
    assert not pressed(stress=0).permanent_set()
    elastic = replace(pressed(), law=Law(Material(("young", "poisson", "number")), 0.0))
    assert not elastic.permanent_set() and not replace(elastic, law=None).permanent_set()


@pytest.mark.parametrize("at", ["node", "element"])
def test_without_a_yield_stress_bodies_with_a_plastic_strain_have_one(at):
    """As in results of Abaqus, which have no material: with as much strain as defines a yield stress, in that frame."""
    answer = replace(pressed(), law=None)
    body = answer.scene.body if at == "node" else answer.scene.body[answer.scene.elements[:, 0]]
    for frame, strain, count in ((LAST, 1.01 * OFFSET, 1), (LAST, 0.99 * OFFSET, 0), (LAST - 1, 1.01 * OFFSET, 0)):
        values = np.zeros((LAST + 1, len(body), 1), np.float32)
        values[frame, np.flatnonzero(body == PLATE)[5]] = strain
        left = replace(answer, fields={"PEEQ": NamedField(values, at)}).permanent_set()
        assert [one.body for one in left] == [PLATE] * count
    assert left == [] != pressed().permanent_set()


def test_with_inertia_there_is_none():
    assert not replace(pressed(), given=2).permanent_set()


def test_a_body_that_is_held_and_driven_is_not_let_go():
    """Its ends are back in their places, but under load; driven at one end alone, it is free."""
    answer = pressed()
    ends = answer.scene.prescribed & (answer.scene.body == PLATE)
    right = ends & (answer.scene.rest_position[:, 0] > 0)
    path = np.repeat(answer.scene.rest_position[None, right], LAST + 1, axis=0).astype(float)
    path[3] += 0.05
    driven = replace(answer, driven=Driven(PLATE, right, path))
    assert not driven.permanent_set()
    free = np.where(ends & ~right, NodeType.NORMAL, answer.scene.node_type).astype(np.uint8)
    (one,) = replace(driven, scene=replace(answer.scene, node_type=free)).permanent_set()
    assert one.body == PLATE
