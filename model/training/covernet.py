"""How CoverNet learns (Phan-Minh et al. 2020, section 3.3)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from model.networks.config import CoverNetConfig
from model.networks.covernet import present_heading, turned
from model.networks.forecaster import CoverNetworks
from model.scenes.scene import AgentType
from model.training.config import TrainingConfig, TrainingError
from model.training.learner import Batch, DescentLearner
from model.training.objectives import Weights
from model.training.trajectory_set import make_cover, summed_distances

_TOP = 5


class CoverNetLearner(DescentLearner):
    """Cross-entropy with the member of the set that is nearest to the truth, by the mean distance.

    A wrong member costs the same whether it is near the truth or far from it. The run's
    ``displacement_weight`` adds the distance from the truth that the probabilities expect, as for the other
    methods; the published objective has none.

    The set is made of all training trajectories; it is part of the network. A run that is resumed makes it
    anew, and it is the same.

    Args:
        config: of the run.
        paths: [P, T, 2], m, the training trajectories in the agents' own frames.
        device: of the network.

    Raises:
        TrainingError: the trajectories have not as many steps as the network's.
    """

    def __init__(self, config: TrainingConfig, paths: Tensor, device: torch.device) -> None:
        shape = config.network
        assert isinstance(shape, CoverNetConfig)  # noqa: S101 (for the type checker; the method's)
        if paths.shape[1] != shape.steps:
            raise TrainingError(f"the trajectories have {paths.shape[1]} steps, the network {shape.steps}")
        cover = make_cover(paths, shape.epsilon)
        count = len(cover.members)
        known = shape.model_copy(update={"members": count, "modes": min(count, shape.modes)})
        networks = CoverNetworks(known)
        self.network = networks.of(AgentType.VEHICLE)
        self.network.cover.copy_(cover.members)
        self.network.variance.copy_(cover.variance)
        super().__init__(config, networks.to(device))

    def step(self, batches: Sequence[Batch], weights: Weights, rate: float) -> dict[str, Tensor]:
        (batch,) = batches
        with torch.no_grad():
            path = turned(batch.future, -present_heading(batch.features))
            distances = summed_distances(path, self.network.cover)
            nearest = distances.argmin(dim=1)
        scores = self.network.scores(batch.features)
        loss = F.cross_entropy(scores, nearest)
        terms = _shares_right(scores.detach(), nearest)
        if weights.displacement:
            displaced = (scores.softmax(dim=1) * distances).sum(dim=1).mean()
            loss = loss + weights.displacement * displaced
            terms["displacement"] = displaced.detach()
        self.descend(loss, rate)
        return {"loss": loss.detach(), **terms}


def _shares_right(scores: Tensor, nearest: Tensor) -> dict[str, Tensor]:
    """How often the nearest member is the likeliest one, and among the likeliest five."""
    likeliest = scores.topk(min(_TOP, scores.shape[1]), dim=1).indices == nearest[:, None]
    return {"top_1": likeliest[:, 0].float().mean(), "top_5": likeliest.any(dim=1).float().mean()}
