"""Elements with a plastic strain whose material says that they are elastic."""

from __future__ import annotations

import numpy as np

from ast_sim.material import ELASTIC, YIELD_STRESS, listed_columns
from ast_sim.named_field import PLASTIC_STRAIN
from ast_sim.plausibility.findings import Finding, places
from ast_sim.scene import Trajectory


def plastic_but_elastic(trajectory: Trajectory) -> list[Finding]:
    """Elements with an equivalent plastic strain in some frame and a known elastic law, without a yield stress. At
    nodes, all nodes of the element must have one, since results are averaged where two materials meet."""
    scene = trajectory.scene
    columns = listed_columns(trajectory.attributes)
    field = trajectory.fields.get(PLASTIC_STRAIN)
    if scene.material is None or field is None or not set(columns).issuperset(ELASTIC):
        return []
    strain = field.values.max(axis=(0, 2))
    strained = (strain if field.location == "element" else strain[scene.elements].min(axis=1)) > 0
    if YIELD_STRESS in columns:
        strained &= scene.material[:, columns.index(YIELD_STRESS)] <= 0
    rows = np.flatnonzero(scene.deforming_elements & strained)
    if not len(rows):
        return []
    meaning = (
        "forces and Newton steps take them for elastic: give their yield stress (--material yield_stress=FIELD), or"
        " leave Young's modulus out"
    )
    return [
        Finding(
            "elements with a plastic strain, but without a yield stress", len(rows), places("elements", rows), meaning
        )
    ]
