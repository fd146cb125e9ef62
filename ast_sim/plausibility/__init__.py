"""What looks wrong in a scene or a simulation, before a model learns from it; numpy only."""
