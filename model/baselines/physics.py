"""The physics baselines: an agent continues its present motion.

They follow nuScenes' prediction baselines (nuscenes-devkit, ``prediction/models/physics.py``), with three
differences. A turn is an exact arc instead of a polygon of Euler steps. Agents that brake stop and stay,
while the devkit lets them reverse and accelerate backwards. The direction of travel is that of the velocity,
and the heading replaces it only for an agent that stands; so a reversing agent continues to reverse, while
the devkit drives it forwards.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from model.arrays import Ints
from model.baselines import uncertainty
from model.baselines.uncertainty import SpreadBySpeed, aligned_covariance
from model.baselines.unimodal import step_times, unimodal
from model.forecaster import Context, Features, Forecaster, ModelInfo, Protocol
from model.geometry import known_or_zero
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType, Scene

STANDING_SPEED = 1e-6
"""m/s; up to this speed the velocity has no direction, and the heading replaces it."""
HEADING_SPEED = 0.5
"""m/s; below this speed the ellipse is aligned with the heading: the velocity's direction is mostly noise."""

_SERIES_LIMIT = 1e-2
"""rad; below this angle the arc's second integral is a series, exact to the last digits of a double."""


class Physics(Forecaster):
    """Constant velocity or acceleration, constant yaw or yaw rate: one mode for each agent.

    The acceleration is the one along the direction of travel, constant until the agent stops. Unknown (NaN)
    velocities, accelerations and heading rates count as zero; an unknown heading is the direction of the
    velocity. The covariance comes from ``model.baselines.uncertainty``, aligned with the direction of travel
    at each step.

    Args:
        name: name of the model.
        accelerates: whether the acceleration stays constant; otherwise the speed does.
        turns: whether the heading rate stays constant; otherwise the direction does.
        spread: growth of the error, by agent type and speed.
    """

    def __init__(
        self, name: str, accelerates: bool, turns: bool, spread: Mapping[AgentType, SpreadBySpeed]
    ) -> None:
        self._accelerates = accelerates
        self._turns = turns
        self._spread = spread
        speed = "acceleration along the direction of travel" if accelerates else "speed"
        course = "heading rate" if turns else "direction of travel"
        self.info = ModelInfo(
            name=name,
            version="1.0.0",
            protocol=Protocol.CAUSAL,
            description=f"Physics: keeps {speed} and {course}; states how far such forecasts are off.",
            agent_types=tuple(AgentType),
            context_types=(),
            history_frames=1,
            modes=1,
            uses_map=False,
            uses_neighbors=False,
            supports_blind=True,
            trained_on="covariance only: nuScenes prediction train (moving vehicles), v1.0-mini (the others)",
            license="Apache-2.0",
        )

    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        """Return the present state.

        Returns:
            Float64: ``position``, ``velocity``, ``acceleration`` [n, 2], ``heading`` (NaN where unknown)
            and ``heading_rate`` [n].

        Raises:
            ValueError: a target is not observed now.
        """
        states = scene.states
        states.require_observed(targets)
        return {
            "position": torch.from_numpy(states.position[targets, -1]),
            "velocity": torch.from_numpy(known_or_zero(states.velocity[targets, -1])),
            "acceleration": torch.from_numpy(known_or_zero(states.acceleration[targets, -1])),
            "heading": torch.from_numpy(states.heading[targets, -1]),
            "heading_rate": torch.from_numpy(known_or_zero(states.heading_rate[targets, -1])),
        }

    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        """Return one mode for each agent; the context makes no difference.

        Raises:
            ValueError: steps outside 1 … 12.
        """
        time = step_times(self.info, steps).to(features["position"].device)
        velocity, heading = features["velocity"], features["heading"]
        speed = velocity.norm(dim=-1)
        course = torch.atan2(velocity[:, 1], velocity[:, 0])
        known = heading.isfinite()
        course = torch.where((speed <= STANDING_SPEED) & known, heading, course)

        moving, acceleration = time.expand(len(speed), -1), torch.zeros_like(speed)
        if self._accelerates:
            along = torch.stack([course.cos(), course.sin()], dim=-1)
            acceleration = (features["acceleration"] * along).sum(-1)
            moving = torch.minimum(moving, _time_to_stop(speed, acceleration)[:, None])
        rate = features["heading_rate"] if self._turns else torch.zeros_like(speed)
        turned = rate[:, None] * moving
        offset = _rotate(_travel(speed[:, None], acceleration[:, None], moving, turned), course[:, None])

        axis = torch.where((speed < HEADING_SPEED) & known, heading, course)
        covariance = aligned_covariance(self._spread[agent_type], speed, time, axis[:, None] + turned)
        return unimodal(offset, covariance, features["position"])


def baselines() -> Sequence[Physics]:
    """Return the four physics baselines of nuScenes, for the registry."""
    return (
        Physics("constant-velocity-yaw", False, False, uncertainty.CONSTANT_VELOCITY_YAW),
        Physics("constant-speed-yaw-rate", False, True, uncertainty.CONSTANT_SPEED_YAW_RATE),
        Physics("constant-acceleration-yaw", True, False, uncertainty.CONSTANT_ACCELERATION_YAW),
        Physics("constant-acceleration-yaw-rate", True, True, uncertainty.CONSTANT_ACCELERATION_YAW_RATE),
    )


def _time_to_stop(speed: Tensor, acceleration: Tensor) -> Tensor:
    """Return the time until an agent stops: [N], s; infinite for an agent that does not brake."""
    braking = acceleration < 0
    return torch.where(braking, speed / torch.where(braking, -acceleration, 1.0), torch.inf)


def _travel(speed: Tensor, acceleration: Tensor, time: Tensor, turned: Tensor) -> Tensor:
    """Return the displacement at heading 0 now: ∫ (speed + acceleration · τ) e^{i ω τ} dτ over time.

    Args:
        speed: [N, 1], m/s, at time 0.
        acceleration: [N, 1], m/s².
        time: [N, T], s.
        turned: [N, T], rad, ω · time.

    Returns:
        [N, T, 2], m.
    """
    # ∫ e^{i x u} du over [0, 1] is the chord of the arc: sinc(x/2) long, at the angle x/2.
    chord = torch.special.sinc(turned / (2 * torch.pi))
    first = torch.stack([chord * torch.cos(turned / 2), chord * torch.sin(turned / 2)], dim=-1)
    # ∫ u e^{i x u} du, by parts; the closed form suffers cancellation where x is small.
    small = turned.abs() < _SERIES_LIMIT
    x = torch.where(small, 1.0, turned)
    real = torch.where(small, 1 / 2 - turned**2 / 8 + turned**4 / 144, (x.cos() + x * x.sin() - 1) / x**2)
    imaginary = torch.where(small, turned / 3 - turned**3 / 30, (x.sin() - x * x.cos()) / x**2)
    second = torch.stack([real, imaginary], dim=-1)
    return (speed * time)[..., None] * first + (acceleration * time**2)[..., None] * second


def _rotate(vectors: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors [N, T, 2] counter-clockwise by angles [N, 1], rad."""
    x, y = vectors[..., 0], vectors[..., 1]
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
