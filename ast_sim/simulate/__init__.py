"""Contact finite elements and the scene families that they generate. Nothing here imports torch."""
