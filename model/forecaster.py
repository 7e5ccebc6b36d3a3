"""The one interface of everything that forecasts."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import StrEnum
from typing import TypeAlias

import torch
from pydantic import BaseModel, ConfigDict

from model.arrays import Ints
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS, AgentType, Scene

Features: TypeAlias = dict[str, torch.Tensor]
"""What a forward needs of each agent, by name; the first axis of every tensor is the agents'."""


class Context(StrEnum):
    """Whether the forecast may look at map and neighbours."""

    FULL = "full"
    BLIND = "blind"


class Protocol(StrEnum):
    """How derivatives in the training data were made (see docs of the contract's InputProtocol)."""

    CAUSAL = "causal"
    PAPER = "paper"


class ModelInfo(BaseModel):
    """What is known of a model; served by the model service and kept in a checkpoint's config."""

    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())

    name: str
    version: str
    protocol: Protocol
    description: str
    agent_types: tuple[AgentType, ...]
    """Types it forecasts."""
    context_types: tuple[AgentType, ...]
    """Types it sees as neighbours."""
    history_frames: int
    """Frames of history used at most, now included."""
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
        """``name@version``, which names this model and no other."""
        return f"{self.name}@{self.version}"

    @property
    def horizon(self) -> float:
        """Longest forecast, s."""
        return self.steps * STEP_SECONDS


class Forecaster(ABC):
    """Turns agents of a scene into Gaussian mixtures over their future positions.

    The work is in two halves, so that agents of many scenes can share one forward: ``prepare`` sees one
    scene, ``forecast`` sees agents of one type from anywhere, joined by ``join``. Both are thread-safe.
    """

    info: ModelInfo

    @abstractmethod
    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        """Features of the agents ``targets`` (indices [n] into the scene, all of one type that
        ``info.agent_types`` names), each observed now."""

    @abstractmethod
    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        """Mixtures of the agents in the features.

        Args:
            features: from ``prepare`` with the same context.
            agent_type: the type of all of them.
            context: full or blind.
            steps: T, at most ``info.steps``; default ``info.steps``.
        """

    def requires_heading(self, agent_type: AgentType) -> bool:
        """Whether an agent of that type cannot be forecast without a heading now."""
        return False

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Whether forecasts of agents of that type depend on the map."""
        return self.info.uses_map

    def looks_at_far_map(self, agent_type: AgentType) -> bool:
        """Whether forecasts of agents of that type depend on a far map patch, too."""
        return False

    def __call__(
        self, scene: Scene, targets: Ints, context: Context = Context.FULL, steps: int | None = None
    ) -> TrajectoryMixture:
        """Both halves, for one scene; the targets must be of one type."""
        features = self.prepare(scene, targets, context)
        return self.forecast(features, scene.types[int(targets[0])], context, steps)


def join(parts: Sequence[Features]) -> Features:
    """Features of all agents of the parts, in order."""
    if len(parts) == 1:
        return parts[0]
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def agent_count(features: Features) -> int:
    """How many agents the features are of."""
    return len(next(iter(features.values())))
