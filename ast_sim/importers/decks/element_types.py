"""The types of elements of Abaqus and CalculiX: what becomes of each in a mesh."""

from __future__ import annotations

import re

# Families of elements of a volume or a surface by the beginning of their names; the number of nodes follows it, and
# letters for the integration, for temperature or pressure as an unknown and the like follow that.
_VOLUMES = ("C3D", "DC3D", "AC3D", "DCC3D", "EMC3D", "F3D", "FC3D", "Q3D", "SC", "CSS")
_SURFACES = (
    *("S", "STRI", "DS", "M3D", "SFM3D", "R3D", "CPS", "CPE", "CPEG", "CAX", "CGAX", "DC2D", "DCAX", "DCC2D", "DCCAX"),
    *("AC2D", "ACAX"),
)

# Elements that stand for the ring that they make around the y axis.
REVOLVED = ("CAX", "CGAX", "DCAX", "DCCAX", "ACAX")

_KIND_OF_VOLUME = {
    4: "tetra",
    5: "pyramid",
    6: "wedge",
    8: "hexahedron",
    10: "tetra10",
    13: "pyramid13",
    15: "wedge15",
    20: "hexahedron20",
}
_KIND_OF_SURFACE = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9", 65: "triangle6"}

# Lines, points, springs and connections have no volume and no surface, and cohesive elements are the glue between two
# faces, so a mesh does not need them.
_LEFT_OUT = re.compile(
    r"B[23][1-3][A-Z]*|PIPE[23][12][A-Z]*|ELBOW3[12][A-Z]*|FRAME[23]D|T[23]D[23][A-Z]*|(DC|AC|FC|DCC)1D[23][A-Z]*|"
    r"D|RAX2|R2D2|RB[23]D2|M?ITT[0-9A-Z]*|MASS|ROTARYI|HEATCAP|(SPRING|DASHPOT)[12A]|GAP[A-Z]*|DGAP|CONN[23]D2|"
    r"COH[23]D[468]P?|COHAX4P?|"
    r"JOINTC|JOINT[23]D|DCOUP[23]D|DRAG[23]D|LS[36]S?|(SAX|DSAX|MAX|MGAX|SFMAX|SFMGAX)[12][A-Z]*|PSI[0-9]+"
)

_USERS_OWN = re.compile(r"V?U[0-9]+")

_NAME = re.compile(r"([A-Z]+(?:[0-9]D)?)([0-9]+)[A-Z]*[0-9]?[A-Z]*")


def kind_of(type_name: str) -> str | None:
    """The kind of cell of a type of element, by meshio's names; an empty string if such elements are left out; None if
    the type is not known.

    The nodes stand in the same order as in VTK.
    """
    name = type_name.upper()
    if _LEFT_OUT.fullmatch(name):
        return ""
    split = _NAME.fullmatch(name)
    if split is None or name == "F3D4":  # a tetrahedron in CalculiX, a surface in Abaqus
        return None
    family = split[1]
    count = int(split[2])
    if family in _VOLUMES:
        return _KIND_OF_VOLUME.get(count)
    return _KIND_OF_SURFACE.get(count) if family in _SURFACES else None


def is_users_own(type_name: str) -> bool:
    """Whether elements of a type have a law of the user (*USER ELEMENT): the deck does not say what shape they have."""
    return _USERS_OWN.fullmatch(type_name.upper()) is not None
