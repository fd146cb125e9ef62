"""The force of an answer: from predicted reactions by the network alone, from the positions after Newton steps."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from simulate.own_assembly.assemblies import write_assembly

import ast_sim
from ast_sim.inference.quantities.band import compared
from ast_sim.named_field import REACTION

EXACT = ast_sim.Effort.exact()


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    """A run that predicts reactions, though it has learnt little, and a plate of the bundled solver."""
    folder = tmp_path_factory.mktemp("force")
    path = folder / "d.h5"
    counts = {"train": 2, "valid": 1, "test": 1}
    ast_sim.generate("deforming_plate", path, **counts, nodes=400, frames=41, keep=(14, 24), progress=False)
    run = ast_sim.train(path, folder / "run", steps=2, batch_size=1, state=(REACTION,), progress=False)
    with ast_sim.Dataset(path) as data:
        return run, data["test"][0]


def test_the_network_alone_predicts_it_and_an_exact_answer_has_the_right_one(plate):
    run, truth = plate
    moved = truth.scene.body == 1
    alone = run.predict(truth, effort=ast_sim.Effort())
    predicted = alone.fields[REACTION].values.astype(float)[:, moved].sum(axis=1)
    np.testing.assert_allclose(alone.reaction(), predicted, atol=1e-9)
    assert alone.errors(truth)["reaction"] > 0.1  # two steps teach little
    finished = run.predict(truth, effort=ast_sim.Effort.exact())
    assert finished.errors(truth)["reaction"] < 0.01
    by_law = replace(finished, fields={}).reaction()
    assert np.array_equal(finished.reaction(), by_law) and not np.allclose(by_law, predicted, rtol=0.1)


@pytest.mark.parametrize("effort", [ast_sim.Effort(newton_steps=1), ast_sim.Effort(newton_steps=3), EXACT])
def test_an_answer_holds_one_force(plate, effort, tmp_path):
    """After Newton steps the predicted reactions would belong to other positions: no answer and no file has them."""
    run, truth = plate
    answer = run.predict(truth, effort=effort)
    assert answer.fields == {} and answer.frame(2).fields == {} and len(answer.last_steps) == 2
    assert answer.errors(answer.trajectory) == {"displacement": 0, "reaction": 0, "stress": 0}
    answer.save(tmp_path / "a.h5")
    with ast_sim.Dataset(tmp_path / "a.h5") as data:
        assert data["test"][0].fields == {}
    answer.save(tmp_path / "a.vtkhdf")
    with h5py.File(tmp_path / "a.vtkhdf") as file:
        assert "von_mises" in file["VTKHDF/PointData"] and "reaction" not in file["VTKHDF/PointData"]
    assert np.linalg.norm(answer.body_forces()[-1].force) == pytest.approx(np.linalg.norm(answer.reaction()[-1]))


def test_the_true_reactions_of_a_file_are_the_force_of_the_true_positions(plate):
    run, truth = plate
    answer = run.predict(truth, effort=ast_sim.Effort())
    true = replace(answer, position=truth.position, fields=truth.fields)
    np.testing.assert_allclose(true.reaction(), replace(true, fields={}).reaction(), rtol=2e-3, atol=0.05)
    assert np.linalg.norm(true.reaction(), axis=1)[1:] == pytest.approx(truth.attributes["reaction"][1:], rel=1e-4)


@pytest.mark.parametrize("effort", [ast_sim.Effort(), ast_sim.Effort(newton_steps=1)])
def test_a_force_is_compared_with_the_stored_one(plate, effort):
    """Of data that follow another law than ours, or in which a tool presses on held nodes: positions do not tell."""
    run, truth = plate
    stored = truth.fields[REACTION]
    other = replace(truth, fields={REACTION: replace(stored, values=3 * stored.values)})
    answer = run.predict(truth, effort=effort)
    force = np.linalg.norm(answer.reaction()[-1] - other.fields[REACTION].values[-1, answer.driven.nodes].sum(axis=0))
    true = 3 * truth.attributes["reaction"][-1]
    assert answer.errors(other)["reaction"] == pytest.approx(force / true, rel=1e-3)
    assert compared(answer, other)["reaction"].errors[-1] == pytest.approx(force, rel=1e-3)


BUSH = """
unit = "mm"
frames = 3
order = 1
[parameters]
aside = [0.2, 0.5]
[parts.bush]
file = "block.vtu"
young = 1e6
poisson = 0.3
fixed = "zmin"
[[parts.bush.move]]
where = "zmax and x<4"
translation = ["aside", 0, -0.4]
[[parts.bush.move]]
where = "zmax and x>6"
translation = [0, "-aside", 0.3]
[parts.far]
file = "punch.vtu"
rigid = true
offset = [12, 0, 0]
"""


@pytest.fixture(scope="module")
def bush(tmp_path_factory):
    """An exact answer to a bush, held at its bottom and moved at two ends of its top; one of the network alone; the
    simulation."""
    folder = tmp_path_factory.mktemp("bush")
    write_assembly(folder, BUSH)
    path = folder / "d.h5"
    counts = {"train": 2, "valid": 1, "test": 1}
    ast_sim.generate("assembly", path, spec=folder / "SPEC.toml", **counts, workers=1, progress=False)
    run = ast_sim.train(path, folder / "run", steps=2, batch_size=1, state=(REACTION,), progress=False)
    with ast_sim.Dataset(path) as data:
        truth = data["test"][0]
    return run.predict(truth, effort=EXACT), run.predict(truth, effort=ast_sim.Effort()), truth


def ends_of(scene):
    """The held bottom of the bush and the two ends of its top, [N] bool each."""
    x, _, z = scene.rest_position.T
    own = (scene.body == 0) & scene.prescribed
    low, high, middle = z[own].min(), z[own].max(), np.median(x[scene.body == 0])
    ends = [own & (z == low), own & (z == high) & (x < middle), own & (z == high) & (x > middle)]
    assert np.array_equal(sum(ends), own) and all(end.any() for end in ends)
    return ends


def test_the_force_on_any_prescribed_nodes(bush):
    """The ends of a bush balance each other, and add up to the force on the body; each is the one of the solver."""
    exact, _, truth = bush
    ends = ends_of(exact.scene)
    bottom, *top = forces = [exact.reaction(nodes) for nodes in ends]
    size = np.linalg.norm(bottom[-1])
    assert size > 1 and np.linalg.norm(top[0][-1] - top[1][-1]) > 0.5 * size
    np.testing.assert_allclose(bottom + sum(top), 0, atol=2e-3 * size)
    whole = [row.force for row in exact.body_forces() if row.body == 0]
    np.testing.assert_allclose(sum(forces), whole, atol=2e-3 * size)
    np.testing.assert_allclose(exact.reaction(ends[1] | ends[2]), sum(top), atol=2e-3 * size)
    stored = truth.fields[REACTION].values
    for nodes, force in zip(ends, forces, strict=True):
        np.testing.assert_allclose(force[1:], stored[1:, nodes].sum(axis=1), atol=5e-3 * size)
    assert np.array_equal(exact.reaction(np.flatnonzero(ends[0])), bottom)
    assert np.array_equal(exact.reaction(np.flatnonzero(ends[0]).tolist()), bottom)
    assert np.array_equal(exact.reaction(exact.driven.nodes), exact.reaction())


def test_the_predicted_force_on_any_prescribed_nodes_is_their_sum(bush):
    _, alone, _ = bush
    tool = np.flatnonzero(alone.scene.body == 1)
    for nodes in (*ends_of(alone.scene), alone.scene.body == 1, tool[:3], alone.scene.prescribed):
        predicted = alone.fields[REACTION].values[:, nodes].astype(float).sum(axis=1)
        np.testing.assert_allclose(alone.reaction(nodes), predicted, atol=1e-9 + 1e-6 * abs(predicted).max())


def test_nodes_on_which_nothing_acts_from_outside_are_refused(bush):
    exact = bush[0]
    count, free = exact.scene.num_nodes, np.flatnonzero(~exact.scene.prescribed)
    prescribed, tool = count - len(free), exact.scene.body == 1
    for nodes, text in (
        (
            free[:3],
            f"3 nodes of the wanted force are free, the first is node {free[0]}: .* {prescribed} prescr",
        ),
        (np.ones(count, bool), f"{len(free)} nodes of the wanted force are free"),
        (free[-1:], f"1 node of the wanted force is free, the first is node {free[-1]}"),
        ([count], f"there is no node {count}; the scene has {count} nodes"),
        ([-1], "there is no node -1"),
        (np.zeros(count, bool), "nodes names none"),
        (np.ones(3, bool), rf"nodes holds bool in the shape \[3\]; must be \[{count}\] bool, or numbers of nodes"),
        (np.ones((count, 1), bool), rf"nodes holds bool in the shape \[{count}, 1\]; must"),
        ([], r"nodes holds float64 in the shape \[0\]; must"),
        ([0.5], r"nodes holds float64 in the shape \[1\]; must"),
        ([[0], [1, 2]], "nodes"),
        ("zmin", "nodes holds <U4 in the shape"),
        (np.flatnonzero(tool)[:5], f"body 1 is rigid, .*: {tool.sum() - 5} nodes of {tool.sum()} left out; name all"),
    ):
        with pytest.raises(ast_sim.AstSimError, match=text):
            exact.reaction(nodes)
