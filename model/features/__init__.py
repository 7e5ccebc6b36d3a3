"""The inputs that networks take of a scene."""
