"""Model cards: data, training, calibration and figures of a checkpoint."""

from dataclasses import dataclass

from model.forecaster import Protocol
from model.networks.config import NetworkConfig
from model.training.calibration import AnyCalibration, HorizonCalibration
from model.training.config import TrainingConfig
from model.training.state import Progress

LICENSE = "trained on nuScenes: non-commercial use only (CC BY-NC-SA 4.0 and the nuScenes terms of use)"


@dataclass(frozen=True)
class Origin:
    """Provenance of a checkpoint."""

    data: str
    """Data set and number of pairs, in words."""
    protocol: Protocol
    reported: str
    """Split of the figures, in words, with its number of pairs in brackets."""
    chosen_on: str
    """Split on which the epoch was chosen and a calibration by horizon was fitted."""
    command: str
    """Command that repeats the run, without paths of the machine."""
    machine: str


def model_card(
    config: TrainingConfig,
    origin: Origin,
    progress: Progress,
    version: str,
    figures: dict[str, float],
    calibration: AnyCalibration | None,
) -> str:
    """Return the model card, in Markdown.

    Args:
        config: settings of the run.
        origin: provenance of the checkpoint.
        progress: progress of the run; the checkpoint is its best epoch.
        version: version of the checkpoint.
        figures: figures of the best epoch by name.
        calibration: calibration that was fitted after training; None: there is none.
    """
    inputs = {
        Protocol.CAUSAL: "causal: states from the past alone, as a live service has them",
        Protocol.PAPER: "paper: central differences over whole tracks, so the state now contains the next "
        "positions. For comparison with published tables only: on live states it is less accurate",
    }
    rows = "\n".join(f"| {name} | {value:.4g} |" for name, value in sorted(figures.items()))
    return f"""# {config.method.value} {version}

{config.description}

- **Data**: {origin.data}.
- **Protocol**: {inputs[origin.protocol]}.
- **Forecasts** vehicles, 6 s ahead at 2 Hz, as {config.network.modes} modes; uses up to
  {config.history_frames} frames of history.
{_network(config)}- **Begun** with {config.start or "random parameters"}.
- **Training**: epoch {progress.best_epoch} of {progress.epoch} (settings ask for {config.epochs}),
  batches of {config.batch_size}, learning rate {config.learning_rate:g}, seed {config.seed};
  {progress.seconds / 60:.0f} minutes on {origin.machine}.
- **Calibration**: {_calibration(calibration, origin, config.in_agent_frame)}.
- **Command**: `{origin.command}`, with the settings below as SETTINGS.toml.
- **Licence**: {LICENSE}.

## Figures

On {origin.reported}, {origin.protocol.value} protocol. {_choice(config, origin)}

| figure | value |
|---|---|
{rows}

## Settings

```toml
{config.toml()}
```
"""


def _network(config: TrainingConfig) -> str:
    """Return the differences from the published network as a Markdown item; empty if there are none."""
    network = config.network
    if not (isinstance(network, NetworkConfig) and config.in_agent_frame):
        return ""
    parts = ["states and forecasts are in the agent's own frame (origin and heading)"]
    if network.far_map:
        parts.append("a second map patch reaches 61 m ahead and 36 m to the sides")
    if network.neighbor_types:
        parts.append("neighbours are attended to one by one")
    read = ", and again after map and neighbours were read where they lead" if network.far_map else ""
    parts += [
        f"the controls of all steps of a mode are decoded at once{read} (no GRU is unrolled)",
        "standard deviations along and across a path are outputs",
        "p(z | x) is trained as the weights of the mixture, so there is no q(z | x, y)",
    ]
    return f"- **Differs from the published network**: {'; '.join(parts)}.\n"


def _choice(config: TrainingConfig, origin: Origin) -> str:
    if config.keep == "last":
        return "The last epoch was kept, whatever its figures."
    same = origin.reported.startswith(f"{origin.chosen_on} (")
    return (
        "The epoch was chosen by the FDE of the likeliest\nmode on "
        f"{'this same split' if same else origin.chosen_on}."
    )


RAN_AWAY = "a number ran to the bound of its search: the likelihood asks for more of it than is reasonable"
"""Warning about such a calibration, on the card and while training."""


def _calibration(calibration: AnyCalibration | None, origin: Origin, held_out: bool) -> str:
    if calibration is None:
        return "none, the forecasts are as sure of themselves as the method has them"
    if isinstance(calibration, HorizonCalibration):
        widths = ", ".join(f"{width:.2f}" for width in calibration.widths)
        return (
            f"standard deviations of the 12 steps times {widths}, logits of the modes divided by "
            f"{calibration.temperature:.2f}, fitted after training to merged forecasts of pairs of "
            f"{origin.chosen_on}, so that their positions are the likeliest"
            f"{f'; {RAN_AWAY}' if calibration.ran_away else ''}"
        )
    blind = calibration.blind_width
    positions = f"positions of {origin.chosen_on}" if held_out else "training positions"
    of_blind = "" if blind is None else f" (of blind forecasts {blind:.3f})"
    return (
        f"standard deviations times {calibration.width:.3f}{of_blind}, logits of the modes divided by "
        f"{calibration.temperature:.3f}, fitted after training, so that {positions} are the "
        "likeliest. Means and the order of the modes are the network's own; their probabilities are nearer "
        "to each other than it had learned them where the divisor is above 1"
        f"{f'; {RAN_AWAY}' if calibration.ran_away else ''}"
    )
