"""Write results of Abaqus (.odb) as files that ast_sim converts. Untried with Abaqus itself: no Abaqus is at hand.

    abaqus python odb_to_vtu.py job.odb folder
    ast-sim convert folder/job.pvd --out data.h5 --displacement U --stress S --obstacle PUNCH-1 --handle PAD-1.FLOOR

Runs in the Python of Abaqus (2.7 or 3), with its module odbAccess. The folder gets a .vtu file for each frame and a
.pvd file with their times. A point has fields with the names of Abaqus: U, RF, S (six components) and PEEQ, if the job
has written them; S and PEEQ are means over the elements at a node, 0 where there are none. Each instance and each set
of nodes is a field, too, which is 1 at its nodes; sets of an instance are called INSTANCE.SET.
"""
# ruff: noqa: UP010, UP031

from __future__ import division, print_function

import base64
import os
import re
import struct
import sys
from xml.sax.saxutils import quoteattr

from abaqusConstants import ELEMENT_NODAL
from odbAccess import openOdb

# Types of elements by the beginning of their names: VTK's type and the number of nodes, which stand in VTK's order.
KINDS = {"C3D4": (10, 4), "C3D10": (24, 10), "C3D8": (12, 8), "C3D20": (25, 20), "C3D6": (13, 6), "C3D15": (26, 15)}
KINDS.update({"R3D3": (5, 3), "R3D4": (9, 4)})
CODES = {"Float64": "d", "Int64": "q", "UInt8": "B"}
COMPONENTS = {"U": ["U1", "U2", "U3"], "RF": ["RF1", "RF2", "RF3"], "PEEQ": ["PEEQ"]}
COMPONENTS["S"] = ["S11", "S22", "S33", "S12", "S13", "S23"]  # as Abaqus orders them


def main(path, folder):
    odb = openOdb(path, readOnly=True)
    if not os.path.isdir(folder):
        os.makedirs(folder)
    name = os.path.splitext(os.path.basename(path))[0]
    rows, points, cells = mesh_of(odb.rootAssembly)
    marks = marks_of(odb.rootAssembly, rows)
    listed = []
    last = None
    for step in odb.steps.values():
        if str(step.domain) != "TIME":
            sys.exit("The step %s is no step in time: %s" % (step.name, step.domain))
        for frame in step.frames:
            time = float(step.totalTime + frame.frameValue)
            if last is not None and time <= last:  # the first frame of a step is the last one of the step before
                continue
            last = time
            file = "%s_%05d.vtu" % (name, len(listed))
            write_vtu(os.path.join(folder, file), points, cells, fields_of(frame, rows), marks)
            listed.append('<DataSet timestep="%r" file=%s/>' % (time, quoteattr(file)))
    with open(os.path.join(folder, name + ".pvd"), "w") as out:
        out.write('<VTKFile type="Collection"><Collection>\n%s\n</Collection></VTKFile>\n' % "\n".join(listed))
    print("%d frames, %d points, %d elements" % (len(listed), len(points), len(cells)))


def mesh_of(assembly):
    """The row of each node (instance, label) that an element has, the points at rest, and (VTK's type, rows)."""
    rows, points, cells, left_out = {}, [], [], {}
    for name, instance in assembly.instances.items():
        places = {node.label: node.coordinates for node in instance.nodes}
        for element in instance.elements:
            kind = re.match("[CR]3D[0-9]+", element.type)
            vtk_type, count = KINDS.get(kind and kind.group(), (0, 0))
            if len(element.connectivity) != count:
                left_out[element.type] = left_out.get(element.type, 0) + 1
                continue
            for label in element.connectivity:
                if (name, label) not in rows:
                    rows[name, label] = len(points)
                    points.append([float(x) for x in places[label]])
            cells.append((vtk_type, [rows[name, label] for label in element.connectivity]))
    for kind, count in sorted(left_out.items()):
        print("left out: %d elements of the type %s" % (count, kind))
    return rows, points, cells


def marks_of(assembly, rows):
    """For each instance and each set of nodes, the rows of its nodes."""
    marks = {}
    for name, instance in assembly.instances.items():
        marks[name] = [row for (owner, _), row in rows.items() if owner == name]
        for set_name, nodes in instance.nodeSets.items():
            marks["%s.%s" % (name, set_name)] = [rows.get((name, node.label)) for node in nodes.nodes]
    for set_name, nodes in assembly.nodeSets.items():  # one sequence of nodes for each instance
        pairs = zip(nodes.instanceNames, nodes.nodes)  # noqa: B905 (Python 2 knows no strict)
        marks[set_name.strip()] = [rows.get((name, node.label)) for name, some in pairs for node in some]
    marks = {name: set(some) - {None} for name, some in marks.items()}
    return {name: some for name, some in marks.items() if some}


def fields_of(frame, rows):
    """The fields of a frame: for each its name and the components of each point."""
    fields = {}
    for name in ("U", "RF", "S", "PEEQ"):
        if name not in frame.fieldOutputs.keys():  # noqa: SIM118 (a repository of Abaqus is no dict)
            continue
        columns = len(COMPONENTS[name])
        field = frame.fieldOutputs[name]
        sums = [[0.0] * columns for _ in rows]
        counts = [0] * len(rows)
        turned = 0
        for value in (field.getSubset(position=ELEMENT_NODAL) if name in ("S", "PEEQ") else field).values:
            row = rows.get((value.instance.name if value.instance else None, value.nodeLabel))
            data = numbers_of(value)
            if row is None or len(data) != columns:  # of an element that is left out, or of a shell
                continue
            turned += name == "S" and getattr(value, "localCoordSystem", None) is not None
            sums[row] = [one + float(other) for one, other in zip(sums[row], data)]  # noqa: B905
            counts[row] += 1
        if name == "U" and 0 in counts:
            sys.exit(
                "U is missing at %d of %d points: let the job write U for the whole model"
                % (counts.count(0), len(rows))
            )
        if turned:
            print("%d values of S are along axes of their own: the mean at nodes where these differ is wrong" % turned)
        fields[name] = [x / max(n, 1) for n, row in zip(counts, sums) for x in row]  # noqa: B905
    if "U" not in fields:
        sys.exit("A frame has no U: let the job write it")
    return fields


def numbers_of(value):
    """The components of a value, which Abaqus keeps elsewhere in jobs of double precision."""
    data = value.dataDouble if str(value.precision) == "DOUBLE_PRECISION" else value.data
    return data if hasattr(data, "__len__") else [data]


def write_vtu(path, points, cells, fields, marks):
    arrays = [array(name, "Float64", values, COMPONENTS[name]) for name, values in sorted(fields.items())]
    for name, some in sorted(marks.items()):
        arrays.append(array(name, "UInt8", [int(row in some) for row in range(len(points))]))
    ends = []
    for _, nodes in cells:
        ends.append(len(nodes) + (ends[-1] if ends else 0))
    parts = [
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        '<UnstructuredGrid><Piece NumberOfPoints="%d" NumberOfCells="%d">' % (len(points), len(cells)),
        "<Points>" + array("Points", "Float64", [x for point in points for x in point], "xyz") + "</Points><Cells>",
        array("connectivity", "Int64", [row for _, nodes in cells for row in nodes]),
        array("offsets", "Int64", ends),
        array("types", "UInt8", [kind for kind, _ in cells]),
        "</Cells><PointData>" + "\n".join(arrays) + "</PointData></Piece></UnstructuredGrid></VTKFile>",
    ]
    with open(path, "w") as file:
        file.write("\n".join(parts) + "\n")


def array(name, kind, values, components=()):
    raw = struct.pack("<%d%s" % (len(values), CODES[kind]), *values)
    text = base64.b64encode(struct.pack("<Q", len(raw)) + raw).decode("ascii")
    named = "".join(' ComponentName%d="%s"' % pair for pair in enumerate(components))
    head = 'type="%s" NumberOfComponents="%d"%s format="binary"' % (kind, max(len(components), 1), named)
    return "<DataArray Name=%s %s>%s</DataArray>" % (quoteattr(name), head, text)


if __name__ == "__main__":
    main(sys.argv[-2], sys.argv[-1])
