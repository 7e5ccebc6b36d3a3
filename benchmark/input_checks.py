"""Rates of wrong and of missed warnings of the input: ``python -m benchmark.input_checks``.

Recorded scenes are turned into what a client would send at 2 Hz or, interpolated, at 10 Hz: the last 2 s of
each agent with headings and velocities. The checks (``model.scenes.plausibility``) see each tick as it is and
with each of the faults below. Rates are per agent and tick, of agents that the fault changes much: the wrong
sign of a velocity of 0.1 m/s does not matter.

    python -m benchmark.input_checks --data nuscenes_pred:PATH@train_val
    python -m benchmark.input_checks --data nuscenes:PATH@mini_train,mini_val
"""

import argparse
import json
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.data.scenes import DataError, SceneRecord, Track
from model.data.sensing import interpolated_headings, spline
from model.data.sources import READERS, parse_data
from model.geometry import rotate
from model.scenes.observations import Observations
from model.scenes.plausibility import Contradiction, find_contradictions
from model.scenes.scene import STEP_SECONDS, AgentType, Raster

RATES_HZ = (2, 10)
HISTORY_FRAMES = 4
"""Frames of 0.5 s before the present that a request holds."""
_EPOCH = 1.5e9  # s, of frame 0: times as rounded as real ones


@dataclass(frozen=True)
class Tick:
    """The N agents that a client sends for one frame."""

    types: Sequence[AgentType]
    observations: Observations
    raster: Raster

    @property
    def newest(self) -> tuple[Ints, Ints]:
        """Index of each agent's newest observation."""
        return np.arange(len(self.types)), self.observations.count - 1

    @property
    def speed(self) -> Floats:
        """[N], m/s, as given; 0 where it is not."""
        velocity = np.nan_to_num(self.observations.velocity[self.newest])
        return np.hypot(velocity[:, 0], velocity[:, 1])


@dataclass(frozen=True)
class Fault:
    """A fault of the input."""

    name: str
    kinds: frozenset[Contradiction]
    """Any of these says it."""
    corrupt: Callable[[Tick, np.random.Generator], tuple[Tick, Bools]]
    """Returns the faulty tick, and which agents [N] the fault changes much."""


def ticks(record: SceneRecord, rate_hz: int) -> Iterator[Tick]:
    """Yield each frame of a scene as a client would send it."""
    for frame in np.unique(np.concatenate([track.frames for track in record.tracks])).tolist():
        seen = [(track, int(np.searchsorted(track.frames, frame))) for track in record.tracks]
        seen = [(t, now) for t, now in seen if now < len(t.frames) and t.frames[now] == frame]
        rows = [_observed(track, now, rate_hz) for track, now in seen]
        counts = np.array([len(row) for row in rows], dtype=np.int64)
        table = np.full((len(rows), int(counts.max()), 6), np.nan)
        table[:, :, 0] = np.inf
        for row, values in zip(table, rows, strict=True):
            row[: len(values)] = values
        unknown = np.full(table.shape[:2], np.nan)
        observations = Observations(
            count=counts,
            time=table[:, :, 0],
            position=table[:, :, 1:3],
            heading=table[:, :, 3],
            velocity=table[:, :, 4:6],
            acceleration=np.stack([unknown, unknown], axis=2),
            heading_rate=unknown,
        )
        yield Tick([track.type for track, _ in seen], observations, record.raster)


def _observed(track: Track, now: int, rate_hz: int) -> Floats:
    """Return time, x, y, heading and velocity of one agent's last 2 s: [S, 6].

    At 2 Hz velocities are central differences, as nuScenes gives them, at the ends one-sided. At 10 Hz
    positions and velocities are those of the spline through the poses up to now.
    """
    first = now
    while first > 0 and now - first < HISTORY_FRAMES and track.frames[first - 1] == track.frames[first] - 1:
        first -= 1
    past = slice(first, now + 1)
    if rate_hz == round(1 / STEP_SECONDS):
        frames = track.frames[past]
        position, heading = track.position[past], track.heading[past]
        before, after = track.positions(frames - 1), track.positions(frames + 1)
        earlier = np.where(np.isfinite(before), before, position)
        later = np.where(np.isfinite(after), after, position)
        steps = np.isfinite(before[:, :1]) * 1.0 + np.isfinite(after[:, :1])
        with np.errstate(invalid="ignore"):
            velocity = (later - earlier) / np.where(steps > 0, steps * STEP_SECONDS, np.nan)
        ages = STEP_SECONDS * (frames[-1] - frames)
    else:
        ages = np.arange(round((now - first) * STEP_SECONDS * rate_hz), -1, -1) / rate_hz
        position, velocity = spline(track.position[past], ages)
        heading = interpolated_headings(track.heading[past], ages)
    time = _EPOCH + STEP_SECONDS * track.frames[now] - ages
    return np.concatenate([time[:, None], position, heading[:, None], velocity], axis=1)


def noisy(tick: Tick, random: np.random.Generator) -> Tick:
    """Return a tick with the noise of a tracker: 10 cm, 0.05 rad, 0.3 m/s."""
    seen = tick.observations
    changed = replace(
        seen,
        position=seen.position + 0.1 * random.standard_normal(seen.position.shape),
        heading=seen.heading + 0.05 * random.standard_normal(seen.heading.shape),
        velocity=seen.velocity + 0.3 * random.standard_normal(seen.velocity.shape),
    )
    return replace(tick, observations=changed)


def _several(tick: Tick) -> Bools:
    """Return which agents have been seen twice or more: nothing contradicts a single state: [N]."""
    several: Bools = tick.observations.count > 1
    return several


def _driving(tick: Tick, speed: float = 2.0) -> Bools:
    """Return which agents have a motion that their headings follow: [N]."""
    driven = [kind in (AgentType.VEHICLE, AgentType.CYCLIST) for kind in tick.types]
    return np.array(driven, dtype=np.bool_) & _several(tick) & (_moved(tick) >= speed)


def _moved(tick: Tick) -> Floats:
    """Return the mean speed of each agent over the last second: [N], m/s."""
    seen, (rows, last) = tick.observations, tick.newest
    start = (seen.time >= seen.time[rows, last][:, None] - 1.0 - 1e-6).argmax(axis=1)
    way = seen.position[rows, last] - seen.position[rows, start]
    seconds = seen.time[rows, last] - seen.time[rows, start]
    moved: Floats = np.hypot(*way.T) / np.where(seconds > 0, seconds, np.inf)
    return moved


def _velocity_fault(
    change: Callable[[Floats, Floats], Floats], speed: float
) -> Callable[..., tuple[Tick, Bools]]:
    """Return the fault of velocities that ``change`` makes of velocities and headings; it counts where it
    changes the velocity by half of it or more, from a speed on."""

    def corrupt(tick: Tick, _: np.random.Generator) -> tuple[Tick, Bools]:
        seen = tick.observations
        wrong = change(seen.velocity, seen.heading)
        off = np.nan_to_num((wrong - seen.velocity)[tick.newest])
        much = (np.hypot(off[:, 0], off[:, 1]) >= 0.5 * tick.speed) & (_moved(tick) >= speed)
        return replace(tick, observations=replace(tick.observations, velocity=wrong)), _several(
            tick
        ) & much & (tick.speed >= speed)

    return corrupt


def _heading_fault(change: Callable[[Floats], Floats], moving: bool) -> Callable[..., tuple[Tick, Bools]]:
    """Return the fault of all headings that ``change`` makes; it counts where it turns them by 60° or more.

    Args:
        change: returns wrong headings of right ones.
        moving: whether it counts for driving agents only; else for all agents while at least two drive.
    """

    def corrupt(tick: Tick, _: np.random.Generator) -> tuple[Tick, Bools]:
        right = tick.observations.heading
        wrong = change(right)
        much = np.abs(np.angle(np.exp(1j * (wrong - right))))[tick.newest] >= np.deg2rad(60)
        witnesses = _driving(tick) & much
        told = witnesses if moving else np.full(len(much), witnesses.sum() >= 2)
        return replace(tick, observations=replace(tick.observations, heading=wrong)), told

    return corrupt


def _flip(tick: Tick, random: np.random.Generator) -> tuple[Tick, Bools]:
    """Turn one heading of each agent by half a turn, at random one of the last second."""
    heading = tick.observations.heading.copy()
    rows, last = tick.newest
    time = tick.observations.time
    recent = (time >= time[rows, last][:, None] - 1.0).sum(axis=1) - (time == np.inf).sum(axis=1)
    at = last - random.integers(0, np.maximum(recent, 1))
    heading[rows, at] += np.pi
    return replace(tick, observations=replace(tick.observations, heading=heading)), _several(tick)


def _other_object(tick: Tick, random: np.random.Generator) -> tuple[Tick, Bools]:
    """Give the id to an object 40 m away, which was not seen in the second between."""
    seen, (rows, last) = tick.observations, tick.newest
    now = seen.time[rows, last][:, None]
    kept = (seen.time <= now - 1.0 + 1e-6) | (seen.time == now)
    order = np.argsort(~kept, axis=1, kind="stable")
    angle = random.uniform(0, 2 * np.pi, len(rows))
    position = seen.position.copy()
    position[rows, last] += 40.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def taken(values: Floats, fill: float) -> Floats:
        chosen = kept if values.ndim == 2 else kept[..., None]
        result: Floats = np.where(chosen, values, fill)[rows[:, None], order]
        return result

    count = kept.sum(axis=1)
    changed = Observations(
        count=count,
        time=taken(seen.time, np.inf),
        position=taken(position, np.nan),
        heading=taken(seen.heading, np.nan),
        velocity=taken(seen.velocity, np.nan),
        acceleration=taken(seen.acceleration, np.nan),
        heading_rate=taken(seen.heading_rate, np.nan),
    )
    changed.time[np.arange(changed.time.shape[1]) >= count[:, None]] = np.inf
    return replace(tick, observations=changed), count >= 3


def _in_nanoseconds(tick: Tick, _: np.random.Generator) -> tuple[Tick, Bools]:
    since = (tick.observations.time - _EPOCH) * 1e9
    return replace(tick, observations=replace(tick.observations, time=since)), _several(tick)


def _map_fault(change: Callable[[Raster, np.random.Generator], Raster]) -> Callable[..., tuple[Tick, Bools]]:
    """Return the fault of a map; it counts where it takes most of the moving vehicles off the road."""

    def corrupt(tick: Tick, random: np.random.Generator) -> tuple[Tick, Bools]:
        wrong = change(tick.raster, random)
        vehicles = np.array([kind is AgentType.VEHICLE for kind in tick.types]) & (_moved(tick) >= 2.0)
        position = tick.observations.position[tick.newest][vehicles]
        pixels = np.rint((position - wrong.origin) * wrong.pixels_per_meter).astype(np.int64)
        inside = ((pixels >= 0) & (pixels < np.array(wrong.layers.shape[1:]))).all(axis=1)
        on = wrong.layers[0][tuple(pixels[inside].T)].sum()
        most = vehicles.any() and 2 * on <= vehicles.sum()
        return replace(tick, raster=wrong), np.full(len(tick.types), most)

    return corrupt


def _shifted(meters: float) -> Callable[[Raster, np.random.Generator], Raster]:
    def change(raster: Raster, random: np.random.Generator) -> Raster:
        angle = random.uniform(0, 2 * np.pi)
        return replace(raster, origin=raster.origin + meters * np.array([np.cos(angle), np.sin(angle)]))

    return change


def _image(axes: tuple[int, ...], exchanged: bool = False) -> Callable[[Raster, np.random.Generator], Raster]:
    def change(raster: Raster, _: np.random.Generator) -> Raster:
        layers = np.flip(raster.layers, axes)
        return replace(raster, layers=layers.transpose(0, 2, 1) if exchanged else layers)

    return change


_VELOCITY = frozenset({Contradiction.VELOCITY_MISMATCH})
_HEADING = frozenset({Contradiction.HEADING_MISMATCH, Contradiction.HEADING_MIRRORED})
_DEGREES = frozenset({Contradiction.HEADING_IN_DEGREES})
_FLIPPED = frozenset({Contradiction.HEADING_FLIPPED})
_OFF_MAP = frozenset({Contradiction.OFF_MAP})
FAULTS = (
    Fault("velocity: wrong sign", _VELOCITY, _velocity_fault(lambda v, _: -v, 2.0)),
    Fault("velocity: km/h", _VELOCITY, _velocity_fault(lambda v, _: 3.6 * v, 2.0)),
    Fault("velocity: m/s taken for km/h", _VELOCITY, _velocity_fault(lambda v, _: v / 3.6, 4.0)),
    Fault("velocity: in the agent's frame", _VELOCITY, _velocity_fault(lambda v, h: rotate(v, -h), 4.0)),
    Fault("velocity: y mirrored", _VELOCITY, _velocity_fault(lambda v, _: v * [1.0, -1.0], 4.0)),
    Fault("heading: a quarter turn off", _HEADING, _heading_fault(lambda h: h + np.pi / 2, moving=True)),
    Fault("heading: clockwise from north", _HEADING, _heading_fault(lambda h: np.pi / 2 - h, moving=True)),
    Fault("heading: y mirrored", _HEADING, _heading_fault(lambda h: -h, moving=True)),
    Fault("heading: degrees", _DEGREES, _heading_fault(np.rad2deg, moving=False)),
    Fault("heading: flipped in one frame", _FLIPPED, _flip),
    Fault("id given to another object", frozenset({Contradiction.OTHER_OBJECT}), _other_object),
    Fault("times in nanoseconds", frozenset({Contradiction.TIME_UNIT}), _in_nanoseconds),
    Fault("map: rows reversed", _OFF_MAP, _map_fault(_image((1,)))),
    Fault("map: columns reversed", _OFF_MAP, _map_fault(_image((2,)))),
    Fault("map: turned by 180°", _OFF_MAP, _map_fault(_image((1, 2)))),
    Fault("map: rows and columns exchanged", _OFF_MAP, _map_fault(_image((), exchanged=True))),
    Fault("map: shifted by 30 m", _OFF_MAP, _map_fault(_shifted(30.0))),
    Fault("map: shifted by 1 km", _OFF_MAP, _map_fault(_shifted(1000.0))),
)


@dataclass
class Rates:
    """Counts over the agents and ticks of a data set at one rate."""

    agents: int = 0
    wrong: Counter[str] = field(default_factory=Counter)
    """Clean agents with a warning, by its kind."""
    wrong_noisy: Counter[str] = field(default_factory=Counter)
    """The same, with the noise of a tracker."""
    faulty: Counter[str] = field(default_factory=Counter)
    """Agents that a fault changes much, by its name."""
    said: Counter[str] = field(default_factory=Counter)
    """Those of them with a warning that says it."""

    def add(self, tick: Tick, random: np.random.Generator) -> None:
        """Count the agents of one tick."""
        self.agents += len(tick.types)
        self.wrong.update(kind for kinds in _found(tick) for kind in kinds)
        self.wrong_noisy.update(kind for kinds in _found(noisy(tick, random)) for kind in kinds)
        for fault in FAULTS:
            changed, much = fault.corrupt(tick, random)
            self.faulty[fault.name] += int(much.sum())
            if much.any():
                said = np.array([bool(kinds & fault.kinds) for kinds in _found(changed)])
                self.said[fault.name] += int((said & much).sum())


def _found(tick: Tick) -> list[set[Contradiction]]:
    """Return the kinds of each agent's contradictions: [N]."""
    kinds: list[set[Contradiction]] = [set() for _ in tick.types]
    for finding in find_contradictions(tick.observations, tick.types, tick.raster):
        kinds[finding.row].add(finding.kind)
    return kinds


def measure(records: Iterable[SceneRecord]) -> dict[int, Rates]:
    """Return the counts of some scenes by rate, Hz."""
    rates = {rate_hz: Rates() for rate_hz in RATES_HZ}
    for record in records:
        random = np.random.default_rng(zlib.crc32(record.name.encode()))
        for rate_hz, counts in rates.items():
            for tick in ticks(record, rate_hz):
                counts.add(tick, random)
    return rates


def report(rates: Mapping[int, Rates]) -> dict[str, Any]:
    """Return the counts of ``measure`` as JSON types."""
    return {
        f"{rate_hz} Hz": {
            "agents": counts.agents,
            "clean": {kind.value: counts.wrong[kind] for kind in Contradiction},
            "clean, with noise": {kind.value: counts.wrong_noisy[kind] for kind in Contradiction},
            "faults": {fault.name: [counts.said[fault.name], counts.faulty[fault.name]] for fault in FAULTS},
        }
        for rate_hz, counts in rates.items()
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the checks on recorded scenes and print the counts as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.input_checks", description=__doc__)
    parser.add_argument(
        "--data",
        action="append",
        required=True,
        metavar="KIND:PATH@SPLIT,…",
        help="may be given more than once",
    )
    chosen = parser.parse_args(arguments)
    found: dict[str, Any] = {}
    for text in chosen.data:
        place, _, splits = text.rpartition("@")
        try:
            kind, path = parse_data(place)
            reader = READERS[kind](path)
            records = (record for split in splits.split(",") for record in reader.scenes(split))
            found[f"{kind} {splits}"] = report(measure(records))
        except DataError as error:
            parser.error(str(error))
    json.dump(found, sys.stdout, indent=1)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
