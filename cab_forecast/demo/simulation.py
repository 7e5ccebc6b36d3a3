"""Simulation of traffic: road users follow routes, each other, the lights and the right of way.

It is deterministic by its seed, and runs as long as it is stepped: users enter at the edges of the scene and
leave there.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cab_forecast.demo.driving import (
    HARDEST_BRAKING,
    Driver,
    acceleration,
    draw_driver,
    speed_limit,
)
from cab_forecast.demo.lane_changes import begin_change, change_lanes
from cab_forecast.demo.lines import STEP, Floats
from cab_forecast.demo.right_of_way import may_pass
from cab_forecast.demo.sight import Leads, look_ahead, places_of
from cab_forecast.demo.walking import distances_to_wait
from cab_forecast.demo.world import BODIES, Body, Kind, Light, Route, World

_WARM_UP = 12.0
"""s that are simulated before the first step, after users were put everywhere."""
_SHORT = 0.3
"""Distance before the end of a line at which one stops, m."""
_TRIES = 8
"""Places that are tried for each user at first."""
_WARM_UP_STEP = 0.1
_JERK = 12.0
"""Maximum change of an acceleration in a second, m/s³; emergency braking is free of it."""
_EMERGENCY = 4.0
"""Deceleration from which on braking is an emergency, m/s²."""
_STOPPED = 0.05
"""Speed below which one stands, m/s."""
_HESITATES = 0.5
"""Speed up to which one reconsiders to pass a gate, m/s."""
_ARRIVALS = 6.0
"""Users who would come in a second if the scene were empty."""
_LANE_ENDS = 4.0
"""Deceleration before the end of a lane that one hopes to leave, m/s²."""
_DWELL = (15.0, 60.0)
"""Time that a vehicle is parked, s."""


@dataclass(eq=False)
class User:
    """A road user."""

    name: str
    route: Route
    limit: Floats
    """[L], speed limit at the points of the route's line, m/s."""
    driver: Driver
    place: float
    """Distance of its middle along the line, m."""
    speed: float
    """m/s."""
    aside: tuple[float, float, float] = (0.0, 0.0, math.inf)
    """Distance to the left of the line, m; place along it where that begins to become less, m; and the
    length of the way over which it becomes 0, m."""
    acceleration: float = 0.0
    """m/s²."""
    gate: int = 0
    """Number of the next gate."""
    committed: int = -1
    """Number of the last gate that it has decided to pass."""
    waits: float = 0.0
    """s that it has stood."""
    parked_until: float = math.nan
    """Time at which it leaves its place at the end of the line, s; NaN: it is not parked."""
    position: Floats = field(default_factory=lambda: np.zeros(2))
    """[2], m."""
    heading: float = 0.0
    """rad."""
    way: float = 1.0
    """Its own way per way along the route's line."""

    @property
    def kind(self) -> Kind:
        """Kind of road user."""
        return self.route.kind

    @property
    def body(self) -> Body:
        """Outline."""
        return BODIES[self.route.kind]

    @property
    def front(self) -> float:
        """Distance of its front along the line, m."""
        return self.place + self.body.length / 2

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity, m/s."""
        return self.speed * math.cos(self.heading), self.speed * math.sin(self.heading)


class Simulation:
    """Traffic in a world."""

    def __init__(self, world: World, seed: int = 0, users: int | None = None) -> None:
        """
        Args:
            world: the place.
            seed: seed of all that is random.
            users: about how many road users there are; None: as many as are usual there.
        """
        self.world = world
        self.time = 0.0
        """s since the simulation began."""
        self.users: list[User] = []
        """Road users, oldest first."""
        usual = sum(world.population.values())
        share = 1.0 if users is None else users / usual
        self._population = {kind: round(count * share) for kind, count in world.population.items()}
        self._rng = np.random.default_rng(seed)
        self._limits: dict[tuple[str, float], Floats] = {}
        self._born = 0
        self._fill()
        while self.time < _WARM_UP:
            self.step(_WARM_UP_STEP)

    def step(self, seconds: float) -> None:
        """Move everyone on.

        Args:
            seconds: duration of the step, s, at most 0.1.
        """
        self._enter(seconds)
        leads = look_ahead(self.users, self.world)
        for user, onto in change_lanes(self.users, self.world, leads, self._rng, seconds):
            begin_change(user, self.world, onto, self._limit(self.world.routes[onto], user.driver.braking))
        for user, wanted in zip(self.users, self._wishes(leads), strict=True):
            _move(user, wanted, seconds)
        self.time += seconds
        self._end_routes()
        self._locate(self.users)

    def _wishes(self, leads: Leads) -> Iterator[float]:
        """Yield the accelerations that the users want, m/s²."""
        on_route: dict[str, list[User]] = {}
        for user in self.users:
            on_route.setdefault(user.route.name, []).append(user)
        waiting = distances_to_wait(self.users)
        for index, user in enumerate(self.users):
            gap, lead_speed = float(leads.gap[index]), float(leads.speed[index])
            limit = float(user.limit[min(int(user.place / STEP), len(user.limit) - 1)])
            wanted = acceleration(user.driver, user.speed, limit, gap, lead_speed)
            if index in waiting:
                room = waiting[index] + user.driver.standoff
                wanted = min(wanted, acceleration(user.driver, user.speed, limit, room, 0.0))
            if user.route.stops:
                end = user.route.line.length - user.place - _SHORT + user.driver.standoff
                wanted = min(wanted, acceleration(user.driver, user.speed, limit, end, 0.0))
            line = self._held_at(user, on_route, leads, index)
            if line is not None:
                wanted = min(wanted, acceleration(user.driver, user.speed, limit, line, 0.0))
            yield wanted

    def _held_at(self, user: User, on_route: dict[str, list[User]], leads: Leads, index: int) -> float | None:
        """Return the distance to the line where a user has to wait, m; None: its way is free."""
        gates = user.route.gates
        while user.gate < len(gates) and user.front > gates[user.gate].place + 0.2:
            user.committed = max(user.committed, user.gate)
            user.gate += 1
        for number in range(user.gate, len(gates)):
            gate = gates[number]
            distance = gate.place - user.front
            if number <= user.committed and (user.speed > _HESITATES or distance < 0.3):
                continue
            user.committed = min(user.committed, number - 1)  # whoever stands before a gate looks again
            if distance > user.speed**2 / 2.5 + 10.0:
                return None
            if distance < user.speed**2 / (2 * _EMERGENCY):  # it cannot stop any more
                user.committed = number
                continue
            if not self._passes(user, number, distance, on_route, leads, index):
                return max(distance - 0.5, 0.0) + user.driver.standoff
            if distance < user.speed**2 / (2 * user.driver.braking) + 1.0:
                user.committed = number
        return None

    def _passes(
        self,
        user: User,
        number: int,
        distance: float,
        on_route: dict[str, list[User]],
        leads: Leads,
        index: int,
    ) -> bool:
        """Return whether a user may pass a gate."""
        gate = user.route.gates[number]
        if gate.group is not None:
            light = self.world.signals.light(gate.group, self.time)
            if light is Light.RED or (light is Light.YELLOW and distance > user.speed**2 / (2 * 3.0)):
                return False
        gap = float(leads.gap[index])
        if gate.keeps_clear and leads.speed[index] < 1.0 and user.front + gap < gate.keeps_clear + 8.0:
            return user.front + gap < gate.place  # whoever stands before the gate does not matter to it
        zones = self.world.zones[user.route.name][number]
        return may_pass(user, zones, on_route, self._is_red)

    def _is_red(self, user: User) -> bool:
        """Return whether the light of a user's next gate keeps it from going on."""
        gates = user.route.gates
        group = gates[user.gate].group if user.gate < len(gates) else None
        return group is not None and self.world.signals.light(group, self.time) is not Light.GREEN

    def _end_routes(self) -> None:
        """Let go who has reached the end of a line: out of the scene, or onto the next route."""
        staying = []
        for user in self.users:
            if user.route.then and user.place >= user.route.line.length - 2.0 and user.speed < _STOPPED:
                if math.isnan(user.parked_until):
                    user.parked_until = self.time + self._rng.uniform(*_DWELL)
                elif self.time >= user.parked_until:
                    self._leave_bay(user)
            if user.route.stops or user.place < user.route.line.length:
                staying.append(user)
        self.users = staying

    def _leave_bay(self, user: User) -> None:
        """Put a parked user on its next route, which begins where it stands."""
        user.route = self.world.routes[user.route.then]
        user.limit = self._limit(user.route, user.driver.braking)
        place, left = user.route.line.nearest(user.position[None])
        user.place = float(place[0])
        user.aside = (float(left[0]), user.place, 8.0)
        user.gate, user.committed, user.parked_until = 0, -1, math.nan

    def _fill(self) -> None:
        """Put users on their ways, but not where ways cross."""
        for kind, wanted in self._population.items():
            for _ in range(wanted * _TRIES):
                if sum(user.kind == kind for user in self.users) >= wanted:
                    break
                route = self._draw_route(kind)
                if route.then:  # parked already
                    self._admit(self._new(route, route.line.length - 1.0))
                    continue
                first = route.gates[0].place - 6.0 if route.gates else route.line.length - 20.0
                self._admit(self._new(route, self._rng.uniform(0.0, first)))

    def _enter(self, seconds: float) -> None:
        """Let new users in where there are too few and there is room."""
        for kind, wanted in self._population.items():
            present = sum(user.kind == kind for user in self.users)
            if present < wanted and self._rng.random() < seconds * (_ARRIVALS * (1 - present / wanted) + 0.1):
                self._admit(self._new(self._draw_route(kind)))

    def _draw_route(self, kind: Kind) -> Route:
        routes = [route for route in self.world.routes.values() if route.kind == kind and route.share]
        shares = np.array([route.share for route in routes])
        return routes[self._rng.choice(len(routes), p=shares / shares.sum())]

    def _new(self, route: Route, place: float = 0.0) -> User:
        """Return a user on a route."""
        driver = draw_driver(self._rng, route.kind, route.speed)
        limit = self._limit(route, driver.braking)
        aside = (self._rng.uniform(*route.spread), 0.0, math.inf)
        speed = 0.9 * min(driver.speed, float(limit[int(place / STEP)]))
        user = User("", route, limit, driver, place, speed, aside)
        self._locate([user])
        return user

    def _admit(self, user: User) -> None:
        """Add a user if there is room for it, and a place if it wants to park."""
        then = user.route.then
        if then and any(then in (other.route.name, other.route.then) for other in self.users):
            return
        for other in self.users:
            between = other.position - user.position
            needed = (user.body.length + other.body.length) / 2 + user.driver.standoff
            if math.cos(other.heading - user.heading) > 0.5:
                ahead = math.cos(user.heading) * between[0] + math.sin(user.heading) * between[1] > 0
                front, rear = (other, user) if ahead else (user, other)
                closing = max(rear.speed**2 - front.speed**2, 0.0) / (2 * rear.driver.braking)
                needed += rear.speed * rear.driver.headway + closing
                side = abs(math.cos(user.heading) * between[1] - math.sin(user.heading) * between[0])
                if side > (user.body.width + other.body.width) / 2 + 0.4:
                    continue
            if np.hypot(*between) < needed:
                return
        self._born += 1
        user.name = f"{user.kind}-{self._born}"
        self.users.append(user)

    def _limit(self, route: Route, braking: float) -> Floats:
        """Return the speed limit along a route's own line."""
        if route.stops and not route.then:
            braking = _LANE_ENDS
        key = route.name, round(braking, 1)
        if key not in self._limits:
            self._limits[key] = speed_limit(route.line, route.kind, key[1], route.stops)
        return self._limits[key]

    def _locate(self, users: Sequence[User]) -> None:
        if users:
            places = np.array([[user.place] for user in users])
            positions, headings, ways = places_of(users, self.world, places)
            for user, position, heading, way in zip(
                users, positions[:, 0], headings[:, 0].tolist(), ways[:, 0].tolist(), strict=True
            ):
                user.position, user.heading, user.way = position, heading, way


def _move(user: User, wanted: float, seconds: float) -> None:
    """Accelerate a user as it wants, within its jerk, and move it on."""
    most = user.acceleration + _JERK * seconds
    least = -HARDEST_BRAKING if wanted < -_EMERGENCY else user.acceleration - _JERK * seconds
    rate = min(max(wanted, least, -HARDEST_BRAKING), most, user.driver.acceleration)
    speed = max(user.speed + rate * seconds, 0.0)
    if speed < 0.02 and wanted < 0:
        speed = 0.0
    user.place += (user.speed + speed) / 2 * seconds / user.way
    user.acceleration = (speed - user.speed) / seconds
    user.speed = speed
    user.waits = user.waits + seconds if speed < _STOPPED else 0.0
