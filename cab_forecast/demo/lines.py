"""Lines that road users follow: smooth, sampled at equal distances."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

STEP = 0.5
"""Distance between the points of a line, m."""
_ROUGH = 8
"""Points of a line from one to the next in a first search."""
_SMOOTHING = 4.0
"""Length over which corners and jumps of the curvature become transitions, m."""


class Line:
    """A smooth line."""

    def __init__(self, points: npt.ArrayLike, smoothing: float = _SMOOTHING) -> None:
        """
        Args:
            points: [V, 2], m; the vertices of a polyline.
            smoothing: length of the transitions at its corners, m.
        """
        self.points = _smooth(_resample(np.asarray(points, dtype=np.float64)), smoothing)
        """[L, 2], m, nearly ``STEP`` apart."""
        ahead = np.gradient(self.points, axis=0)
        self.headings: Floats = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        """[L], rad, without jumps."""
        self.length = (len(self.points) - 1) * STEP
        """m."""

    @cached_property
    def curvature(self) -> Floats:
        """Curvature: [L], 1/m, positive to the left."""
        bend: Floats = np.gradient(self.headings, STEP)
        return bend

    def nearest(self, points: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Return how far along the line points [N, 2] are, and how far to the left of it: [N] each, m."""
        array = np.asarray(points, dtype=np.float64)
        rough = ((array[:, None] - self.points[None, ::_ROUGH]) ** 2).sum(axis=-1).argmin(axis=1) * _ROUGH
        rows = np.clip(rough[:, None] + np.arange(-_ROUGH, _ROUGH + 1), 0, len(self.points) - 1)
        best = ((array[:, None] - self.points[rows]) ** 2).sum(axis=-1).argmin(axis=1)
        row = rows[np.arange(len(array)), best]
        x, y = (array - self.points[row]).T
        cos, sin = np.cos(self.headings[row]), np.sin(self.headings[row])
        along: Floats = row * STEP + cos * x + sin * y
        left: Floats = cos * y - sin * x
        return along, left

    def part(self, start: float, end: float = math.inf) -> Floats:
        """Return the points between two distances along the line: [·, 2], m."""
        last = None if math.isinf(end) else round(end / STEP) + 1
        return self.points[max(round(start / STEP), 0) : last]

    def beside(self, left: float | Floats) -> Floats:
        """Return the points moved to the left, by one distance or [L], m; negative: to the right."""
        moved: Floats = self.points + self.normals * np.reshape(left, (-1, 1))
        return moved

    @cached_property
    def normals(self) -> Floats:
        """Unit vectors to the left: [L, 2]."""
        return np.stack([-np.sin(self.headings), np.cos(self.headings)], axis=-1)


@dataclass(frozen=True)
class Aside:
    """Distances to the left of lines, which lanes are changed by: [N] each."""

    offset: Floats
    """Distance at the start, m."""
    start: Floats
    """Place along the line from which on the distance becomes less, m."""
    over: Floats
    """Length of the way over which it becomes 0, m; infinite: it stays."""

    def at(self, distance: Floats) -> tuple[Floats, Floats]:
        """Return the distances to the left, m, and their slopes at places along the lines: [N, F], m."""
        part = np.clip((distance - self.start[:, None]) / self.over[:, None], 0.0, 1.0)
        offset = self.offset[:, None]
        left: Floats = offset * (1 - ease(part))
        slope: Floats = -offset * 30 * part**2 * (1 - part) ** 2 / self.over[:, None]
        return left, slope


class Lines:
    """Lines side by side, for looking up many places at once; straight beyond their ends."""

    def __init__(self, lines: Sequence[Line]) -> None:
        """
        Args:
            lines: the lines, which are referred to by their numbers.
        """
        sizes = np.array([len(line.points) for line in lines])
        self._first = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self._last = sizes - 1
        # x, y, heading, curvature
        self._table = np.concatenate(
            [np.column_stack([one.points, one.headings, one.curvature]) for one in lines]
        )

    def at(
        self, line: npt.NDArray[np.int64], distance: Floats, aside: Aside
    ) -> tuple[Floats, Floats, Floats]:
        """Return the places at distances along lines.

        Args:
            line: [N], numbers of the lines.
            distance: [N, F], m from their starts.
            aside: distances to the left of the lines.

        Returns:
            [N, F, 2] positions, m, [N, F] headings, rad, and [N, F] the way per way along the line.
        """
        index = distance / STEP
        whole = np.clip(index.astype(np.int64), 0, self._last[line, None] - 1)
        part = (index - whole)[..., None]  # beyond the ends: outside 0 … 1
        rows = whole + self._first[line, None]
        start, end = self._table[rows], self._table[rows + 1]
        straight = start[..., :2] + part * (end[..., :2] - start[..., :2])
        inside = np.clip(part[..., 0], 0.0, 1.0)
        heading = start[..., 2] + inside * (end[..., 2] - start[..., 2])
        curvature = start[..., 3] + inside * (end[..., 3] - start[..., 3])
        left, slope = aside.at(distance)
        normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        forward = 1 - curvature * left
        return (
            straight + left[..., None] * normal,
            heading + np.arctan2(slope, forward),
            np.hypot(forward, slope),
        )


def polyline(*parts: npt.ArrayLike) -> Floats:
    """Return the points of parts, each [2] or [·, 2], one after the other: [V, 2], m."""
    return np.concatenate([np.atleast_2d(np.asarray(part, dtype=np.float64)) for part in parts])


def fillet(start: Sequence[float], corner: Sequence[float], end: Sequence[float]) -> Floats:
    """Return an arc [V, 2] that joins the straight lines from a start to a corner and on to an end.

    It begins or ends at the nearer one of start and end.
    """
    a, b, c = (np.asarray(point, dtype=np.float64) for point in (start, corner, end))
    inward, outward = a - b, c - b
    tangent = min(np.hypot(*inward), np.hypot(*outward))
    u, w = inward / np.hypot(*inward), outward / np.hypot(*outward)
    half = math.acos(float(np.clip(u @ w, -1.0, 1.0))) / 2
    radius = tangent * math.tan(half)
    middle = (u + w) / np.hypot(*(u + w)) * (radius / math.sin(half))
    first, last = tangent * u - middle, tangent * w - middle
    begin, finish = math.atan2(first[1], first[0]), math.atan2(last[1], last[0])
    turn = (finish - begin + math.pi) % (2 * math.pi) - math.pi
    way: Floats = b + middle + arc((0.0, 0.0), radius, begin, turn)
    return way


def arc(center: Sequence[float], radius: float, begin: float, turn: float) -> Floats:
    """Return points of an arc [V, 2].

    Args:
        center: [2], m.
        radius: m.
        begin: angle of the first point, rad.
        turn: angle from the first to the last point, rad; positive: counter-clockwise.
    """
    angles = begin + np.linspace(0.0, turn, max(round(abs(turn) * radius / STEP), 2) + 1)
    return np.asarray(center) + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def quarter_turns(points: npt.ArrayLike, quarters: int) -> Floats:
    """Return points [V, 2] turned counter-clockwise by quarter turns about the origin."""
    x, y = np.asarray(points, dtype=np.float64).T
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def ease(part: Floats) -> Floats:
    """Return the share of a lateral movement that is done, without jumps of the acceleration.

    Args:
        part: share of the way, any shape; clipped to 0 … 1.
    """
    p = np.clip(part, 0.0, 1.0)
    done: Floats = p**3 * (10 - 15 * p + 6 * p**2)
    return done


def change_over(onto: Line, start: float, offset: float, over: float) -> Floats:
    """Return the points [V, 2] of a way from beside a line onto it.

    Args:
        onto: the line.
        start: distance along it at which the way begins, m.
        offset: distance to the left of it at which the way begins, m.
        over: length of the way until it is on the line, m; the line follows to its end.
    """
    first = round(start / STEP)
    along: Floats = np.arange(len(onto.points) - first, dtype=np.float64) * STEP
    return onto.points[first:] + onto.normals[first:] * (offset * (1 - ease(along / over)))[:, None]


def _resample(points: Floats) -> Floats:
    apart = np.hypot(*np.diff(points, axis=0).T)
    points = np.concatenate([points[:1], points[1:][apart > 1e-9]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0.0, length[-1], max(round(length[-1] / STEP), 1) + 1)
    return np.stack([np.interp(at, length, axis) for axis in points.T], axis=-1)


def _smooth(points: Floats, length: float) -> Floats:
    """Return points after two moving averages over a length, m; straight ends stay where they are."""
    half = int(length / STEP / 2)
    if half == 0 or len(points) <= 2 * half:
        return points
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    for _ in range(2):
        before = 2 * points[0] - points[half:0:-1]
        after = 2 * points[-1] - points[-2 : -half - 2 : -1]
        longer = np.concatenate([before, points, after])
        points = np.stack([np.convolve(axis, kernel, "valid") for axis in longer.T], axis=-1)
    return _resample(points)
