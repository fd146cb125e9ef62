"""The order of nodes against its composition, by hand, and the band of a mesh that it makes."""

import numpy as np
import pytest
import torch
from checks import assert_same_everywhere
from meshes import box

from ast_sim.ops import breadth_first
from ast_sim.ops._edges import _breadth_first


def test_values_by_hand():
    """A path 3 - 0 - 4 - 1, of which 0 is the lowest node: searches start there, at its end 1, and at 3."""
    path = torch.tensor([[3, 0], [0, 4], [4, 1]])
    assert breadth_first(path, torch.tensor([1, 1, 1, 1, 1])).tolist() == [1, 3, 4, 0, 2]
    assert breadth_first(path, torch.tensor([1, 1, 1, 1, 0])).tolist() == [0, 2, 3, 1, -1]
    assert breadth_first(path[:0], torch.tensor([1, 0, 1])).tolist() == [0, -1, 1]


@pytest.mark.parametrize("corners", [1, 3, 4])
@pytest.mark.parametrize("nodes", [1, 30, 500])
def test_the_kernel_is_the_composition(nodes, corners):
    generator = torch.Generator().manual_seed(nodes)
    elements = torch.randint(0, nodes, (nodes // 2, corners), generator=generator)
    wanted = torch.randint(0, 2, (nodes,), generator=generator)
    expected = _breadth_first.composition(elements, wanted)
    assert torch.equal(breadth_first(elements, wanted), expected)
    assert sorted(expected[wanted > 0].tolist()) == list(range(int(wanted.sum())))


def test_the_band_of_a_bar_is_as_wide_as_its_section():
    cells = (40, 3, 2)
    elements = torch.from_numpy(box(cells, (1, 1, 1))[1].astype(np.int64))
    mixed = torch.randperm(41 * 4 * 3, generator=torch.Generator().manual_seed(0))
    rank = breadth_first(mixed[elements], torch.ones(len(mixed), dtype=torch.int64))[mixed[elements]]
    section = 4 * 3
    assert (rank.amax(1) - rank.amin(1)).max() <= 2 * section


CODE = """
import hashlib, torch
from ast_sim.ops import breadth_first
elements = torch.randint(0, 300, (400, 4), generator=torch.Generator().manual_seed(1))
rank = breadth_first(elements, (torch.arange(300) % 5 > 0).long())
print(hashlib.sha256(rank.numpy().tobytes()).hexdigest())
"""


def test_every_instruction_set_gives_the_same():
    assert_same_everywhere(CODE)


def test_what_does_not_fit_is_refused():
    elements, wanted = torch.tensor([[0, 1, 2]]), torch.tensor([1, 0, 1])
    with pytest.raises(ValueError, match=r"breadth_first: elements\[0, 2\] = 3 is not an index below 3"):
        breadth_first(elements + torch.tensor([0, 0, 1]), wanted)
    with pytest.raises(ValueError, match=r"breadth_first: wanted\[2\] = 2 is not an index below 2"):
        breadth_first(elements, wanted + torch.tensor([0, 0, 1]))
