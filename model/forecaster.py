"""The interface of all forecasting models."""

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
"""Inputs of a forward pass by name; the first axis of every tensor is the agents'."""


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

    Forecasting has two halves, so that agents of many scenes can share one forward pass: ``prepare`` takes
    one scene, ``forecast`` takes agents of one type from any number of scenes, joined by ``join``. Both are
    thread-safe.
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

    def compile(self, threads: int | None = None) -> bool:
        """Run forwards as native calls from now on, and return whether they are.

        Answers stay the same within 1e-3 m. A forecaster without a native forward changes nothing.

        Args:
            threads: the threads of a forward; None: all cores.
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


def agent_count(features: Features) -> int:
    """Return the number of agents in the features."""
    return len(next(iter(features.values())))
