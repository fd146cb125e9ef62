"""The contact solver. What a scene family of your own needs is imported from here."""

from ast_sim.mechanics.case import Drawn, SolidCase
from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.dynamics import ClothCase, implicit_euler
from ast_sim.mechanics.elements.cloth import ClothMaterial
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.solid_frames import quasi_static
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.mechanics.unfinished import Checkpoint

__all__ = [
    "Checkpoint",
    "ClothCase",
    "ClothMaterial",
    "ContactSettings",
    "Drawn",
    "NeoHookean",
    "SolidCase",
    "SolverSettings",
    "implicit_euler",
    "quasi_static",
]
