"""Made-up scenes for every row, with the project's own numbers."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from model.arrays import Floats
from model.geometry import rotate
from tests.cases import roads
from tests.cases.case import NOW, Facts, Pose, Road, Row, Scenario, Track

Path = Callable[[Floats], tuple[Floats, Floats]]
"""Position [F, 2], m, and heading [F], rad, at distances [F], m, along the path from the car's position."""

LANE = 3.6
"""Width of a lane, m."""
HISTORY = 2.8
"""s of observations, except in cases about short histories."""
RATE = 10.0
"""Hz of observations, unless a case sets another."""
STOP_X = -14.0
"""m, the position of a car that waits at a red light."""


def line(x: float, y: float, heading: float = 0.0) -> Path:
    """Return a straight path through a point."""
    ahead = np.array([math.cos(heading), math.sin(heading)])
    return lambda s: (np.array([x, y]) + s[:, None] * ahead, np.full(len(s), heading))


def left_arc(start: Floats, radius: float, at: float, arc: float = math.inf) -> Path:
    """Return a path along x that turns left at a point and then continues straight.

    Args:
        start: start of the turn, [2], m.
        radius: radius of the turn, m.
        at: distance of the car beyond that point now, m; negative: before it.
        arc: angle of the turn, rad.
    """

    def path(s: Floats) -> tuple[Floats, Floats]:
        way = s + at
        angle = np.clip(way / radius, 0.0, arc)
        bent = radius * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1)
        rest = np.where(way < 0, way, np.maximum(way - radius * arc, 0.0))
        return start + bent + rotate(np.stack([rest, np.zeros_like(rest)], axis=-1), angle), angle

    return path


def standing(
    name: str,
    *,
    heading: float = 0.0,
    slip: float = 0.0,
    noise: float = 0.0,
    heading_noise: float = 0.01,
    oriented: bool = True,
    exact: bool = True,
    rate: float = RATE,
    seed: int = 0,
    row: Row = Row.STANDING,
) -> Scenario:
    """Return a car that waits at a junction.

    Args:
        name: name of the case.
        heading: heading of the whole scene, rad.
        slip: observed velocity to the left, m/s.
        noise: standard deviation of positions, m.
        heading_noise: standard deviation of headings, rad; without effect if ``noise`` is 0.
        oriented: whether headings are observed.
        exact: whether velocities are observed.
        rate: rate of observations, Hz.
        seed: seed of the noise.
        row: row of the case.
    """
    times = _times(rate)
    positions = np.array([STOP_X, -LANE / 2]) + np.stack([np.zeros_like(times), slip * times], axis=-1)
    velocities = np.tile([0.0, slip], (len(times), 1))
    track = Track(times, positions, np.zeros(len(times)), velocities)
    observed = noisy(track, noise, heading_noise if noise else 0.0, seed)
    return Scenario(
        name,
        row,
        _without(observed, headings=not oriented, velocities=not exact),
        positions[-1],
        0.0,
        Facts(speed=0.0, noisy=noise > 0, oriented=oriented),
        roads.junction(2, LANE, 5.0),
        pose=Pose(angle=heading),
    )


def parked(name: str, *, gap: float = 0.6, rate: float = RATE, noise: float = 0.0, seed: int = 0) -> Scenario:
    """Return a car that is parked at the kerb of a straight road, its side ``gap`` m from the edge."""
    y = -2 * LANE + 1.0 + gap
    return drive(name, Row.PARKED, line(0.0, y), 0.0, rate=rate, noise=noise, seed=seed, velocities=not noise)


def drive(
    name: str,
    row: Row,
    path: Path,
    speed: float,
    *,
    acceleration: float = 0.0,
    road: Road | None = None,
    rate: float = RATE,
    history: float = HISTORY,
    noise: float = 0.0,
    heading_noise: float = 0.0,
    headings: bool = True,
    velocities: bool = True,
    reverse: bool = False,
    turned: float = 0.0,
    seed: int = 0,
    companion: str = "",
) -> Scenario:
    """Return a car that drives along a path.

    Args:
        name: name of the case.
        row: row of the case.
        path: path of the car.
        speed: speed along the path now, m/s.
        acceleration: acceleration along the path while the car moves, m/s².
        road: the map; None: a straight road along x, two lanes of 3.6 m per direction.
        rate: rate of observations, Hz.
        history: duration of the observations, s.
        noise: standard deviation of positions, m.
        heading_noise: standard deviation of headings, rad.
        headings: whether headings are observed.
        velocities: whether velocities are observed.
        reverse: whether the car drives backwards.
        turned: see ``Facts``.
        seed: seed of the noise.
        companion: see ``Facts``.
    """
    times = _times(rate, history)
    now, _ = path(np.zeros(1))
    exact = driven(path, times, speed, acceleration, reverse)
    assert exact.headings is not None
    observed = noisy(exact, noise, heading_noise, seed)
    return Scenario(
        name,
        row,
        _without(observed, headings=not headings, velocities=not velocities),
        now[0],
        float(exact.headings[-1]),
        Facts(
            -speed if reverse else speed,
            -acceleration if reverse else acceleration,
            turned,
            noise > 0 or heading_noise > 0,
            headings,
            companion,
        ),
        road or roads.straight(2, LANE),
    )


def driven(
    path: Path, times: Floats, speed: float, acceleration: float = 0.0, reverse: bool = False
) -> Track:
    """Return the noise-free observations of a car at times [F], s from now; arguments as in ``drive``."""
    began = -speed / acceleration if acceleration > 0 else -math.inf  # until then the car stood
    clipped = np.maximum(times, began)
    speeds = np.where(times < began, 0.0, speed + acceleration * times)
    positions, headings = path(speed * clipped + acceleration * clipped**2 / 2)
    velocities = speeds[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    return Track(times, positions, headings + math.pi if reverse else headings, velocities)


def noisy(track: Track, noise: float, heading_noise: float, seed: int) -> Track:
    """Return a track with normal noise on its positions (m) and headings (rad)."""
    generator = np.random.default_rng(seed)
    positions = track.positions + noise * generator.standard_normal(track.positions.shape)
    headings = track.headings
    if headings is not None:
        headings = headings + heading_noise * generator.standard_normal(headings.shape)
    return replace(track, positions=positions, headings=headings)


def heading_flip(name: str, speed: float, rate: float) -> Scenario:
    """Return a car that drives straight on, its last heading wrong by π."""
    scenario = drive(name, Row.FLIP, line(0.0, -1.5 * LANE), speed, rate=rate, velocities=False)
    assert scenario.car.headings is not None
    headings = scenario.car.headings.copy()
    headings[-1] += math.pi
    return replace(scenario, car=replace(scenario.car, headings=headings))


def jitter(name: str, speed: float, spread: float, seed: int, *, told: bool) -> Scenario:
    """Return a car observed at times up to ``spread`` s off the grid.

    Args:
        name: name of the case.
        speed: speed, m/s.
        spread: max deviation, s.
        seed: seed of the times.
        told: whether the observations carry the true times rather than the grid's.
    """
    scenario = drive(name, Row.STRAIGHT, line(0.0, -1.5 * LANE), speed, headings=False, velocities=False)
    grid = scenario.car.times
    seen = grid + np.random.default_rng(seed).uniform(-spread, spread, len(grid))
    if told:
        seen = np.sort(seen[seen <= 0])
        grid = seen
    positions, _ = line(0.0, -1.5 * LANE)(speed * seen)
    return replace(
        scenario,
        car=Track(grid, positions),
        facts=replace(scenario.facts, noisy=not told),
    )


def standing_lead(name: str, speed: float, ahead: float, *, y: float = -LANE / 2) -> Scenario:
    """Return a car that drives towards a standing car, whose centre is ``ahead`` m ahead of its own."""
    scenario = drive(name, Row.LEAD, line(0.0, y), speed)
    lead = driven(line(ahead, y), scenario.car.times, 0.0)
    return replace(scenario, lead=lead)


def without_map(scenario: Scenario, name: str) -> Scenario:
    """Return the same scene without a map."""
    return replace(scenario, name=name, road=None)


def at_poses(scenarios: Sequence[Scenario]) -> list[Scenario]:
    """Return each scene once, rotated by its own angle and far from the ground frame's origin, every third
    one mirrored."""
    generator = np.random.default_rng(5)
    placed = []
    for number, scenario in enumerate(scenarios):
        x, y = generator.uniform(-2000, 2000, 2).round(2)
        angle = scenario.pose.angle + generator.uniform(-math.pi, math.pi)
        placed.append(scenario.at(Pose(float(x), float(y), float(angle), mirrored=number % 3 == 2)))
    return placed


def all_rows() -> list[Scenario]:
    """Return the scenes, in the order of the table, their roads along x; companions are among them."""
    outer, inner = line(0.0, -1.5 * LANE), line(0.0, -0.5 * LANE)
    fast_road, fast_lane = roads.straight(3, 3.75), line(0.0, -1.5 * 3.75)
    clean = drive("straight 9", Row.STRAIGHT, outer, 9.0)
    crossing = roads.junction(2, LANE, 5.0)

    def approach(x: float) -> Path:
        return line(x, -0.5 * LANE)

    def turn(radius: float, turned: float) -> Path:
        return left_arc(np.array([LANE / 2 - radius, -LANE / 2]), radius, turned * radius, math.pi / 2)

    return [
        standing("standing"),
        standing("standing, 2 Hz", rate=2.0),
        standing("standing, headings 3 cm", exact=False, noise=0.03, seed=11),
        standing("standing, 1 cm, 5 Hz", exact=False, noise=0.01, rate=5.0, seed=12),
        standing("standing, no headings", oriented=False, exact=False),
        standing("sideways 2 cm/s, 2 Hz", slip=0.02, rate=2.0, row=Row.SIDEWAYS),
        standing("sideways -2 cm/s", slip=-0.02, row=Row.SIDEWAYS),
        parked("parked"),
        parked("parked, 2 cm", gap=0.3, noise=0.02, seed=13),
        drive("creeping 0.6", Row.CREEPING, outer, 0.6),
        drive("creeping 0.4, 5 Hz", Row.CREEPING, inner, 0.4, rate=5.0, velocities=False),
        heading_flip("heading flip 9, 10 Hz", 9.0, 10.0),
        heading_flip("heading flip 11, 2 Hz", 11.0, 2.0),
        drive("reversing 1.6", Row.REVERSE, line(0.0, -1.5 * LANE, math.pi), 1.6, reverse=True),
        drive(
            "reversing 2.3, no velocities",
            Row.REVERSE,
            line(0.0, -1.5 * LANE, math.pi),
            2.3,
            reverse=True,
            velocities=False,
        ),
        drive(
            "reversing 1.8, no headings",
            Row.REVERSE,
            line(0.0, -1.5 * LANE, math.pi),
            1.8,
            reverse=True,
            headings=False,
            velocities=False,
        ),
        clean,
        drive("straight 12, 20 Hz", Row.STRAIGHT, inner, 12.0, rate=20.0),
        drive("straight 9, 2 Hz", Row.STRAIGHT, outer, 9.0, rate=2.0, headings=False, velocities=False),
        drive(
            "straight 9, 5 cm",
            Row.STRAIGHT,
            outer,
            9.0,
            noise=0.05,
            headings=False,
            velocities=False,
            seed=21,
            companion=clean.name,
        ),
        drive(
            "straight 9, 5 cm 0.02 rad",
            Row.STRAIGHT,
            outer,
            9.0,
            noise=0.05,
            heading_noise=0.02,
            velocities=False,
            seed=22,
            companion=clean.name,
        ),
        drive(
            "straight 9, 8 cm, 20 Hz",
            Row.STRAIGHT,
            outer,
            9.0,
            rate=20.0,
            noise=0.08,
            heading_noise=0.03,
            velocities=False,
            seed=23,
            companion=clean.name,
        ),
        without_map(clean, "straight 9, no map"),
        jitter("jitter 30 ms", 9.0, 0.03, 24, told=True),
        jitter("timestamps 30 ms off", 9.0, 0.03, 25, told=False),
        drive("noisy headings 0.1", Row.NOISY_HEADINGS, outer, 9.0, heading_noise=0.1, seed=26),
        drive(
            "noisy headings 0.08, 2 Hz",
            Row.NOISY_HEADINGS,
            inner,
            11.0,
            heading_noise=0.08,
            rate=2.0,
            seed=27,
        ),
        drive("highway 22", Row.HIGHWAY, fast_lane, 22.0, road=fast_road),
        drive("highway 30", Row.HIGHWAY, fast_lane, 30.0, road=fast_road, rate=20.0),
        drive("highway 37", Row.HIGHWAY, fast_lane, 37.0, road=fast_road),
        drive("accelerating 1.7", Row.ACCELERATING, outer, 3.4, acceleration=1.7),
        drive("accelerating 2.2", Row.ACCELERATING, inner, 2.8, acceleration=2.2, velocities=False),
        drive("braking 2.7", Row.BRAKING, outer, 5.2, acceleration=-2.7),
        drive("braking 3.4", Row.BRAKING, inner, 6.0, acceleration=-3.4, velocities=False),
        *(
            drive(
                f"curve {radius:g}",
                Row.CURVE,
                line(x, y),
                speed,
                road=roads.curve(radius, 2, LANE),
            )
            for radius, speed, x, y in (
                (42.0, 8.0, -6.0, -1.8),
                (62.0, 10.5, 0.0, -5.4),
                (78.0, 12.0, -3.0, -5.4),
            )
        ),
        drive("junction in 22 m", Row.JUNCTION, approach(-22.0), 7.5, road=crossing),
        drive("junction in 30 m", Row.JUNCTION, approach(-30.0), 8.5, road=crossing, rate=5.0),
        drive("left turn 0.6 rad", Row.LEFT_TURN, turn(10.0, 0.6), 5.5, road=crossing, turned=0.6),
        drive(
            "left turn 0.75 rad",
            Row.LEFT_TURN,
            turn(11.0, 0.75),
            6.5,
            road=crossing,
            turned=0.75,
            velocities=False,
        ),
        standing_lead("lead in 24 m", 9.0, 24.0),
        standing_lead("lead in 29 m", 11.0, 29.0, y=-1.5 * LANE),
        drive("one state", Row.SHORT, outer, 9.0, history=0.0, companion=clean.name),
        drive(
            "one state, no heading", Row.SHORT, outer, 9.0, history=0.0, headings=False, companion=clean.name
        ),
        *(
            drive(
                f"two states {gap:g} s apart",
                Row.SHORT,
                outer,
                9.0,
                rate=1 / gap,
                history=gap,
                headings=False,
                velocities=False,
                companion=clean.name,
            )
            for gap in (0.1, 0.5)
        ),
    ]


def ticks(
    path: Path, speed: float, road: Road, count: int, *, noise: float, heading_noise: float
) -> list[Scenario]:
    """Return the scenes of one car at ``count`` successive ticks, 0.1 s apart.

    An observation has the same noise in every tick. The path starts at the car's position at the first tick.

    Args:
        path: path of the car.
        speed: speed, m/s.
        road: the map.
        count: number of ticks.
        noise: standard deviation of positions, m.
        heading_noise: standard deviation of headings, rad.
    """
    frames = round(HISTORY * RATE) + 1
    times = np.arange(1 - frames, count) / RATE
    exact = driven(path, times, speed)
    observed = _without(noisy(exact, noise, heading_noise, 31), velocities=True)
    assert exact.headings is not None
    assert observed.headings is not None
    begin, end = exact.positions.min(0), exact.positions.max(0) + 6.0 * speed + 40.0
    scenarios = []
    for tick in range(count):
        seen, now = slice(tick, tick + frames), tick + frames - 1
        scenarios.append(
            Scenario(
                f"tick {tick}",
                Row.STRAIGHT,
                Track(times[seen] - times[now], observed.positions[seen], observed.headings[seen]),
                exact.positions[now],
                float(exact.headings[now]),
                Facts(speed, noisy=True),
                road,
                extent=((begin[0], begin[1]), (end[0], end[1])),
            )
        )
    return scenarios


def _times(rate: float, history: float = HISTORY) -> Floats:
    """Return the times of observations, s relative to now, after rounding to float64 as absolute times."""
    count = math.floor(history * rate + 1e-6) + 1
    ages = np.arange(count - 1, -1, -1) / rate
    return (NOW - ages) - NOW


def _without(track: Track, *, headings: bool = False, velocities: bool = False) -> Track:
    return replace(
        track,
        headings=None if headings else track.headings,
        velocities=None if velocities else track.velocities,
    )
