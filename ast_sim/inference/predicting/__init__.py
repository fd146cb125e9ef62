"""How a model predicts the frames of scenes: by jumps, or step by step."""
