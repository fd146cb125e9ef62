"""Random simulations and meshes in the dialects of many programs, and what the readers make of them."""
