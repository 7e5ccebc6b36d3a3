"""The decoder of the modes: what its controls are bounded by."""

import pytest
import torch

from model.networks.decoder import ModeDecoder
from model.networks.dynamics import Controls

AGENTS, MODES, STEPS = 4, 3, 6


def made(max_sigma: float | None, log_sigma: float) -> ModeDecoder:
    """A decoder whose standard deviations lie about a value."""
    torch.manual_seed(0)
    decoder = ModeDecoder(MODES, encoding_size=8, state_size=5, max_sigma=max_sigma)
    with torch.no_grad():
        decoder.log_sigma.bias.fill_(log_sigma)
    return decoder.eval()


def run(decoder: ModeDecoder, sample_controls: bool = False) -> Controls:
    torch.manual_seed(1)
    controls: Controls = decoder(torch.randn(AGENTS, 8), torch.randn(AGENTS, 5), STEPS, sample_controls)
    return controls


def test_no_control_is_wider_than_the_bound() -> None:
    wide, bounded = run(made(None, 3.0)), run(made(5.0, 3.0))
    assert wide.variance_0.min() > 25
    assert wide.variance_1.min() > 25
    for variance in (bounded.variance_0, bounded.variance_1):
        torch.testing.assert_close(variance, torch.full_like(variance, 25.0))
    correlations = [c.covariance / (c.variance_0 * c.variance_1).sqrt() for c in (wide, bounded)]
    torch.testing.assert_close(*correlations)


def test_what_is_narrower_is_as_without() -> None:
    plain, bounded = run(made(None, -1.0)), run(made(5.0, -1.0))
    assert all(torch.equal(one, another) for one, another in zip(plain, bounded, strict=True))


def test_means_do_not_hang_on_the_bound() -> None:
    plain, bounded = run(made(None, 3.0)), run(made(5.0, 3.0))
    assert torch.equal(plain.mean_0, bounded.mean_0)
    assert torch.equal(plain.mean_1, bounded.mean_1)


def test_training_knows_no_bound() -> None:
    plain, bounded = run(made(None, 3.0).train()), run(made(5.0, 3.0).train())
    assert all(torch.equal(one, another) for one, another in zip(plain, bounded, strict=True))


def test_samples_are_drawn_within_the_bound() -> None:
    decoder = made(1e-6, 3.0)
    latents = torch.zeros(AGENTS, STEPS, dtype=torch.int64)
    torch.manual_seed(1)
    drawn = decoder.sample(torch.randn(AGENTS, 8), torch.randn(AGENTS, 5), latents)
    means = run(decoder)
    torch.testing.assert_close(drawn[..., 0], means.mean_0[:, 0], rtol=0, atol=1e-4)
    fed_back = run(decoder, sample_controls=True)
    torch.testing.assert_close(fed_back.mean_1, means.mean_1, rtol=0, atol=1e-4)


def test_the_bound_is_kept_with_the_parameters_where_there_is_one() -> None:
    assert "log_sigma_bound" not in made(None, 0.0).state_dict()
    assert made(5.0, 0.0).state_dict()["log_sigma_bound"].exp().item() == pytest.approx(5.0)
    assert "log_sigma_bound" not in dict(made(5.0, 0.0).named_parameters())
