"""What resists deformation: the law of the material, tetrahedra and cloth."""
