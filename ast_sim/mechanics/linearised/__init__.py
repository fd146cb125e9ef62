"""Contact as linear constraints: pairs of near surfaces, Newton steps with them, and the forces that they carry."""
