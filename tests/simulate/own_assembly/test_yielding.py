"""Parts that yield: what a specification says of them, who solves them, and what is stored."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from simulate.own_assembly.assemblies import STRIP, write_box

from ast_sim import Dataset
from ast_sim.cli import main
from ast_sim.scene import NodeType
from ast_sim.simulate.families import assembly
from ast_sim.simulate.jobs.look import outcome
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.spec_reader import parse_spec, read_spec
from ast_sim.support.errors import ConfigError, SimulationError

CLIP = Path(__file__).parents[3] / "examples" / "clip"
METAL = """law = "elastoplastic"
hardening = [["yields", 0], ["yields + 2e7", "0.1"]]"""
YIELDS = (
    STRIP.format(settings="order = 1")
    .replace("young = 1e9", f"young = 1e9\n{METAL}")
    .replace("down = [1, 2]", "down = [1, 2]\nyields = [1e7, 2e7]")
    .replace('"-0.2 - down"] }', '"-0.2 - down"], [0, 0, 0]] }')
    .replace("translation = [0", "translation = [[0")
)


@pytest.fixture(scope="module")
def strip(tmp_path_factory) -> Path:
    """The specification of a strip that is held at one end and bent at the other."""
    folder = tmp_path_factory.mktemp("strip")
    write_box(folder / "strip.vtu", (0, 0, 0), (10, 2, 1), (5, 1, 1))
    write_box(folder / "roller.vtu", (8, -0.5, 1.2), (9, 2.5, 2.2), (1, 2, 1))
    (folder / "SPEC.toml").write_text(YIELDS)
    return folder / "SPEC.toml"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"elastoplastic"', '"plastic"', r"parts.strip.law is 'plastic'; must be elastoplastic, or neo_hookean"),
        ('law = "elastoplastic"', "", r"parts.strip.hardening: rows of .* go with law = 'elastoplastic', and only"),
        (METAL, 'law = "elastoplastic"', r"parts.strip.hardening: rows of .* go with law = 'elastoplastic', and only"),
        ("rigid = true", 'rigid = true\nlaw = "neo_hookean"', "parts.roller.law: a rigid part has no law"),
        ('["yields", 0]', '["yields"]', r"parts.strip.hardening is .*; must be a list of pairs of numbers"),
        ('["yields", 0]', '["yield", 0]', r"parts.strip.hardening\[0\].*yield"),
    ],
)
def test_a_wrong_law_is_told(old, new, line):
    assert YIELDS.count(old) == 1
    with pytest.raises(ConfigError, match=line):
        parse_spec(Path("SPEC.toml"), YIELDS.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('["yields", 0]', '["yields", 0.01]', "plastic strains, the second numbers, must begin at 0 and ascend"),
        ('"0.1"', '"0.0"', "plastic strains, the second numbers, must begin at 0 and ascend"),
        ('"yields + 2e7"', '"yields - 1e6"', "stresses, the first numbers, must not fall"),
        ('["yields", 0]', '["0 * yields", 0]', r"\[0, 0\], .* stresses must be finite and above 0 \(pascal\)"),
    ],
)
def test_numbers_that_are_no_hardening_are_told(strip, old, new, line):
    spec = parse_spec(strip, YIELDS.replace(old, new))
    with pytest.raises(ConfigError, match=r"with down=1.5, yields=1.5e\+07: parts.strip.hardening is .*" + line):
        assembly.scene_of(spec, completed(spec.parameters, {}), None, 3)


def test_the_own_solver_refuses_what_yields(strip, capsys):
    words = ["generate", "assembly", str(strip), "--out", str(strip.parent / "own.h5"), "--count", "1"]
    assert main([*words, "--solver", "own"]) == 2
    told = "strip: the own solver knows elastic laws only, and this one is elastoplastic: CalculiX solves it"
    assert told in capsys.readouterr().err
    spec = read_spec(strip)
    case = assembly.scene_of(spec, completed(spec.parameters, {}), None, 3).case
    with pytest.raises(SimulationError, match="elastic laws only, but body 0 yields: use CalculiX"):
        assembly.solve(case)


def test_the_material_of_a_scene_has_the_hardening_of_each_part(strip):
    spec = read_spec(strip)
    scene = assembly.scene_of(spec, completed(spec.parameters, {"yields": 1.2e7}), None, 3).case.scene
    metal = scene.body[scene.elements[:, 0]] == 0
    np.testing.assert_allclose(scene.material[metal], np.array([[1e9, 0.3, 1.2e7, 3.2e7, 0.1]]).repeat(metal.sum(), 0))
    assert not scene.material[~metal].any()


def test_scenes_that_calculix_does_not_finish_are_counted_and_located(strip, tmp_path, monkeypatch, capfd):
    crash = tmp_path / "ccx"
    crash.write_text('#!/bin/sh\nif [ "$1" = -v ]; then echo "This is Version 2.20"; exit; fi\nkill -SEGV $$\n')
    crash.chmod(0o755)
    monkeypatch.setenv("CCX_BIN", str(crash))
    words = ["generate", "assembly", str(strip), "--out", str(tmp_path / "d.h5"), "--count", "2", "--workers", "1"]
    assert main([*words, "--valid", "0", "--test", "1"]) == 0
    printed = capfd.readouterr()
    assert "strip: elastoplastic, so CalculiX solves these scenes" in printed.err
    lines = printed.out.splitlines()
    one = r"\(down=(\S+), yields=\S+\) stopped at frame 1: ccx was killed by SIGSEGV"
    down = [
        float(re.fullmatch(rf"{name} {one}", line)[1])
        for name, line in zip(("train/000000", "train/000001", "test/000000"), lines[1:4], strict=True)
    ]
    counted = f"3 of 3 scenes stopped before their last frame, at down {min(down):g} to {max(down):g} of 1 to 2; yields"
    assert lines[4].startswith(counted)


def test_a_look_tells_the_peak_force_and_the_permanent_set(strip, capfd):
    assert main(["generate", "assembly", str(strip), "--look", "--count", "5", "--workers", "1"]) == 0
    told = capfd.readouterr().out
    found = re.search(r"^peak force (\S+) N, permanent set (\S+) mm of (\S+) mm$", told, re.MULTILINE)
    assert float(found[1]) > 0 and 0.1 < float(found[2]) < float(found[3]) < 3
    assert re.search(r"^one scene: \S+ s \(.* s to mesh\), complete$", told, re.MULTILINE)
    assert "at half the size: CalculiX does not start from a coarse solution; at twice the size: the mesh of" in told


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """Two scenes of the example on a coarse mesh; only the travel differs."""
    folder = tmp_path_factory.mktemp("clip")
    shutil.copy(CLIP / "clip.py", folder)
    text = (CLIP / "SPEC.toml").read_text()
    for pattern, one in (
        (r"frames = 7", "frames = 5"),
        (r"length = \[.*?\]", "length = 13"),
        (r"thickness = \[.*?\]", "thickness = 1.0"),
        (r"place = \[.*?\]", "place = 0.5"),
        (r"yield_stress = \[.*?\]", "yield_stress = 3.5e8"),
        (r"file = \[.*?\]", 'file = "clip.py:notches"'),
        (r"travel = \[.*?\]", "travel = [1.0, 2.5]"),
        (r"finer = .*\n", ""),
        (r"size = .*", "size = 6.0"),
    ):
        text, count = re.subn(pattern, one, text)
        assert count >= 1
    (folder / "SPEC.toml").write_text(text)
    words = ["generate", "assembly", str(folder / "SPEC.toml"), "--out", str(folder / "clips.h5"), "--count", "2"]
    assert main([*words, "--valid", "0", "--test", "0", "--workers", "2"]) == 0
    return folder / "clips.h5"


def test_the_clip_keeps_a_set_that_grows_with_the_travel(clips):
    spec = read_spec(clips.with_name("SPEC.toml"))
    sets = {}
    with Dataset(clips) as dataset:
        assert dataset.info.generator["solver"] == "calculix"
        assert dataset.material.columns[:3] == ("young", "poisson", "yield_stress") and dataset.material.law is None
        for index in range(2):
            solved = dataset["train"][index]
            solved.check(stress_location="node")
            scene, attributes = solved.scene, solved.attributes
            assert attributes["status"] == "complete" and scene.elements.shape[1] == 10
            force = attributes["reaction"]
            peak = max(force)
            assert peak == force[2] > 20 and force[-1] < 1e-3 * peak  # newton; the ram has left
            forces = solved.fields["reaction"].values
            of_ram = forces[:, scene.node_type == NodeType.OBSTACLE].sum(axis=1)
            np.testing.assert_allclose(np.linalg.norm(of_ram, axis=1), force, atol=0.01 * peak)
            of_base = forces[:, scene.node_type == NodeType.HANDLE].sum(axis=1)
            np.testing.assert_allclose(of_ram + of_base, 0, atol=0.01 * peak)
            assert not forces[:, ~scene.prescribed].any()
            strain = solved.fields["PEEQ"].values
            assert not strain[0].any() and not strain[:, scene.body == 1].any()
            assert strain[2].max() > 0.01 and np.abs(strain[4] - strain[2]).max() < 0.1 * strain[2].max()
            free = ~scene.prescribed
            way = np.linalg.norm(solved.position - solved.position[0], axis=2)[:, free].max(axis=1)
            assert 0.1 < way[4] < way[2] - 0.2  # some of the way springs back
            sets[attributes["parameter travel"]] = way[4]
            told = f"peak force {peak:.3g} N, permanent set {way[4]:.3g} mm of {way[2]:.3g} mm"
            assert outcome(spec, solved) == told
    (small, little), (large, much) = sorted(sets.items())
    assert large > small + 0.3 and much - little == pytest.approx(large - small, rel=0.4)
