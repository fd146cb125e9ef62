"""Elements that stand in a file twice are taken once; it is told if their values differ."""

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.importers.series import FieldNames, read_series

BLOCK = block(2, 1, 1)
COPIES = BLOCK.elements[[3, 8]][:, [2, 0, 1, 3]]  # the same nodes, numbered otherwise
TOLD = "1 element that stands in the file twice has other values there: the first ones are taken"
NAMES = FieldNames(handle="0:xmin", material=("young=E", "poisson=nu"), fields=("heat",))


def written(folder, changes):
    """Frames of a bar, two of whose elements stand at the end once more, with `changes` of their fields."""
    rest = BLOCK.rest_position.astype(float)
    for frame in range(3):
        fields = {"von_mises": 10.0 * frame + np.arange(14.0), "E": np.full(14, 1e6), "nu": np.full(14, 0.3)}
        fields["heat"] = np.arange(14.0)
        for name, values in fields.items():
            values[12:] = values[[3, 8]]
            values[13] += changes.get(name, 0) * (frame == 2)
        cells = [("tetra", np.concatenate([BLOCK.elements, COPIES]))]
        points = {"displacement": rest * (0.1 * frame, 0, 0)}
        mesh = meshio.Mesh(rest, cells, points, {name: [values] for name, values in fields.items()})
        mesh.write(folder / f"f_{frame}.vtu")
    return folder


@pytest.mark.parametrize(
    ("changes", "told"),
    [({}, 0), ({"von_mises": 1e-5}, 0), ({"von_mises": 1.0}, 1), ({"heat": 0.5}, 1), ({"von_mises": np.nan}, 1)],
)
def test_other_values_of_copies_are_told(tmp_path, changes, told):
    read = read_series(written(tmp_path, changes), NAMES)
    assert len(read.scene.elements) == 12
    assert np.array_equal(read.stress[2, :, 0], 20 + np.arange(12, dtype=np.float32))
    said = str(read.attributes["notes"])
    assert "2 elements that stand in the file twice are taken once" in said
    assert said.count("other values there") == said.count(TOLD) == told
