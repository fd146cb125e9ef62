"""A rubber bumper and the rounded ram that presses it; gmsh makes both (lengths in millimetres)."""


def bumper(gmsh, radius, height):
    """A round rubber pad with a bore, its upper edge rounded."""
    occ = gmsh.model.occ
    pad = occ.addCylinder(0, 0, 0, 0, 0, height, radius)
    bore = occ.addCylinder(0, 0, -1, 0, 0, height / 2 + 1, radius / 3)
    occ.cut([(3, pad)], [(3, bore)])
    occ.synchronize()
    top = [tag for dim, tag in gmsh.model.getEntities(1) if gmsh.model.getBoundingBox(dim, tag)[2] > height - 1e-3]
    occ.fillet([pad], top, [height / 8])


def ram(gmsh, nose, height):
    """A rod with a round nose, half a millimetre above the bumper."""
    occ = gmsh.model.occ
    low = height + 0.5
    ball = occ.addSphere(0, 0, low + nose, nose)
    rod = occ.addCylinder(0, 0, low + nose, 0, 0, nose, nose)
    occ.fuse([(3, ball)], [(3, rod)])
