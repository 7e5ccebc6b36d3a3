"""A planner's loop at 10 Hz: each tick sends what perception saw, and gets the forecasts back in time.

The track memory of the server holds the histories, so that a tick sends new observations only. The map is
sent once and then named by its digest (the client does that by itself). A second thread reads how well
earlier forecasts fit what was observed. A call that fails or is late costs one tick: the loop goes on
with older forecasts.

    .venv/bin/python examples/python/closed_loop.py --seconds 20

The endpoint is grpc://127.0.0.1:50051, or what CAB_FORECAST_ENDPOINT names.
"""

import argparse
import math
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from statistics import fmean

from cab.forecast.v1.consistency_service_pb2 import WatchSceneResponse
from cab.forecast.v1.prediction_service_pb2 import Agent
from cab_forecast import (
    BadRequest,
    Client,
    Forecast,
    ForecastError,
    Stream,
    Tracking,
    agent,
    forecasts,
    predict_request,
    tracking,
)
from cab_forecast.demo.junction import junction
from cab_forecast.demo.simulation import Simulation, User
from cab_forecast.requests import TypeName

PERIOD = 0.1
"""s between ticks."""
HISTORY = 2.5
"""s of observations that the loop keeps, to send them again if the server lost its memory."""
STALE = 0.5
"""s after which older forecasts are no longer used."""


@dataclass(frozen=True)
class Observation:
    """One road user as perception sees it at one time."""

    time: float
    x: float
    y: float
    heading: float
    velocity: tuple[float, float]


class Tracks:
    """Observations of the last seconds, by road user, and up to when the server has them."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[TypeName, deque[Observation]]] = {}
        self._acknowledged = -math.inf

    def add(self, now: float, users: Sequence[User]) -> None:
        """Add what is seen at a time; drop who is gone."""
        present = {user.name for user in users}
        self._seen = {name: track for name, track in self._seen.items() if name in present}
        for user in users:
            _, track = self._seen.setdefault(user.name, (user.kind, deque()))
            x, y = user.position.tolist()
            track.append(Observation(now, x, y, user.heading, user.velocity))
            while track[0].time < now - HISTORY:
                track.popleft()

    def agents(self) -> Iterator[Agent]:
        """Yield all road users with the observations that the server does not have yet."""
        for name, (kind, track) in self._seen.items():
            new = [one for one in track if one.time > self._acknowledged]
            yield agent(
                name,
                kind,
                times=[one.time for one in new],
                positions=[(one.x, one.y) for one in new],
                headings=[one.heading for one in new],
                velocities=[one.velocity for one in new],
            )

    def acknowledge(self, now: float, scene: Tracking) -> None:
        """Note that a call was answered: what it sent is remembered unless the memory says otherwise."""
        self._acknowledged = now if scene is Tracking.OK else -math.inf


@dataclass
class Report:
    """Counts since the last report."""

    calls: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    """Failed calls by status code."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Forecasts by status."""
    seconds: list[float] = field(default_factory=list)
    """Durations of the calls."""

    def line(self) -> str:
        """Return the report as one line."""
        slowest = f"{max(self.seconds) * 1e3:.0f} ms" if self.seconds else "–"
        statuses = ", ".join(f"{count} {status}" for status, count in sorted(self.statuses.items()))
        failed = "".join(f"; {count} failed with {code}" for code, count in self.failed.items())
        return f"{self.calls} calls, slowest {slowest}; forecasts: {statuses or 'none'}{failed}"


class Consistency(threading.Thread):
    """Reader of a scene's consistency events: how far off were forecasts, once the future is there?"""

    AGE = 1.0
    """s: the forecasts that are compared with the observation are so old."""

    def __init__(self, events: Stream[WatchSceneResponse]) -> None:
        super().__init__(daemon=True)
        self._events = events
        self.errors: deque[float] = deque(maxlen=500)
        """Displacement errors of the latest forecasts of that age, m."""
        self.settled = 0
        """Observations whose forecasts of all ages are known."""
        self.missed = 0
        """Events that this reader was too slow for."""

    def run(self) -> None:
        """Read events until the stream ends."""
        try:
            for event in self._events:
                self.missed += event.missed
                for instant in event.instants:
                    self.settled += instant.settled and instant.complete
                    self.errors += [one.displacement_error for one in instant.errors if one.age == self.AGE]
        except ForecastError as error:  # forecasts go on without it
            print(f"no more consistency events: {error.code}: {error}", file=sys.stderr)

    def line(self) -> str:
        """Return what is known as one line."""
        if not self.errors:
            return f"no forecast is {self.AGE:g} s old yet"
        return f"forecasts of {self.AGE:g} s were off by {fmean(list(self.errors)):.2f} m on average"


def plan(views: dict[str, Forecast], age: float) -> None:
    """Plan with the forecasts: your planner goes here.

    Args:
        views: forecasts by road user. ``weights`` are the probabilities of the modes, ``means`` and
            ``covariances`` their Gaussians at ``times``. Whoever is ``INVALID`` has none.
        age: s since they were made.
    """
    if age > STALE:
        print(f"forecasts are {age:.1f} s old: plan with your own prediction", file=sys.stderr)


def drive(client: Client, seconds: float, deadline: float, scene_id: str, consistency: Consistency) -> int:
    """Run the loop; return the number of calls that were answered in time."""
    world = junction()
    perception = Simulation(world, seed=1, users=12)  # stands for your perception
    tracks, report = Tracks(), Report()
    views: dict[str, Forecast] = {}
    epoch, start = time.time(), time.monotonic()
    made, answered = epoch, 0
    for tick in range(round(seconds / PERIOD)):
        time.sleep(max(0.0, start + tick * PERIOD - time.monotonic()))  # after a late call it catches up
        now = epoch + tick * PERIOD
        perception.step(PERIOD)
        tracks.add(now, perception.users)
        request = predict_request(
            now, tracks.agents(), scene_id=scene_id, raster=world.raster, history="memory", priority=5
        )
        began = time.perf_counter()
        try:
            response = client.predict(request, timeout=deadline)
        except BadRequest as error:  # a bug of the caller: it would fail in each tick
            for violation in error.field_violations:
                print(f"{violation.field}: {violation.description}", file=sys.stderr)
            raise
        except ForecastError as error:  # late, overloaded, draining, unreachable: the next tick tries again
            report.failed[error.code] += 1
        else:
            views, made = forecasts(response), now
            answered += 1
            tracks.acknowledge(now, tracking(response))
            report.calls += 1
            report.seconds.append(time.perf_counter() - began)
            report.statuses.update(view.status for view in views.values())
        plan(views, now - made)
        if (tick + 1) % round(1 / PERIOD) == 0:
            print(f"{(tick + 1) * PERIOD:4.0f} s: {report.line()}; {consistency.line()}", flush=True)
            report = Report()
    return answered


def main() -> int:
    """Run the example; return 1 if the server answered no call in time."""
    parser = argparse.ArgumentParser(description="Forecast simulated traffic at 10 Hz, as a planner would.")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--deadline", type=float, default=0.25, help="s within which a call must be answered")
    arguments = parser.parse_args()
    scene_id = f"closed-loop/{time.time():.0f}"  # the ground frame stays the same as long as the name does
    try:
        # Without retries: a late forecast is worth less than the next one
        with Client.from_environment(retries=0) as client, client.watch_scene(scene_id) as events:
            consistency = Consistency(events)
            consistency.start()
            answered = drive(client, arguments.seconds, arguments.deadline, scene_id, consistency)
    except ForecastError as error:
        print(f"{error.code}: {error}", file=sys.stderr)
        return 1
    consistency.join(timeout=5)  # the stream is closed
    print(
        f"{answered} ticks were forecast in time; {consistency.settled} observations with forecasts of all "
        f"ages; {consistency.line()}; {consistency.missed} events missed"
    )
    return 0 if answered else 1


if __name__ == "__main__":
    sys.exit(main())
