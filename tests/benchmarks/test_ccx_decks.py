"""The comparison of decks with what CalculiX says of them, on small decks of our own."""

import gzip

import pytest

from benchmarks.robustness import ccx_decks

CUBE = """*NODE, NSET=ALL
1, 0, 0, 0
2, 1, 0, 0
3, 1.2, 1, 0
4, 0, 1, 0
5, 0, 0, 1
6, 1, 0, 1
7, 1.2, 1, 1
8, 0, 1, 1
9, 7, 7, 7
*ELEMENT, TYPE=C3D8, ELSET=E
1, 1, 2, 3, 4, 5, 6, 7, 8
"""
HEAT = """*MATERIAL, NAME=M
*CONDUCTIVITY
1.
*DENSITY
1.
*SOLID SECTION, ELSET=E, MATERIAL=M
*STEP
*HEAT TRANSFER, STEADY STATE
*END STEP
"""
BEAM = "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n*ELEMENT, TYPE=B31, ELSET=E\n1, 1, 2\n"
SHELL = CUBE.replace("TYPE=C3D8", "TYPE=S4").replace("3, 4, 5, 6, 7, 8\n", "3, 4\n")


@pytest.fixture
def decks(tmp_path):
    (tmp_path / "cube.inp").write_text(CUBE + HEAT)
    (tmp_path / "mesh.inc").write_text(CUBE)
    (tmp_path / "outer.inp.gz").write_bytes(gzip.compress(f"*INCLUDE, INPUT=mesh.inc\n{HEAT}".encode()))
    (tmp_path / "beam.inp").write_text(BEAM)
    (tmp_path / "sheet.inp").write_text(
        SHELL + HEAT.replace("*SOLID SECTION", "*SHELL SECTION").replace("M\n*ST", "M\n0.1\n*ST")
    )
    return tmp_path


def test_decks_are_counted_and_alike(decks):
    result = ccx_decks.measure(decks)
    rows = result["rows"]
    assert list(rows) == ["beam", "cube", "outer", "sheet"]
    assert rows["cube"] == rows["outer"] == {"elements of": ["solids"], "read": [8, 1, pytest.approx(1.1)]}
    assert rows["sheet"] == {"elements of": ["shells or plane elements"], "read": [4, 1, pytest.approx(1.1)]}
    assert rows["beam"]["elements of"] == ["beams"] and "B31" in rows["beam"]["refused"]
    assert (result["decks"], result["read"], result["alike"]) == (4, 3, 3)
    assert result["silent"] == result["not compared"] == []
    assert result["read, by elements"] == {"solids": 2, "shells or plane elements": 1}
    assert result["refused, by elements"] == {"beams": 1}


@pytest.mark.parametrize("change", [{"nodes": 9}, {"elements": 2}, {"size": 1.2}])
def test_a_difference_is_seen(decks, monkeypatch, change):
    right = ccx_decks.by_our_reader(decks / "cube.inp")
    monkeypatch.setattr(ccx_decks, "by_our_reader", lambda deck: right._replace(**change))
    rows = {"cube": ccx_decks.outcome(decks / "cube.inp")}
    assert rows["cube"]["ccx"] == [8, 1, pytest.approx(right.size, rel=1e-3)]
    assert ccx_decks.counts(rows)["silent"] == ["cube"] and ccx_decks.counts(rows)["alike"] == 0


def test_a_deck_of_which_calculix_lists_no_mesh_is_not_compared(decks):
    text = (decks / "cube.inp").read_text().replace("*SOLID SECTION, ELSET=E", "*SOLID SECTION, ELSET=NONE")
    (decks / "cube.inp").write_text(text)
    rows = {"cube": ccx_decks.outcome(decks / "cube.inp")}
    assert rows["cube"]["ccx"] is None and ccx_decks.counts(rows)["not compared"] == ["cube"]
