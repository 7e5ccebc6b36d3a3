"""Prometheus metrics of API keys, by the name of the key."""

from collections.abc import Collection

from prometheus_client import CollectorRegistry, Counter

from service.errors import TABLE

_REASONS = ("limit", "scope")
_CODES = {"OK", "CANCELLED", *(row.code for row in TABLE)} - {"UNAUTHENTICATED", "UNIMPLEMENTED"}
"""Codes that calls of a key that was accepted, at an address that there is, can end with."""


class KeyMetrics:
    """Counters of each key. The file of keys bounds their number; names that leave it lose their series."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self.requests = Counter(
            "forecast_key_requests_total",
            "Calls of each API key by canonical status code.",
            ["key", "code"],
            registry=registry,
        )
        self.agents = Counter(
            "forecast_key_agents_total",
            "Agents in the requests of each API key, within its limits; a call counts as at least one.",
            ["key"],
            registry=registry,
        )
        self.refused = Counter(
            "forecast_key_refused_total",
            "Calls refused because an API key had reached a limit of its own, or lacked the scope.",
            ["key", "reason"],
            registry=registry,
        )
        self._codes: dict[str, set[str]] = {}

    def add(self, name: str) -> None:
        """Begin the counters of a key at 0: rate() and increase() would miss the first event otherwise."""
        for code in self._codes.setdefault(name, set(_CODES)):
            self.requests.labels(name, code)
        self.agents.labels(name)
        for reason in _REASONS:
            self.refused.labels(name, reason)

    def count(self, name: str, code: str) -> None:
        """Count a call of a key that is let in, or was when the call began."""
        codes = self._codes.get(name)
        if codes is not None:
            codes.add(code)
            self.requests.labels(name, code).inc()

    def keep(self, names: Collection[str]) -> None:
        """Remove the counters of all other keys."""
        for name in set(self._codes) - set(names):
            for code in self._codes.pop(name):
                self.requests.remove(name, code)
            self.agents.remove(name)
            for reason in _REASONS:
                self.refused.remove(name, reason)
