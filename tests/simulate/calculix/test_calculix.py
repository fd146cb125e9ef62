"""CalculiX as the referee: closed forms, agreement with the own solver, the readers on what it writes, errors."""

import io
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ast_sim.mechanics import quasi_static
from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.scene import NodeType, Scene, Trajectory
from ast_sim.simulate.calculix import program
from ast_sim.simulate.calculix import solve as calculix
from ast_sim.simulate.calculix.ccx_results import read_increments, read_results
from ast_sim.simulate.calculix.deck import Increments, contact_stiffness, slave_first, write_deck
from ast_sim.simulate.calculix.solve import CalculixSettings
from ast_sim.simulate.shapes import mesh
from ast_sim.support.errors import MissingExtra, SimulationError
from benchmarks.simulation.calculix import agrees, compare, with_crush

YOUNG, POISSON = 1e6, 0.4
CONTACT = ContactSettings(dhat=1e-3, stiffness=YOUNG)


def box(size, cells, keep=None) -> tuple[np.ndarray, np.ndarray]:
    coordinates, elements = mesh.hexahedral_grid(cells, keep)
    return (coordinates / np.array(cells) - [0.5, 0.5, 0]) * size, elements


def uniaxial(stretches: np.ndarray) -> SolidCase:
    """A block whose end faces follow the homogeneous uniaxial deformation diag(sqrt(s), sqrt(s), stretch)."""
    position, elements = box([0.3, 0.4, 0.5], (2, 3, 4))
    ends = np.isin(position[:, 2], [0, 0.5])
    scene = Scene(
        position.astype(np.float32),
        elements.astype(np.int32),
        np.where(ends, NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8),
        np.zeros(len(position), np.int32),
    )
    lateral = np.sqrt(lateral_square(stretches))
    scale = np.stack([lateral, lateral, stretches], axis=1)
    targets = scene.rest_position.astype(float) * scale[:, None, :]
    return SolidCase(scene, targets, NeoHookean(YOUNG, POISSON), CONTACT, "element")


def lateral_square(stretch):
    material = NeoHookean(YOUNG, POISSON)
    mu, lam = material.mu, material.lam
    return (-mu + np.sqrt(mu**2 + lam * stretch**2 * (2 * mu + lam))) / (lam * stretch**2)


def squeezed(crush=0.2, frames=5, friction=0.0, materials=((YOUNG, POISSON), (2 * YOUNG, 0.3)), order=1) -> SolidCase:
    """A block with a boss under a block, clamped at the bottom and pushed down at the top; elements of second order are
    twice as large."""
    keep = np.ones((6, 6, 6), bool)
    keep[:, :, 4:] = False
    keep[1:5, 1:5, :] = True
    if order == 1:
        (lower, lower_elements), (upper, upper_elements) = (
            box([0.8, 0.8, 0.5], (6, 6, 6), keep),
            box([0.7, 0.6, 0.4], (5, 4, 4)),
        )
    else:
        keep = np.ones((4, 4, 3), bool)
        keep[:, :, 2] = False
        keep[1:3, 1:3, :] = True
        (lower, lower_elements), (upper, upper_elements) = (
            mesh.second_order(*box([0.8, 0.8, 0.5], (4, 4, 3), keep)),
            mesh.second_order(*box([0.7, 0.6, 0.4], (3, 2, 2))),
        )
    upper = upper + [0, 0, 0.5 + 2 * CONTACT.dhat]
    position = np.concatenate([lower, upper])
    body = np.repeat([0, 1], [len(lower), len(upper)]).astype(np.int32)
    top = np.isclose(position[:, 2], position[:, 2].max())
    node_type = np.where(top | (position[:, 2] == 0), NodeType.HANDLE, NodeType.NORMAL).astype(np.uint8)
    elements = np.concatenate([lower_elements, upper_elements + len(lower)]).astype(np.int32)
    scene = Scene(position.astype(np.float32), elements, node_type, body)
    way = np.linspace(0, 1, frames)[:, None, None] * np.where(top[:, None], [0, 0, -crush * position[:, 2].max()], 0)
    material = NeoHookean(*np.array(materials)[body[elements[:, 0]]].T)
    contact = ContactSettings(CONTACT.dhat, YOUNG, friction)
    return SolidCase(scene, scene.rest_position.astype(float) + way, material, contact, "element", {"kind": "boss"})


def pressed() -> SolidCase:
    """A plate between clamps and a rigid ball that comes down on it and goes back, faster and slower."""
    plate, plate_elements = mesh.plate((0.5, 0.3, 0.04), (12, 6, 2), np.zeros((0, 3)))
    ball, ball_elements = mesh.ball(0.05, 8)
    ball = ball + [0.03, 0.02, 0.02 - ball[:, 2].min() + 0.005]
    position = np.concatenate([plate, ball])
    body = np.repeat([0, 1], [len(plate), len(ball)]).astype(np.int32)
    node_type = np.where(body == 1, NodeType.OBSTACLE, NodeType.NORMAL).astype(np.uint8)
    node_type[: len(plate)][np.isclose(np.abs(plate[:, 0]), 0.25)] = NodeType.HANDLE
    elements = np.concatenate([plate_elements, ball_elements + len(plate)]).astype(np.int32)
    scene = Scene(position.astype(np.float32), elements, node_type, body)
    depth = np.array([0, 0.03, 0.05, 0.04])
    way = np.where(body[:, None] == 1, [0.1, 0, -1.0], 0)
    targets = scene.rest_position.astype(float) + depth[:, None, None] * way
    contact = ContactSettings(dhat=2e-4, stiffness=YOUNG)
    return SolidCase(scene, targets, NeoHookean(YOUNG, POISSON), contact, "node")


def test_a_uniaxially_deformed_block_has_the_stress_of_the_closed_form():
    stretches = np.array([1, 1.1, 1.3, 0.8])
    case = uniaxial(stretches)
    solved = calculix.quasi_static(case)
    assert solved.attributes["status"] == "complete" and solved.attributes["solver"].startswith("calculix 2")
    solved.check(stress_location="element")
    np.testing.assert_allclose(
        solved.position, case.prescribed_position, atol=2e-6
    )  # the deformation is affine everywhere
    s = lateral_square(stretches)
    sigma = case.material.mu * (stretches**2 - s) / (stretches * s)
    expected = np.zeros((4, case.scene.num_elements, 6))
    expected[:, :, 2] = sigma[:, None]
    np.testing.assert_allclose(solved.cauchy_stress, expected, atol=1e-4 * YOUNG)
    np.testing.assert_allclose(solved.stress[:, :, 0], np.abs(expected[:, :, 2]), atol=1e-4 * YOUNG)
    # Both ends move sideways; the force is that on the one that goes farther.
    np.testing.assert_allclose(solved.attributes["reaction"][1:], np.abs(sigma[1:]) * s[1:] * 0.3 * 0.4, rtol=1e-3)
    np.testing.assert_allclose(solved.attributes["jacobian"], stretches * s, rtol=1e-4)


@pytest.mark.parametrize(("friction", "order"), [(0.0, 1), (0.3, 1), (0.3, 2)])
def test_both_solvers_agree_on_two_bodies_of_two_materials(friction, order):
    """The elements of second order are C3D10 in CalculiX; at a Poisson's ratio of 0.4 they are the same."""
    case = squeezed(friction=friction, order=order)
    ours, referee = quasi_static(case), calculix.quasi_static(case)
    assert ours.attributes["status"] == referee.attributes["status"] == "complete"
    assert referee.attributes["kind"] == "boss" and referee.attributes["friction"] == friction
    figures = compare(case, ours, referee)
    assert figures["frames"] == 5
    assert agrees(figures), figures
    assert sum(referee.attributes["solve_seconds"]) > 0 and len(referee.attributes["newton_iterations"]) == 5


def test_both_solvers_agree_on_a_rigid_obstacle_on_a_bent_way():
    case = pressed()
    ours, referee = quasi_static(case), calculix.quasi_static(case)
    referee.check(stress_location="node")
    assert referee.attributes["status"] == "complete"
    figures = compare(case, ours, referee)
    assert agrees(figures), figures
    obstacle = case.scene.body == 1
    np.testing.assert_array_equal(
        referee.position[:, obstacle], case.prescribed_position[:, obstacle].astype(np.float32)
    )
    assert (referee.stress[:, obstacle] == 0).all() and referee.cauchy_stress is None


def test_figures_tell_solutions_apart():
    case = squeezed(frames=2)
    rest = case.scene.rest_position
    stress = np.linspace(1, 2, case.scene.num_elements, dtype=np.float32)[None, :, None].repeat(2, axis=0)

    def solution(factor):
        position = (rest + factor * (case.prescribed_position - case.prescribed_position[0])).astype(np.float32)
        position[1, 0] += np.float32(factor * 0.1)  # a free node
        attributes = {"reaction": [0.0, 7 * factor]}
        return Trajectory(case.scene, position, factor * stress, attributes=attributes)

    types = case.scene.node_type.copy()
    types[0] = NodeType.NORMAL
    case = replace(case, scene=replace(case.scene, node_type=types))
    same = compare(case, solution(1.0), solution(1.0))
    assert same == {
        "frames": 2,
        "displacement": 0,
        "displacement_all": 0,
        "displacement_by_frame": [0.0],
        "stress_correlation": pytest.approx(1),
        "mean_stress_ratio": 1,
        "reaction_ratio": 1,
    }
    assert agrees(same)
    larger = compare(case, solution(1.06), solution(1.0))
    for key, value in (("displacement", 0.06), ("mean_stress_ratio", 1.06), ("reaction_ratio", 1.06)):
        assert larger[key] == pytest.approx(value, rel=1e-4)
        assert not agrees({**same, key: larger[key]})
    assert not agrees({**same, "stress_correlation": 0.96})


def test_the_crush_of_a_case_can_be_chosen():
    drawn = squeezed(crush=0.2 + 2 * CONTACT.dhat / 0.902)  # the air between the parts comes on top
    drawn.attributes["crush"] = 0.2
    halved = with_crush(drawn, 0.1)
    travel = (halved.prescribed_position[-1] - halved.prescribed_position[0])[:, 2].min()
    assert travel == pytest.approx(-0.1 * 0.902 - 2 * CONTACT.dhat, rel=1e-6)
    assert halved.attributes["crush"] == 0.1
    np.testing.assert_allclose(with_crush(drawn, 0.2).prescribed_position, drawn.prescribed_position, atol=1e-12)


def test_a_solve_that_does_not_converge_keeps_the_frames_that_did():
    case = uniaxial(np.array([1, 0.9, 0.8, 0.7]))
    case.prescribed_position[3] = case.prescribed_position[2] - [0, 0, 1]
    case.prescribed_position[3, case.prescribed_position[2, :, 2] == 0] += [
        0,
        0,
        1,
    ]  # the ends would have to pass through each other
    solved = calculix.quasi_static(case)
    assert solved.attributes["status"] == "truncated" and solved.num_frames == 3
    expected = "frame 3: no convergence in CalculiX: increment size smaller than minimum"
    assert solved.attributes["stopped_by"] == expected
    solved.check(stress_location="element")
    np.testing.assert_allclose(solved.position, case.prescribed_position[:3], atol=2e-6)
    for record in ("reaction", "halvings", "newton_iterations", "jacobian", "solve_seconds"):
        assert len(solved.attributes[record]) == 3


def test_softer_contact_is_tried_where_stiff_contact_does_not_converge():
    case = squeezed(frames=2)
    ladder = Increments(stiffness=1e9, smallest=0.9), Increments()
    solved = calculix.quasi_static(case, CalculixSettings(ladder=ladder))
    assert solved.attributes["status"] == "complete"
    assert solved.attributes["contact_stiffness"] == contact_stiffness(case)


def test_the_deck_has_a_section_for_each_material_and_the_finer_body_as_slave():
    case = squeezed(friction=0.25)
    lines = deck_of(case)
    sections = [line for line in lines if line.startswith("*SOLID SECTION")]
    assert len(sections) == 2 and all("MATERIAL=CIARLET_EL_" in line for line in sections)
    constants = [lines[n + 1] for n, line in enumerate(lines) if line.startswith("*USER MATERIAL")]
    assert constants == ["1.000000000e+06, 4.000000000e-01", "2.000000000e+06, 3.000000000e-01"]
    pair = next(n for n, line in enumerate(lines) if line.startswith("*CONTACT PAIR"))
    assert lines[pair + 1] == "BODY0, BODY1"  # edges of 0.83/6 against 0.7/5
    assert lines[lines.index("*FRICTION") + 1].startswith("2.500000000e-01, ")
    assert "*FRICTION" not in deck_of(squeezed())
    obstacle = deck_of(pressed())
    pair = next(n for n, line in enumerate(obstacle) if line.startswith("*CONTACT PAIR"))
    assert obstacle[pair + 1] == "BODY0, BODY1"  # an obstacle is the master


def test_the_body_with_the_edge_is_the_slave_of_the_rounded_one():
    ball, ball_elements = mesh.ball(0.3, 8)  # much finer than the block
    block, block_elements = box([0.5, 0.5, 0.5], (1, 1, 1))
    block = block + [0.4, 0, ball[:, 2].max() - 0.06]  # its lower edge above the slope of the ball
    position = np.concatenate([ball, block]).astype(np.float32)
    elements = np.concatenate([ball_elements, block_elements + len(ball)]).astype(np.int32)
    body = np.repeat([0, 1], [len(ball), len(block)]).astype(np.int32)
    scene = Scene(position, elements, np.zeros(len(position), np.uint8), body)
    assert slave_first(scene, 0, 1) == slave_first(scene, 1, 0) == (1, 0)


def deck_of(case) -> list[str]:
    file = io.StringIO()
    write_deck(file, case, Increments())
    return file.getvalue().splitlines()


def test_a_still_case_is_refused():
    case = uniaxial(np.ones(3))
    with pytest.raises(SimulationError, match="needs prescribed nodes that move"):
        deck_of(case)


@pytest.fixture(scope="module")
def output(tmp_path_factory) -> tuple[Path, SolidCase]:
    """The folder of a run of ccx as it stands at the end, and its case."""
    folder, case = tmp_path_factory.mktemp("ccx"), uniaxial(np.array([1, 1.1, 1.2]))
    with open(folder / "case.inp", "w") as file:
        write_deck(file, case, Increments())
    assert program.run(program.find_ccx(), folder, 60) == ""
    return folder, case


def damaged(output, tmp_path, name: str, old: str, new: str) -> None:
    """Read the output with one piece of text replaced where it stands last."""
    folder, case = output
    for file in folder.glob("case.*"):
        shutil.copy(file, tmp_path)
    text = (tmp_path / name).read_text()
    head, found, tail = text.rpartition(old)
    assert found or not old
    (tmp_path / name).write_text(head + new + (tail if new else ""))
    read_results(tmp_path, "case", 2, case.scene.num_nodes, case.scene.num_elements)


def test_output_that_is_damaged_is_refused(output, tmp_path):
    damaged(output, tmp_path, "case.dat", " total force", " total force")
    for name, old, new, message in (
        ("case.frd", " -1  ", "", r"case\.frd is cut off"),
        ("case.frd", " -4  DISP", " -4  ELSE", r"case\.frd holds nothing for frame 2, which converged"),
        ("case.dat", " stresses", "", r"case\.dat holds nothing for frame 2"),
        ("case.dat", "   1 ", "", r"case\.dat is cut off"),
        ("case.dat", "E+0", "x+0", r"case\.dat: could not convert"),
        ("case.sta", "     1 ", "     1 x\n", r"case\.sta: not a line of increments"),
    ):
        with pytest.raises(SimulationError, match=message):
            damaged(output, tmp_path, name, old, new)
    (tmp_path / "case.sta").unlink()
    with pytest.raises(SimulationError, match=r"cannot read what CalculiX wrote: .*case\.sta"):
        read_increments(tmp_path / "case.sta")


def test_a_frame_that_did_not_converge_is_not_read(output, tmp_path):
    folder, case = output
    for file in folder.glob("case.*"):
        shutil.copy(file, tmp_path)
    status = (tmp_path / "case.sta").read_text().splitlines()
    failed = status[3][:18] + status[3][18:].replace(" 1 ", " 1U", 1)
    (tmp_path / "case.sta").write_text("\n".join([*status[:3], failed]))
    results = read_results(tmp_path, "case", 2, case.scene.num_nodes, case.scene.num_elements)
    assert results.displacement.shape[0] == results.stress.shape[0] == results.reaction.shape[0] == 1


def test_exponents_of_three_digits_and_cutbacks_are_read(tmp_path):
    path = tmp_path / "case.sta"
    path.write_text(
        "SUMMARY OF JOB INFORMATION\n  STEP      INC     ATT  ITRS     TOT TIME     STEP TIME      INC TIME\n"
        "     1          1     1U    7  0.000000E+00  0.000000E+00  0.100000E+01\n"
        "     1          1     2     5  0.250000E+00  0.250000E+00  0.250000E+00\n"
        "     1          2     1     4  0.100000E+01  0.100000E+01  0.750000E+00\n"
        "     2          1     1     3  0.200000E+01  0.100000E+01  0.100000E+01\n"
        "     3          1     1     3  0.250000E+01  0.500000E+00  0.500000E+00\n"
    )
    assert read_increments(path) == ([16, 3], [1, 0])
    from ast_sim.simulate.calculix.ccx_results import _numbers

    words = np.array([[b" 1.234567E+05", b"-1.234567-105"]])
    np.testing.assert_array_equal(_numbers(path, words), [[1.234567e5, -1.234567e-105]])


def fake_ccx(tmp_path, monkeypatch, script: str) -> None:
    path = tmp_path / "ccx"
    path.write_text(f'#!/bin/sh\nif [ "$1" = -v ]; then echo "This is Version 2.20"; exit; fi\n{script}\n')
    path.chmod(0o755)
    monkeypatch.setenv("CCX_BIN", str(path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)


def test_a_missing_or_wrong_binary_is_named(tmp_path, monkeypatch):
    case = uniaxial(np.array([1, 1.1]))
    monkeypatch.setenv("CCX_BIN", str(tmp_path / "none"))
    with pytest.raises(MissingExtra, match=r"CCX_BIN=.*none is no program: apt install calculix-ccx"):
        calculix.quasi_static(case)
    monkeypatch.delenv("CCX_BIN")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtra, match=r"ccx is not in PATH .*: apt install calculix-ccx"):
        calculix.quasi_static(case)
    monkeypatch.setenv("CCX_BIN", "/bin/true")
    with pytest.raises(SimulationError, match="/bin/true -v reports no version; is it CalculiX"):
        calculix.quasi_static(case)


def test_a_failed_run_says_why_and_keeps_its_folder(tmp_path, monkeypatch):
    case = uniaxial(np.array([1, 1.1]))
    fake_ccx(tmp_path, monkeypatch, 'printf " *ERROR reading *NODE: no\\n        such thing\\n\\nbye\\n"; exit 201')
    with pytest.raises(
        SimulationError, match=r"code 201: reading \*NODE: no such thing \(deck .* kept in (.*)\)"
    ) as error:
        calculix.quasi_static(case)
    kept = Path(str(error.value).rpartition(" kept in ")[2].rstrip(")"))
    assert (kept / "case.inp").exists() and kept.parent == tmp_path


@pytest.mark.parametrize(
    ("script", "why"), [("exec sleep 10", "did not end within 0.2 s"), ("kill -SEGV $$", "was killed by SIGSEGV")]
)
def test_a_run_that_crashes_or_takes_too_long_leaves_the_frame_at_rest(tmp_path, monkeypatch, script, why):
    """So one scene of many does not end the others."""
    case = uniaxial(np.array([1, 1.1]))
    fake_ccx(tmp_path, monkeypatch, script)
    solved = calculix.quasi_static(case, CalculixSettings(timeout=0.2))
    assert solved.attributes["status"] == "truncated" and solved.attributes["stopped_by"] == f"frame 1: ccx {why}"
    np.testing.assert_array_equal(solved.position, [case.scene.rest_position])
    assert [path.name for path in tmp_path.iterdir()] == ["ccx"]


HEADING = "summary\\nstep\\ncontact\\npercent\\n"


@pytest.mark.parametrize(
    ("script", "ended"),
    [
        (f"printf '{HEADING}1\\n' > case.cvg; exec sleep 10", "hangs: no iteration has ended for "),
        (f"printf '{HEADING}' > case.cvg; exec sleep 10", "did not end within 3 s"),  # of the first one
        (f"printf '{HEADING}1\\n' > case.cvg; for i in $(seq 99); do sleep 0.1; echo $i >> case.cvg; done", "did not"),
        (f"printf '{HEADING}' > case.cvg; sleep 0.9; echo 1 >> case.cvg; exec sleep 10", "did not"),  # as before
    ],
)
def test_a_search_for_contact_that_never_ends_is_given_up(tmp_path, monkeypatch, script, ended):
    """Else each attempt takes the two hours of the timeout."""
    monkeypatch.setattr(program, "SECONDS_BETWEEN_LOOKS", 0.05)
    monkeypatch.setattr(program, "SECONDS_OF_SILENCE", 1.0)
    monkeypatch.setattr(program, "LONGEST", 4)
    fake_ccx(tmp_path, monkeypatch, script)
    settings = CalculixSettings(ladder=(Increments(),), timeout=3)
    solved = calculix.quasi_static(uniaxial(np.array([1, 1.1])), settings)
    assert solved.attributes["status"] == "truncated"
    assert solved.attributes["stopped_by"].startswith(f"frame 1: ccx {ended}")
    assert [path.name for path in tmp_path.iterdir()] == ["ccx"]


def test_an_error_after_a_run_that_crashed_names_its_folder(tmp_path, monkeypatch):
    def refuse(*arguments):
        raise SimulationError("no frame")

    fake_ccx(tmp_path, monkeypatch, "kill -SEGV $$")
    monkeypatch.setattr(calculix, "_trajectory", refuse)
    with pytest.raises(SimulationError, match=r"no frame \(deck and output are kept in .*\)") as error:
        calculix.quasi_static(uniaxial(np.array([1, 1.1])))
    assert (Path(str(error.value).rpartition(" kept in ")[2].rstrip(")")) / "case.inp").exists()


def test_a_run_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    assert calculix.quasi_static(uniaxial(np.array([1, 1.1]))).num_frames == 2
    assert list(tmp_path.iterdir()) == []


def test_metal_follows_its_hardening_and_keeps_its_plastic_strain():
    """A block that is pulled and let go. Its ends follow the motion of J2 flow with isotropic hardening: the plastic
    strain p solves strain = p + Y(p) / E in logarithmic strains; sideways, metal shrinks by p / 2 + poisson Y / E."""
    young, poisson, table = 2e11, 0.3, np.array([[3e8, 0], [5e8, 0.1], [6e8, 0.3]])
    plastic = np.array([0, 0.02, 0.15, 0.15])
    stress = np.interp(plastic, *table.T[::-1]) * [0, 1, 1, 0]
    strain, lateral = plastic + stress / young, -plastic / 2 - poisson * stress / young
    pulled = uniaxial(np.exp(strain))
    targets = pulled.scene.rest_position * np.exp(np.stack([lateral, lateral, strain], axis=1))[:, None]
    case = replace(pulled, prescribed_position=targets, material=NeoHookean(young, poisson), hardening={0: table})
    solved = calculix.quasi_static(case)
    assert solved.attributes["status"] == "complete"
    solved.check(stress_location="element")
    np.testing.assert_allclose(solved.position, targets, atol=3e-4)  # the elastic part is not quite logarithmic
    strains = solved.fields["PEEQ"].values
    # Each increment of CalculiX is too long by half of its own strain, of which the longest has a quarter of a frame's.
    np.testing.assert_allclose(strains, plastic[:, None, None] + 0 * strains, atol=0.15 * (0.14 / 4) / 2)
    np.testing.assert_allclose(solved.stress[:, :, 0], stress[:, None] + 0 * solved.stress[:, :, 0], atol=2e-4 * young)
    forces = solved.fields["reaction"].values
    upper = pulled.scene.rest_position[:, 2] == 0.5
    area = 0.3 * 0.4 * np.exp(2 * lateral)
    np.testing.assert_allclose(forces[:, upper, 2].sum(axis=1), stress * area, atol=2e-4 * young * 0.12)
    assert not forces[:, ~case.scene.prescribed].any()
    with pytest.raises(SimulationError, match="body 0 yields: use CalculiX"):
        quasi_static(case)
