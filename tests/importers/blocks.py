"""Blocks of tetrahedra of positive volume."""

from dataclasses import replace

import data_samples

from ast_sim.plausibility.topology import turned_over
from ast_sim.scene import Scene


def block(x: int, y: int, z: int) -> Scene:
    scene = data_samples.block(x, y, z)
    elements = turned_over(scene)
    return scene if elements is None else replace(scene, elements=elements)
