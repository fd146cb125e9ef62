"""Comments with one asterisk instead of two: they look like keywords, and the data lines after them would be lost."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from ast_sim.importers.decks.deck_numbers import tokens
from ast_sim.importers.decks.keyword_lines import Keyword

# Words that are as alike as ELEMENT and ELEMENTS are taken for slips of the pen.
_ALIKE = 0.85

_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([dDeE]?[-+]?[0-9]+)?|")

# Keywords whose data lines are read: a comment among these lines loses some of them.
_READ = {"NODE", "ELEMENT", "NSET", "ELSET", "SYSTEM", "INSTANCE", "BOUNDARY"}

# What may stand behind the target of a line of *BOUNDARY.
_HELD = {"ENCASTRE", "PINNED", "XSYMM", "YSYMM", "ZSYMM", "XASYMM", "YASYMM", "ZASYMM"}

# Keywords of Abaqus and CalculiX whose data lines may hold numbers alone, but for names that end as `_ENDS` says.
_KEYWORDS = """
ACOUSTICMEDIUM AMPLITUDE ANNEAL ASSEMBLY BASELINECORRECTION BASEMOTION BOUNDARY BRITTLECRACKING BRITTLEFAILURE
BRITTLESHEAR BUCKLE BULKVISCOSITY CAPACITY CAPCREEP CECHARGE CECURRENT CFLUX CHANGEFRICTION CHANGEMATERIAL
CHANGEPLASTIC CLEARANCE CLOAD COHESIVEBEHAVIOR COMPLEXFREQUENCY COMPOSITEMODALDAMPING CONCRETE CONDUCTIVITY
CONNECTORBEHAVIOR CONNECTORDAMPING CONNECTORELASTICITY CONNECTORLOAD CONNECTORMOTION CONTACT CONTACTDAMPING
CONTACTPAIR CORRELATIONLENGTH COUPLEDTEMPERATURE-DISPLACEMENT CRACKPROPAGATION CREEP CYCLICSYMMETRYMODEL
DAMAGEEVOLUTION DAMAGEINITIATION DAMPING DASHPOT DENSITY DEPVAR DESIGNRESPONSE DESIGNVARIABLES DFLUX DIAGNOSTICS
DIFFUSIVITY DISPLAYBODY DISTRIBUTING DISTRIBUTION DLOAD DSECHARGE DSFLUX DSLOAD DYNAMIC ELASTIC ELCOPY
ELECTRICALCONDUCTIVITY ELECTROMAGNETICS ELGEN ELSET EMBEDDEDELEMENT ENDSTEP EOS EQUATION EXPANSION EXTREMEVALUE
FASTENER FEASIBLEDIRECTION FIELD FILM FILTER FLOW FLUIDCAVITY FLUIDCONSTANTS FLUIDEXCHANGE FOUNDATION FREQUENCY
FRICTION GAP GAPCONDUCTANCE GAPHEATGENERATION GASKETBEHAVIOR GASKETCONTACTAREA GEOMETRICTOLERANCE GEOSTATIC GREEN HCF
HEADING HEATTRANSFER HYPERELASTIC HYPERFOAM HYPOELASTIC HYSTERESIS IMPEDANCE INCIDENTWAVE INELASTICHEATFRACTION
INERTIARELIEF INITIALSTRAININCREASE INSTANCE JOINT KAPPA KINEMATIC LATENTHEAT MAGNETICPERMEABILITY MASS MASSFLOW
MASSFLOWRATE MATERIAL MATRIXASSEMBLE MODALDAMPING MODALDYNAMIC MODELCHANGE MOLECULARWEIGHT MONITOR MOTION MPC
MULLINSEFFECT NETWORKMPC NFILL NGEN NMAP NODALTHICKNESS NODE NONSTRUCTURALMASS NORMAL NSET OBJECTIVE ORIENTATION
PARTICLEGENERATOR PERIODIC PERMEABILITY PHYSICALCONSTANTS PIEZOELECTRIC PLASTIC POROUSELASTIC PREDEFINEDFIELD
PRESSURESTRESS RADIATE RADIATION RANDOMFIELD RANDOMRESPONSE RATEDEPENDENT REFERENCEPRESSURE RELEASE RESPONSESPECTRUM
RESTART RETAINEDNODALDOFS RIGIDBODY RIGIDSURFACE ROBUSTDESIGN ROTARYINERTIA SECTIONORIGIN SELECTCYCLICSYMMETRYMODES
SELECTEIGENMODES SENSITIVITY SOILS SOLUBILITY SORPTION SPECIFICGASCONSTANT SPECIFICHEAT SPECTRUM SPRING STATIC
STEADYSTATETRANSPORT STEP SUBMODEL SUBSTRUCTUREGENERATE SUBSTRUCTUREPATH SURFACE SURFACEBEHAVIOR SURFACEFLAW
SURFACEINTERACTION SYSTEM TEMPERATURE TENSILEFAILURE THERMALEXPANSION TIE TIMEPOINTS TORQUE TRANSFORM
TRANSPORTVELOCITY UEL UNCOUPLEDTEMPERATURE-DISPLACEMENT USERELEMENT USERMATERIAL VALUESATINFINITY VIEWFACTOR VISCO
VISCOELASTIC VISCOUS WAVE WIND
"""
_ENDS = (
    *("SECTION", "FILE", "PRINT", "OUTPUT", "CONDITIONS", "CONTROLS", "PLASTICITY", "HARDENING", "DAMAGE", "CRITERIA"),
    *("STABILIZATION", "STIFFNESS", "INPUT", "CONSTRAINT", "PROPERTY", "DATA", "ASSIGNMENT", "DYNAMICS", "TABLE"),
    *("COUPLING", "BEHAVIOR"),
)


def require_keyword(keyword: Keyword, before: Keyword | None, known: Iterable[str], sets: Iterable[str]) -> None:
    """Check that a keyword that is passed over is no comment whose data lines belong to the keyword before it.

    Args:
        before: the last keyword that is no comment.
        known: the keywords that are read; the data lines of a name like one of these are not passed over.
        sets: the names of sets so far.

    Raises:
        DatasetError: the text names the line.
    """
    if not keyword.data:
        return
    if not keyword.name:
        raise keyword.error("a single asterisk; a comment begins with two")
    like = difflib.get_close_matches(keyword.name, known, 1, _ALIKE)
    if like:
        raise keyword.error(f"is this *{like[0]}?")
    if before is None or before.name not in _READ or is_keyword(keyword.name):
        return
    names = {*sets, *(_HELD if before.name == "BOUNDARY" else ())}
    entries = {text.strip('"').upper() for line in keyword.data for text in tokens(line)}
    if all(_NUMBER.fullmatch(text) or text in names for text in entries):
        count = len(keyword.data)
        lines = f"the {count} lines after this one seem" if count > 1 else "the line after this one seems"
        raise keyword.error(
            f"{lines} to belong to *{before.name} in line {before.line.number}; a comment begins with two asterisks"
        )


def is_keyword(name: str) -> bool:
    """Whether a name is a keyword of Abaqus or CalculiX, as far as they are known here."""
    return name in _KEYWORDS.split() or name.endswith(_ENDS)
