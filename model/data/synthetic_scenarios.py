"""Scenarios of made-up scenes: the roads, and the vehicles and pedestrians on them, before they move.

A plan is drawn for a kind of scene. ``model.data.synthetic_roads`` has the roads' geometry,
``model.data.synthetic_traffic`` moves the vehicles.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from model.arrays import Floats
from model.data.synthetic_roads import (
    STEP,
    Junction,
    Lane,
    Road,
    draw_junction,
    draw_line,
    draw_section,
    headings,
    places,
    shifted,
)
from model.data.synthetic_traffic import Vehicle, draw_driver, wander
from model.geometry import wrap_angle
from model.scenes.scene import STEP_SECONDS

WARM_UP = 2.0
"""s of traffic before the first frame."""
_OWN_STREAMS = 1000
"""Streams numbered from about here on belong to no lane; their vehicles follow only each other."""
_ROOM = 95.0
"""m of road behind the last and before the first vehicle."""


class Kind(NamedTuple):
    """A kind of scene."""

    share: float
    """Share of the scenes of this kind."""
    lanes: tuple[float, float, float]
    """Shares of 1, 2 and 3 lanes a direction."""
    radii: tuple[float, float]
    """m, range of the arcs' radii."""
    turn: float
    """rad, maximum turn of an arc."""
    desired: tuple[float, float]
    """m/s, range of the desired speed."""
    frames: int = 24
    spread: float = 70.0
    """m of a lane on which vehicles start."""


KINDS = {
    "junction": Kind(0.3, (1, 0, 0), (1, 1), 0.0, (6.0, 16.0)),
    "city": Kind(0.14, (0.6, 0.3, 0.1), (12.0, 500.0), 1.2, (5.0, 16.0)),
    "bends": Kind(0.13, (0.9, 0.1, 0.0), (12.0, 120.0), 1.7, (7.0, 20.0)),
    "fast": Kind(0.2, (0.1, 0.5, 0.4), (200.0, 5000.0), 0.6, (18.0, 40.0), 20, 160.0),
    "lead": Kind(0.12, (0.5, 0.35, 0.15), (40.0, 800.0), 0.8, (5.0, 16.0)),
    "queue": Kind(0.06, (0.5, 0.4, 0.1), (20.0, 500.0), 1.2, (0.3, 2.0)),
    "parking": Kind(0.11, (0.9, 0.1, 0.0), (60.0, 800.0), 0.6, (4.0, 11.0)),
}


@dataclass
class Plan:
    """A scene before its vehicles move."""

    frames: int
    roads: list[Road] = field(default_factory=list)
    junction: Junction | None = None
    stubs: list[tuple[Floats, float]] = field(default_factory=list)
    """Lines [L, 2] and half widths, m, of side roads."""
    vehicles: list[Vehicle] = field(default_factory=list)
    parked: list[tuple[Floats, float]] = field(default_factory=list)
    """Positions [2], m, and headings, rad."""
    walkers: list[Floats] = field(default_factory=list)
    """Paths [F, 2], m."""

    @property
    def seconds(self) -> float:
        """Duration of the simulation, s."""
        return WARM_UP + (self.frames - 1) * STEP_SECONDS


def draw_plan(rng: np.random.Generator, name: str) -> Plan:
    """Return a plan of a kind of scene.

    Args:
        rng: random generator.
        name: name of the kind, in ``KINDS``.
    """
    if name == "junction":
        return _plan_junction(rng, KINDS[name])
    kind = KINDS[name]
    plan = Plan(kind.frames)
    desired = rng.uniform(*kind.desired)
    road = _draw_road(rng, name, kind, desired, plan.seconds)
    plan.roads.append(road)
    length = len(road.line) * STEP
    if name in ("city", "bends", "lead", "parking"):
        plan.stubs += [_draw_stub(rng, road) for _ in range(rng.integers(0, 4))]
    if name == "lead":
        _add_lead(rng, plan, road, desired)
    elif name == "parking":
        for _ in range(rng.integers(1, 4)):
            _add_reversing(rng, plan, road)
    for stream, lane in enumerate(road.section.lanes):
        taken = any(stream in (one.stream, one.joins) for one in plan.vehicles)
        if taken or (plan.vehicles and rng.random() < 0.2):
            continue
        _add_traffic(rng, plan, road, stream, lane, kind, desired)
    if name == "city" and rng.random() < 0.25:
        _add_u_turn(rng, plan, road, desired)
    reach = min(length - _ROOM, _ROOM + 120.0)
    if name != "fast" or rng.random() < 0.15:
        _add_parked(rng, plan, road, (_ROOM, reach), 10 if name in ("city", "parking") else 4)
    if name not in ("fast", "bends") or rng.random() < 0.3:
        _add_walkers(rng, plan, road, (_ROOM, reach), int(rng.integers(0, 5)))
    return plan


def _draw_road(rng: np.random.Generator, name: str, kind: Kind, desired: float, seconds: float) -> Road:
    ahead = int(rng.choice([1, 2, 3], p=kind.lanes))
    back = 0 if rng.random() < 0.3 else int(rng.integers(1, ahead + 1)) if rng.random() < 0.2 else ahead
    width = rng.uniform(3.2, 3.9) if name == "fast" else rng.uniform(2.8, 3.9)
    median = rng.uniform(0.0, 6.0) if rng.random() < (0.6 if name == "fast" else 0.12) else 0.0
    strips = [0.0, 0.0]
    for side in range(2):
        if name == "fast":
            strips[side] = rng.choice([0.0, rng.uniform(0.5, 3.0)])
        elif name != "bends" and rng.random() < (0.9 if name == "parking" else 0.55):
            strips[side] = rng.uniform(4.8, 5.6) if rng.random() < 0.25 else rng.uniform(1.8, 2.6)
    section = draw_section(rng, ahead, back, width, median, (strips[0], strips[1]))
    least = max(kind.radii[0], max(map(abs, section.edges)) + 6.0)
    if name == "fast":
        least = max(least, desired**2 / rng.uniform(1.5, 3.0))  # so that its bends need little braking
    length = 2 * _ROOM + kind.spread + max(desired, 3.0) * 1.15 * seconds
    return Road(draw_line(rng, length, (least, max(kind.radii[1], 2 * least)), kind.turn), section)


def _draw_stub(rng: np.random.Generator, road: Road) -> tuple[Floats, float]:
    """Return a side road, which no vehicle of the scene takes."""
    left = bool(rng.random() < 0.5)
    row = int(rng.integers(len(road.line)))
    d = road.section.edges[int(left)]
    start = shifted(road.line, d - np.sign(d))[row]
    away = headings(road.line)[row] + np.sign(d) * (np.pi / 2 + rng.uniform(-0.4, 0.4))
    length = rng.choice([rng.uniform(6.0, 20.0), rng.uniform(30.0, 120.0)])
    line = start + np.arange(0.0, length, STEP)[:, None] * np.array([np.cos(away), np.sin(away)])
    return line, float(rng.uniform(1.8, 4.5))


def _along(road: Road, lane: Lane, d: Floats | float) -> Floats:
    """Return a path [L, 2], m, at a distance d from the road's line, in the direction of the lane."""
    line = shifted(road.line, d)
    return line if lane.ahead else line[::-1]


def _step(place: Floats, begin: float, length: float) -> Floats:
    """Return a smooth step from 0 to 1 over a length, m, from a place on."""
    part = np.clip((place - begin) / length, 0.0, 1.0)
    smooth_step: Floats = part * part * (3 - 2 * part)
    return smooth_step


def _add_traffic(
    rng: np.random.Generator, plan: Plan, road: Road, stream: int, lane: Lane, kind: Kind, desired: float
) -> None:
    """Add vehicles in one lane, from the first one back."""
    start = _ROOM + rng.uniform(0.4, 1.0) * kind.spread
    lanes = road.section.of(lane.ahead)
    queue = desired < 3.0
    halt = (0.0, rng.uniform(2.0, 40.0), 2.0) if queue and rng.random() < 0.25 else None
    while start > _ROOM - 10 and len(plan.vehicles) < 9:
        driver = draw_driver(rng, desired)
        others = [one for one in lanes if abs(abs(one.d - lane.d) - road.section.lane_width) < 0.1]
        changes = others and not queue and rng.random() < 0.2
        most = min(0.45, road.section.lane_width / 2 - 1.1)
        along = places(road.line)
        d = np.full(len(along), lane.d)
        begin = length = np.inf
        joins = None
        if changes:
            onto = others[int(rng.integers(len(others)))]
            length = max(driver.desired * rng.uniform(3.0, 6.0), 25.0)
            begin = start + rng.uniform(0.0, 0.8) * driver.desired * plan.seconds
            d += (onto.d - lane.d) * _step(along, begin, length)
            joins = road.section.lanes.index(onto)
        line, place = wander(rng, _along(road, lane, d if lane.ahead else d[::-1]), most, along)
        vehicle = Vehicle(line, place, start, driver.desired, driver, stream)
        vehicle.leaves, vehicle.joins, vehicle.joined = begin + length, joins, begin
        _add_events(rng, vehicle, plan.seconds)
        if halt:
            vehicle.brakes, vehicle.speed = halt, 0.0
            halt = (0.0, halt[1] + rng.uniform(0.5, 1.5), 2.0)
        plan.vehicles.append(vehicle)
        pause = rng.uniform(0.0, 3.0) if queue else driver.desired * rng.uniform(0.8, 4.0)
        start -= 4.7 + driver.gap + pause


def _add_events(rng: np.random.Generator, vehicle: Vehicle, seconds: float) -> None:
    """Let some vehicles change their speed, stop or start."""
    event = rng.random()
    when = rng.uniform(0.0, seconds - 2.0)
    if vehicle.driver.desired > 18:
        if event < 0.3:
            vehicle.changes = (when, rng.uniform(0.7, 1.2))
        elif event < 0.38:
            vehicle.brakes = (when, when + rng.uniform(1.0, 3.0), rng.uniform(1.0, 3.0))
    elif event < 0.12:
        vehicle.brakes = (when, when + rng.uniform(5.0, 60.0), rng.uniform(1.0, 4.0))
    elif event < 0.24:
        vehicle.speed, vehicle.brakes = 0.0, (0.0, rng.uniform(1.0, 2.5 * seconds), 2.0)
    elif event < 0.5:
        vehicle.changes = (when, rng.uniform(0.3, 1.8))


def _add_lead(rng: np.random.Generator, plan: Plan, road: Road, desired: float) -> None:
    """Add a vehicle that stands in a lane, and some behind it that stop or pass it."""
    section = road.section
    lanes = section.of(ahead=True)
    index = len(lanes) - 1 if rng.random() < 0.8 else int(rng.integers(len(lanes)))
    lane = lanes[index]
    driver = draw_driver(rng, desired)
    where = _ROOM + rng.uniform(0.5, 1.0) * KINDS["lead"].spread + rng.uniform(0.0, 2.0) * desired
    line, place = wander(rng, _along(road, lane, lane.d), 0.6, places(road.line))
    plan.vehicles.append(
        Vehicle(line, place, where, 0.0, driver, index, brakes=(0.0, np.inf, 2.0), about_lead=True)
    )
    # On the left is the adjacent lane, or one of the other direction
    left = [one.d - lane.d for one in section.lanes if 0 < one.d - lane.d < section.lane_width + 1.5]
    right = [one.d - lane.d for one in lanes if -section.lane_width - 0.1 < one.d - lane.d < 0]
    sides = (left or right) if section.median is None or index else right
    passes = bool(sides) and rng.random() < 0.55
    start = where - max(9.0, desired * rng.uniform(1.5, 7.0))
    for _ in range(rng.integers(1, 4)):
        if start < _ROOM - 40:
            break
        driver = draw_driver(rng, desired)
        along = places(road.line)
        d = np.full(len(along), lane.d)
        if passes:
            aside = sides[0] * rng.uniform(min(0.95, 2.5 / abs(sides[0])), 1.05)
            leaving, returning = (max(driver.desired * rng.uniform(1.3, 3.0), 11.0) for _ in range(2))
            d += aside * _step(along, where - 5.5 - leaving, leaving)
            if len(lanes) == 1 or rng.random() < 0.5:
                d -= aside * _step(along, where + rng.uniform(5.5, 12.0), returning)
        line, place = wander(rng, _along(road, lane, d), 0.25, along)
        stream = _OWN_STREAMS - 1 if passes else index
        vehicle = Vehicle(line, place, start, driver.desired, driver, stream, about_lead=True)
        if passes and sides[0] > 0 and len(lanes) == 1:
            vehicle.joins = index + 1  # reserves the lane of oncoming traffic
        plan.vehicles.append(vehicle)
        start -= 4.7 + driver.gap + driver.desired * rng.uniform(0.7, 2.5)


def _add_reversing(rng: np.random.Generator, plan: Plan, road: Road) -> None:
    """Add a vehicle that reverses: into a strip, out of a perpendicular bay, or along the kerb."""
    section = road.section
    row = int(rng.uniform(_ROOM + 10, _ROOM + 70) / STEP)
    strip = section.strips[int(rng.integers(len(section.strips)))] if section.strips else None
    ahead = strip.d < 0 if strip else True
    if strip and strip.d > 0 and not section.of(ahead=False):
        ahead = True
    lanes = section.of(ahead)
    lane = lanes[0] if strip and (strip.d > 0) is ahead else lanes[-1]
    way = road.line if ahead else road.line[::-1]
    sign = 1.0 if ahead else -1.0
    backwards = way[row : row - int(60 / STEP) : -1]
    place = places(backwards)
    # What lies to the left of the traffic lies to the right of a reversing vehicle
    across = strip.d if strip else lane.d
    d = np.full(len(place), sign * lane.d)
    length = rng.uniform(4.0, 25.0)
    if strip and strip.across:
        radius = rng.uniform(5.0, 7.5)
        corner = shifted(backwards, -sign * lane.d)
        out = shifted(backwards, -sign * across)
        bay = out[0] + np.linspace(0, 1, 12)[:, None] * (corner[0] - out[0])
        straight = corner[int(radius / STEP) :]
        room = max(float(np.hypot(*(out[0] - corner[0]))) - radius, 0.2)
        begin = bay[0] + (bay[-1] - bay[0]) / np.hypot(*(bay[-1] - bay[0])) * room
        angle = np.linspace(0.0, np.pi / 2, 16)[:, None]
        arc = begin + (corner[0] - begin) * np.sin(angle) + (straight[0] - corner[0]) * (1 - np.cos(angle))
        line = np.concatenate([bay[:1], arc, straight[1:]])
        length += float(np.hypot(*(arc[-1] - bay[0])))
    else:
        if strip and rng.random() < 0.6:
            side = rng.uniform(8.0, 12.0)
            length = max(length, side + 2.0)
            d += sign * (across - lane.d) * _step(place, rng.uniform(0.0, length - side), side)
        elif strip and rng.random() < 0.4:
            d[:] = sign * across
        line = shifted(backwards, -d)
    line, place = wander(rng, line, 0.15, places(line))
    line, place = line[: int(length / STEP)], place[: int(length / STEP)]
    driver = draw_driver(rng, rng.uniform(1.0, 3.0))
    driver = replace(driver, acceleration=rng.uniform(0.4, 1.2), braking=rng.uniform(0.5, 1.5))
    vehicle = Vehicle(line, place, 0.0, 0.0, driver, _OWN_STREAMS + len(plan.vehicles))
    vehicle.brakes = (0.0, rng.uniform(0.0, 5.0), 2.0)  # most pairs are then of vehicles that move
    vehicle.backwards = vehicle.ends = True
    plan.vehicles.append(vehicle)


def _add_u_turn(rng: np.random.Generator, plan: Plan, road: Road, desired: float) -> None:
    """Add a vehicle that makes a U-turn, if the road is wide enough."""
    section = road.section
    ways = [
        (lane, back)
        for lane in section.of(ahead=True)
        for back in section.of(ahead=False)
        if back.d - lane.d > 9.6 and section.median is None
    ]
    if not ways:
        return
    lane, back = ways[int(rng.integers(len(ways)))]
    row = int((_ROOM + rng.uniform(40.0, 70.0)) / STEP)
    radius = (back.d - lane.d) / 2
    heading = headings(road.line)[row]
    ahead, side = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    angle = np.linspace(0.0, np.pi, 30)[1:-1, None]
    round_ = road.line[row] + side * (lane.d + radius * (1 - np.cos(angle))) + ahead * radius * np.sin(angle)
    line = np.concatenate(
        [shifted(road.line, lane.d)[: row + 1], round_, shifted(road.line, back.d)[row::-1]]
    )
    line, place = wander(rng, line, 0.3, places(line))
    start = row * STEP - rng.uniform(5.0, 40.0)
    driver = draw_driver(rng, min(desired, 9.0))
    plan.vehicles.insert(0, Vehicle(line, place, start, driver.desired, driver, _OWN_STREAMS - 1))


def _add_parked(
    rng: np.random.Generator, plan: Plan, road: Road, between: tuple[float, float], most: int
) -> None:
    """Add parked cars in the strips."""
    line = road.line
    direction = headings(line)
    for strip in road.section.strips:
        taken = rng.uniform(0.0, 0.95)
        middle = shifted(line, strip.d)
        at = between[0] + rng.uniform(0.0, 8.0)
        parked = 0
        while at < between[1] and parked < most:
            if rng.random() < taken:
                row = min(int(at / STEP), len(line) - 1)
                heading = direction[row] + (np.pi if (strip.d > 0) != (rng.random() < 0.1) else 0.0)
                if strip.across:
                    heading += rng.choice([-0.5, 0.5]) * np.pi
                plan.parked.append((middle[row] + rng.normal(0.0, 0.12, 2), heading + rng.normal(0.0, 0.03)))
                parked += 1
            at += rng.uniform(2.6, 3.2) if strip.across else rng.uniform(5.6, 7.5)


def _add_walkers(
    rng: np.random.Generator, plan: Plan, road: Road, between: tuple[float, float], number: int
) -> None:
    """Add pedestrians beside the road; some of them stand."""
    for _ in range(number):
        d = road.section.edges[0] - rng.uniform(0.8, 3.5) if rng.random() < 0.5 else 0.0
        d = d or road.section.edges[1] + rng.uniform(0.8, 3.5)
        pace = 0.0 if rng.random() < 0.25 else rng.normal(1.35, 0.25) * rng.choice([-1.0, 1.0])
        at = rng.uniform(*between) + pace * STEP_SECONDS * np.arange(plan.frames)
        rows = places(road.line)
        way = shifted(road.line, d)
        plan.walkers.append(np.stack([np.interp(at, rows, axis) for axis in way.T], axis=-1))


def _plan_junction(rng: np.random.Generator, kind: Kind) -> Plan:
    """Return a plan of a junction with traffic lights, signs or neither."""
    plan = Plan(kind.frames)
    desired = rng.uniform(*kind.desired)
    reach = 2 * _ROOM + desired * 1.15 * plan.seconds
    junction = draw_junction(rng, reach)
    plan.junction = junction
    control = "free" if junction.ring else str(rng.choice(["lights", "signs", "free"], p=[0.7, 0.08, 0.22]))
    green = int(rng.integers(2))
    change = rng.uniform(1.0, 1.4 * plan.seconds) if rng.random() < 0.4 else np.inf
    for arm in rng.permutation(len(junction.arms)).tolist():
        section = junction.arms[arm].section
        for index in range(len(section.of(ahead=False))):
            if rng.random() < 0.2:
                continue
            held = control == "signs" or (control == "lights" and arm % 2 != green)
            until = change if control == "lights" else np.inf
            _add_arm(rng, plan, junction, (arm, index), desired, held, until, control == "signs")
        road = junction.arms[arm]
        near = road.begin + 12.0
        _add_parked(rng, plan, road, (near, near + 40.0), 3)
        _add_walkers(rng, plan, road, (road.begin + 3.0, near + 25.0), int(rng.integers(0, 3)))
    return plan


def _add_arm(
    rng: np.random.Generator,
    plan: Plan,
    junction: Junction,
    whence: tuple[int, int],
    desired: float,
    held: bool,
    until: float,
    signs: bool,
) -> None:
    """Add vehicles that enter a junction by one lane (arm, number), or have entered it."""
    arm, index = whence
    entry = junction.arms[arm].lane(junction.arms[arm].section.of(ahead=False)[index])
    waits = held and rng.random() < 0.65
    before = rng.uniform(2.8, 5.0) if waits else rng.uniform(-12.0, 0.8 * desired * plan.seconds)
    for _ in range(rng.integers(1, 4)):
        driver = draw_driver(rng, desired)
        exit_arm, lane = _draw_exit(rng, junction, arm, index)
        exit_ = junction.arms[exit_arm].lane(junction.arms[exit_arm].section.of(ahead=True)[lane])
        across = junction.connect(entry, exit_, (arm, exit_arm))
        raw = np.concatenate([entry, across[1:-1], exit_])
        length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(raw, axis=0).T))])
        stop, out = length[len(entry) - 1], length[len(entry) + len(across) - 3]
        line, place = wander(rng, raw, 0.4, length)
        own = places(line)
        at = float(np.interp(stop, place, own))
        start = at - before
        vehicle = Vehicle(line, place - stop, start, driver.desired, driver, arm * 10 + index)
        vehicle.leaves = float(np.interp(out, place, own))
        vehicle.joins, vehicle.joined, vehicle.shift = 100 + exit_arm * 10 + lane, at, stop - out
        if held and start + 2.4 < at:
            vehicle.stop, vehicle.until = at - rng.uniform(0.0, 1.5), until
            if signs:
                vehicle.wait = rng.uniform(0.3, 3.0)
        elif not held or start > at:
            _add_events(rng, vehicle, plan.seconds)
        if waits:
            vehicle.speed = 0.0
        plan.vehicles.append(vehicle)
        pause = rng.uniform(0.0, 1.5) if waits else driver.desired * rng.uniform(0.7, 3.0)
        before += 4.7 + driver.gap + pause


def _draw_exit(rng: np.random.Generator, junction: Junction, arm: int, index: int) -> tuple[int, int]:
    """Return arm and lane of an exit; left turns begin in the innermost lane, right ones in the outermost."""
    inward = headings(junction.arms[arm].line[:3])[0] + np.pi
    last = len(junction.arms[arm].section.of(ahead=False)) - 1
    choices: list[tuple[int, int]] = []
    weights = []
    for other, road in enumerate(junction.arms):
        if other == arm:
            continue
        turn = float(wrap_angle(headings(road.line[:3])[:1] - inward)[0])
        lanes = len(road.section.of(ahead=True))
        straight = abs(turn) < 0.6
        fits = straight or bool(junction.ring) or index == (0 if turn > 0 else last)
        lane = min(index, lanes - 1) if straight else 0 if turn > 0 else lanes - 1
        choices.append((other, lane))
        weights.append((0.45 if straight else 0.3) if fits else 1e-6)
    chosen = int(rng.choice(len(choices), p=np.array(weights) / sum(weights)))
    return choices[chosen]
