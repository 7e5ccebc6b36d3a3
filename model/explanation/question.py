"""The forecasts that explain an agent's forecast, and what follows from them.

Players are the agent's own state, the map and the neighbours; the value of a coalition is about the most
likely end point when the parts outside of the coalition are absent (Ben-Younes et al. 2022, section 4.4:
Shapley values for the distance to the final most likely point). Absent is what ``Donors`` say, or the null
context of that paper.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import Final

import numpy as np
import torch

from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.explanation.donors import Donors, in_ground_frame, in_own_frame
from model.explanation.shapley import (
    antithetic_orders,
    coalitions,
    estimated_values,
    joined,
    shapley_values,
    standard_error,
)
from model.forecaster import Forecaster, Prepared
from model.geometry import rotate
from model.mixture import TrajectoryMixture
from model.scenes.raster import MapView
from model.scenes.scene import AgentStates, AgentType, Scene

EXACT_NEIGHBORS: Final = 6
"""Number of neighbours up to which their values are exact."""
_FAR: Final = "far_map"
_Patches = Mapping[str, Bytes | Float32s]
"""Map patches [3, 100, 100] in [0, 1] by the name of their view; what is not named is unknown."""


class Part(IntFlag):
    """Players of the game of three, and their coalitions."""

    STATE = 1
    MAP = 2
    NEIGHBORS = 4


PARTS: Final = (Part.STATE, Part.MAP, Part.NEIGHBORS)
_ALL: Final = Part.STATE | Part.MAP | Part.NEIGHBORS


@dataclass(frozen=True)
class ExplanationSettings:
    """How forecasts are explained."""

    donors: Donors | None = None
    """What stands for absent parts; None: the null context."""
    draws: int = 8
    """Maximum number of donors drawn for an agent."""
    by_neighbor: bool = False
    """Flag for the value of each neighbour."""
    permutations: int = 16
    """Orders that are drawn of more than ``EXACT_NEIGHBORS`` neighbours, an even number."""
    seed: int = 0


@dataclass(frozen=True)
class ShapleyValue:
    """What a player contributes: three numbers in m.

    They are how much nearer it brings the end point to that of the whole scene, and how far it moves it ahead
    and to the left in the agent's frame.
    """

    value: Floats
    """[3]."""
    error: Floats
    """[3], standard errors; 0 where nothing is drawn, NaN where there is one sample only."""


@dataclass(frozen=True)
class Explanation:
    """The explanation of an agent's forecast."""

    end_point: Floats
    """[2], m, ground frame: where the most likely mode ends."""
    base_point: Floats
    """[2], mean of where it ends when everything is absent."""
    parts: Mapping[Part, ShapleyValue]
    by_neighbor: Mapping[int, ShapleyValue]
    """Values by the neighbour's index in the scene; all other agents of the scene that are observed now."""
    draws: int
    """Number of donors; 0: the null context."""
    permutations: int
    """Number of orders of the neighbours; 0: their values are exact."""


def end_points(mixture: TrajectoryMixture) -> Floats:
    """Return where the most likely modes end: [N, 2], m, ground frame."""
    agents = torch.arange(len(mixture))
    last = mixture.means[agents, mixture.most_likely(), -1]
    return (last.double() + mixture.origin).numpy()


@dataclass
class _Rows:
    """Forecasts to make, each once."""

    parts: list[Prepared] = field(default_factory=list)
    patches: list[_Patches] = field(default_factory=list)
    _known: dict[object, int] = field(default_factory=dict)

    def row(self, key: object, make: Callable[[], Prepared], patches: _Patches) -> int:
        """Return the row of a forecast, which is added unless one of its key is there.

        Args:
            key: identifies the forecast.
            make: makes its features; their views are replaced.
            patches: its map.
        """
        if key not in self._known:
            self._known[key] = len(self.parts)
            self.parts.append(make())
            self.patches.append(patches)
        return self._known[key]

    def joined(self) -> Prepared:
        """Return all rows. Views hold references to the patches, which are copied when they are cut."""
        features = {
            name: torch.cat([part.features[name] for part in self.parts]) for name in self.parts[0].features
        }
        views = {}
        for name, view in self.parts[0].views.items():
            given = {row: patches[name] for row, patches in enumerate(self.patches) if name in patches}
            views[name] = _without_raster(view, len(self.parts), given)
        return Prepared(features, views)


def _without_raster(view: MapView, count: int, given: Mapping[int, Bytes | Float32s]) -> MapView:
    unseen = np.full((count, 2), np.nan)
    return MapView(view.geometry, view.outside, None, 1.0, unseen, np.zeros(count), given)


@dataclass(frozen=True)
class Question:
    """The forecasts that explain that of one agent."""

    inputs: Prepared
    """Features of N forecasts; the first is that of the whole scene."""
    _position: Floats
    _heading: float
    _table: Ints
    """[D, 8], row of each coalition of parts for each draw."""
    _draws: int
    _others: Ints
    """Indices of the other agents whose values are wanted."""
    _seen: Ints
    """Places in ``_others`` of those that are players."""
    _coalitions: Ints | None
    """[2^n], rows of the coalitions of neighbours; None: orders are drawn, or nothing is wanted."""
    _orders: Ints
    """[P, n], orders of the neighbours."""
    _paths: Ints
    """[P, n + 1], rows of the coalitions that the orders pass through."""

    def answer(self, points: Floats) -> Explanation:
        """Return the explanation.

        Args:
            points: [N, 2], m, ground frame, from ``end_points`` of the forecasts.
        """
        values = self._values(points)
        samples = shapley_values(values[self._table])  # [D, 3, 3]
        mean = samples.mean(axis=0)
        error = standard_error(samples) if self._draws else np.zeros_like(mean)
        parts = {part: ShapleyValue(mean[n], error[n]) for n, part in enumerate(PARTS)}
        return Explanation(
            end_point=points[0],
            base_point=points[self._table[:, 0]].mean(axis=0),
            parts=parts,
            by_neighbor=self._by_neighbor(values),
            draws=self._draws,
            permutations=len(self._orders),
        )

    def _values(self, points: Floats) -> Floats:
        """Return the values of the forecasts as coalitions: [N, 3]."""
        nearer = -np.hypot(*(points - points[0]).T)
        in_frame = rotate(points - self._position, np.asarray(-self._heading))
        return np.concatenate([nearer[:, None], in_frame], axis=1)

    def _by_neighbor(self, values: Floats) -> dict[int, ShapleyValue]:
        count = len(self._others)
        value, error = np.zeros((count, 3)), np.zeros((count, 3))
        if self._coalitions is not None:
            value[self._seen] = shapley_values(values[self._coalitions])
        elif len(self._orders):
            value[self._seen], error[self._seen] = estimated_values(self._orders, values[self._paths])
        return {int(index): ShapleyValue(value[n], error[n]) for n, index in enumerate(self._others)}


def forecasts_needed(neighbors: int, settings: ExplanationSettings) -> int:
    """Return the greatest number of forecasts that the explanation of an agent can take.

    Args:
        neighbors: number of neighbours that the model sees of it.
        settings: how it is explained.
    """
    needed: int = 2 ** len(PARTS)
    if settings.donors is not None:
        needed = 1 + (needed - 1) * settings.draws
    if not settings.by_neighbor:
        return needed
    if neighbors <= EXACT_NEIGHBORS:
        return needed + int(2**neighbors) - 1
    return needed + 1 + settings.permutations * (neighbors - 1)


def ask(forecaster: Forecaster, scene: Scene, target: int, settings: ExplanationSettings) -> Question:
    """Return the forecasts that explain that of one agent.

    Args:
        forecaster: the model.
        scene: the scene.
        target: index of the agent, which the model can forecast.
        settings: how it is explained.
    """
    agent = _Agent(forecaster, scene, target, settings)
    table, draws = agent.coalitions_of_parts()
    others = np.zeros(0, dtype=np.int64)
    seen = others
    exact: Ints | None = None
    orders = paths = np.zeros((0, 0), dtype=np.int64)
    if settings.by_neighbor:
        present = agent.scene.states.observed[:, -1].copy()
        present[target] = False
        others = np.flatnonzero(present)
        seen = np.searchsorted(others, agent.neighbors)
        if len(seen) <= EXACT_NEIGHBORS:
            exact = np.array([agent.with_neighbors(members) for members in coalitions(len(seen))])
        else:
            orders = antithetic_orders(len(seen), settings.permutations, agent.random)
            paths = np.array([[agent.with_neighbors(members) for members in joined(o)] for o in orders])
    return Question(
        agent.rows.joined(),
        agent.position,
        agent.heading,
        table,
        draws,
        others,
        seen,
        exact,
        orders,
        paths,
    )


class _Agent:
    """An agent whose forecast is explained, with the forecasts that are needed so far."""

    def __init__(
        self, forecaster: Forecaster, scene: Scene, target: int, settings: ExplanationSettings
    ) -> None:
        self._forecaster = forecaster
        self._settings = settings
        self.scene = replace(scene, states=scene.states.last_frames(forecaster.info.history_frames))
        self._target = target
        self._kind = scene.types[target]
        states = self.scene.states
        self.position = states.position[target, -1]
        self.heading = _heading(states, target)
        self.random = np.random.default_rng(settings.seed)  # agents of a scene draw alike
        self.rows = _Rows()
        alone = np.array([target])
        self.neighbors = np.flatnonzero(forecaster.sees(self.scene, alone)[0])
        self._own = in_own_frame(states, alone, self.position, self.heading)[0]
        self._patches = _own_patches(forecaster, self.scene, target)
        self._players = (
            Part.STATE
            | (Part.MAP if self._patches else Part(0))
            | (Part.NEIGHBORS if len(self.neighbors) else Part(0))
        )
        self.rows.row(_ALL & self._players, lambda: self._view(None, self._members(None)), self._patches)

    def coalitions_of_parts(self) -> tuple[Ints, int]:
        """Return the row of each coalition for each draw [D, 8], and the number of donors."""
        donors = self._settings.donors
        drawn = None if donors is None else self._drawn(donors)
        if donors is None or drawn is None:
            return np.array([[self._null(Part(number)) for number in range(8)]]), 0
        table = [
            [
                self._with_donor(donors, Part(number), int(like if number & Part.STATE else spread))
                for number in range(8)
            ]
            for like, spread in zip(*drawn, strict=True)
        ]
        return np.array(table), len(table)

    def with_neighbors(self, members: Bools) -> int:
        """Return the row of a coalition of the neighbours [n], with own state and map."""
        if members.all():
            return 0  # the whole scene
        kept = self.neighbors[members]
        key = ("neighbors", *kept.tolist())
        return self.rows.row(key, lambda: self._view(None, self._members(kept)), self._patches)

    def _drawn(self, donors: Donors) -> tuple[Ints, Ints] | None:
        """Return the donors for coalitions with the own state, and those for coalitions without it: [D] each.

        None: there are fewer than two donors for the agent, too few for a standard error.
        """
        if self._kind is not AgentType.VEHICLE:
            return None
        count = self._settings.draws
        if self._players == Part.STATE:
            like = np.zeros(count, dtype=np.int64)  # nothing else is taken from them
        else:
            like = donors.matching(self._own, len(self.neighbors), self.random)[:count]
        if len(like) < 2:
            return None
        patch = self._patches.get(_FAR)
        return like, donors.spread(len(like), patch)

    def _null(self, coalition: Part) -> int:
        """Return the row of a coalition, with the null context for what is absent."""
        present = coalition & self._players
        history = None if Part.STATE in present else self._standing()
        members = self._members(None if Part.NEIGHBORS in present else self.neighbors[:0])
        return self.rows.row(
            present, lambda: self._view(history, members), self._patches if Part.MAP in present else {}
        )

    def _with_donor(self, donors: Donors, coalition: Part, donor: int) -> int:
        """Return the row of a coalition, with the parts of a donor for what is absent."""
        present = coalition & self._players
        if present == self._players:
            return 0
        history = None
        if Part.STATE not in present:
            history = self._placed(donors.history[donor][None])
        patches: _Patches = self._patches
        if Part.MAP in self._players and Part.MAP not in present:
            patches = {name: (donors.far if name == _FAR else donors.near)[donor] for name in self._patches}

        def make() -> Prepared:
            members = self._members(None)
            if Part.NEIGHBORS in self._players and Part.NEIGHBORS not in present:
                own = self._own if history is None else donors.history[donor]
                kinds, histories = donors.neighbors_of(donor, len(self.neighbors), own)
                members = kinds, self._placed(histories)
            return self._view(history, members)

        return self.rows.row((present, donor), make, patches)

    def _placed(self, histories: Floats) -> AgentStates:
        return in_ground_frame(histories, self.position, self.heading, self.scene.states.frames)

    def _standing(self) -> AgentStates:
        """Return the agent's states if it had always stood where it is."""
        own = self.scene.states.select(np.array([self._target]))
        none = np.where(own.observed, 0.0, np.nan)
        return replace(
            own,
            position=none[..., None] + own.position[:, -1:],
            velocity=none[..., None] + np.zeros(2),
            acceleration=none[..., None] + np.zeros(2),
            heading=none + own.heading[:, -1:],
            heading_rate=none,
        )

    def _members(self, kept: Ints | None) -> tuple[Sequence[AgentType], AgentStates]:
        """Return types and states of some of the agent's neighbours; None: of all."""
        kept = self.neighbors if kept is None else kept
        return [self.scene.types[index] for index in kept.tolist()], self.scene.states.select(kept)

    def _view(
        self, history: AgentStates | None, members: tuple[Sequence[AgentType], AgentStates]
    ) -> Prepared:
        """Return the features of the agent without a map.

        Args:
            history: its states; None: its own.
            members: types and states of its neighbours.
        """
        own = self.scene.states.select(np.array([self._target])) if history is None else history
        kinds, states = members
        scene = Scene([self._kind, *kinds], _stacked(own, states))
        with torch.inference_mode():
            return self._forecaster.view(scene, np.zeros(1, dtype=np.int64))


def _own_patches(forecaster: Forecaster, scene: Scene, target: int) -> _Patches:
    """Return the map patches that the model sees of the agent; none if it looks at none, or has none."""
    given = scene.raster is not None or target in scene.patches or target in scene.far_patches
    if not given or not forecaster.looks_at_map(scene.types[target]):
        return {}
    with torch.inference_mode():
        views = forecaster.view(scene, np.array([target])).views
        return {
            name: (view.cut()[0] + 1) / 2
            for name, view in views.items()
            if view.layers is not None or view.given
        }


def _heading(states: AgentStates, target: int) -> float:
    """Return the direction ahead of an agent, rad: its heading, else that of its motion, else the x axis."""
    heading = float(states.heading[target, -1])
    if np.isfinite(heading):
        return heading
    velocity = states.velocity[target, -1]
    return float(np.arctan2(velocity[1], velocity[0])) if np.isfinite(velocity).all() else 0.0


def _stacked(one: AgentStates, others: AgentStates) -> AgentStates:
    """Return the states of agents after those of another one."""
    names = ("position", "velocity", "acceleration", "heading", "heading_rate", "first", "velocity_known")
    return AgentStates(
        **{name: np.concatenate([getattr(one, name), getattr(others, name)]) for name in names}
    )
