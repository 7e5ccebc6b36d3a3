"""Bounds of what a call may hold that are the contract's, not an operator's."""

MAX_ID_LENGTH = 128
"""Characters of an agent's or a scene's id."""
