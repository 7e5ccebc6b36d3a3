"""Forecaster that a test controls."""

import threading

import numpy as np
import torch

from model.arrays import Ints
from model.baselines import kalman, physics
from model.forecaster import Context, Features, Forecaster, ModelInfo, Protocol, agent_count
from model.mixture import TrajectoryMixture
from model.registry import Registry
from model.scenes.scene import AgentType, Scene


class FakeForecaster(Forecaster):
    """Forecaster of straight motion: each mode is a little faster and heavier than the one before."""

    def __init__(
        self,
        name: str = "fake",
        *,
        version: str = "1.0.0",
        agent_types: tuple[AgentType, ...] = (AgentType.VEHICLE, AgentType.PEDESTRIAN),
        modes: int = 4,
        history_frames: int = 3,
        steps: int = 12,
        uses_map: bool = False,
        supports_blind: bool = True,
        protocol: Protocol = Protocol.CAUSAL,
        needs_heading: bool = False,
        map_types: tuple[AgentType, ...] | None = None,
    ) -> None:
        self.info = ModelInfo(
            name=name,
            version=version,
            protocol=protocol,
            description="Made up.",
            agent_types=agent_types,
            context_types=agent_types,
            history_frames=history_frames,
            steps=steps,
            modes=modes,
            uses_map=uses_map,
            uses_neighbors=False,
            supports_blind=supports_blind,
            trained_on="nothing",
            benchmark={"fde_ml_6s_m": 1.5},
            license="Apache-2.0",
        )
        self.needs_heading = needs_heading
        self.map_types = map_types
        self.free = threading.Event()
        """Event that forwards wait for."""
        self.free.set()
        self.entered = threading.Event()
        """Event that is set when a forward begins."""
        self.batches: list[tuple[AgentType, int, Context, int]] = []
        """Type, agents, context and steps of each forward."""
        self.scenes: list[Scene] = []
        self.broken = False
        self.nan_beyond = np.inf
        """Position x in m beyond which forecasts are NaN."""

    def requires_heading(self, agent_type: AgentType) -> bool:
        return self.needs_heading

    def looks_at_map(self, agent_type: AgentType) -> bool:
        return self.info.uses_map and (self.map_types is None or agent_type in self.map_types)

    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        self.scenes.append(scene)
        return {
            "position": torch.from_numpy(scene.states.position[targets, -1]),
            "velocity": torch.from_numpy(scene.states.velocity[targets, -1]),
        }

    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        steps = steps or self.info.steps
        self.batches.append((agent_type, agent_count(features), context, steps))
        self.entered.set()
        assert self.free.wait(20), "the test never let the forward go"
        if self.broken:
            raise RuntimeError("secret of the model")
        position, velocity = features["position"], features["velocity"].float()
        ahead = 0.5 * torch.arange(1, steps + 1)
        factor = 1 + 0.1 * torch.arange(self.info.modes)
        means = velocity[:, None, None, :] * ahead[None, None, :, None] * factor[None, :, None, None]
        means[position[:, 0] > self.nan_beyond] = torch.nan
        weights = torch.arange(1.0, self.info.modes + 1).log_softmax(0).expand(len(position), -1)
        covariances = torch.eye(2) * ahead[:, None, None]
        return TrajectoryMixture(
            weights, means, covariances.expand(*means.shape[:3], 2, 2).clone(), position.clone()
        )

    def forget(self) -> None:
        """Forget the forwards of the warm-up."""
        self.batches.clear()
        self.scenes.clear()
        self.entered.clear()


def registry(*forecasters: Forecaster) -> Registry:
    """Return a registry of the baselines and some more forecasters."""
    return Registry([*physics.baselines(), kalman.Kalman(), *forecasters])
