"""Warnings of linear elements: walls that bend with fewer than three across, and Poisson's ratios near 1/2."""

import re
import warnings

import meshio
import numpy as np
import pytest
from simulate.own_assembly.assemblies import SPEC, box, write_assembly, write_box

from ast_sim.cli import main
from ast_sim.simulate.families import assembly
from ast_sim.simulate.own_assembly.spec_reader import read_spec


def told(path) -> list[str]:
    """What `check_spec` warns of."""
    spec = read_spec(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assembly.check_spec(spec, None, spec.frames)
    return [str(one.message) for one in caught]


def strip(folder, layers, order=1, fixed="xmin", length=40):
    """A strip of the thickness 1 that stands by its end at x = 0, and a punch above it."""
    spec = SPEC.replace("order = 1", f"order = {order}").replace('"zmin"', f'"{fixed}"').replace("block", "strip")
    path = write_assembly(folder, spec)
    write_box(folder / "strip.vtu", (0, 0, 0), (length, 10, 1), (length // 2, 5, layers))
    write_box(folder / "punch.vtu", (length - 4, 3, 1.2), (length - 2, 7, 4), (1, 2, 2))
    return path


@pytest.mark.parametrize(("layers", "warned"), [(1, True), (2, True), (3, False)])
def test_a_strip_with_fewer_than_three_linear_elements_across(tmp_path, layers, warned):
    lines = told(strip(tmp_path, layers))
    assert len(lines) == warned
    if warned:
        # Top and bottom have 20 x 5 squares each; no triangle of them has all nodes at the held end.
        start = "strip: fewer than 3 linear elements lie across its wall at 400 of "
        assert lines[0].startswith(start) and ", where it is 1 mm thick. If it bends there, it is several" in lines[0]
        where = [float(x) for x in re.search(r"such as \((.*?)\)", lines[0])[1].split(", ")]
        assert 0 < where[0] < 40 and 0 < where[1] < 10 and where[2] in (0, 1)


def kept(path, low, high, cells, inside):
    """The elements of a box whose middles are inside."""
    points, elements = box(low, high, cells)
    elements = elements[inside(points[elements].mean(axis=1))]
    used, elements = np.unique(elements, return_inverse=True)
    meshio.Mesh(points[used], {"tetra": elements.reshape(-1, 4)}).write(path)


def test_small_knobs_far_from_each_other_are_no_wall(tmp_path):
    """Each is as long as wide. A fin of the same thickness is one, and so is a thin place between thick ones."""
    path = write_assembly(tmp_path)
    write_box(tmp_path / "punch.vtu", (14, 2, 7.3), (16, 4, 9), (1, 1, 1))
    place = (tmp_path / "block.vtu", (0, 0, 0), (30, 6, 7), (30, 6, 7))
    kept(*place, lambda at: (at[:, 2] < 6) | ((at[:, 1] < 1) & (np.floor(at[:, 0]) % 6 == 0)))
    assert told(path) == []
    kept(*place, lambda at: (at[:, 2] < 6) | (at[:, 1] < 1))
    (line,) = told(path)
    assert "fewer than 3 linear elements lie across its wall" in line and ", where it is 1 mm thick" in line
    kept(*place, lambda at: (np.abs(at[:, 0] - 15) > 5) | (np.abs(at[:, 2] - 2.5) < 0.6))
    (line,) = told(path)
    where = [float(x) for x in re.search(r"such as \((.*?)\)", line)[1].split(", ")]
    assert 10 < where[0] < 20 and where[2] in (2, 3)


def test_walls_that_are_bent_by_their_ends_or_held_at_both_are_warned_of(tmp_path):
    for held in ('fixed = "xmin,xmax"', 'fixed = "xmin"\nmove = { where = "xmax", translation = [0, 0, -1] }'):
        path = strip(tmp_path, 2)
        path.write_text(path.read_text().replace('fixed = "xmin"', held))
        assert [line.partition(":")[0] for line in told(path)] == ["strip"]


def test_each_part_is_warned_of_by_itself(tmp_path):
    """A thin one beside a fine one; a rigid one never bends."""
    path = strip(tmp_path, 4)
    write_box(tmp_path / "thin.vtu", (0, 0, -3), (40, 10, -2), (20, 5, 1))
    write_box(tmp_path / "plate.vtu", (0, 0, -6), (40, 10, -5), (20, 5, 1))
    held = 'file = "{}.vtu"\nyoung = 1e6\npoisson = 0.3\nfixed = "xmin"\n'
    more = f"[parts.thin]\n{held.format('thin')}[parts.plate]\nfile = 'plate.vtu'\nrigid = true\n"
    path.write_text(path.read_text() + more)
    assert [line.partition(":")[0] for line in told(path)] == ["thin"]


def test_second_order_elements_and_walls_that_cannot_bend_are_not_warned_of(tmp_path):
    assert told(strip(tmp_path, 1, order=2)) == []
    assert told(strip(tmp_path, 1, fixed="zmin")) == []  # glued over its whole length
    assert told(write_assembly(tmp_path)) == []  # a block


def test_a_ratio_near_a_half_is_warned_of_at_its_worst_value(tmp_path):
    path = write_assembly(tmp_path, SPEC.replace("poisson = 0.3", "poisson = [0.4, 0.49]"))
    line = r"block: its 192 linear elements lock at Poisson's ratio 0.49, above 0.45, and its forces are too large: .*"
    (found,) = told(path)
    assert re.fullmatch(line, found)
    assert told(write_assembly(tmp_path, SPEC.replace("poisson = 0.3", "poisson = 0.45"))) == []
    assert told(write_assembly(tmp_path, path.read_text().replace("order = 1", "order = 2"))) == []


def test_the_command_line_tells_them_once(tmp_path, capsys):
    path = strip(tmp_path, 1)
    words = ["generate", "assembly", str(path), "--out", str(tmp_path / "a.h5"), "--count", "1", "--valid", "0"]
    assert main([*words, "--test", "0", "--workers", "1"]) == 0
    assert capsys.readouterr().err.count("warning: strip: fewer than 3 linear elements") == 1
