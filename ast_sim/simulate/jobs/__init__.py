"""Many scenes, solved by many processes."""
