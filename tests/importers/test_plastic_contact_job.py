"""Two bodies of second-order tetrahedra, one of which yields under the other: from CalculiX's files to a prediction of
the plastic strain, of the forces and of the dent that stays."""

import csv
import re
import subprocess

import numpy as np
import pytest
from data_samples import block
from test_jobs import faces_at

import ast_sim
from ast_sim import Dataset, cli
from ast_sim.simulate.shapes.mesh import second_order

GAP, DOWN = 0.01, 0.16  # between the bodies at rest; how far the top of the punch goes


def body_lines(nodes, elements, first, name):
    rows = [f"{first + row}, {x:.9g}, {y:.9g}, {z:.9g}" for row, (x, y, z) in enumerate(nodes)]
    cells = [", ".join(map(str, [first + row, *(first + cell)])) for row, cell in enumerate(elements)]
    return ["*NODE", *rows, f"*ELEMENT, TYPE=C3D10, ELSET={name}", *cells]


def deck():
    """A pad of 2 x 2 x 1, held at its floor, and a punch of 1 x 1 x 1 above its middle, whose top goes down and up."""
    pad, punch = block(2, 2, 1), block(1, 1, 1)
    meshes = [second_order(b.rest_position.astype(float), b.elements) for b in (pad, punch)]
    (low, low_cells), (high, high_cells) = meshes
    high = high + (0.5, 0.5, 1 + GAP)
    top = high[:, 2].max()
    return [
        *body_lines(low, low_cells, 1, "PAD"),
        *body_lines(high, high_cells, 1001, "PUNCH"),
        *["*NSET, NSET=FLOOR", *map(str, 1 + np.flatnonzero(low[:, 2] == 0))],
        *["*NSET, NSET=TOP", *map(str, 1001 + np.flatnonzero(high[:, 2] == top))],
        *["*MATERIAL, NAME=SOFT", "*ELASTIC", "100., 0.3", "*PLASTIC", "4., 0.", "24., 0.5"],
        *["*MATERIAL, NAME=STEEL", "*ELASTIC", "1000., 0.3"],
        *["*SOLID SECTION, ELSET=PAD, MATERIAL=SOFT", "*SOLID SECTION, ELSET=PUNCH, MATERIAL=STEEL"],
        *["*SURFACE, NAME=ABOVE", *(f"{1 + row}, S{side}" for row, side in faces_at(pad, 1))],
        *["*SURFACE, NAME=BELOW", *(f"{1001 + row}, S{side}" for row, side in faces_at(punch, 0))],
        *["*SURFACE INTERACTION, NAME=HARD", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", "2000."],
        *["*CONTACT PAIR, INTERACTION=HARD, TYPE=SURFACE TO SURFACE", "ABOVE, BELOW"],
        *(line for travel in (-DOWN, 0.0) for line in step(travel)),
    ]


def step(travel):
    """The top goes to this place in four increments."""
    return [
        *["*STEP, NLGEOM", "*STATIC, DIRECT", "0.25, 1."],
        *["*BOUNDARY", "FLOOR, 1, 3", "TOP, 1, 2", f"TOP, 3, 3, {travel}"],
        *["*NODE FILE", "U, RF", "*EL FILE", "S, PEEQ", "*END STEP"],
    ]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The dataset of one job."""
    folder = tmp_path_factory.mktemp("yields")
    (folder / "job.inp").write_text("\n".join(deck()) + "\n")
    done = subprocess.run(["ccx", "job"], cwd=folder, check=True, capture_output=True, text=True, timeout=100)
    assert "Job finished" in done.stdout
    units = ["--length-unit", "mm", "--stress-unit", "MPa", "--shares", "1", "0", "0"]
    kept = ["--field", "PEEQ", "--reaction", "RF"]
    files = [str(folder / name) for name in ("job.inp", "job.frd")]
    assert cli.main(["convert", *files, "--out", str(folder / "d.h5"), *units, *kept]) == 0
    return folder / "d.h5"


def relative(predicted, true):
    return np.sqrt(np.mean((predicted - true) ** 2) / np.mean(true**2))


def test_plastic_strain_and_forces_are_predicted(data, tmp_path, capsys):
    run, out, forces = tmp_path / "run", tmp_path / "answer.h5", tmp_path / "forces.csv"
    chosen = ["train.steps=400", "train.batch_size=2", "train.stress_weight=1"]
    settings = [part for setting in chosen for part in ("--set", setting)]
    states = ["--state", "PEEQ", "--state", "reaction"]
    assert cli.main(["train", str(data), "--out", str(run), "--model", "transolver", *states, *settings]) == 0
    options = ["--split", "train", "--index", "0", "--out", str(out), "--forces", str(forces)]
    capsys.readouterr()
    assert cli.main(["predict", str(run), str(data), *options]) == 0
    said = re.findall(r"^permanent set of body (\d): (\S+) mm at most, (\S+) mm on av", capsys.readouterr().out, re.M)
    with Dataset(data) as dataset, Dataset(out) as answers:
        truth, answer = dataset["train"][0], answers["test"][0]
    scene = truth.scene
    assert scene.elements.shape[1] == 10 and 0.05 < truth.fields["PEEQ"].values.max() < 0.5
    for name, unit in (("PEEQ", ""), ("reaction", "N")):
        one = answer.fields[name]
        assert (one.location, one.unit, one.values.shape) == ("node", unit, truth.fields[name].values.shape)
        assert not one.values[0].any()
    assert relative(answer.fields["PEEQ"].values, truth.fields["PEEQ"].values) < 0.1
    assert not answer.fields["reaction"].values[:, ~scene.prescribed].any()
    told = list(csv.DictReader(forces.read_text().splitlines()))
    assert [(row["frame"], row["body"]) for row in told] == [(str(f), b) for f in range(9) for b in "01"]
    top = scene.prescribed & (scene.body == 1)
    pushed = truth.fields["reaction"].values[:, top].sum(axis=1)[:, 2]
    np.testing.assert_allclose([float(row["force_z"]) for row in told[1::2]], pushed, atol=0.1 * abs(pushed[4]))
    assert -30 < pushed[4] < -15 and abs(pushed[-1]) < 0.01
    # The punch is back where it was, and the pad keeps a dent: the permanent set.
    pad = scene.body == 0
    np.testing.assert_allclose(truth.position[-1, top], scene.rest_position[top], atol=1e-6)
    dents = [scene.rest_position[pad] - one.position[-1, pad] for one in (truth, answer)]
    deepest = np.argmax(dents[0][:, 2])
    assert 0.3 * DOWN < dents[0][deepest, 2] < 0.9 * DOWN
    assert dents[1][deepest, 2] == pytest.approx(dents[0][deepest, 2], rel=0.15)
    assert relative(dents[1], dents[0]) < 0.15
    # The answer says so without a hand: of the pad, since the punch does not yield.
    true, left = (np.linalg.norm(dent[~scene.prescribed[pad]], axis=1) for dent in dents)
    assert [body for body, *_ in said] == ["0"]
    largest, mean = map(float, said[0][1:])
    assert (largest, mean) == pytest.approx((left.max(), left.mean()), rel=5e-3)
    assert (largest, mean) == pytest.approx((true.max(), true.mean()), rel=0.2)
    assert float(told[-2]["permanent_set"]) == pytest.approx(largest, rel=5e-3)
    assert [row["permanent_set"] for row in told].count("") == len(told) - 1
    # The law of a body that yields is not known, so the predicted reactions give the force on the driven nodes.
    again = ast_sim.Run(run).predict(truth)
    np.testing.assert_allclose(again.reaction()[:, 2], [float(row["force_z"]) for row in told[1::2]], rtol=1e-5)
    capsys.readouterr()
    assert cli.main(["evaluate", str(run), str(data), "--split", "train", "--solver-scenes", "0"]) == 0
    share = re.search(r"relative: (\S+) % of the root mean square of PEEQ", capsys.readouterr().out)
    assert float(share[1]) == pytest.approx(
        100 * relative(answer.fields["PEEQ"].values, truth.fields["PEEQ"].values), rel=0.05
    )
