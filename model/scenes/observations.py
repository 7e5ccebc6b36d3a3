"""Observations of agents as received: any rate, any length, with or without derivatives."""

from dataclasses import dataclass, fields

from model.arrays import Bools, Floats, Ints

MAX_SPEED = 100.0
"""m/s, maximum speed between successive observations of an agent."""
JUMP_SLACK = 5.0
"""m, allowed in addition to ``MAX_SPEED``: detections jitter, and short intervals magnify that."""


@dataclass(frozen=True)
class Observations:
    """Observations of N agents, at most S each, padded at the end.

    The times of an agent ascend strictly. Values are finite, except for the padding and for values that were
    not given, which are NaN. SI units, ground frame, seconds since the epoch.
    """

    count: Ints
    """[N], number of observations of each agent, at least 1."""
    time: Floats
    """[N, S], s; +inf in the padding."""
    position: Floats
    """[N, S, 2], m."""
    heading: Floats
    """[N, S], rad."""
    velocity: Floats
    """[N, S, 2], m/s, ground frame."""
    acceleration: Floats
    """[N, S, 2], m/s², ground frame."""
    heading_rate: Floats
    """[N, S], rad/s."""

    def select(self, agents: Bools | Ints) -> "Observations":
        """Return some of the agents, by mask [N] or indices [n]."""
        return Observations(**{field.name: getattr(self, field.name)[agents] for field in fields(self)})
