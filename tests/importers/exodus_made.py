"""Exodus files of a block that a tool presses, as classic NetCDF of each kind, byte by byte, and as NetCDF-4."""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from data_samples import block

KINDS = {"i1": 1, "S1": 2, "i4": 4, "f4": 5, "f8": 6, "i8": 10}
UNWRITTEN = 9.9692099683868690e36  # with which NetCDF fills places that are never written

PAD = block(2, 2, 2)
TOOL = block(1, 1, 1)
POINTS = np.concatenate([PAD.rest_position, TOOL.rest_position + np.array((0.5, 0.5, 2.1))])
PAD_NODES = np.arange(PAD.num_nodes)
TOOL_NODES = np.arange(PAD.num_nodes, len(POINTS))
ELEMENTS = [PAD.elements, TOOL.elements + PAD.num_nodes]
LOW = np.flatnonzero(POINTS[:, 2] == 0)
SIDES = ((0, 1, 3), (1, 2, 3), (0, 3, 2), (0, 2, 1))  # of a tetrahedron, from 1 in Exodus


def pressed(frame: float) -> np.ndarray:
    """[n, 3]: displacements; the pad gets 5 % lower a frame, the tool moves down and aside."""
    moved = POINTS * np.array((0, 0, -0.05 * frame))
    moved[TOOL_NODES] = np.array((0.02, -0.01, -0.1)) * frame
    return moved


def nodal(frames: int = 3, names: tuple[str, str, str] = ("disp_x", "disp_y", "disp_z")) -> dict[str, np.ndarray]:
    """[frames, n] by name: the displacements."""
    held = np.array([pressed(frame) for frame in range(frames)]).reshape(frames, len(POINTS), 3)
    return {name: held[:, :, axis] for axis, name in enumerate(names)}


@dataclass
class Netcdf:
    """What a file holds: lengths of dimensions (0: the records), variables with dimensions, values and texts."""

    dimensions: dict[str, int] = field(default_factory=dict)
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = field(default_factory=dict)

    def put(self, name: str, dimensions: tuple[str, ...], values: np.ndarray, /, **texts: str) -> None:
        self.variables[name] = dimensions, np.asarray(values), texts

    def write(self, path: Path, version: int = 2) -> None:
        count = ">q" if version == 5 else ">i"
        place = ">i" if version == 1 else ">q"
        moving = {name for name, (dimensions, _, _) in self.variables.items() if dimensions[:1] == ("time_step",)}
        data = {name: as_bytes(values, name in moving) for name, (_, values, _) in self.variables.items()}
        records = max((len(data[name]) for name in moving), default=0)
        start = len(self.head(version, count, place, dict.fromkeys(data, 0), data, records))
        begins = {}
        for name in (*(one for one in data if one not in moving), *(one for one in data if one in moving)):
            begins[name] = start
            start += self.size(name)
        content = self.head(version, count, place, begins, data, records)
        content += b"".join(data[name][0] for name in data if name not in moving)
        for record in range(records):
            content += b"".join(data[name][record] for name in data if name in moving)
        path.write_bytes(content)

    def write_hdf(self, path: Path) -> None:
        """As NetCDF-4, which is HDF5."""
        moving = [values for dimensions, values, _ in self.variables.values() if dimensions[:1] == ("time_step",)]
        lengths = self.dimensions | {"time_step": max(map(len, moving), default=0)}
        with h5py.File(path, "w") as file:
            file.attrs.update({name: np.float32(5.1) for name in ("api_version", "version")})
            file.attrs.update(floating_point_word_size=np.int32(8), file_size=np.int32(1), title=np.bytes_("made"))
            for name, length in lengths.items():
                most = None if name == "time_step" else length
                file.create_dataset(name, (length,), "f4", maxshape=(most,), chunks=True).make_scale(
                    f"This is a netCDF dimension but not a netCDF variable. {length:9d}"
                )
            for name, (dimensions, values, texts) in self.variables.items():
                most = [None if one == "time_step" else lengths[one] for one in dimensions]
                array = file.create_dataset(name, data=values, maxshape=most, chunks=True)
                for axis, one in enumerate(dimensions):
                    array.dims[axis].attach_scale(file[one])
                array.attrs.update({key: np.bytes_(value) for key, value in texts.items()})

    def size(self, name: str) -> int:
        """The bytes of a variable, or of one record, filled up to whole words."""
        dimensions, values, _ = self.variables[name]
        lengths = [self.dimensions[one] for one in dimensions if one != "time_step"]
        return -(-values.dtype.itemsize * int(np.prod(lengths)) // 4) * 4

    def head(self, version, count, place, begins, data, records) -> bytes:
        facts = {"api_version": np.float32(5.1), "version": np.float32(5.1)}
        facts |= {"floating_point_word_size": np.int32(8), "file_size": np.int32(1), "title": "made"}
        head = b"CDF" + bytes([version]) + struct.pack(count, records)
        head += listed(
            10, [text(name, count) + struct.pack(count, size) for name, size in self.dimensions.items()], count
        )
        head += listed(12, [attribute(name, value, count) for name, value in facts.items()], count)
        numbers = {name: number for number, name in enumerate(self.dimensions)}
        entries = []
        for name, (dimensions, values, texts) in self.variables.items():
            entry = text(name, count) + struct.pack(count, len(dimensions))
            entry += b"".join(struct.pack(count, numbers[one]) for one in dimensions)
            entry += listed(12, [attribute(key, value, count) for key, value in texts.items()], count)
            entry += struct.pack(">i", KINDS[values.dtype.str[1:]])
            entry += struct.pack(count, self.size(name)) + struct.pack(place, begins[name])
            entries.append(entry)
        return head + listed(11, entries, count)


def as_bytes(values: np.ndarray, of_records: bool) -> list[bytes]:
    """The bytes of each record, or of all values, filled up to whole words."""
    big = np.ascontiguousarray(values, values.dtype.newbyteorder(">"))
    return [filled(big[row : row + 1].tobytes()) for row in range(len(big))] if of_records else [filled(big.tobytes())]


def filled(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % 4)


def text(value: str, count: str) -> bytes:
    return struct.pack(count, len(value.encode())) + filled(value.encode())


def attribute(name: str, value, count: str) -> bytes:
    if isinstance(value, str):
        return text(name, count) + struct.pack(">i", 2) + text(value, count)
    number = np.asarray(value)
    entry = text(name, count) + struct.pack(">i", KINDS[number.dtype.str[1:]]) + struct.pack(count, 1)
    return entry + number.astype(number.dtype.newbyteorder(">")).tobytes()


def listed(tag: int, entries: list[bytes], count: str) -> bytes:
    return struct.pack(">i", tag if entries else 0) + struct.pack(count, len(entries)) + b"".join(entries)


def characters(*texts: str) -> np.ndarray:
    return np.array([list(one.ljust(33, "\0")) for one in texts], "S1")


def exodus(
    points=POINTS,
    blocks=(("TETRA4", 1, "pad", ELEMENTS[0]), ("TETRA4", 2, "tool", ELEMENTS[1])),
    values=None,
    of_elements=None,
    times=(0.0, 0.5, 1.0),
    node_sets=(("low", LOW), ("punch", TOOL_NODES)),
    side_sets=(),
    numbers=None,
) -> Netcdf:
    """The block and the tool as an Exodus file.

    Args:
        blocks: the kind, number, name and nodes of each.
        values, of_elements: [frames, n] at the nodes by name; by name, for some blocks by place, [frames, e].
        node_sets: the name and the nodes of each; side_sets: the name, the elements and their sides from 1.
        numbers: [n] the numbers of the nodes.
    """
    values = nodal(len(times)) if values is None else values
    file = Netcdf({"time_step": 0, "len_string": 33, "num_dim": 3, "num_nodes": len(points)})
    file.dimensions |= {"num_elem": sum(len(nodes) for *_, nodes in blocks), "num_el_blk": len(blocks)}
    file.put("time_whole", ("time_step",), np.array(times, float))
    for axis, column in zip("xyz", np.asarray(points, float).T, strict=True):
        file.put(f"coord{axis}", ("num_nodes",), column)
    sets = {"eb": ("num_el_blk", blocks, [number for _, number, _, _ in blocks])}
    sets |= {"ns": ("num_node_sets", node_sets, range(1, len(node_sets) + 1))}
    sets |= {"ss": ("num_side_sets", side_sets, range(1, len(side_sets) + 1))}
    for key, (size, held, ids) in sets.items():
        if len(held):
            file.dimensions[size] = len(held)
            names = [one[2] if key == "eb" else one[0] for one in held]
            file.put(f"{key}_status", (size,), np.ones(len(held), "i4"))
            file.put(f"{key}_prop1", (size,), np.array(list(ids), "i4"), name="ID")
            file.put(f"{key}_names", (size, "len_string"), characters(*names))
    for number, (kind, _, _, nodes) in enumerate(blocks, 1):
        file.dimensions |= {f"num_el_in_blk{number}": len(nodes), f"num_nod_per_el{number}": nodes.shape[1]}
        rows = (f"num_el_in_blk{number}", f"num_nod_per_el{number}")
        file.put(f"connect{number}", rows, (nodes + 1).astype("i4"), elem_type=kind)
    for number, (_, nodes) in enumerate(node_sets, 1):
        file.dimensions[f"num_nod_ns{number}"] = len(nodes)
        file.put(f"node_ns{number}", (f"num_nod_ns{number}",), (np.asarray(nodes) + 1).astype("i4"))
    for number, (_, elements, sides) in enumerate(side_sets, 1):
        file.dimensions[f"num_side_ss{number}"] = len(elements)
        file.put(f"elem_ss{number}", (f"num_side_ss{number}",), (np.asarray(elements) + 1).astype("i4"))
        file.put(f"side_ss{number}", (f"num_side_ss{number}",), np.asarray(sides, "i4"))
    if numbers is not None:
        file.put("node_num_map", ("num_nodes",), np.asarray(numbers, "i4"))
    if values:
        file.dimensions["num_nod_var"] = len(values)
        file.put("name_nod_var", ("num_nod_var", "len_string"), characters(*values))
        for number, rows in enumerate(values.values(), 1):
            file.put(f"vals_nod_var{number}", ("time_step", "num_nodes"), np.asarray(rows, float))
    if of_elements:
        file.dimensions["num_elem_var"] = len(of_elements)
        file.put("name_elem_var", ("num_elem_var", "len_string"), characters(*of_elements))
        table = [[int(place in held) for held in of_elements.values()] for place in range(len(blocks))]
        file.put("elem_var_tab", ("num_el_blk", "num_elem_var"), np.array(table, "i4"))
        for number, held in enumerate(of_elements.values(), 1):
            for place, rows in held.items():
                name = f"vals_elem_var{number}eb{place + 1}"
                file.put(name, ("time_step", f"num_el_in_blk{place + 1}"), np.asarray(rows, float))
    return file
