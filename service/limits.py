"""Bounds of what a call may hold that are the contract's, not an operator's."""

MAX_ID_LENGTH = 128
"""Characters of an agent's or a scene's id."""


def too_long(an_id: str) -> str | None:
    """What is wrong with an id's length; None: nothing."""
    return f"has {len(an_id)} characters; at most {MAX_ID_LENGTH}" if len(an_id) > MAX_ID_LENGTH else None
