from pathlib import Path

import pytest

from model.checkpoint import CheckpointError
from model.evaluation.selection import EvaluationError, select
from model.forecaster import Protocol
from tests.model.evaluation.builders import PAPER_VERSION, checkpoints, save

PHYSICS_AND_KALMAN = 5


def test_checkpoints_of_the_protocol_beside_all_baselines(tmp_path: Path) -> None:
    folder = checkpoints(tmp_path)
    causal = select(folder, Protocol.CAUSAL)
    assert len(causal.baselines) == PHYSICS_AND_KALMAN
    assert causal.names[4:] == ("kalman@1.0.0", "physics-oracle", "cab@1.0.0", "trajectron-no-context@1.0.0")
    paper = select(folder, Protocol.PAPER)
    assert [model.info.version for model in paper.learned] == [PAPER_VERSION]


@pytest.mark.parametrize(
    ("only", "rows"),
    [
        (["cab"], ["cab@1.0.0"]),
        (["cab@1.0.0", "physics-oracle"], ["physics-oracle", "cab@1.0.0"]),
        (["kalman"], ["kalman@1.0.0"]),
        (["physics-oracle"], ["physics-oracle"]),
    ],
)
def test_only_what_is_named(tmp_path: Path, only: list[str], rows: list[str]) -> None:
    assert list(select(checkpoints(tmp_path), Protocol.CAUSAL, only).names) == rows


def test_baselines_need_no_checkpoint() -> None:
    assert select(None, Protocol.PAPER, ["kalman"]).names == ("kalman@1.0.0",)


def test_what_cannot_be_chosen_is_said(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such folder"):
        select(tmp_path / "nowhere", Protocol.CAUSAL)
    with pytest.raises(EvaluationError, match="none are bundled"):
        select(None, Protocol.CAUSAL)
    save(tmp_path / "cab-paper", "cab", version=PAPER_VERSION)
    none = r"no checkpoint of the causal protocol .*; there are cab@1\.0\.0\+paper \(paper\)"
    with pytest.raises(EvaluationError, match=none):
        select(tmp_path, Protocol.CAUSAL)
    with pytest.raises(
        EvaluationError, match="no model 'nobody' of the paper protocol; there are cab, const"
    ):
        select(tmp_path, Protocol.PAPER, ["cab", "nobody"])
    save(tmp_path / "again", "cab", version=PAPER_VERSION)
    with pytest.raises(EvaluationError, match=r"two models cab@1\.0\.0\+paper"):
        select(tmp_path, Protocol.PAPER)
