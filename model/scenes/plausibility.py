"""Contradictions in what is observed of agents: velocities and headings against positions, jumps, the map.

The checks look at the newest observations, those that forecasts depend on. Each finds what no agent does,
not what is unusual: thresholds leave room for the noise of trackers, for braking, turning and reversing. What
several agents show together (degrees, a mirrored axis, a map that does not fit) is said of all of them.

``docs/warnings.md`` states how often each check is wrong and how often it misses, as measured by
``benchmark.input_checks``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.geometry import rotate, wrap_angle
from model.scenes.observations import Observations
from model.scenes.raster import NEAR
from model.scenes.resample import MAX_GAP
from model.scenes.scene import AgentType, Raster

SPAN = 1.05
"""s, the time before the newest observation over which motion is measured."""
MIN_SPAN = 0.15
"""s; over a shorter time, positions tell no motion."""
VELOCITY_SLACK = 0.8
"""m between the ways over ``SPAN`` by velocities and by positions, allowed at any speed."""
VELOCITY_SHARE = 0.35
"""Part of the longer of the two ways that is allowed in addition."""
HEADING_DISTANCE = 2.0
"""m to move within ``SPAN`` before the direction of motion is compared with the heading."""
HEADING_OFF = np.deg2rad(50.0)
"""rad between the heading and the direction of motion of a vehicle or cyclist, at most."""
REVERSE_OFF = np.deg2rad(150.0)
"""rad; from here on, the agent reverses, if it is slow."""
REVERSE_SPEED = 3.0
"""m/s, maximum speed of an agent that reverses."""
FIT = np.deg2rad(20.0)
"""rad between motion and heading, up to which another reading of the heading explains it."""
MANY_TURNS = 4 * np.pi
"""rad; headings beyond it are degrees, unless a moving agent shows otherwise."""
FLIP = np.deg2rad(150.0)
"""rad between successive headings of an agent from which on one of them is flipped."""
FLIP_GAP = 0.6
"""s between these headings, at most."""
JUMP_SLACK = 3.0
"""m between a position and where the motion before leads, allowed over any time."""
JUMP_ACCELERATION = 15.0
"""m/s²; what it explains of the distance is allowed in addition."""
OFF_SHARE = 0.25
"""Part of the paths of moving vehicles that is off the driveable area, at most."""
IMAGE_SHARE = 0.1
"""The same where a mirror image of the map fits better: where at most ``IMAGE_FIT`` of that is off it."""
IMAGE_FIT = 0.2
IMAGE_VEHICLES = 3
"""Moving vehicles that it takes to tell by a mirror image; one or two that leave a car park can fit any."""
PATH_AGES = (0.0, 0.5, 1.0, 1.5, 2.0)
"""s before the newest observation at which a path is compared with the map."""
PATH_AHEAD = (0.5, 1.0)
"""s after it at which the path, straight on, is compared with the map."""
UNIT_GAP = 30.0
"""s between successive observations from which on the times are not in seconds."""
_NEWEST = 64
"""Observations of an agent that are looked at; more than ``SPAN`` holds at 50 Hz."""
_ROUNDING = 1e-6  # s
_CLOCKWISE = {"y is mirrored": 0.0, "they are clockwise from the y axis": np.pi / 2}
"""rad, headings from x that clockwise headings h may mean, less −h."""


class Contradiction(StrEnum):
    """Kinds of contradictions."""

    VELOCITY_MISMATCH = "velocity_mismatch"
    HEADING_MISMATCH = "heading_mismatch"
    HEADING_IN_DEGREES = "heading_in_degrees"
    HEADING_MIRRORED = "heading_mirrored"
    HEADING_FLIPPED = "heading_flipped"
    OFF_MAP = "off_map"
    OTHER_OBJECT = "other_object"
    TIME_UNIT = "time_unit"


@dataclass(frozen=True)
class Finding:
    """One contradiction of one agent."""

    row: int
    """Index of the agent among the observations."""
    kind: Contradiction
    detail: str
    state: int
    """Index of the observation among the agent's."""
    value: str
    """Name of the value at fault: ``time``, ``x``, ``heading`` or ``velocity_x``."""


def find_contradictions(
    observations: Observations,
    types: Sequence[AgentType],
    raster: Raster | None = None,
    patches: Mapping[int, Bytes | Float32s] | None = None,
) -> list[Finding]:
    """Return the contradictions of N agents, at most one of each kind for an agent.

    Args:
        observations: observations of N agents, all of them up to the present.
        types: [N].
        raster: the map of the scene; None: it is not compared.
        patches: agents' own map patches by agent, [3, S, S], which take precedence over the raster.
    """
    recent = _Recent.of(observations)
    motion = _Motion.of(recent)
    found = [*_time_units(recent), *_jumps(recent)]
    usable = _without(recent, found)
    headings = _headings(recent, motion, types, usable)
    explained = {finding.row for finding in headings if finding.kind is not Contradiction.HEADING_MISMATCH}
    flips = [flip for flip in _flips(recent, usable) if flip.row not in explained]
    flipped = {flip.row for flip in flips}
    return [
        *found,
        *flips,
        *(finding for finding in headings if finding.row not in flipped),
        *_velocities(recent, motion, usable),
        *_off_map(recent, motion, types, raster, patches or {}),
    ]


def find_breaks(observations: Observations) -> list[Finding]:
    """Return only where positions or headings break off, as if the agent were another: see above.

    Args:
        observations: observations of N agents, all of them up to the present.
    """
    recent = _Recent.of(observations)
    jumps = _jumps(recent)
    return [*jumps, *_flips(recent, _without(recent, jumps))]


def _without(recent: "_Recent", found: Sequence[Finding]) -> Bools:
    """Return which agents nothing was found of: [N]."""
    clean = np.ones(len(recent.time), dtype=np.bool_)
    clean[[finding.row for finding in found]] = False
    return clean


@dataclass(frozen=True)
class _Recent:
    """The newest observations of N agents, K each, padded at the front: the last column is the newest."""

    time: Floats  # [N, K], s; NaN in the padding, as all others
    position: Floats  # [N, K, 2]
    heading: Floats  # [N, K]
    velocity: Floats  # [N, K, 2]
    state: Ints  # [N, K], index of the observation; negative in the padding
    gap: Floats  # [N, K − 1], s between successive ones; NaN in the padding
    connected: Bools  # [N, K], whether no gap too wide lies between it and the newest

    @classmethod
    def of(cls, observations: Observations) -> "_Recent":
        count = observations.count
        columns = min(int(count.max()), _NEWEST)
        state = count[:, None] - np.arange(columns, 0, -1)
        rows, padding = np.arange(len(count))[:, None], state < 0
        same = bool((count == count[0]).all())  # nearly always: then there is no padding

        def newest(values: Floats) -> Floats:
            if same:
                return values[:, count[0] - columns : count[0]]
            taken: Floats = values[rows, np.maximum(state, 0)]
            taken[padding] = np.nan
            return taken

        time = newest(observations.time)
        gap = np.diff(time, axis=1)
        near = gap <= MAX_GAP + _ROUNDING
        connected = np.ones(time.shape, dtype=np.bool_)
        connected[:, :-1] = np.logical_and.accumulate(near[:, ::-1], axis=1)[:, ::-1]
        return cls(
            time,
            newest(observations.position),
            newest(observations.heading),
            newest(observations.velocity),
            state,
            gap,
            connected,
        )


@dataclass(frozen=True)
class _Motion:
    """Motion of N agents over the last ``SPAN``, of those that have been observed long enough."""

    start: Ints  # [N], column of the first observation within the span
    within: Bools  # [N, K], the observations within the span
    seconds: Floats  # [N]; 0: not observed long enough
    way: Floats  # [N, 2], m
    distance: Floats  # [N], m
    course: Floats  # [N], rad; NaN where the agent hardly moved

    @classmethod
    def of(cls, recent: _Recent) -> "_Motion":
        newest = recent.time[:, -1:]
        within = recent.connected & (recent.time >= newest - SPAN - _ROUNDING)
        start = within.argmax(axis=1)
        rows = np.arange(len(start))
        seconds = newest[:, 0] - recent.time[rows, start]
        seconds = np.where(seconds >= MIN_SPAN - _ROUNDING, seconds, 0.0)
        way = np.where(seconds[:, None] > 0, recent.position[:, -1] - recent.position[rows, start], 0.0)
        distance = np.hypot(way[:, 0], way[:, 1])
        course = np.where(distance >= HEADING_DISTANCE, np.arctan2(way[:, 1], way[:, 0]), np.nan)
        return cls(start, within, seconds, way, distance, course)


def _time_units(recent: _Recent) -> list[Finding]:
    """Find times in milliseconds, microseconds or nanoseconds."""
    known = np.isfinite(recent.gap)
    some = np.flatnonzero((known & (recent.gap >= UNIT_GAP)).any(axis=1))
    found = []
    for row in some.tolist():
        gap = float(np.median(recent.gap[row][known[row]]))
        if gap >= UNIT_GAP:
            unit = "milliseconds" if gap < 1e4 else "microseconds" if gap < 1e7 else "nanoseconds"
            detail = f"successive states are {gap:.3g} s apart: are these {unit}?"
            found.append(_finding(recent, row, -1, Contradiction.TIME_UNIT, "time", detail))
    return found


def _jumps(recent: _Recent) -> list[Finding]:
    """Find positions that the motion before or after them cannot lead to."""
    if recent.time.shape[1] < 3:
        return []
    step = np.where(recent.connected[:, :-1, None], np.diff(recent.position, axis=1), np.nan)
    before, after = recent.gap[:, :-1], recent.gap[:, 1:]
    off = step[:, 1:] - step[:, :-1] * (after / before)[..., None]
    allowed = JUMP_SLACK + JUMP_ACCELERATION / 2 * after * (after + before)
    jump = np.hypot(off[..., 0], off[..., 1]) > allowed  # False in the padding
    found = []
    for row in np.flatnonzero(jump.any(axis=1)).tolist():
        first = int(jump[row].argmax())
        meters = np.hypot(*step[row, first : first + 2].T)
        seconds = recent.gap[row, first : first + 2]
        fast = int((meters / seconds).argmax())
        at, slow = first + fast + 1, meters[1 - fast] / seconds[1 - fast]
        detail = (
            f"moves {meters[fast]:.3g} m in {seconds[fast]:.3g} s, at {slow:.3g} m/s "
            f"{'after' if fast == 0 else 'before'} it: is it another object?"
        )
        found.append(_finding(recent, row, at, Contradiction.OTHER_OBJECT, "x", detail))
    return found


def _flips(recent: _Recent, usable: Bools) -> list[Finding]:
    """Find headings that differ by half a turn from those beside them."""
    turned = np.abs(wrap_angle(np.diff(recent.heading, axis=1)))
    flip = (turned > FLIP) & (recent.gap <= FLIP_GAP) & recent.connected[:, :-1] & usable[:, None]
    found = []
    for row in np.flatnonzero(flip.any(axis=1)).tolist():
        first = int(flip[row].argmax())
        begins = first == 0 or not np.isfinite(recent.heading[row, first - 1])
        later = flip[row, first + 1 :].any() or first + 2 == recent.time.shape[1]
        at = first if begins and not later else first + 1
        detail = f"turns by {np.rad2deg(turned[row, first]):.0f}° in {recent.gap[row, first]:.3g} s"
        found.append(_finding(recent, row, at, Contradiction.HEADING_FLIPPED, "heading", detail))
    return found


def _velocities(recent: _Recent, motion: _Motion, usable: Bools) -> list[Finding]:
    """Find velocities that lead elsewhere than the positions."""
    first = int(motion.start.min())
    velocity, within = recent.velocity[:, first:], motion.within[:, first:]
    given = np.isfinite(velocity[..., 0])
    if not given.any():
        return []
    # Over each interval the mean of both ends, or the one that is given
    ends = given[:, 1:] + given[:, :-1].astype(np.int64)
    sums = np.where(given[..., None], velocity, 0.0)
    counted = (ends > 0) & within[:, :-1] & within[:, 1:]
    gap = np.where(counted, recent.gap[:, first:], 0.0)
    told = ((sums[:, 1:] + sums[:, :-1]) * (gap / np.maximum(ends, 1))[..., None]).sum(axis=1)
    position = recent.position[:, first:]
    way = np.where(counted[..., None], position[:, 1:] - position[:, :-1], 0.0).sum(axis=1)
    seconds = gap.sum(axis=1)
    length, way_length = np.hypot(*told.T), np.hypot(*way.T)
    off = np.hypot(*(told - way).T)
    bad = off > VELOCITY_SLACK + VELOCITY_SHARE * np.maximum(length, way_length)
    bad &= usable & (seconds >= MIN_SPAN - _ROUNDING)
    found = []
    for row in np.flatnonzero(bad).tolist():
        hint = _velocity_hint(told[row], way[row], recent.heading[row, -1])
        detail = (
            f"{length[row] / seconds[row]:.3g} m/s, {off[row] / seconds[row]:.3g} m/s off the motion of the "
            f"positions, {way_length[row] / seconds[row]:.3g} m/s{hint}"
        )
        found.append(_finding(recent, row, -1, Contradiction.VELOCITY_MISMATCH, "velocity_x", detail))
    return found


def _velocity_hint(told: Floats, way: Floats, heading: float) -> str:
    """Return which other reading of the velocities fits the positions, as the end of a sentence."""
    readings = {
        "the sign is wrong": -told,
        "it is in km/h": told / 3.6,
        "y is mirrored": told * [1, -1],
        "it is in the agent's frame": rotate(told, np.asarray(heading)),
    }
    allowed = 0.2 * float(np.hypot(*way)) + 0.2
    for text, reading in readings.items():
        if np.hypot(*(reading - way)) <= allowed:
            return f"; it fits if {text}"
    return ""


def _headings(recent: _Recent, motion: _Motion, types: Sequence[AgentType], usable: Bools) -> list[Finding]:
    """Find headings off the direction of motion, in degrees, or mirrored."""
    first = int(motion.start.min())
    headings = recent.heading[:, first:]
    given = motion.within[:, first:] & np.isfinite(headings)
    some = given.any(axis=1) & usable
    if not some.any():
        return []
    mean = _mean_angle(headings, given)
    course, speed = motion.course, motion.distance / np.where(motion.seconds > 0, motion.seconds, 1.0)
    still = motion.seconds == 0
    if still.any():  # where positions tell no motion, the velocity does
        velocity = recent.velocity[:, -1]
        speed = np.where(still, np.hypot(velocity[:, 0], velocity[:, 1]), speed)
        fast = still & (speed >= HEADING_DISTANCE / SPAN)
        course = np.where(fast, np.arctan2(velocity[:, 1], velocity[:, 0]), course)

    off = np.abs(wrap_angle(course - mean))  # NaN where either is unknown
    walks = np.array([kind in (AgentType.PEDESTRIAN, AgentType.UNKNOWN) for kind in types], dtype=np.bool_)
    reverses = (off > REVERSE_OFF) & (speed < REVERSE_SPEED)
    bad = some & (off > HEADING_OFF) & ~reverses & ~walks
    large = some & (np.where(given, np.abs(headings), 0.0).max(axis=1) > MANY_TURNS)
    if not (bad.any() or large.any()):
        return []
    fits = some & (off <= FIT) & ~walks
    as_degrees = np.abs(wrap_angle(course - _mean_angle(np.deg2rad(headings), given))) <= FIT
    in_degrees = bad & as_degrees & large
    witnesses, against = int((bad & as_degrees).sum()), int((fits & ~as_degrees).sum())
    if large.any() and (witnesses or 2 * large.sum() > some.sum()) and witnesses >= 2 * against:
        in_degrees = some
    mirrored, clockwise = np.zeros_like(bad), ""
    for reading, offset in _CLOCKWISE.items():
        as_mirrored = np.abs(wrap_angle(course + mean - offset)) <= FIT
        witnesses, against = int((bad & as_mirrored).sum()), int((fits & ~as_mirrored).sum())
        if not in_degrees.any() and witnesses >= max(2, 2 * against):
            mirrored, clockwise = some, f"{witnesses} agents move where their headings point if {reading}"
    found = []
    for row in np.flatnonzero(in_degrees | mirrored | bad).tolist():
        if in_degrees[row]:
            kind = Contradiction.HEADING_IN_DEGREES
            detail = f"is {recent.heading[row, -1]:.5g}, in degrees by the motion of the agents"
        elif mirrored[row]:
            kind, detail = Contradiction.HEADING_MIRRORED, clockwise
        else:
            kind = Contradiction.HEADING_MISMATCH
            detail = f"is {np.rad2deg(off[row]):.0f}° off the motion, {speed[row]:.3g} m/s"
        found.append(_finding(recent, row, -1, kind, "heading", detail))
    return found


def _off_map(
    recent: _Recent,
    motion: _Motion,
    types: Sequence[AgentType],
    raster: Raster | None,
    patches: Mapping[int, Bytes | Float32s],
) -> list[Finding]:
    """Find maps on which moving vehicles leave the road: said of all agents that see such a map."""
    if raster is None and not patches:
        return []
    vehicle = np.array([kind is AgentType.VEHICLE for kind in types], dtype=np.bool_)
    moving = np.flatnonzero(vehicle & (motion.distance >= HEADING_DISTANCE))
    if not len(moving):
        return []
    path = _path(recent, motion, moving)
    found = []
    own = np.array([row in patches for row in moving.tolist()], dtype=np.bool_)
    if raster is not None and not own.all():
        points = path[~own]
        share = _share_off(raster.layers[0], (points - raster.origin) * raster.pixels_per_meter)
        hint = _map_hint(raster, points, share) if share > IMAGE_SHARE else ""
        if share > OFF_SHARE or (hint and len(points) >= IMAGE_VEHICLES):
            detail = _off_detail(share, len(points)) + hint
            without = [row for row in range(len(types)) if row not in patches]
            found += [_finding(recent, row, -1, Contradiction.OFF_MAP, "", detail) for row in without]
    if own.any():
        heading = recent.heading[moving[own], -1]
        heading = np.where(np.isfinite(heading), heading, motion.course[moving[own]])
        seen = rotate(path[own] - recent.position[moving[own], -1][:, None], -heading[:, None])
        pixels = seen * NEAR.pixels_per_meter + np.array([NEAR.rows_behind, NEAR.columns_right])
        inside = ((pixels > -0.5) & (pixels < NEAR.size - 0.5)).all(axis=2)
        pixels[~inside] = np.nan  # nothing is known beyond a patch's edges
        shares = [
            _share_off(patches[row][0], pixel)
            for row, pixel in zip(moving[own].tolist(), pixels, strict=True)
        ]
        share = float(np.mean(shares))
        if share > OFF_SHARE:
            detail = _off_detail(share, len(shares))
            found += [_finding(recent, row, -1, Contradiction.OFF_MAP, "", detail) for row in sorted(patches)]
    return found


def _path(recent: _Recent, motion: _Motion, rows: Ints) -> Floats:
    """Return n agents' positions at ``PATH_AGES`` and ``PATH_AHEAD``: [n, P, 2], m; NaN where unknown."""
    time, position = recent.time[rows], recent.position[rows]
    ages = np.where(recent.connected[rows], time[:, -1:] - time, np.inf)
    wanted = np.array(PATH_AGES)
    # The first observation of that age or less, if it is near that age
    column = (ages[:, None, :] <= wanted[:, None] + _ROUNDING).argmax(axis=2)
    index = np.arange(len(rows))[:, None]
    near = wanted - ages[index, column] <= PATH_AGES[1] / 2
    behind = np.where(near[..., None], position[index, column], np.nan)
    velocity = motion.way[rows] / motion.seconds[rows, None]
    ahead = position[:, -1:] + velocity[:, None] * np.array(PATH_AHEAD)[:, None]
    return np.concatenate([behind, ahead], axis=1)


def _share_off(driveable: Bytes | Float32s, pixels: Floats) -> float:
    """Return the share of points off the driveable area; beyond its edges nothing is driveable.

    Args:
        driveable: [rows, columns], 0 or 1.
        pixels: [..., 2], row and column of the points; NaN: unknown, and not counted.
    """
    row, column = pixels[..., 0], pixels[..., 1]
    rows, columns = driveable.shape
    inside = (row > -0.5) & (row < rows - 0.5) & (column > -0.5) & (column < columns - 0.5)
    index = np.rint(pixels[inside]).astype(np.int64)
    on = driveable[index[:, 0], index[:, 1]] >= 0.5
    known = row.size - int(np.isnan(row).sum())
    return 1.0 - float(on.sum()) / max(known, 1)


def _off_detail(share: float, vehicles: int) -> str:
    return f"{100 * share:.0f} % of the paths of {vehicles} moving vehicles are off the driveable area"


def _map_hint(raster: Raster, points: Floats, share: float) -> str:
    """Return which mirror image of the map the paths fit, as the end of a sentence; empty: none.

    Args:
        raster: the map.
        points: [n, P, 2], m; the paths.
        share: share of them off the map as it is.
    """
    driveable = raster.layers[0]
    images = {
        "rows are reversed": driveable[::-1],
        "columns are reversed": driveable[:, ::-1],
        "rows and columns are reversed": driveable[::-1, ::-1],
        "rows and columns are exchanged": driveable.T,
    }
    pixels = (points - raster.origin) * raster.pixels_per_meter
    shares = {text: _share_off(image, pixels) for text, image in images.items()}
    best = min(shares, key=shares.__getitem__)
    return f"; they fit if its {best}" if shares[best] <= IMAGE_FIT * share else ""


def _mean_angle(angles: Floats, given: Bools) -> Floats:
    """Return the circular mean of each row's given angles: [N], rad; NaN where none is given."""
    sine = np.where(given, np.sin(angles), 0.0).sum(axis=1)
    cosine = np.where(given, np.cos(angles), 0.0).sum(axis=1)
    return np.where(given.any(axis=1), np.arctan2(sine, cosine), np.nan)


def _finding(recent: _Recent, row: int, column: int, kind: Contradiction, value: str, detail: str) -> Finding:
    return Finding(row, kind, detail, int(recent.state[row, column]), value)
