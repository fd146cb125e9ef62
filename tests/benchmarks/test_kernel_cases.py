"""The benchmarks of kernels call the ops as they are, and agree with their peers before any time is taken."""

import importlib

import pytest


@pytest.mark.parametrize("family", ["octree", "segment", "elastic_forces", "elastic_stiffness", "mesh"])
def test_the_smallest_case_of_each_op_agrees_with_its_peers(family):
    smallest = {}
    for case in importlib.import_module(f"benchmarks.kernels.{family}").cases():
        smallest.setdefault(case.op, case)
    for case in smallest.values():
        case.check()
        assert all(peer() is not None for peer in case.peers.values())
