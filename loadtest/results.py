"""Results of load tests: what became of the calls, and what the server used."""

import math
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import httpx
import numpy as np
import psutil
from prometheus_client.parser import text_string_to_metric_families

from loadtest.generator import Call, Calls

_OUTCOMES = {"RESOURCE_EXHAUSTED": "refused", "DEADLINE_EXCEEDED": "late", "CANCELLED": "cancelled"}


@dataclass(frozen=True)
class Usage:
    """Resources of a server, and its counts of refused calls, at one time."""

    time: float
    cpu: float
    """Seconds of CPU so far."""
    resident: float
    """Bytes."""
    files: int
    """Open files and connections."""
    threads: int
    """Threads; 0: unknown."""
    queued: float
    """Agents in the queue."""
    refused: Mapping[str, float]
    """Refused calls by reason, so far."""


class Observer:
    """View of a server's resources and metrics.

    Args:
        http: HOST:PORT of its REST.
        pid: its process; None: it runs elsewhere, and its metrics say what it uses.
    """

    def __init__(self, http: str, pid: int | None) -> None:
        self.http = http
        self._pid = pid

    def resident(self) -> float:
        """Return the bytes of the process now; NaN if it runs elsewhere."""
        return float(psutil.Process(self._pid).memory_info().rss) if self._pid is not None else math.nan

    def usage(self) -> Usage:
        """Return the usage now."""
        text = httpx.get(f"http://{self.http}/metrics", timeout=30, trust_env=False).text
        values: dict[str, float] = {}
        refused: dict[str, float] = {}
        for family in text_string_to_metric_families(text):
            for sample in family.samples:
                if sample.name == "forecast_refused_total":
                    refused[sample.labels["reason"]] = sample.value
                elif not sample.labels:
                    values[sample.name] = sample.value
        cpu, resident = values["process_cpu_seconds_total"], values["process_resident_memory_bytes"]
        files, threads = int(values["process_open_fds"]), 0
        if self._pid is not None:
            server = psutil.Process(self._pid)
            family_tree = [server, *server.children(recursive=True)]
            cpu = sum(sum(process.cpu_times()[:2]) for process in family_tree)
            resident = sum(process.memory_info().rss for process in family_tree)
            files = sum(process.num_fds() for process in family_tree)
            threads = sum(process.num_threads() for process in family_tree)
        return Usage(
            time.perf_counter(), cpu, resident, files, threads, values["forecast_queue_agents"], refused
        )


@dataclass
class Result:
    """Result of one run."""

    name: str
    calls: Calls
    before: Usage
    after: Usage
    peak: float = 0.0
    """Calls/s of the closed loop, in the same run; 0: not measured."""
    resident: list[float] = field(default_factory=list)
    """Bytes of the server again and again during the run."""
    checked: int = 0
    """Number of answers that were compared with the forward."""
    wrong: list[str] = field(default_factory=list)
    """Faults of these answers."""
    normal_after: float | None = None
    """Seconds from the end until calls were as fast as before; inf: they were not; None: not measured."""
    notes: list[str] = field(default_factory=list)
    """Further figures."""
    problems: list[str] = field(default_factory=list)
    """Other events that must not happen but did."""

    @property
    def deadline(self) -> float | None:
        """Seconds from the scheduled time; None: none."""
        return self.calls.load.deadline

    @property
    def offered(self) -> int:
        """Number of calls."""
        return len(self.calls.all)

    @property
    def rate(self) -> float:
        """Offered calls/s."""
        return self.offered / self.calls.load.seconds

    def outcome(self, call: Call) -> str:
        """Return "in time", "late", "refused", "cancelled" or "lost"."""
        if call.code == "OK":
            # A retried call is in time when it is answered at all
            limit = self.calls.load.retry_for + (self.deadline or math.inf)
            return "in time" if call.seconds <= limit else "late"
        return _OUTCOMES.get(call.code, "lost")

    @cached_property
    def counts(self) -> "Counter[str]":
        """Number of calls by outcome."""
        return Counter(map(self.outcome, self.calls.all))

    @property
    def accepted(self) -> int:
        """Number of calls that were not refused."""
        return self.offered - self.counts["refused"]

    @property
    def goodput(self) -> float:
        """Calls/s that were answered in time."""
        return self.counts["in time"] / self.calls.seconds

    @property
    def ratio(self) -> float:
        """Goodput relative to the peak; NaN without one."""
        return self.goodput / self.peak if self.peak else math.nan

    @property
    def refused_by_reason(self) -> dict[str, int]:
        """Refused and dropped calls by reason, as the server counted them."""
        return {
            reason: round(count - self.before.refused.get(reason, 0))
            for reason, count in self.after.refused.items()
        }

    @property
    def server_cpu(self) -> float:
        """Share of one core that the server used."""
        return (self.after.cpu - self.before.cpu) / (self.after.time - self.before.time)

    def latency(self, share: float) -> float:
        """Return a quantile of the latencies of accepted calls, s; NaN if there are none."""
        seconds = [c.seconds for c in self.calls.all if self.outcome(c) in ("in time", "late")]
        return float(np.quantile(seconds, share)) if seconds else math.nan

    @property
    def longest_refusal(self) -> float:
        """Longest time from sending a call until it was refused, s; NaN if none was."""
        refused = (c.done - c.sent for c in self.calls.all if self.outcome(c) == "refused")
        return max(refused, default=math.nan)

    @property
    def lag(self) -> float:
        """The 99th percentile of the delay with which the generator sent calls, s."""
        return (
            float(np.quantile([c.sent - c.scheduled for c in self.calls.all], 0.99)) if self.offered else 0.0
        )

    @property
    def failures(self) -> list[str]:
        """Events that must not happen but did."""
        failures = [f"{self.name}: {problem}" for problem in self.problems]
        if self.counts["lost"]:
            codes = Counter(call.code for call in self.calls.all if self.outcome(call) == "lost")
            named = ", ".join(f"{count} {code}" for code, count in codes.items())
            failures.append(f"{self.name}: {self.counts['lost']} calls lost ({named})")
        if self.wrong:
            failures.append(f"{self.name}: {len(self.wrong)} answers wrong, e.g. {self.wrong[0]}")
        return failures
