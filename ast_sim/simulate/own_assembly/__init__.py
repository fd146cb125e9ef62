"""An assembly of the user's own parts: its specification, its drawn parameters, its meshes and its motion."""
