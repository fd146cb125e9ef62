"""Each check of values stands twice: in the core, before a kernel reads where an index points, and in Python, for the
compositions and for messages. Both refuse the same arrays."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from ast_sim.ops import library
from ast_sim.ops.library import OPS
from ast_sim.ops.spec import CHECKS, check


def whole(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.int64)


ORDER = whole(0, 4, 1, 5, 2, 6, 3, 7)  # the corners of two tetrahedra by their nodes
GROUPS = torch.cat([torch.zeros(20, dtype=torch.int64), whole(0, 2, 2, 2, 4, 4, 4, 4)])
CALLS = {
    "segment_sum": (torch.ones(4, 2), whole(2, 0, 3, 1), whole(0, 1, 1, 4), False),
    "message": (
        *(torch.ones(shape) for shape in ((3, 2), (2, 2), (4, 0), (0, 0), 0, (2, 0), (2, 2), 2, 2, 2)),
        *(whole(0, 2, 1, 1), whole(0, 0, 1, 1), whole(0, 2, 4), False),
    ),
    "sparse_conv": (
        *(torch.ones(3, 2), torch.ones(27, 2, 2), None, False, GROUPS, whole(0, 2, 1, 1), whole(0, 1, 0, 1)),
        *(whole(0, 0, 0, 0), whole(0, 0, 0, 0), 2),
    ),
    "octree_coarsen": (whole(3, 9, 1, 2), whole(0, 2, 4), 1),
    "elastic_forces": (
        *(torch.rand(4, 3), torch.rand(4, 3), torch.ones(2, 2)),
        *(whole(0, 1, 2, 3, 0, 1, 2, 3).view(2, 4), ORDER, whole(0, 2, 4, 6, 8)),
    ),
}


def spoiled(x: Tensor) -> Iterator[Tensor]:
    """The array with another value at each place, and with each two neighbours exchanged."""
    for place in range(x.numel()):
        for value in (-(2**62), -1, 0, 1, 2, 3, 4, 5, 2**62):
            y = x.clone()
            y.view(-1)[place] = value
            yield y
        y = x.clone()
        y.view(-1)[[place - 1, place]] = x.view(-1)[[place, place - 1]]
        yield y


def core_refuses(name: str, arguments: tuple) -> bool:
    taken = arguments if OPS[name].spec.counts else OPS[name].spec.arguments(*arguments)
    try:
        getattr(library._C, name)(*taken)
    except ValueError as error:
        assert "has other values than its spec says" in str(error)
        return True
    return False


def python_refuses(name: str, arguments: tuple) -> bool:
    spec = OPS[name].spec
    try:
        check(name, spec.inputs, dict(zip([p.name for p in spec.inputs], arguments, strict=True)))
    except ValueError:
        return True
    return False


def test_all_checks_are_compared():
    words = {word for name in CALLS for p in OPS[name].spec.taken for word in p.words}
    assert CHECKS.keys() <= words and CHECKS.keys() == set(library._C.checks.split())


@pytest.mark.parametrize("name", CALLS)
def test_both_refuse_the_same_arrays(name):
    arguments = CALLS[name]
    assert not core_refuses(name, arguments) and not python_refuses(name, arguments)
    answers = []
    for place, x in enumerate(arguments[: len(OPS[name].spec.taken)]):
        for wrong in spoiled(x) if isinstance(x, Tensor) and x.dtype == torch.int64 else ():
            changed = (*arguments[:place], wrong, *arguments[place + 1 :])
            answers.append(core_refuses(name, changed))
            assert python_refuses(name, changed) == answers[-1], (place, wrong)
    assert {True, False} == set(answers)
