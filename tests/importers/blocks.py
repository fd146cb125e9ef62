"""Blocks of tetrahedra of positive volume."""

from dataclasses import replace

import data_samples

from ast_sim.element_topology import turned_over
from ast_sim.scene import Scene


def block(x: int, y: int, z: int) -> Scene:
    scene = data_samples.block(x, y, z)
    return replace(scene, elements=turned_over(scene.elements, scene.rest_volumes < 0))
