"""Grids and tables of parameters, as texts and as mappings."""

import os

import numpy as np
import pytest

from ast_sim.simulate.own_assembly.grid import grid, parse_setting, parse_settings, read_table
from ast_sim.support.errors import ConfigError


def test_settings_and_grids():
    texts = ["travel=1:3:3", "pad.young = 1e6, 2e6", "hook.file=long.step", "skew=-5"]
    values = parse_settings(texts)
    assert values == {"travel": [1, 2, 3], "pad.young": [1e6, 2e6], "hook.file": ["long.step"], "skew": [-5]}
    rows = grid(values)
    assert len(rows) == 6 and rows[1] == {"travel": 1, "pad.young": 2e6, "hook.file": "long.step", "skew": -5}
    assert grid({"travel": 3.0, "young": {"pad": [1, 2]}}) == [{"travel": 3.0, "pad.young": v} for v in (1, 2)]
    assert grid({"travel": np.linspace(0, 1, 2)}) == [{"travel": 0.0}, {"travel": 1.0}] and grid({}) == [{}]


def test_a_parameter_is_set_once():
    with pytest.raises(ConfigError, match="travel is given twice: write all its values behind one travel="):
        parse_settings(["travel=1,2", "travel=3"])


@pytest.mark.parametrize(
    "text", ["travel", "travel=", "=3", "travel=1:2", "travel=1:2:0", "travel=1:2:x", "travel=a:2:3"]
)
def test_other_settings_are_refused(text):
    if text == "travel=1:2":  # a text of its own, which no number is
        assert parse_setting(text) == ("travel", ["1:2"])
        return
    with pytest.raises(ConfigError, match="cannot be read; write travel=4.2, travel=1,2,3"):
        parse_setting(text)


def test_grids_have_an_end():
    with pytest.raises(ConfigError, match="the grid has 1,000,000 rows; at most 100,000"):
        grid({"a": range(1000), "b": range(1000)})
    with pytest.raises(ConfigError, match="a has no value"):
        grid({"a": []})
    with pytest.raises(ConfigError, match="'a=0:1:100000000000' asks for 100,000,000,000 values; at most 100,000"):
        parse_setting("a=0:1:100000000000")
    with pytest.raises(ConfigError, match="pad.young is given twice"):
        grid({"young": {"pad": [1, 2]}, "pad.young": 3})


def test_tables(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("travel, hook.file\n1.5,a.step\n\n2,b.step\n")
    assert read_table(path) == [{"travel": 1.5, "hook.file": "a.step"}, {"travel": 2.0, "hook.file": "b.step"}]
    for text, line in (
        ("travel\n", "a row or more"),
        ("a,b\n1,2\n3\n", "row 3 has 1 value, but there are 2 names"),
        ("a, b,a\n1,2,3\n", "two columns have the name 'a'"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=line):
            read_table(path)
    with pytest.raises(ConfigError, match="the table cannot be read"):
        read_table(tmp_path / "none.csv")
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(ConfigError, match="the table cannot be read: it is no regular file"):  # and does not block
        read_table(tmp_path / "pipe.csv")
