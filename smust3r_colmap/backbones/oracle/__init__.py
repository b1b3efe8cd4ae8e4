"""A simulated backbone: segments as a network would give them, from a scene that is known exactly."""
