"""Roads of made-up scenes: lines, cross sections, junctions, and the rasters that show them.

Everything is laid out for traffic on the right, with d, the distance from a road's own line, to the left of
its direction. Traffic on the left is the mirror image of a whole scene.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from model.arrays import Floats
from model.geometry import rotate, wrap_angle
from model.scenes.scene import Raster

STEP = 0.5
"""m between points of lines."""
PIXELS_PER_METER = 3.0

_DIVIDER_PIXELS = 2
_DRIVEABLE, _ROAD_DIVIDER, _LANE_DIVIDER = range(3)
_SPACING = 2.0
"""m between the vertices that are painted."""
_RING_LANE = 5.5
"""m, width of a roundabout's lane."""


def resample(points: Floats, *along: Floats) -> tuple[Floats, ...]:
    """Return points [L, 2], ``STEP`` apart along the line through [V, 2], and numbers [V] at these points.

    Args:
        points: [V, 2], m.
        along: each [V], interpolated linearly to [L].
    """
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.arange(0.0, length[-1], STEP)
    line = np.stack([np.interp(at, length, axis) for axis in points.T], axis=-1)
    return line, *(np.interp(at, length, values) for values in along)


def places(line: Floats) -> Floats:
    """Return how far along a line, whose points [L, 2] are ``STEP`` apart, each of them lies: [L], m."""
    along: Floats = np.arange(len(line), dtype=np.float64) * STEP
    return along


def smooth(points: Floats, metres: float) -> Floats:
    """Return a line [L, 2] with points ``STEP`` apart after two moving averages, whose ends stay.

    Corners and jumps of curvature become transitions; an arc of radius R is cut by metres² / (12 R).
    """
    half = max(int(metres / STEP / 2), 1)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    for _ in range(2):
        # Reflection in the end points keeps straight ends straight
        before = 2 * points[0] - points[half:0:-1]
        after = 2 * points[-1] - points[-2 : -half - 2 : -1]
        longer = np.concatenate([before, points, after])
        points = np.stack([np.convolve(axis, kernel, "valid") for axis in longer.T], axis=-1)
    return points


def headings(points: Floats) -> Floats:
    """Return the directions [L], rad, without jumps, of a line [L, 2]."""
    ahead = np.gradient(points, axis=0)
    directions: Floats = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return directions


def shifted(points: Floats, d: Floats | float) -> Floats:
    """Return a line [L, 2] moved to its left by d, [L] or one number, m."""
    heading = headings(points)
    left: Floats = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    moved: Floats = points + left * np.reshape(d, (-1, 1))
    return moved


def draw_line(
    rng: np.random.Generator, length: float, radii: tuple[float, float], turn: float, begin: float = 0.0
) -> Floats:
    """Return a road's line [L, 2] from the origin towards +x: straights, arcs, transitions between them.

    The line never comes near itself again.

    Args:
        rng: random generator.
        length: m.
        radii: minimum and maximum radius of arcs, m.
        turn: rad, maximum turn of an arc, and maximum angle between the line and +x.
        begin: m of straight at the beginning.
    """
    for _ in range(8):
        points = _try_line(rng, length, radii, turn, begin)
        coarse = points[:: int(10 / STEP)]
        apart = np.hypot(*(coarse[:, None] - coarse[None]).transpose(2, 0, 1))
        rows = np.arange(len(coarse))
        if (apart[abs(rows[:, None] - rows) > 7] > 60).all():
            return points
    straight: Floats = np.arange(0.0, length, STEP)[:, None] * np.array([1.0, 0.0])
    return straight


def _try_line(
    rng: np.random.Generator, length: float, radii: tuple[float, float], turn: float, begin: float
) -> Floats:
    parts = [np.zeros(int(begin / STEP))]
    course, drawn = 0.0, begin
    while drawn < length:
        straight = np.zeros(int(rng.exponential(35.0) / STEP) + 1)
        radius = float(np.exp(rng.uniform(*np.log(radii))))
        angle = rng.uniform(0.15, 1.0) * min(turn, 150 / radius)
        side = float(rng.choice([-1.0, 1.0]))
        if abs(course + side * angle) > turn:
            side = -side
        full = max(int(angle * radius / STEP), 4)
        ramp = max(int(full * rng.uniform(0.1, 0.8)), 2)  # each transition turns by half as much as the arc
        rise = np.linspace(0.0, 1.0, ramp)
        arc = np.concatenate([rise, np.ones(max(full - ramp, 1)), rise[::-1]]) * side / radius
        course += float(arc.sum()) * STEP
        parts += [straight, arc]
        drawn += (len(straight) + len(arc)) * STEP
    curvature = np.concatenate(parts)[: int(length / STEP)]
    heading = np.cumsum(curvature) * STEP
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * STEP
    points: Floats = np.cumsum(steps, axis=0) - steps[0]
    return points


@dataclass(frozen=True)
class Lane:
    """A lane of a cross section."""

    d: float
    """m, its middle."""
    ahead: bool
    """True if traffic runs as the road's line does."""


@dataclass(frozen=True)
class Strip:
    """Room for parked cars beside the lanes."""

    d: float
    """m, its middle."""
    across: bool
    """True if the cars stand at a right angle to the road."""


@dataclass(frozen=True)
class CrossSection:
    """Cross section of a road, along the distance d from its line."""

    lanes: Sequence[Lane]
    """Lanes ahead, then lanes back, each from the middle to the edge."""
    lane_width: float
    """m."""
    edges: tuple[float, float]
    """d of the right and the left edge, m."""
    median: tuple[float, float] | None
    """d of an island between the directions, m."""
    dividers: Sequence[tuple[int, float]]
    """Layer and d, m."""
    strips: Sequence[Strip]

    def of(self, ahead: bool) -> list[Lane]:
        """Return the lanes of one direction, from the middle to the edge."""
        return [lane for lane in self.lanes if lane.ahead is ahead]


def draw_section(
    rng: np.random.Generator, ahead: int, back: int, width: float, median: float, strips: tuple[float, float]
) -> CrossSection:
    """Return a cross section.

    Args:
        rng: random generator.
        ahead: lanes as the line runs.
        back: lanes against it; none: a one-way road with its line in the middle.
        width: of lanes, m.
        median: m between the directions; from 1.5 m on it is an island.
        strips: m of width at the right and at the left; from 4 m on cars stand across; 0: none.
    """
    middle = median / 2 if back else -ahead * width / 2
    lanes = [Lane(-middle - (k + 0.5) * width, True) for k in range(ahead)]
    lanes += [Lane(middle + (k + 0.5) * width, False) for k in range(back)]
    right = -middle - ahead * width
    left = middle + back * width if back else -middle
    places = [Strip(right - strips[0] / 2, strips[0] > 4), Strip(left + strips[1] / 2, strips[1] > 4)]
    dividers: list[tuple[int, float]] = []
    if back and rng.random() < 0.9:
        dividers += [(_ROAD_DIVIDER, d) for d in ([0.0] if median < 1 else [-middle, middle])]
    if rng.random() < 0.93:
        dividers += [(_LANE_DIVIDER, -middle - k * width) for k in range(1, ahead)]
        dividers += [(_LANE_DIVIDER, middle + k * width) for k in range(1, back)]
    if rng.random() < 0.25:
        dividers += [(_LANE_DIVIDER, d) for d, room in zip((right, left), strips, strict=True) if room]
    return CrossSection(
        lanes=lanes,
        lane_width=width,
        edges=(right - strips[0], left + strips[1]),
        median=(-middle, middle) if back and median >= 1.5 else None,
        dividers=dividers,
        strips=[place for place, room in zip(places, strips, strict=True) if room],
    )


@dataclass(frozen=True)
class Road:
    """A line with a cross section."""

    line: Floats
    """[L, 2], m."""
    section: CrossSection
    begin: float = 0.0
    """m along the line, where the road begins."""

    def lane(self, lane: Lane) -> Floats:
        """Return the middle [L, 2] of a lane in the direction of its traffic, m."""
        points = shifted(self.line[int(self.begin / STEP) :], lane.d)
        return points if lane.ahead else points[::-1]


@dataclass(frozen=True)
class Junction:
    """Roads that leave the origin, and what lies between their mouths."""

    arms: Sequence[Road]
    """Roads in the order of their directions, counter-clockwise; each begins at its mouth."""
    ring: float
    """m, radius of a roundabout's lane; 0: a crossing."""

    def connect(self, entry: Floats, exit_: Floats, arms: tuple[int, int]) -> Floats:
        """Return the path [L, 2], m, across from the end of one lane to the beginning of another.

        Args:
            entry: [L, 2], the lane that comes in.
            exit_: [L, 2], the lane that goes out.
            arms: numbers of their arms.
        """
        poses = (entry[-1], entry[-1] - entry[-2], exit_[0], exit_[1] - exit_[0])
        if not self.ring:
            return _join(*poses)
        first, last = (float(headings(self.arms[arm].line[:3])[0]) for arm in arms)
        gap = (last - first) % (2 * np.pi)
        splay = min(0.55, 0.35 * gap)
        angle = np.arange(first + splay, first + gap - splay + 1e-6, STEP / self.ring)
        round_ = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        onto = _join(*poses[:2], self.ring * round_[0], rotate(round_[0], np.array(np.pi / 2)))
        off = _join(self.ring * round_[-1], rotate(round_[-1], np.array(np.pi / 2)), *poses[2:])
        return np.concatenate([onto, self.ring * round_[1:-1], off])


def draw_junction(rng: np.random.Generator, reach: float) -> Junction:
    """Return a crossing of three or four arms, or a roundabout.

    Args:
        rng: random generator.
        reach: length of the arms, m.
    """
    round_ = rng.random() < 0.15
    bend, slack = rng.uniform(-0.4, 0.4), 0.25 if round_ else 0.5
    angles = [0.0, np.pi / 2 + rng.uniform(-slack, slack), np.pi + bend * slack]
    if rng.random() < 0.6:
        angles.append(1.5 * np.pi + rng.uniform(-slack, slack))
    elif rng.random() < 0.3:
        angles = [0.0, 2 * np.pi / 3 + rng.uniform(-0.4, 0.1), 4 * np.pi / 3 + rng.uniform(-0.1, 0.4)]
    width = rng.uniform(2.9, 3.8)
    lanes = [1, 1] if round_ else rng.choice([1, 2, 3], 2, p=[0.55, 0.35, 0.1]).tolist()
    sections = []
    for k in range(len(angles)):
        strip = rng.uniform(1.8, 2.6) if rng.random() < 0.25 and not round_ else 0.0
        median = rng.uniform(1.5, 4.0) if rng.random() < 0.15 else 0.0
        # Opposite arms have as many lanes
        count = lanes[k % 2] if len(angles) == 4 or k != 2 else lanes[0]
        sections.append(draw_section(rng, count, count, width, median, (strip, strip)))
    ring = rng.uniform(11.0, 22.0) if round_ else 0.0
    corner = rng.uniform(4.0, 14.0)
    mouths = [_mouth(k, angles, sections, corner) for k in range(len(angles))]
    if ring:
        mouths = [ring + _RING_LANE / 2 + rng.uniform(5.0, 9.0)] * len(angles)
    arms = []
    for angle, section, mouth in zip(angles, sections, mouths, strict=True):
        half = section.edges[1]
        line = draw_line(rng, reach + mouth, (half + 40.0, 500.0), 0.5, mouth + rng.uniform(8.0, 40.0))
        arms.append(Road(rotate(line, np.array(angle)), section, mouth))
    return Junction(arms, ring)


def _mouth(arm: int, angles: Sequence[float], sections: Sequence[CrossSection], corner: float) -> float:
    """Return the distance, m, from the middle to where an arm's rounded corners end on both sides."""
    half, least = sections[arm].edges[1], sections[arm].edges[1] + 2.0
    for other in (arm - 1, (arm + 1) % len(angles)):
        apart = abs(float(wrap_angle(np.array(angles[other] - angles[arm]))))
        if apart < 2.7:
            cut = (sections[other].edges[1] + half * np.cos(apart)) / np.sin(apart)
            least = max(least, cut + corner / np.tan(apart / 2))
    return float(least)


def _join(start: Floats, ahead: Floats, end: Floats, on: Floats) -> Floats:
    """Return a path [V, 2] from one point and direction to another: an arc between straights, or an S."""
    ahead, on = ahead / np.hypot(*ahead), on / np.hypot(*on)
    across = ahead[0] * on[1] - ahead[1] * on[0]
    between = end - start
    distance = float(np.hypot(*between))
    reach = (0.4 * distance, 0.4 * distance)
    parts = [start, end]
    if abs(across) > 0.15:
        to = (between[0] * on[1] - between[1] * on[0]) / across
        beyond = (ahead[0] * between[1] - ahead[1] * between[0]) / across
        if to > 0.5 and beyond > 0.5:
            # From where both are as far from the corner on, an arc
            tangent = min(to, beyond)
            turned = abs(np.arctan2(across, ahead @ on))
            handle = 4 / 3 * np.tan(turned / 4) * tangent / np.tan(turned / 2)
            parts = [start + (to - tangent) * ahead, end - (beyond - tangent) * on]
            reach = (handle, handle)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    first, last = parts
    curve = (
        (1 - t) ** 3 * first
        + 3 * (1 - t) ** 2 * t * (first + reach[0] * ahead)
        + 3 * (1 - t) * t**2 * (last - reach[1] * on)
        + t**3 * last
    )
    return np.concatenate([start[None], curve, end[None]])


class Painter:
    """Painter of roads into a raster."""

    def __init__(self, low: Floats, high: Floats, place: Callable[[Floats], Floats]) -> None:
        """
        Args:
            low: [2], m; the raster's origin is the whole metre at or before it.
            high: [2], m, inside the raster.
            place: function that moves drawn points [V, 2], m, to their place on the map.
        """
        self._place = place
        self._origin = np.floor(low)
        rows, columns = np.ceil((high - self._origin) * PIXELS_PER_METER).astype(int) + 1
        self._images = [Image.new("L", (int(columns), int(rows))) for _ in range(3)]
        self._draws = [ImageDraw.Draw(image) for image in self._images]

    def raster(self) -> Raster:
        """Return the raster as drawn so far."""
        layers = np.stack([np.asarray(image) for image in self._images])
        return Raster(layers, self._origin, PIXELS_PER_METER)

    def area(self, points: Floats, value: int = 1) -> None:
        """Fill a polygon [V, 2], m, as driveable, or, with 0, as not driveable."""
        self._draws[_DRIVEABLE].polygon(self._pixels(points), fill=value)

    def ribbon(self, line: Floats, right: float, left: float, value: int = 1) -> None:
        """Fill the area along a line as driveable, or, with value 0, as not driveable.

        Args:
            line: [L, 2], m.
            right: d of the right edge, m; d is the distance to the left of the line.
            left: d of the left edge, m.
            value: 1 or 0.
        """
        every = int(_SPACING / STEP)
        coarse = np.concatenate([line[:-1:every], line[-1:]])
        self.area(np.concatenate([shifted(coarse, right), shifted(coarse, left)[::-1]]), value)

    def divider(self, layer: int, line: Floats) -> None:
        """Draw a line [L, 2], m, into a layer: 1 road dividers, 2 lane dividers."""
        every = int(_SPACING / STEP)
        coarse = np.concatenate([line[:-1:every], line[-1:]])
        self._draws[layer].line(self._pixels(coarse), fill=1, width=_DIVIDER_PIXELS)

    def _pixels(self, points: Floats) -> list[tuple[float, float]]:
        # An image's lines run along x: (column, row) is (y, x)
        pixels = np.round((self._place(points) - self._origin) * PIXELS_PER_METER)
        return [(y, x) for x, y in pixels.tolist()]

    def road(self, road: Road) -> None:
        """Draw a road from its beginning to the end of its line."""
        line, section = road.line[int(road.begin / STEP) :], road.section
        # In pieces: the outline of a whole winding road could cross itself
        piece = int(60 / STEP)
        for start in range(0, len(line) - 1, piece):
            self.ribbon(line[start : start + piece + 2], *section.edges)
        if section.median:
            self.ribbon(line, *section.median, value=0)
        for layer, d in section.dividers:
            self.divider(layer, shifted(line, d))

    def junction(self, junction: Junction) -> None:
        """Draw the arms and all paths across."""
        corners: list[Floats] = []
        for k, arm in enumerate(junction.arms):
            self.road(arm)
            for other, exit_ in enumerate(junction.arms):
                if other != k:
                    self._ways(junction, (k, other), arm, exit_)
            mouth = arm.line[int(arm.begin / STEP) :][:2]
            corners += [shifted(mouth, d)[:1] for d in arm.section.edges]
        if junction.ring:
            turn = np.linspace(0, 2 * np.pi, 60)
            island = (junction.ring - _RING_LANE / 2) * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            outer = (junction.ring + _RING_LANE / 2) / (junction.ring - _RING_LANE / 2) * island
            self.area(outer)
            self.area(island, 0)
            return
        outline = []
        for k, arm in enumerate(junction.arms):
            left, right = corners[2 * k + 1][0], corners[(2 * k + 2) % len(corners)][0]
            following = junction.arms[(k + 1) % len(junction.arms)]
            outwards = [one.line[int(one.begin / STEP) :][:2] for one in (arm, following)]
            corner = _join(left, outwards[0][0] - outwards[0][1], right, outwards[1][1] - outwards[1][0])
            outline += [corners[2 * k], corner]
        self.area(np.concatenate(outline))

    def _ways(self, junction: Junction, arms: tuple[int, int], entry: Road, exit_: Road) -> None:
        half = entry.section.lane_width / 2 + 0.2
        for lane in entry.section.of(ahead=False):
            for onto in exit_.section.of(ahead=True):
                ends = entry.lane(lane)[-3:], exit_.lane(onto)[:3]
                way, *_ = resample(junction.connect(*ends, arms))
                self.ribbon(smooth(way, 3.0), -half, half)
