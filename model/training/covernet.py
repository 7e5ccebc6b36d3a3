"""Training of CoverNet (Phan-Minh et al. 2020, section 3.3)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from model.networks.config import CoverNetConfig
from model.networks.covernet import present_heading, turned
from model.networks.forecaster import CoverNetworks
from model.scenes.scene import AgentType
from model.training.config import TrainingConfig, TrainingError
from model.training.learner import Batch, DescentLearner, perturbed
from model.training.objectives import LossWeights
from model.training.trajectory_set import make_trajectory_set, summed_distances

_TOP = 5


class CoverNetLearner(DescentLearner):
    """CoverNet under the cross-entropy with the member nearest to the truth, by the mean distance.

    In the cross-entropy a wrong member costs the same whether it is near the truth or far from it. The
    setting ``displacement_weight`` adds the expected distance from the truth, as for the other methods; the
    published objective has no such term.

    The set is made from all training trajectories and is part of the network. A resumed run makes it again,
    with the same result.

    Args:
        config: settings of the run.
        paths: [P, T, 2], m, the training trajectories in the agents' own frames.
        device: device of the network.

    Raises:
        TrainingError: the trajectories and the network differ in their number of steps.
    """

    def __init__(self, config: TrainingConfig, paths: Tensor, device: torch.device) -> None:
        shape = config.network
        assert isinstance(shape, CoverNetConfig)  # noqa: S101 (for the type checker; the method's)
        if paths.shape[1] != shape.steps:
            raise TrainingError(f"the trajectories have {paths.shape[1]} steps, the network {shape.steps}")
        trajectories = make_trajectory_set(paths, shape.epsilon)
        count = len(trajectories.members)
        known = shape.model_copy(update={"members": count, "modes": min(count, shape.modes)})
        networks = CoverNetworks(known)
        self.network = networks.of(AgentType.VEHICLE)
        self.network.trajectory_set.copy_(trajectories.members)
        self.network.variance.copy_(trajectories.variance)
        super().__init__(config, networks.to(device))
        self._config = config

    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        features, path = self._shown(*batches)
        with torch.no_grad():
            distances = summed_distances(path, self.network.trajectory_set)
            nearest = distances.argmin(dim=1)
        scores = self.network.scores(features)
        loss = F.cross_entropy(scores, nearest)
        terms = _accuracies(scores.detach(), nearest)
        if weights.displacement:
            displaced = (scores.softmax(dim=1) * distances).sum(dim=1).mean()
            loss = loss + weights.displacement * displaced
            terms["displacement"] = displaced.detach()
        self.descend(loss, rate)
        return {"loss": loss.detach(), **terms}

    def _shown(self, batch: Batch) -> Batch:
        """Return features as the network is shown them, and the future in the agents' frames."""
        if self._config.in_agent_frame:
            return perturbed(batch, self._config)
        return Batch(batch.features, turned(batch.future, -present_heading(batch.features)))


def _accuracies(scores: Tensor, nearest: Tensor) -> dict[str, Tensor]:
    """Return how often the nearest member is the likeliest one, and among the likeliest five."""
    likeliest = scores.topk(min(_TOP, scores.shape[1]), dim=1).indices == nearest[:, None]
    return {"top_1": likeliest[:, 0].float().mean(), "top_5": likeliest.any(dim=1).float().mean()}
