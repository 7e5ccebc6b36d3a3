"""The track memory: what was observed of the agents of a scene, and what was forecast."""
