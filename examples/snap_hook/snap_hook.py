"""A snap hook and the slot that it is pushed into; gmsh makes both (lengths in millimetres)."""

WIDTH, NOSE = 4.0, 3.0  # of the hook, and the length of its nose
SLACK = 0.15  # between the beam and the edge of the slot


def _extruded(gmsh, corners, width, start):
    """A profile in the plane of x and y, extruded along z."""
    occ = gmsh.model.occ
    points = [occ.addPoint(x, y, start) for x, y in corners]
    lines = [occ.addLine(a, b) for a, b in zip(points, [*points[1:], points[0]], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    occ.extrude([(2, face)], 0, 0, width)


def hook(gmsh, length, thickness, undercut):
    """A beam along x with a nose at its end: a ramp, a flat top and a steep back."""
    back = length - NOSE - 0.2 * undercut
    top = [(length - NOSE, thickness + undercut), (length - NOSE + 0.6, thickness + undercut)]
    corners = [(0, 0), (length, 0), (length, 0.6 * thickness), *reversed(top), (back, thickness), (0, thickness)]
    _extruded(gmsh, corners, WIDTH, 0)


def slot(gmsh, length, thickness, wall):
    """The rigid edge that the nose has to pass, with a chamfer, half a millimetre before the nose."""
    low, high, start = thickness + SLACK, thickness + 6, length + 0.5
    corners = [(start, low + 0.4), (start + 0.4, low), (start + wall, low), (start + wall, high), (start, high)]
    _extruded(gmsh, corners, WIDTH + 2, -1)
