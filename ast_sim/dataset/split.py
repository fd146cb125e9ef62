"""A split of a dataset as a sequence of trajectories."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, overload

from ast_sim.scene import Trajectory
from ast_sim.support.errors import AstSimError, counted
from ast_sim.support.notebook_table import html_table, one_line

if TYPE_CHECKING:
    from ast_sim.dataset.reader import Dataset


class Split(Sequence[Trajectory]):
    """The trajectories of a dataset's split, in order; each is read on access. A slice of a split is a `Split`, too."""

    def __init__(self, dataset: Dataset, name: str, indices: range) -> None:
        self._dataset = dataset
        self.name = name
        self._indices = indices

    def _facts(self) -> dict[str, str]:
        return {"name": self.name, "scenes": f"{len(self):,}", "file": self._dataset.path.name}

    def __repr__(self) -> str:
        return one_line("Split", self._facts())

    def _repr_html_(self) -> str:
        return html_table("Split", self._facts(), first_scene([self]))

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> Split: ...
    def __getitem__(self, index: int | slice) -> Trajectory | Split:
        if isinstance(index, slice):
            return Split(self._dataset, self.name, self._indices[index])
        try:
            number = self._indices[index]
        except IndexError as error:
            raise IndexError(f"{self.name} has {counted(len(self), 'scene')}: there is no {index}") from error
        cauchy_stress = self._dataset.cauchy_stress(self.name, number)
        fields = self._dataset.fields(self.name, number)
        return replace(self._dataset.load(self.name, number), cauchy_stress=cauchy_stress, fields=fields)


def first_scene(splits: Iterable[Split]) -> str:
    """The first scene of these splits in HTML; empty if there is none, or it cannot be read any more."""
    for split in splits:
        if len(split):
            try:
                return split[0].scene._repr_html_()
            except AstSimError:
                return ""
    return ""
