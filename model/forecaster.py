"""The interface of all forecasting models."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict

from model.arrays import Bools, Ints
from model.mixture import TrajectoryMixture
from model.scenes.raster import MapView, cut_views
from model.scenes.scene import STEP_SECONDS, AgentType, Scene

Features: TypeAlias = dict[str, torch.Tensor]
"""Inputs of a forward pass by name; the first axis of every tensor is the agents'."""


_CHUNK_AGENTS = 32
"""Agents whose map patches a thread cuts at once."""


@dataclass(frozen=True)
class Prepared:
    """Agents that wait for a forward: features, and views of the map in place of patches.

    Patches are a hundred times as large as all else, so they are cut when the forward starts (``complete``).
    """

    features: Features
    views: Mapping[str, MapView] = field(default_factory=dict)
    """Views by the name of the feature that their patches become."""

    def __len__(self) -> int:
        return agent_count(self.features)

    def __getitem__(self, agents: slice) -> "Prepared":
        """Return successive agents."""
        return Prepared(
            {name: tensor[agents] for name, tensor in self.features.items()},
            {name: view[agents] for name, view in self.views.items()},
        )


class Context(StrEnum):
    """The part of a scene that a forecast may use: all of it, or the agent's own history alone (blind)."""

    FULL = "full"
    BLIND = "blind"


class Protocol(StrEnum):
    """The derivation of velocities and so on in the training data (see the contract's InputProtocol)."""

    CAUSAL = "causal"
    PAPER = "paper"


class ModelInfo(BaseModel):
    """Facts about a model, served by the model service and stored in a checkpoint's config."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    name: str
    version: str
    protocol: Protocol
    description: str
    agent_types: tuple[AgentType, ...]
    """Types that it forecasts."""
    context_types: tuple[AgentType, ...]
    """Types that it sees as neighbours."""
    history_frames: int
    """Maximum number of history frames that it uses, now included."""
    steps: int = 12
    """Longest forecast, in steps of 0.5 s."""
    modes: int
    uses_map: bool
    uses_neighbors: bool
    supports_blind: bool
    trained_on: str = ""
    benchmark: dict[str, float] = {}
    license: str

    @property
    def full_name(self) -> str:
        """``name@version``, unique to this model."""
        return f"{self.name}@{self.version}"

    @property
    def contexts(self) -> tuple[Context, ...]:
        """Contexts that the model can forecast in."""
        return (Context.FULL, Context.BLIND) if self.supports_blind else (Context.FULL,)

    @property
    def horizon(self) -> float:
        """Longest forecast, s."""
        return self.steps * STEP_SECONDS


class Forecaster(ABC):
    """A model that forecasts agents of a scene as Gaussian mixtures over their future positions.

    Forecasting has two halves, so that agents of many scenes can share one forward pass: ``view`` takes one
    scene, ``forecast`` takes agents of one type from any number of scenes, joined by ``complete``. Both are
    thread-safe. ``prepare`` is ``view`` and ``complete`` of one scene.
    """

    info: ModelInfo

    @abstractmethod
    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        """Return the features of some agents.

        Args:
            scene: the scene.
            targets: [n], indices of agents, all of one type in ``info.agent_types``, each observed now.
            context: full or blind.
        """

    def view(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Prepared:
        """Return what ``prepare`` does, but with map patches that are not cut yet.

        Args:
            scene: as for ``prepare``.
            targets: as for ``prepare``.
            context: as for ``prepare``.
        """
        return Prepared(self.prepare(scene, targets, context))

    @abstractmethod
    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        """Return the mixtures of the agents in the features.

        Args:
            features: result of ``prepare`` with the same context.
            agent_type: the type of all agents.
            context: full or blind.
            steps: T, at most ``info.steps``; None: ``info.steps``.
        """

    def compile(self, threads: int) -> bool:
        """Run forwards as native calls from now on, and return whether they are.

        Answers stay the same within 1e-3 m. A forecaster without a native forward changes nothing.

        Args:
            threads: number of threads of a forward.
        """
        return False

    def requires_heading(self, agent_type: AgentType) -> bool:
        """Return whether a forecast of an agent of that type needs its heading now."""
        return False

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Return whether forecasts of agents of that type depend on the map."""
        return self.info.uses_map

    def looks_at_far_map(self, agent_type: AgentType) -> bool:
        """Return whether forecasts of agents of that type also depend on the far map patch."""
        return False

    def sees(self, scene: Scene, targets: Ints) -> Bools:
        """Return which agents of the scene can change the forecasts of n others as neighbours: [n, N].

        Args:
            scene: the scene.
            targets: as for ``prepare``.
        """
        kinds = self.info.context_types if self.info.uses_neighbors else ()
        seen = np.array([kind in kinds for kind in scene.types], dtype=np.bool_)
        seen &= scene.states.observed[:, -1]
        others = targets[:, None] != np.arange(len(scene.types))[None]
        return np.asarray(seen[None] & others)

    def __call__(
        self, scene: Scene, targets: Ints, context: Context = Context.FULL, steps: int | None = None
    ) -> TrajectoryMixture:
        """Forecast targets of one type in one scene: ``prepare``, then ``forecast``."""
        features = self.prepare(scene, targets, context)
        return self.forecast(features, scene.types[int(targets[0])], context, steps)


def join(parts: Sequence[Features]) -> Features:
    """Concatenate the features of agents, in order."""
    if len(parts) == 1:
        return parts[0]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def complete(parts: Sequence[Prepared], threads: Executor | None = None) -> Features:
    """Cut the map patches of agents, and concatenate all features, in order.

    Args:
        parts: agents with the same features.
        threads: the threads to cut in; None: the calling one.
    """
    features = dict(join([part.features for part in parts]))
    names = [name for name in parts[0].views for _ in parts]
    views = [part.views[name] for name in parts[0].views for part in parts]
    starts = _chunk_starts(names, [len(view) for view in views])
    chunks = [views[start:stop] for start, stop in zip(starts, [*starts, len(views)][1:], strict=True)]
    cut = [patch for some in (threads.map if threads else map)(cut_views, chunks) for patch in some]
    for name in parts[0].views:
        patches = [patch for one, patch in zip(names, cut, strict=True) if one == name]
        # In numpy: torch would concatenate in threads of its own
        features[name] = torch.from_numpy(patches[0] if len(parts) == 1 else np.concatenate(patches))
    return features


def _chunk_starts(names: Sequence[str], agents: Sequence[int]) -> list[int]:
    """Return where the chunks of views begin that are cut at once: of one name, and of few agents."""
    starts: list[int] = []
    size = 0
    for index, (name, count) in enumerate(zip(names, agents, strict=True)):
        if not starts or name != names[starts[-1]] or size + count > _CHUNK_AGENTS:
            starts.append(index)
            size = 0
        size += count
    return starts


def agent_count(features: Features) -> int:
    """Return the number of agents in the features."""
    return len(next(iter(features.values())))
