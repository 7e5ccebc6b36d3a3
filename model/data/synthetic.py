"""Reader of made-up scenes, with what recorded data has too little of.

That is standing and parked cars, queues, reversing, bends of any radius, fast roads, vehicles that stand in a
lane. Roads, drivers and traffic are drawn from wide ranges; nothing is taken from recorded data.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from model.arrays import Bools, Floats
from model.data.checks import FUTURE_STEPS, check_pairs
from model.data.scenes import DataError, Pair, SceneRecord, Track
from model.data.synthetic_roads import Painter
from model.data.synthetic_scenarios import KINDS, WARM_UP, Plan, draw_plan
from model.data.synthetic_traffic import TICK, Drives, clear, simulate
from model.geometry import rotate, wrap_angle
from model.scenes.scene import STEP_SECONDS, AgentType

SCENES = {"train": 1000, "validation": 60, "hard": 500}
"""Number of scenes by split."""
VERSION = 1
"""Version of the generator. It must be raised with every change of the generated scenes, so that caches of
other ones are rebuilt."""
PAIRS = 10
"""Maximum number of pairs in a scene."""
MARGIN = 77.0
"""m of raster around all positions in a scene."""
HISTORY_STEPS = 5
"""Minimum number of frames before the present of a pair."""

_STANDING_STEPS = 4
"""Frames before the present in which a standing vehicle has not moved."""
_HARD = {"junction": 0.3, "bends": 0.1, "lead": 0.4, "city": 0.2}
"""Shares of kinds of scenes in the split ``hard``: standing leads, junctions, bends, sudden braking."""
_PAIR_WEIGHTS = {
    "parked": 0.1,
    "standing": 0.15,
    "slow": 0.1,
    "reversing": 0.8,
    "fast": 0.4,
    "lead": 0.3,
    "curve": 0.38,
    "plain": 0.12,
}
"""Weights in the choice of pairs, by the behaviour of the vehicle."""


class SyntheticReader:
    """Made-up scenes; each depends on seed, split and number alone."""

    def __init__(self, seed: Path) -> None:
        """
        Args:
            seed: a whole number ≥ 0, as a path, as other readers take one.

        Raises:
            DataError: the seed is no such number.
        """
        if not (str(seed).isascii() and str(seed).isdecimal()):
            raise DataError(f"synthetic:{seed}: the seed is not a whole number from 0 on")
        self._seed = int(str(seed))

    @property
    def place(self) -> str:
        """The seed and the version of the generator."""
        return f"seed {self._seed}, version {VERSION}"

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits, which share no scene."""
        return tuple(SCENES)

    def scene_count(self, split: str) -> int:
        """Return the number of scenes of a split.

        Raises:
            DataError: there is no such split.
        """
        if split not in SCENES:
            raise DataError(f"there is no split {split!r}; there are {', '.join(SCENES)}")
        return SCENES[split]

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """Return the scenes of a split, in order of their names.

        Raises:
            DataError: there is no such split.
        """
        return (self.scene(split, number) for number in range(self.scene_count(split)))

    def scene(self, split: str, number: int) -> SceneRecord:
        """Return one scene.

        Args:
            split: one of the splits.
            number: number of the scene, from 0 on.
        """
        rng = np.random.default_rng([self._seed, list(SCENES).index(split), number])
        by_kind = {name: kind.share for name, kind in KINDS.items()} if split != "hard" else _HARD
        shares = np.array([by_kind.get(name, 0.0) for name in KINDS])
        name = str(rng.choice(list(KINDS), p=shares / shares.sum()))
        while True:
            plan = draw_plan(rng, name)
            if plan.vehicles:
                return _record(rng, plan, f"{split}-{number:04}-{name}")


def _record(rng: np.random.Generator, plan: Plan, name: str) -> SceneRecord:
    """Return the scene that results from a plan."""
    drives = simulate(plan.vehicles, plan.seconds)
    at = np.round((WARM_UP + STEP_SECONDS * np.arange(plan.frames)) / TICK).astype(np.int64)
    drives = Drives(drives.position[:, at], drives.heading[:, at], drives.speed[:, at])
    still = np.array([where for where, _ in plan.parked]).reshape(-1, 1, 2)
    towards = np.array([heading for _, heading in plan.parked]).reshape(-1, 1)
    position = np.concatenate([drives.position, still.repeat(plan.frames, axis=1)])
    heading = np.concatenate([drives.heading, towards.repeat(plan.frames, axis=1)])
    kept = clear(position, heading, len(plan.vehicles))
    about_lead = np.array([one.about_lead for one in plan.vehicles] + [False] * len(plan.parked))
    position, heading, about_lead = position[kept], heading[kept], about_lead[kept]
    speed = np.concatenate([drives.speed, np.zeros((len(plan.parked), plan.frames))])[kept]
    pairs = _pairs(rng, position, heading, speed, about_lead)

    place = _Placing(rng)
    walks = np.array(plan.walkers).reshape(-1, plan.frames, 2)
    everybody = place.points(np.concatenate([position, walks]))
    tracks = [
        Track(str(row), AgentType.VEHICLE, np.arange(plan.frames), everybody[row], place.directions(one))
        for row, one in enumerate(heading)
    ]
    tracks += [
        Track(str(row), AgentType.PEDESTRIAN, np.arange(plan.frames), everybody[row], place.directions(one))
        for row, one in enumerate(map(_course, walks), start=len(tracks))
    ]
    check_pairs(name, tracks, pairs)
    low, high = everybody.min(axis=(0, 1)) - MARGIN, everybody.max(axis=(0, 1)) + MARGIN
    painter = Painter(low, high, place.points)
    for line, half in plan.stubs:
        painter.ribbon(line, -half, half)
    for road in plan.roads:
        painter.road(road)
    if plan.junction:
        painter.junction(plan.junction)
    return SceneRecord(name, tracks, pairs, painter.raster())


class _Placing:
    """Random placement of a scene on a map: any direction, and traffic on the left in half of them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._mirror = np.array([1.0, rng.choice([-1.0, 1.0])])
        self._turn = np.array(rng.uniform(-np.pi, np.pi))
        self._origin = rng.uniform(950.0, 2300.0, 2)

    def points(self, points: Floats) -> Floats:
        """Return placed points [..., 2], m."""
        return rotate(points * self._mirror, self._turn) + self._origin

    def directions(self, heading: Floats) -> Floats:
        """Return placed directions [...], rad."""
        return wrap_angle(heading * self._mirror[1] + self._turn)


def _course(walk: Floats) -> Floats:
    """Return the directions [F], rad, of a path [F, 2]; arbitrary where it stands."""
    ahead = np.gradient(walk, axis=0)
    return np.arctan2(ahead[:, 1], ahead[:, 0])


def _pairs(
    rng: np.random.Generator, position: Floats, heading: Floats, speed: Floats, about_lead: Bools
) -> list[Pair]:
    """Draw pairs so that the vehicles' behaviours have about the shares of ``_PAIR_WEIGHTS``."""
    frames = np.arange(HISTORY_STEPS, position.shape[1] - FUTURE_STEPS)
    kinds = list(_PAIR_WEIGHTS)
    behavior = np.full((len(position), len(frames)), kinds.index("plain"))
    turned = np.unwrap(heading, axis=1)
    window = np.stack([turned[:, frames + k] for k in range(-2, FUTURE_STEPS + 1)])
    behavior[np.ptp(window, axis=0) > 0.35] = kinds.index("curve")
    behavior[about_lead] = kinds.index("lead")
    now = position[:, frames]
    ahead = np.stack([np.cos(heading[:, frames]), np.sin(heading[:, frames])], axis=-1)
    later = ((position[:, frames + FUTURE_STEPS] - now) * ahead).sum(axis=-1)
    behavior[speed[:, frames] < 2.3] = kinds.index("slow")
    behavior[(speed[:, frames] > 0) & (later < -0.5)] = kinds.index("reversing")
    behavior[speed[:, frames] > 20] = kinds.index("fast")
    stood = np.hypot(*(now - position[:, frames - _STANDING_STEPS]).T).T < 0.3
    behavior[stood] = kinds.index("standing")
    behavior[(speed == 0).all(axis=1)] = kinds.index("parked")
    # Each behaviour gets its share of a scene, however many vehicles show it
    counts = np.bincount(behavior.ravel(), minlength=len(kinds))
    weights = np.array(list(_PAIR_WEIGHTS.values())) / np.maximum(counts, 1)
    keys = rng.exponential(1.0, behavior.shape) / weights[behavior]
    chosen = np.argsort(keys, axis=None)[:PAIRS]
    rows, columns = np.unravel_index(chosen, behavior.shape)
    pairs = [Pair(int(row), int(frames[column])) for row, column in zip(rows, columns, strict=True)]
    return sorted(pairs, key=lambda pair: (pair.frame, pair.track))
