"""Observations of agents as they come in: any rate, any length, with or without derivatives."""

from dataclasses import dataclass, fields

from model.arrays import Bools, Floats, Ints

MAX_SPEED = 100.0
"""m/s; successive observations further apart than this allows are not of one agent."""
JUMP_SLACK = 5.0
"""m; beyond what the speed allows: detections jitter, and short intervals magnify it."""


@dataclass(frozen=True)
class Observations:
    """Observations of N agents, at most S each, padded behind.

    Within an agent times ascend strictly. Everything is finite but for the padding and for what was not
    given, which is NaN. SI units, ground frame, seconds since the epoch.
    """

    count: Ints
    """[N], observations of each agent, at least 1."""
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
        """Some of the agents, by mask [N] or indices [n]."""
        return Observations(**{field.name: getattr(self, field.name)[agents] for field in fields(self)})
