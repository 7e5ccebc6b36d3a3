"""Data sets by name."""

from pathlib import Path

import pytest

from model.data.scenes import DataError
from model.data.sources import parse_also, parse_data, parse_protocol
from model.forecaster import Protocol


def test_data_is_a_kind_and_a_path() -> None:
    assert parse_data("nuscenes_pred:/some/where:else") == ("nuscenes_pred", Path("/some/where:else"))


@pytest.mark.parametrize("text", ["nowhere", "nuscenes_pred:", "other:/path", ":/path"])
def test_what_is_no_data_is_said(text: str) -> None:
    with pytest.raises(DataError, match="KIND:PATH with KIND one of nuscenes_pred, nuscenes, synthetic"):
        parse_data(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("synthetic:3", ("synthetic", Path("3"), "train")),
        ("nuscenes:/some/where@mini_train", ("nuscenes", Path("/some/where"), "mini_train")),
        ("nuscenes_pred:/at@home@train_main", ("nuscenes_pred", Path("/at@home"), "train_main")),
    ],
)
def test_more_data_is_a_kind_a_path_and_a_split(text: str, expected: tuple[str, Path, str]) -> None:
    assert parse_also(text) == expected


@pytest.mark.parametrize("text", ["nowhere@train", "@train", "nuscenes:@train", "other:/path@train"])
def test_what_is_no_more_data_is_said(text: str) -> None:
    with pytest.raises(DataError, match="is not KIND:PATH"):
        parse_also(text)


def test_protocols_by_name() -> None:
    assert [parse_protocol(name) for name in ("causal", "paper")] == [Protocol.CAUSAL, Protocol.PAPER]
    with pytest.raises(DataError, match="no protocol 'best'; there are causal, paper"):
        parse_protocol("best")
