"""What resists motion: the law of the material, tetrahedra and cloth, and inertia."""
