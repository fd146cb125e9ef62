"""What a simulation needs for a model to learn from it, and which fields of its files may hold what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.importers.series import FieldNames, frames
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.errors import DatasetError

# A node moves if it moves by more than this share of the size of its scene.
_STILL = 1e-6

# Words in the names of fields by which programs say what a field holds.
_WORDS = {
    "--obstacle": ("tool", "punch", "die", "rigid", "obstacle", "indenter"),
    "--handle": ("fix", "clamp", "held", "hold", "handle", "bound", "bc", "encastre", "support"),
    "--stress": ("mises", "stress", "s_eq", "seqv"),
    "--body": ("body", "part", "instance"),
}
_OF_TENSORS = ("stress", "sig")  # also a field that is called S alone
# Of several fields for one option, one with these words is proposed.
_LIKELIEST = {"--displacement": ("disp", "depl"), "--stress": ("mises",)}
# The options that a field decides alone, in the order of the proposal.
_PROPOSED = ("--displacement", "--stress", "--obstacle", "--handle")


def require_complete(source: Path, trajectory: Trajectory, names: FieldNames, deck: Path | None = None) -> None:
    """Check that nodes move, and that some are prescribed and some are not. Beside a deck no field needs a name.

    Raises:
        DatasetError: a model cannot learn from the simulation; the text names the fields that were not used, and the
            option for each.
    """
    missing = _missing(trajectory)
    if missing:
        first = next(iter(frames(source))) if deck is None else None
        unused = _unused(first, names) if first is not None else []
        named = ", ".join(f"{name} ({option})" for option, name in unused)
        proposed = {option: name for option, name in reversed(unused) if option in _PROPOSED}
        pairs = sorted(proposed.items(), key=lambda pair: _PROPOSED.index(pair[0]))
        options = " ".join(f"{option} {name}" for option, name in pairs)
        arguments = ", ".join(f"{option[2:]}={name!r}" for option, name in pairs)
        advice = f"; these fields were not used: {named}" if unused else ""
        advice += f"; try {options}, in Python names=FieldNames({arguments})" if options else ""
        if source.suffix.lower() == ".frd" and deck is None:
            advice += "; or name its deck before it, which says what is prescribed: ast-sim convert JOB.inp JOB.frd"
        if first is not None and "displacement" in first.cell_fields.keys() - first.point_fields.keys():
            advice += "; 'displacement' is a cell field, and must be one of points"
        raise DatasetError(
            f"{source}: {' and '.join(missing)}{advice}; to predict a mesh with a trained run, use `ast-sim predict RUN"
            " MESH --move BODY=X,Y,Z`; to convert as it is, give incomplete=True (--incomplete)"
        )


def _missing(trajectory: Trajectory) -> list[str]:
    scene = trajectory.scene
    position = trajectory.position
    largest = _STILL * np.ptp(position[0], axis=0).max()
    moves = (np.ptp(position, axis=0) > largest).any(axis=1)
    missing = []
    if not moves.any():
        missing.append("nothing moves")
    elif scene.prescribed.all():
        missing.append("all nodes are prescribed, so there is nothing to predict: mark fewer, or mesh finer")
    elif not moves[scene.node_type == NodeType.NORMAL].any() and trajectory.stress is None:
        missing.append("no free node moves and there is no stress, so there is nothing to learn from")
    if not scene.prescribed.any():
        missing.append("nothing is prescribed")
    return missing


def _unused(frame: SourceMesh, names: FieldNames) -> list[tuple[str, str]]:
    """(option, name) of the fields that were not used, the likeliest of each option first. If only some options can be
    told, "|" separates them."""
    used = {names.displacement or "displacement", names.stress or "von_mises", names.node_type or "node_type"}
    used |= {*(text.partition("=")[0] for text in names.fields), names.reaction}
    used |= {names.obstacle, names.handle, names.body or "body", *names.material_fields}
    unused = []
    of_cells = {name: np.concatenate(parts) for name, parts in frame.cell_fields.items()}
    for place, fields in (("point", frame.point_fields), ("cell", of_cells)):
        for name, values in fields.items():
            if name not in used and values.dtype.kind in "iufb":
                unused.append((_option(place, name, values.reshape(len(values), -1)), name))
    return sorted(unused, key=_rank)


def _rank(one: tuple[str, str]) -> tuple[int, bool]:
    option, name = one
    likely = any(word in name.lower() for word in _LIKELIEST.get(option, ()))
    return (_PROPOSED.index(option) if option in _PROPOSED else len(_PROPOSED)), not likely


def _option(place: str, name: str, values: np.ndarray) -> str:
    """The option that may take a field of this place, name and these values."""
    if values.shape[1] in (4, 6, 9) and (name.lower() == "s" or any(word in name.lower() for word in _OF_TENSORS)):
        return "--stress"
    if values.shape[1] > 1:
        return "--displacement" if place == "point" and values.shape[1] in (2, 3) else "no option: several components"
    for option, words in _WORDS.items():
        if any(word in name.lower() for word in words) and (place == "point" or option in ("--stress", "--body")):
            return option
    if place == "cell":
        return "--stress|--material|--body"
    marks = np.isin(values, (0, 1)).all()
    return "--obstacle|--handle|--node-type" if marks else "--stress|--body"
