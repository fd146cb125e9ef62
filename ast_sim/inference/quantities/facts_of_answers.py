"""What an answer shows of itself, by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ast_sim.inference.quantities.band import LEVEL
from ast_sim.number_arrays import percent

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer


def facts_of(answer: Answer) -> dict[str, str]:
    """The facts of an answer as texts."""
    unit = "" if answer.info is None else f" {answer.info.length_unit}"
    moved = np.linalg.norm(answer.displacement[:, answer.scene.deforming_nodes], axis=2)
    band = answer.band()
    left = [one.largest for one in answer.permanent_set()]
    return {
        "name": answer.name,
        "frames": ", ".join(map(str, answer.frames[:10])) + (", ..." if len(answer.frames) > 10 else ""),
        "nodes": f"{answer.scene.num_nodes:,}",
        "largest displacement": f"{moved.max(initial=0.0):.4g}{unit}",
        "largest stress": "none" if answer.stress is None else f"{answer.stress.max(initial=0.0):.4g} Pa",
        **({"permanent set": f"{max(left):.4g}{unit}"} if left else {}),
        "expected error": "not known" if answer.expected_error is None else percent(answer.expected_error),
        "converged": {None: "no Newton steps", True: "yes", False: "no"}[answer.converged],
        **({} if band is None else {f"band ({100 * LEVEL:g} %)": f"{band.max():.3g}{unit}"}),
        "seconds": f"{answer.seconds:.3g}",
        **({} if answer.failure is None else {"failure": answer.failure}),
    }
