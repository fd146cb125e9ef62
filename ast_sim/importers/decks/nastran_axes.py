"""Where the points of a deck of Nastran are, if they stand in coordinate systems of their own.

    CORD2R, CORD2C, CORD2S   a system by three points: its origin, one on its z axis, one in its plane of x and z
    CORD1R, CORD1C, CORD1S   the same by three points (GRID) of the deck; a card may hold two

The last letter says what coordinates are: x, y, z; radius, angle, z; or radius, angle from the z axis, angle about it.
Angles are in degrees. A system, and a GRID, may stand in another system. Source: the quick reference guide of MSC
Nastran.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.importers.decks.deck_axes import from_angles
from ast_sim.support.errors import DatasetError

# Nastran writes 1.5-3 for 1.5e-3, and 1.5D-3.
_REAL = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+))(?:[DdEe]?([-+]\d+)|[DdEe](\d+))?")

_BASIC = ("", "0")


@dataclass
class NastranPoints:
    """The points of a deck and the systems in which they stand.

    Attributes:
        grids: by number as it is written: the system, three coordinates as texts, the place of the card.
        systems: by number: the letter, the system of its points, three points as texts or numbers of grids, the place.
        default: the system of points that name none (GRDSET).
    """

    path: Path
    grids: dict[str, tuple[str, list[str], str]] = field(default_factory=dict)
    systems: dict[str, tuple[str, str, list[str], str]] = field(default_factory=dict)
    default: str = ""
    axes: dict[str, tuple[str, np.ndarray, np.ndarray]] = field(default_factory=dict)

    def take(self, place: str, name: str, fields: list[str]) -> None:
        """Add a GRID, a GRDSET or a coordinate system.

        Raises:
            DatasetError: there are two systems of one number; the text names the place.
        """
        if name == "GRDSET":
            self.default = fields[1]
        elif name == "GRID":
            self.grids[fields[0]] = (fields[1], fields[2:5], place)
        elif name[:5] == "CORD2":
            self._system(place, name[5:], fields[0], fields[1], fields[2:11])
        else:
            for start in (0, 4):
                if fields[start]:
                    self._system(place, name[5:], fields[start], "", fields[start + 1 : start + 4])

    def _system(self, place: str, letter: str, number: str, within: str, points: list[str]) -> None:
        new = (letter, within, points, place)
        if self.systems.setdefault(number, new)[:3] != new[:3]:
            raise DatasetError(f"{self.path}: there are two coordinate systems {number} ({place})")

    def texts(self, number: str) -> list[str]:
        """The coordinates of a point along the basic axes, as texts with all digits."""
        system, texts, place = self.grids[number]
        return [repr(float(x)) for x in self._moved(system or self.default, texts, place, ())]

    def _moved(self, system: str, texts: list[str], place: str, within: tuple[str, ...]) -> np.ndarray:
        values = np.array([self._real(text, place) for text in texts])
        if system in _BASIC:
            return values
        letter, origin, axes = self._axes(system, place, within)
        if letter == "S":  # the second coordinate is the angle from the z axis, the third the one around it
            values = np.array([values[0], values[2], 90 - values[1]])
        if letter != "R":
            values = from_angles(values[None], letter == "S")[0]
        return origin + values @ axes

    def _axes(self, system: str, place: str, within: tuple[str, ...]) -> tuple[str, np.ndarray, np.ndarray]:
        """The letter, the origin and the axes [3, 3] of a system."""
        if system in self.axes:
            return self.axes[system]
        if system in within or system not in self.systems:
            what = "stands in itself" if system in within else "there is not, or of a kind that is not read"
            raise DatasetError(f"{self.path}: {place} stands in the coordinate system {system}, which {what}")
        letter, other, texts, place = self.systems[system]
        within = (*within, system)
        if len(texts) == 9:
            rows = [self._moved(other, texts[row : row + 3], place, within) for row in (0, 3, 6)]
        else:
            missing = next((text for text in texts if text not in self.grids), None)
            if missing is not None:
                raise DatasetError(
                    f"{self.path}: the system {system} ({place}) has the GRID {missing}, which there is not"
                )
            cards = [self.grids[text] for text in texts]
            rows = [self._moved(other or self.default, own, place, within) for other, own, _ in cards]
        z = rows[1] - rows[0]
        y = np.cross(z, rows[2] - rows[0])
        axes = np.stack([np.cross(y, z), y, z])
        sizes = np.linalg.norm(axes, axis=1, keepdims=True)
        if not (sizes > 0).all():
            raise DatasetError(f"{self.path}: the three points of the system {system} ({place}) lie on a line")
        self.axes[system] = (letter, rows[0], axes / sizes)
        return self.axes[system]

    def _real(self, text: str, place: str) -> float:
        match = _REAL.fullmatch(text or "0.")
        if match is None:
            raise DatasetError(f"{self.path}: {text!r} is no number ({place})")
        return float(f"{match[1]}e{match[2] or match[3] or 0}")
