"""The canary scene: sound models pass, broken ones are named with what is wrong."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from model.baselines.physics import baselines
from model.forecaster import Context, Features
from model.mixture import TrajectoryMixture
from model.registry import Registry
from model.scenes.scene import AgentType
from service.predict.canary import CanaryError, check
from service.settings import bundled_models
from tests.service.fakes import FakeForecaster


class Altered(FakeForecaster):
    """Forecaster whose mixtures are altered before they are returned."""

    def __init__(self, alter: Callable[[TrajectoryMixture], TrajectoryMixture]) -> None:
        super().__init__()
        self.alter = alter

    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        return self.alter(super().forecast(features, agent_type, context, steps))


def test_sound_models_pass() -> None:
    for forecaster in [*baselines(), FakeForecaster(), Altered(lambda mixture: mixture)]:
        check(forecaster)


def test_bundled_models_pass() -> None:
    models = Registry.load(bundled_models(), allow_paper=True)
    for info in models.infos():
        check(models.get(info.full_name))


@pytest.mark.parametrize(
    ("alter", "fault"),
    [
        (lambda m: replace(m, means=m.means + torch.nan), "not finite"),
        (lambda m: replace(m, log_weights=m.log_weights + 0.1), "weights sum to 1.105"),
        (lambda m: replace(m, covariances=0 * m.covariances), "not positive definite"),
        (lambda m: replace(m, means=m.means + 20), "stands is forecast 28 m away"),
        (lambda m: replace(m, means=0.1 * m.means), "go 60 m at constant speed is forecast to go 8 m"),
        (lambda m: replace(m, means=3.6 * m.means), "is forecast to go 281 m"),
        (lambda m: replace(m, means=m.means[:, :1]), "of the shapes"),
    ],
)
def test_unsound_models_are_refused(
    alter: Callable[[TrajectoryMixture], TrajectoryMixture], fault: str
) -> None:
    with pytest.raises(CanaryError, match=fault) as caught:
        check(Altered(alter))
    assert "fake@1.0.0" in str(caught.value)
    assert "vehicle, full context" in str(caught.value)


def test_a_model_that_raises_is_refused() -> None:
    broken = FakeForecaster()
    broken.broken = True
    with pytest.raises(CanaryError, match=r"failed on the canary scene .*secret of the model"):
        check(broken)
