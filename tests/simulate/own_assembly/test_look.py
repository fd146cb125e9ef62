"""A look before anything is solved: the picture, what is said of the first scene, and what the dataset will cost."""

import re

import numpy as np
from matplotlib.image import imread
from simulate.own_assembly.assemblies import SPEC, write_assembly

from ast_sim.cli import main


def colors_of(path) -> set[str]:
    picture = np.round(255 * imread(path)[:, :, :3]).astype(int)
    blue = (picture[:, :, 2] > picture[:, :, 0] + 60).sum()
    orange = (picture[:, :, 0] > picture[:, :, 2] + 60).sum()
    red = ((picture[:, :, 0] > 180) & (picture[:, :, 1] < 90) & (picture[:, :, 2] < 90)).sum()
    return {name for name, count in (("blue", blue), ("orange", orange), ("red", red)) if count > 100}


def test_a_look_says_what_was_made_and_what_it_costs(tmp_path, capfd):
    path = write_assembly(tmp_path)
    capfd.readouterr()
    assert main(["generate", "assembly", str(path), "--look", "--count", "50", "--workers", "2"]) == 0
    told = capfd.readouterr().out.splitlines()
    assert told[0] == "block: 75 nodes (50 free, 25 stand still)"
    found = re.fullmatch(r"punch: 27 nodes \(rigid, 27 move up to (.*) mm\)", told[1])
    assert found and 0.5 <= float(found[1]) <= 1.5
    assert told[2] == "block and punch: 0.2 mm apart"
    assert re.fullmatch(r"one scene: .* s \(.* s to mesh\), complete", told[3])
    assert re.fullmatch("force .* N, at half the size .* N: this mesh is .* % off", told[4])
    assert re.fullmatch("--count 50: 60 scenes, about .* with 2 processes", told[5])
    assert told[6] == f"picture: {tmp_path / 'SPEC.look.png'}"
    assert colors_of(tmp_path / "SPEC.look.png") == {"blue", "orange", "red"}
    assert not list(tmp_path.glob("*.h5*"))


def test_a_look_tells_mistakes_and_needs_a_specification(tmp_path, capsys):
    path = write_assembly(tmp_path, SPEC.replace("zmin", "z>9"))
    for words, line in (
        (["assembly", str(path), "--look"], "no node of block .block.vtu. lies in 'z>9'"),
        (["abcd", "--look"], "--look is for a specification"),
        (["assembly", str(path), "--look", "--order", "2"], "leave out --order$"),
        (["assembly", str(path), "--count", "3"], "give --out FILE, or --look"),
        (["abcd", "--out", "a.h5"], "give --count N$"),
    ):
        capsys.readouterr()
        assert main(["generate", *words]) == 2
        assert re.search(line, capsys.readouterr().err.strip()), words
