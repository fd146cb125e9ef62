"""What our reader makes of the decks with which CalculiX tests itself, beside what CalculiX says of them.

`python -m benchmarks.robustness.ccx_decks FOLDER --json benchmarks/results/ccx_decks.json`, with CalculiX (`ccx`) at
hand. The decks are in a package of Debian. They are under the GPL and not part of this repository:

    apt-get download calculix-ccx-test && dpkg -x calculix-ccx-test_*.deb there
    python -m benchmarks.robustness.ccx_decks there/usr/share/doc/calculix-ccx-test/examples/test --json FILE

Each deck (`.inp`, or packed as `.inp.gz`) is read as `predict` reads it, with the corners of its elements alone. Beside
it, ccx reads the nodes, elements, sets and sections of the same deck, with a step of ours that computes nothing
(`*NO ANALYSIS`), and lists the mesh that it holds. The corners, the cells and the volume must be the ones of ccx (the
area, where a deck has shells or plane elements alone). A difference is `silent`. Where ccx lists no mesh, nothing is
compared.
"""

from __future__ import annotations

import argparse
import gzip
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ast_sim.importers.mesh_file import MeshFile, read_mesh
from ast_sim.simulate.calculix.program import find_ccx
from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError
from ast_sim.support.provenance import provenance

# CalculiX lists coordinates with six digits, and faces of hexahedra that are not flat are cut into triangles.
_SAME_SIZE = 2e-3
_SECONDS = 120.0  # for CalculiX

# The step that computes nothing; elements with two dimensions stay such.
_LIST = ("*STEP", "*NO ANALYSIS", "*NODE FILE, OUTPUT=2D", "U", "*END STEP")

# The blocks of a deck that make its mesh, or without which ccx reads no mesh.
_KEPT = {
    "BEAMSECTION", "DASHPOT", "ELEMENT", "ELSET", "FLUIDSECTION", "GAP", "INCLUDE", "MASS", "MEMBRANESECTION",
    "NODALTHICKNESS", "NODE", "NSET", "ORIENTATION", "SHELLSECTION", "SOLIDSECTION", "SPRING",
}  # fmt: skip
_MATERIAL = ("*ELASTIC", "1., 0.3", "*DENSITY", "1.")  # of all materials: of others, ccx wants further data

# Kinds of cells in a file of results, by number: the dimension and the number of corners.
_CELLS = {
    1: (3, 8), 2: (3, 6), 3: (3, 4), 4: (3, 8), 5: (3, 6), 6: (3, 4),
    7: (2, 3), 8: (2, 3), 9: (2, 4), 10: (2, 4), 11: (1, 2), 12: (1, 2),
}  # fmt: skip

# What the types of elements are.
_FAMILIES = (
    ("solids", r"C3D|F3D"),
    ("shells or plane elements", r"S\d|M3D|CPS|CPE|CAX"),
    ("networks", r"D$"),
    ("beams", r"B\d|U1"),
    ("springs or trusses", r"T\dD|SPRING|GAP|DASHPOT|MASS|DCOUP|U"),
)


class Mesh(NamedTuple):
    """Of the cells of the highest dimension, 2 or 3: their corners, their number, and their volume or area."""

    dimension: int
    nodes: int
    elements: int
    size: float

    def differs(self, other: Mesh) -> bool:
        return self[:3] != other[:3] or abs(self.size - other.size) > _SAME_SIZE * abs(other.size)


def families(deck: Path) -> list[str]:
    """What kinds of elements a deck has, in it or in the files that it includes."""
    text = deck.read_text("latin-1")
    for name in re.findall(r"^\*INCLUDE\s*,\s*INPUT\s*=\s*(\S+)", text, re.MULTILINE | re.IGNORECASE):
        included = deck.parent / name.strip("\"'")
        text += included.read_text("latin-1") if included.is_file() else ""
    types = re.findall(r"^\*\s*ELEMENT\s*,.*?TYPE\s*=\s*(\w+)", text, re.MULTILINE | re.IGNORECASE)
    return sorted({_family(one.upper()) for one in types})


def _family(kind: str) -> str:
    return next((name for name, pattern in _FAMILIES if re.match(pattern, kind)), kind)


def by_our_reader(deck: Path) -> Mesh:
    """What our reader makes of a deck.

    Raises:
        AstSimError: it refuses the deck.
    """
    mesh = read_mesh(deck, corners=True)
    mesh.scene(None, None)[0].check(str(deck))
    return _of_file(mesh)


def _of_file(mesh: MeshFile) -> Mesh:
    dimension = max(block.dimension for block in mesh.source.blocks)
    of_cells = np.repeat([b.dimension for b in mesh.source.blocks], [len(b.nodes) for b in mesh.source.blocks])
    kept = of_cells[mesh.element_rows] == dimension  # the layers behind shells are none of the deck's
    elements = mesh.elements[kept]
    corners = mesh.points[elements]
    if dimension == 3:
        sizes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    else:
        sizes = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return Mesh(dimension, len(np.unique(elements)), len(np.unique(mesh.element_rows[kept])), float(sizes.sum()))


def by_calculix(deck: Path) -> Mesh | None:
    """The mesh that ccx lists of a deck; None if it lists none. Files are written beside the deck, which may include
    others of its folder."""
    text = re.split(r"^\*\s*STEP\b", deck.read_text("latin-1"), maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)[0]
    job = deck.with_name(f"listed_{deck.stem}.inp")
    job.write_text("\n".join([*_of_mesh(text.splitlines()), *_LIST]) + "\n", "latin-1")
    try:
        subprocess.run([find_ccx(), job.stem], cwd=deck.parent, capture_output=True, timeout=_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    result = job.with_suffix(".frd")
    return of_results(result.read_text("latin-1")) if result.is_file() else None


def _of_mesh(lines: list[str]) -> Iterator[str]:
    """The lines of a deck that make its mesh, as they stand there, but for materials, and solids in place of fluids."""
    kept = False
    for line in lines:
        if line.startswith("*") and not line.startswith("**"):
            name = line[1:].split(",")[0].replace(" ", "").strip().upper()
            kept = name in _KEPT
            if name == "MATERIAL":
                yield from (line, *_MATERIAL)
            if name == "ELEMENT":
                line = re.sub(r"(TYPE\s*=\s*)F3D", r"\1C3D", line, flags=re.IGNORECASE)
        if kept:
            yield line


def of_results(text: str) -> Mesh | None:
    """The mesh in a file of results of CalculiX, whose lines have columns of fixed width; None if it holds none."""
    points: dict[int, list[float]] = {}
    cells: list[tuple[int, list[int]]] = []
    part = ""
    for line in text.splitlines():
        head = line[:6].strip()
        if head in ("2C", "3C") or line.startswith(" -3"):
            part = head
        elif part == "2C" and line.startswith(" -1"):
            points[int(line[3:13])] = [float(line[start : start + 12]) for start in (13, 25, 37)]
        elif part == "3C" and line.startswith(" -1"):
            cells.append((int(line[13:18]), []))
        elif part == "3C" and line.startswith(" -2"):
            cells[-1][1].extend(int(line[start : start + 10]) for start in range(3, len(line.rstrip()), 10))
        elif line[:6] == "  100C":
            break
    dimension = max((_CELLS[kind][0] for kind, _ in cells), default=0)
    if dimension < 2:
        return None
    kept: dict[int, list[list[int]]] = {}
    for kind, nodes in cells:
        if _CELLS[kind][0] == dimension:
            corners = _CELLS[kind][1]
            kept.setdefault(corners, []).append(nodes[:corners])
    measure = _volume if dimension == 3 else _area
    size = sum(measure(np.array([[points[node] for node in nodes] for nodes in one])) for one in kept.values())
    used = {node for one in kept.values() for nodes in one for node in nodes}
    return Mesh(dimension, len(used), sum(map(len, kept.values())), float(size))


def _volume(corners: np.ndarray) -> float:
    """Of cells with 4, 6 or 8 corners [c, k, 3]; a face of four corners is the mean of its two cuts into triangles."""
    faces: list[tuple[int, ...]] = {
        4: [(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)],
        6: [(0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
        8: [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)],
    }[corners.shape[1]]
    at = corners - corners.mean(axis=1, keepdims=True)
    total = np.zeros(len(at))
    for face in faces:
        turns = [face] if len(face) == 3 else [face, (*face[1:], face[0])]
        for turn in turns:
            for second in range(1, len(turn) - 1):
                total += np.linalg.det(at[:, [turn[0], turn[second], turn[second + 1]]]) / len(turns)
    return float(np.abs(total).sum()) / 6


def _area(corners: np.ndarray) -> float:
    """Of triangles and quadrilaterals [c, k, 3]; a quadrilateral is the mean of its two cuts into triangles."""
    triangles = [(0, 1, 2)] if corners.shape[1] == 3 else [(0, 1, 2), (0, 2, 3), (1, 2, 3), (1, 3, 0)]
    share = min(1.0, 2 / len(triangles))
    total = 0.0
    for one in triangles:
        a, b, c = np.moveaxis(corners[:, one], 1, 0)
        total += share * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    return total


def outcome(deck: Path) -> dict[str, Any]:
    """The families of elements of a deck; its mesh, or why it is refused; and the mesh that ccx lists, if it differs,
    or None if it lists none."""
    row: dict[str, Any] = {"elements of": families(deck)}
    try:
        ours = by_our_reader(deck)
    except AstSimError as error:
        return {**row, "refused": str(error).removeprefix(f"{deck}: ")}
    row["read"] = _rounded(ours)
    theirs = by_calculix(deck)
    if theirs is not None and theirs.dimension == 3 and "solids" not in row["elements of"]:
        theirs = None  # ccx lists the layers of a shell as solids
    if theirs is None or ours.differs(theirs):
        row["ccx"] = None if theirs is None else _rounded(theirs)
    return row


def _rounded(mesh: Mesh) -> list[float]:
    return [mesh.nodes, mesh.elements, float(f"{mesh.size:.5g}")]


def counts(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """How many decks are read, by the families of their elements, and refused, and how many differ."""
    read = {name: row for name, row in rows.items() if "read" in row}
    refused = [row for row in rows.values() if "refused" in row]
    return {
        "decks": len(rows),
        "read": len(read),
        "read, by elements": _by_elements(read.values()),
        "refused, by elements": _by_elements(refused),
        "alike": sum("ccx" not in row for row in read.values()),
        "silent": sorted(name for name, row in read.items() if row.get("ccx")),
        "not compared": sorted(name for name, row in read.items() if "ccx" in row and row["ccx"] is None),
    }


def _by_elements(rows: Iterable[dict[str, Any]]) -> dict[str, int]:
    return dict(Counter(", ".join(row["elements of"]) or "none" for row in rows).most_common())


def unpacked(folder: Path, there: Path) -> list[Path]:
    """All files of a folder in another one, packed ones unpacked; returns the decks."""
    for file in sorted(folder.iterdir()):
        if file.suffix == ".gz":
            (there / file.stem).write_bytes(gzip.decompress(file.read_bytes()))
        elif file.is_file():
            shutil.copy(file, there)
    return sorted(there.glob("*.inp"))


def measure(folder: Path) -> dict[str, Any]:
    """Read all decks of a folder."""
    rows = {}
    with tempfile.TemporaryDirectory() as there:
        for deck in unpacked(folder, Path(there)):
            rows[deck.stem] = outcome(deck)
            print(deck.stem, rows[deck.stem], flush=True)
    return {**counts(rows), "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the decks lie")
    parser.add_argument("--json", type=Path, help="file for the result")
    args = parser.parse_args()
    result = measure(args.folder)
    print(*(f"{name}: {one}" for name, one in result.items() if name != "rows"), sep="\n")
    if args.json:
        command = " ".join(["python -m benchmarks.robustness.ccx_decks", *sys.argv[1:]])
        write_json(args.json, {**provenance(command), **result})


if __name__ == "__main__":
    main()
