"""One generated sample, as a pure function of its recipe, split and index; and the file of the sample.

A sample has a small file of its own until the dataset is whole. The file appears under its name complete or not at all.
It holds the seconds of the solver apart from the other attributes: only the seconds differ when a sample is made again.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.layout import SPLITS
from ast_sim.dataset.solver_seconds import Seconds, split_seconds
from ast_sim.mechanics.case import NEXT_NOTE, NOTES, Drawn
from ast_sim.mechanics.unfinished import Checkpoint
from ast_sim.named_field import NamedField
from ast_sim.scene import Scene, Trajectory
from ast_sim.simulate.families.known_families import family_module
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.disk import replacing
from ast_sim.support.provenance import processor

Sample = tuple[str, int]  # split and index in it

_SCENE = ("rest_position", "elements", "node_type", "body", "material")
_FRAMED = ("position", "stress", "cauchy_stress")
FIELD = "field "  # the name of an array of a named field begins so


@dataclass(frozen=True)
class Recipe:
    """The settings that all samples of a dataset share.

    Attributes:
        family: scene family.
        seed: the seed of all random draws.
        nodes: about how many nodes a scene has; None: as the specification of an assembly says.
        frames: frames of a scene, for families that have this option.
        solver: "own" or "calculix".
        parts: a file or folder of the user's parts, for families that have this option.
        patient: whether the own solver may take any number of Newton iterations for a frame.
        spec: the specification of an assembly, for the family `assembly`.
        keep: the frames that are solved and stored after frame 0, by their numbers in the whole motion; None: all.
        order: 2 if a family with this option makes second-order tetrahedra; None: linear ones.
    """

    family: str
    seed: int
    nodes: int | None
    frames: int | None = None
    solver: str = "own"
    parts: str | None = None
    spec: str | None = None
    patient: bool = False
    keep: tuple[int, ...] | None = None
    order: int | None = None


def make_sample(recipe: Recipe, split: str, index: int, checkpoint: Checkpoint | None = None) -> Trajectory:
    """Draw and solve one sample. The same arguments give the same arrays, whichever other samples are made.

    Args:
        recipe: the settings that all samples share.
        split: "train", "valid", "test" or "calibration".
        index: which sample of the split.
        checkpoint: where an unfinished solve is kept. If there is one already, it goes on.
    """
    module = family_module(recipe.family)
    case = _drawn_assembly(recipe, split, index).case if recipe.spec else _draw(module.draw, recipe, split, index)
    if recipe.keep is not None:
        case = case.keeping(recipe.keep)
    if recipe.solver == "calculix":
        from ast_sim.simulate.calculix import solve as calculix

        trajectory = calculix.quasi_static(case)
    else:
        trajectory = module.solve(case, checkpoint, recipe.patient)
    if recipe.spec is not None:
        trajectory = module.in_newton(trajectory, read_spec(recipe.spec).unit)
    trajectory.attributes.update(seed=recipe.seed, index=index)
    if recipe.keep is not None or recipe.spec is not None:
        notes = case.notes()
        trajectory.attributes.update({NOTES: NEXT_NOTE.join(notes)} if notes else {})
    return trajectory


def draw_sample(recipe: Recipe, split: str, index: int) -> Drawn:
    """The scene of a sample of a family without inertia, with all frames of its motion, and its other meshes."""
    if recipe.spec is not None:
        return _drawn_assembly(recipe, split, index)
    return _draw(family_module(recipe.family).draw_geometry, recipe, split, index)


def _draw(draw: Callable[..., Any], recipe: Recipe, split: str, index: int) -> Any:
    """What `draw` or `draw_geometry` of a family gives."""
    seeds = np.random.SeedSequence(recipe.seed, spawn_key=(SPLITS.index(split), index))
    return draw(np.random.default_rng(seeds), recipe.nodes, **_options(recipe))


def _drawn_assembly(recipe: Recipe, split: str, index: int) -> Drawn:
    from ast_sim.simulate.families import assembly

    assert recipe.spec is not None and recipe.frames is not None
    sample = (recipe.seed, SPLITS.index(split), index)
    return assembly.draw_scene(read_spec(recipe.spec), sample, recipe.nodes, recipe.frames)


def _options(recipe: Recipe) -> dict[str, Any]:
    """The arguments of the drawing beside the number of nodes."""
    given = {"frames": recipe.frames, "order": recipe.order}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if recipe.parts is not None:
        from ast_sim.simulate.shapes.part_source import part_source

        options["parts"] = part_source(Path(recipe.parts))
    return options


def sample_name(split: str, index: int) -> str:
    """The name of a sample in messages, and of its group in the dataset file."""
    return f"{split}/{index:06d}"


def sample_path(folder: Path, split: str, index: int) -> Path:
    """Where a sample lies in its folder."""
    return folder / f"{split}-{index:06d}.npz"


def checkpoint_path(folder: Path, split: str, index: int) -> Path:
    """Where an unfinished sample lies in its folder."""
    return folder / f"{split}-{index:06d}.checkpoint"


def save_sample(path: Path, trajectory: Trajectory) -> None:
    """Write a sample. Its file is whole or absent."""
    store_sample(path, pack_sample(trajectory))


def store_sample(path: Path, data: bytes) -> None:
    """Write the bytes of a sample. Its file is whole or absent."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def pack_sample(trajectory: Trajectory, seconds: Seconds | None = None) -> bytes:
    """A sample as the bytes of its file; with the seconds of its attributes, on this processor, if none are given."""
    kept, taken = split_seconds(trajectory.attributes)
    arrays: dict[str, Any] = {key: getattr(trajectory.scene, key) for key in _SCENE}
    arrays |= {key: getattr(trajectory, key) for key in _FRAMED}
    arrays |= {FIELD + name: one.values for name, one in trajectory.fields.items()}
    places = {name: [one.location, one.unit] for name, one in trajectory.fields.items()}
    seconds = {**taken, "processor": processor()} if seconds is None else seconds
    texts = {"attributes": kept, "fields": places, "seconds": seconds}
    arrays |= {key: np.array(json.dumps(value)) for key, value in texts.items()}
    file = io.BytesIO()
    np.savez(file, **{key: array for key, array in arrays.items() if array is not None})
    return file.getvalue()


def load_sample(path: Path) -> tuple[Trajectory, Seconds]:
    """Read a sample; return it and the seconds that the solver took."""
    with np.load(path, allow_pickle=False) as file:
        scene = Scene(**{key: file[key] for key in _SCENE if key in file})
        framed = {key: file[key] for key in _FRAMED if key in file}
        attributes, seconds, places = (json.loads(str(file[key])) for key in ("attributes", "seconds", "fields"))
        fields = {name: NamedField(file[FIELD + name], *place) for name, place in places.items()}
    return replace(Trajectory(scene, framed.pop("position"), attributes=attributes, fields=fields), **framed), seconds
