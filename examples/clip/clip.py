"""A metal clip and the ram that bends it open; gmsh makes both (lengths in millimetres).

The clip is a strip that is bent to a right angle: a base along x, and an arm along z whose outer face lies in x = 0.
Its three variants differ in what is cut out of the arm at the height `place`.
"""

WIDTH, BASE, RADIUS = 5.0, 6.0, 1.0  # of the strip, and the inner radius of its bend
GAP = 0.1  # between arm and ram at rest
HIGH = 0.85  # the height of the ram, as a share of the length of the arm
RAM_RADIUS = 1.5


def hole(gmsh, length, thickness, place):
    """The clip with a round hole."""
    _cut(gmsh, _strip(gmsh, length, thickness), [_drill(gmsh, thickness, 0.0, place * length, 1.1)])


def slot(gmsh, length, thickness, place):
    """The clip with a long hole across the arm."""
    occ = gmsh.model.occ
    ends = [_drill(gmsh, thickness, side, place * length, 0.6) for side in (-0.9, 0.9)]
    middle = occ.addBox(-1, -0.9, place * length - 0.6, thickness + 2, 1.8, 1.2)
    _cut(gmsh, _strip(gmsh, length, thickness), [*ends, middle])


def notches(gmsh, length, thickness, place):
    """The clip with a round notch at each edge."""
    edges = [_drill(gmsh, thickness, side, place * length, 0.8) for side in (-WIDTH / 2, WIDTH / 2)]
    _cut(gmsh, _strip(gmsh, length, thickness), edges)


def ram(gmsh, length, thickness):
    """The round bar inside of the clip, across its arm."""
    x = thickness + GAP + RAM_RADIUS
    gmsh.model.occ.addCylinder(x, -WIDTH / 2 - 1, HIGH * length, 0, WIDTH + 2, 0, RAM_RADIUS)


def _strip(gmsh, length, thickness):
    """The bent strip without cutouts."""
    occ = gmsh.model.occ
    outer = RADIUS + thickness
    corners = [(BASE, 0), (BASE, thickness), (outer, thickness), (thickness, outer), (thickness, length), (0, length)]
    points = [occ.addPoint(x, -WIDTH / 2, z) for x, z in [*corners, (0, outer), (outer, 0)]]
    centre = occ.addPoint(outer, -WIDTH / 2, outer)
    bends = (2, 6)  # arcs start at these points
    lines = []
    for start, end in zip(points, [*points[1:], points[0]], strict=True):
        arc = points.index(start) in bends
        lines.append(occ.addCircleArc(start, centre, end) if arc else occ.addLine(start, end))
    profile = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    return next(tag for kind, tag in occ.extrude([(2, profile)], 0, WIDTH, 0) if kind == 3)


def _drill(gmsh, thickness, y, z, radius):
    return gmsh.model.occ.addCylinder(-1, y, z, thickness + 2, 0, 0, radius)


def _cut(gmsh, body, tools):
    gmsh.model.occ.cut([(3, body)], [(3, tool) for tool in tools])
