"""How much a request may hold, counted before anything is made of it.

A megabyte can say "another agent" half a million times. Readers of a request count what it holds first,
by the means of its encoding, and make messages only of what is within these bounds.
"""

from dataclasses import dataclass

from service.errors import TooLarge
from service.settings import Settings

_ALWAYS_STATES = 2**16
"""States that any request may have, however few its agents may: then it is the agent that has too many of
them that is told, and the others get their forecasts."""


@dataclass(frozen=True)
class Sizes:
    """The bounds."""

    agents: int
    """Of a request."""
    states: int
    """Of all agents together. Of more than a single agent may have, that agent is told and not the call."""

    @classmethod
    def of(cls, settings: Settings) -> "Sizes":
        """What the settings allow."""
        return cls(settings.max_agents, max(settings.max_agents * settings.max_states, _ALWAYS_STATES))

    def check_agents(self, agents: int) -> None:
        """
        Raises:
            TooLarge: there are more agents than that.
        """
        if agents > self.agents:
            raise TooLarge(f"more than {self.agents} agents")

    def check_states(self, states: int) -> None:
        """
        Raises:
            TooLarge: there are more states than that.
        """
        if states > self.states:
            raise TooLarge(f"more than {self.states} states")
