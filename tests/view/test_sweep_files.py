"""A sweep as a table and as a picture: curves for few groups, coloured points for many."""

import csv

import numpy as np
import pytest
from matplotlib.image import imread

from ast_sim.support.errors import AstSimError, ConfigError
from ast_sim.view.sweep_files import write_picture, write_table


def rows_of(groups: int) -> list[dict]:
    return [
        {"travel": t, "young": 1e6 * (g + 1), "reaction": t * (g + 1.0)} for g in range(groups) for t in (1.0, 2.0, 3.0)
    ]


def colors_of(path) -> int:
    picture = np.round(255 * imread(path)[:, :, :3]).astype(int).reshape(-1, 3)
    colored = picture[np.ptp(picture, axis=1) > 60]
    return len(np.unique(colored // 32, axis=0))


def test_a_table_has_every_key_of_any_row(tmp_path):
    write_table(tmp_path / "a.csv", [{"a": 1, "b": 2.5}, {"a": 2, "failure": "too far, really"}])
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "a,b,failure"
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert rows[0] == {"a": "1", "b": "2.5", "failure": ""} and rows[1]["failure"] == "too far, really"
    with pytest.raises(AstSimError, match="cannot be written"):
        write_table(tmp_path / "none" / "a.csv", rows)


def test_curves_and_clouds(tmp_path):
    for name, groups, varied in (
        ("one", 1, ["travel"]),
        ("few", 3, ["travel", "young"]),
        ("many", 20, ["travel", "young"]),
    ):
        write_picture(tmp_path / f"{name}.png", rows_of(groups), varied, "reaction", "mm")
    one, few, many = (colors_of(tmp_path / f"{name}.png") for name in ("one", "few", "many"))
    assert one < few < many


def test_rows_without_the_quantity_are_left_out_and_names_stand_side_by_side(tmp_path):
    rows = [{**row, "file": f"{row['young']:g}.step"} for row in rows_of(2)] + [
        {"travel": 9.0, "file": "c", "failure": "x"}
    ]
    write_picture(tmp_path / "a.png", rows, ["travel", "file"], "reaction", "mm")
    assert colors_of(tmp_path / "a.png") > 0
    write_picture(tmp_path / "files.png", rows, ["file"], "reaction", "mm")
    assert colors_of(tmp_path / "files.png") > 0
    with pytest.raises(ConfigError, match="no parameter varies"):
        write_picture(tmp_path / "b.png", rows, [], "reaction", "mm")
    with pytest.raises(ConfigError, match="no row has 'heat'; the rows have: travel"):
        write_picture(tmp_path / "b.png", rows, ["travel"], "heat", "mm")
