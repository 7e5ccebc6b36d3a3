"""Settings under the names that they had before; saved runs, cards and files of users still have them."""

from pathlib import Path

import pytest
import torch
from pydantic import ValidationError

from model.training.config import (
    Method,
    MixtureWeights,
    Precision,
    TrainingConfig,
    TrainingError,
    load_config,
)
from tests.model.training.fakes import small_config

OLD_NAMES = {
    "averaging": ("ema_decay", 0.9),
    "least_learning_rate": ("min_learning_rate", 1e-4),
    "displacement_after": ("displacement_warmup_epochs", 3),
    "least_step_likelihood": ("min_step_likelihood", -20.0),
    "curved_copies": ("curved_oversampling", 4),
    "leaving_share": ("leaving_keep_probability", 0.25),
    "apart_weight": ("blind_kl_weight", 2.0),
    "hide": ("context_dropout", True),
    "block": ("stopped_vehicles", True),
}
OLD_MIXTURE_NAMES = {
    "likelihood": "nll",
    "joint_likelihood": "joint_nll",
    "nearest": "min_ade",
    "nearest_of_5": "min_ade_5",
    "nearest_of_10": "min_ade_10",
    "likeliest": "most_likely_ade",
    "choice": "classification",
    "choice_range_m": "classification_range_m",
    "expected": "expected_ade",
    "apart": "blind_kl",
}
CHECKPOINTS = Path("model/checkpoints")


@pytest.mark.parametrize("old", OLD_NAMES)
def test_a_setting_has_its_old_name_as_an_alias(old: str) -> None:
    new, value = OLD_NAMES[old]
    given = load_config(Method.CAB).model_dump()
    by_new = TrainingConfig.model_validate(given | {new: value})
    del given[new]
    by_old = TrainingConfig.model_validate(given | {old: value})
    assert getattr(by_old, new) == value
    assert by_old == by_new
    with pytest.raises(ValidationError, match=f"{old}\n.*not permitted"):
        TrainingConfig.model_validate(given | {old: value, new: value})


@pytest.mark.parametrize("old", OLD_MIXTURE_NAMES)
def test_a_weight_of_the_mixture_has_its_old_name_as_an_alias(old: str) -> None:
    new = OLD_MIXTURE_NAMES[old]
    assert MixtureWeights.model_validate({old: 0.125}) == MixtureWeights.model_validate({new: 0.125})
    assert getattr(MixtureWeights.model_validate({old: 0.125}), new) == 0.125
    with pytest.raises(ValidationError, match=f"{old}\n.*not permitted"):
        MixtureWeights.model_validate({old: 0.125, new: 0.125})


@pytest.mark.parametrize("method", list(Method))
def test_a_file_with_old_names_is_read_and_written_with_new_ones(tmp_path: Path, method: Method) -> None:
    config = load_config(method, seed=3)
    old = config.toml()
    for before, (after, _) in OLD_NAMES.items():
        old = old.replace(f"\n{after} = ", f"\n{before} = ")
    for before, after in OLD_MIXTURE_NAMES.items():
        old = old.replace(f"\n{after} = ", f"\n{before} = ")
    file = tmp_path / "settings.toml"
    file.write_text(old)
    assert "\naveraging = " in old
    assert load_config(method, file) == config
    assert not any(f"\n{name} = " in config.toml() for name in OLD_NAMES | OLD_MIXTURE_NAMES)


@pytest.mark.parametrize("card", sorted(CHECKPOINTS.glob("*/README.md")), ids=lambda card: card.parent.name)
def test_the_settings_on_the_cards_of_the_bundled_checkpoints_train_again(tmp_path: Path, card: Path) -> None:
    text = card.read_text()
    method = Method(text.split()[1])
    file = tmp_path / "settings.toml"
    file.write_text(text.split("```toml\n")[1].split("```")[0])
    assert load_config(method, file).method is method


def test_a_name_that_no_setting_has_or_had_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("averageing = 0.9\n" + load_config(Method.CAB).toml())
    with pytest.raises(TrainingError, match="averageing: Extra inputs are not permitted"):
        load_config(Method.CAB, file)


def test_a_fault_in_a_setting_under_its_old_name_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="averaging"):
        small_config(Method.CAB, averaging=1.5)


@pytest.mark.parametrize(("instructions", "expected"), [(True, torch.bfloat16), (False, torch.float32)])
def test_a_cpu_without_bfloat16_trains_in_float32(
    monkeypatch: pytest.MonkeyPatch, instructions: bool, expected: torch.dtype
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True, "avx512_bf16": instructions})
    assert Precision.BFLOAT16.dtype_on(torch.device("cpu")) is expected
    assert Precision.BFLOAT16.dtype_on(torch.device("cuda")) is torch.bfloat16
    assert Precision.FLOAT32.dtype_on(torch.device("cpu")) is torch.float32
