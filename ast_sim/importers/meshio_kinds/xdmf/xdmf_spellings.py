"""Spellings of XDMF that meshio does not know, written as it knows them: what is left to a default, what another place
holds, times in a list. PETSc and PyLith, whose script is `petsc_gen_xdmf.py`, write all of these."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from ast_sim.support.errors import DatasetError, counted

# The words of XDMF that meshio knows in one spelling; XDMF itself takes capital and small letters alike.
_WORDS = {
    "Attribute": {"Center": ("Node", "Cell", "Grid")},
    "Grid": {"GridType": ("Uniform", "Collection", "Tree"), "CollectionType": ("Temporal", "Spatial")},
    "DataItem": {"NumberType": ("Float", "Int", "UInt", "Char", "UChar"), "Format": ("XML", "HDF", "Binary")},
    "Geometry": dict.fromkeys(("GeometryType", "Type"), ("XYZ", "XY", "X_Y_Z", "X_Y")),
}


def with_version(tree: ET.ElementTree[Any]) -> bool:
    """Take a file that does not say its version for version 3. Whether it is so."""
    silent = "Version" not in tree.getroot().attrib
    if silent:
        tree.getroot().set("Version", "3.0")
    return silent


def with_series_of_version_3(tree: ET.ElementTree[Any]) -> bool:
    """Take a series of version 2 for one of version 3, of which meshio reads series; their grids are written alike.
    Whether it is so."""
    is_series = tree.find("Domain/Grid[@GridType='Collection']") is not None
    old = is_series and str(tree.getroot().get("Version")).startswith("2.")
    if old:
        tree.getroot().set("Version", "3.0")
    return old


def with_known_words(tree: ET.ElementTree[Any]) -> bool:
    """Write words as meshio knows them, where their letters are capital or small ones instead, and leave out remarks
    (Information). Whether there is one of either."""
    from meshio.xdmf.common import xdmf_to_meshio_type

    cells = dict.fromkeys(("TopologyType", "Type"), (*xdmf_to_meshio_type, "Mixed"))
    changed = False
    for parent in list(tree.iter()):
        for remark in parent.findall("Information"):
            parent.remove(remark)
            changed = True
        for key, words in {**_WORDS, "Topology": cells}.get(parent.tag, {}).items():
            said = parent.get(key, "")
            word = next((one for one in words if one.casefold() == said.strip().casefold()), said)
            if word != said:
                parent.set(key, word)
                changed = True
    return changed


def without_fields_of_grids(tree: ET.ElementTree[Any]) -> list[str]:
    """Leave out fields with one value for a whole grid. A note on them."""
    fields = [(grid, one) for grid in tree.iter("Grid") for one in grid.findall("Attribute[@Center='Grid']")]
    for grid, one in fields:
        grid.remove(one)
    names = dict.fromkeys(repr(one.get("Name", "without a name")) for _, one in fields)
    fields = "with one value for the whole grid"
    are = counted(len(names), f"field {fields} is", f"fields {fields} are")
    return [f"{are} left out: {', '.join(names)}"] if names else []


def with_own_times(path: Path, tree: ET.ElementTree[Any]) -> bool:
    """Give each frame of a series its time, where the series lists them. Whether one does.

    Raises:
        DatasetError: the list is not one of numbers, has another length than the series, or is not alone.
    """
    listed = [(series, time) for series in tree.iter("Grid") for time in series.findall("Time[@TimeType]")]
    listed = [(series, time) for series, time in listed if time.get("TimeType", "").upper() in ("LIST", "HYPERSLAB")]
    for series, time in listed:
        grids = series.findall("Grid")
        try:
            values = [float(text) for text in (time.findtext("DataItem") or time.get("Value") or "").split()]
        except ValueError as error:
            raise DatasetError(f"{path}: the times of a series are no numbers: {error}") from error
        if time.get("TimeType", "").upper() == "HYPERSLAB" and len(values) == 3:
            values = [values[0] + values[1] * row for row in range(int(values[2]))]
        if len(values) != len(grids):
            raise DatasetError(f"{path}: lists {counted(len(values), 'time')} for {counted(len(grids), 'frame')}")
        if any(grid.find("Time") is not None for grid in grids):
            raise DatasetError(f"{path}: lists the times of its frames, and some have a Time of their own: write one")
        series.remove(time)
        for grid, value in zip(grids, values, strict=True):
            ET.SubElement(grid, "Time", Value=repr(value))
    return bool(listed)


def with_fields_of_one_step(tree: ET.ElementTree[Any]) -> bool:
    """Write fields of one step, [1, rows, columns], as [rows, columns]. Whether there are some."""
    items = [item for one in tree.iter("Attribute") for item in one.findall("DataItem") if item.get("ItemType")]
    steps = [item for item in items if item.get("Dimensions", "").split()[:1] == ["1"]]
    steps = [item for item in steps if len(item.get("Dimensions", "").split()) == 3]
    for item in steps:
        item.set("Dimensions", item.get("Dimensions", "").split(maxsplit=1)[1])
    return bool(steps)


def without_time(path: Path, tree: ET.ElementTree[Any]) -> tuple[float | None, bool]:
    """Take the time out of the grid of a file without a series: meshio refuses it. What it says, and whether there was
    one."""
    said = [(grid, time) for grid in tree.iter("Grid") for time in grid.findall("Time")]
    for grid, time in said:
        grid.remove(time)
    try:
        return (float(said[0][1].attrib["Value"]) if said else None), bool(said)
    except (KeyError, ValueError) as error:
        raise DatasetError(f"{path}: the Time of its grid has no Value that is a number") from error


def with_defaults(tree: ET.ElementTree[Any]) -> bool:
    """Write out what XDMF takes where nothing is said, and meshio needs: uniform grids, fields of nodes. Whether there
    is such a place."""
    defaults = [("Grid", "GridType", "Uniform"), ("Attribute", "Center", "Node")]
    silent = [(one, key, value) for tag, key, value in defaults for one in tree.iter(tag) if one.get(key) is None]
    for one, key, value in silent:
        one.set(key, value)
    return bool(silent)


def with_references(path: Path, tree: ET.ElementTree[Any]) -> bool:
    """Put what is referred to in the place of each reference; meshio knows them within numbers alone. Items that stand
    beside the grids, to be referred to, are taken away. Whether there is one of either.

    Raises:
        DatasetError: there is no such item, or it refers to itself.
    """
    places = _references(tree)
    changed = bool(places)
    while places:
        targets = [_referred(path, tree, parent[row]) for parent, row in places]
        ready = [not any(one.get("Reference") for one in target.iter()) for target in targets]
        if not any(ready):
            named = (places[0][0][places[0][1]].text or "").strip()
            raise DatasetError(f"{path}: refers to {named!r}, which refers to itself: write it out")
        for (parent, row), target, is_ready in zip(places, targets, ready, strict=True):
            if is_ready:
                parent[row] = target
        places = _references(tree)
    for domain in tree.findall("Domain"):
        for item in domain.findall("DataItem"):
            domain.remove(item)
            changed = True
    return changed


def _references(tree: ET.ElementTree[Any]) -> list[tuple[ET.Element, int]]:
    """Where references stand: the parent and the row in it."""
    return [(parent, row) for parent in tree.iter() for row, one in enumerate(parent) if one.get("Reference")]


def _referred(path: Path, tree: ET.ElementTree[Any], item: ET.Element) -> ET.Element:
    """What an item refers to."""
    named = item.get("Reference", "")
    named = (item.text or "" if named == "XML" else named).strip()
    target = None
    with contextlib.suppress(SyntaxError, KeyError, TypeError):  # no path as ElementTree knows them
        target = tree.getroot().find("." + (named if named.startswith("//") else named.removeprefix("/Xdmf")))
    if target is None or target.tag != item.tag:
        raise DatasetError(f"{path}: refers to {named!r}, which it does not hold: write it out")
    return target
