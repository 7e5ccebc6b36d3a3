"""What a network takes of a scene."""
