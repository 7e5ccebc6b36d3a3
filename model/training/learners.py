"""The learner of each method."""

import torch

from model.features.spec import Frame
from model.networks.config import NetworkConfig
from model.training.config import Method, TrainingConfig
from model.training.covernet import CoverNetLearner
from model.training.halentnet import HalentLearner
from model.training.learner import AgentFrameLearner, CvaeLearner, Learner
from model.training.source import BatchSource


def make_learner(config: TrainingConfig, train: BatchSource, device: torch.device) -> Learner:
    """What learns by a method.

    Args:
        config: of the run.
        train: the pairs, for methods that begin with a look at all of them.
        device: of the networks.
    """
    if config.method in (Method.HALENTNET, Method.HALENTNET_NO_CONTEXT):
        return HalentLearner(config, device)
    if config.method is Method.COVERNET:
        return CoverNetLearner(config, train.paths, device)
    if isinstance(config.network, NetworkConfig) and config.network.frame is Frame.AGENT:
        return AgentFrameLearner(config, device)
    return CvaeLearner(config, device)
