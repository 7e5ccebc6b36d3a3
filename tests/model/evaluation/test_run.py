from pathlib import Path

import pytest

from model.data.scenes import DataError
from model.evaluation.run import Evaluation, write_results
from model.evaluation.selection import select
from model.forecaster import Protocol
from tests.model.data.records import FixedReader, record
from tests.model.evaluation.builders import checkpoints


def evaluation(folder: Path, reader: FixedReader) -> Evaluation:
    models = select(checkpoints(folder / "models"), Protocol.CAUSAL, ["cab", "kalman"])
    return Evaluation(models, "made", reader, "some", Protocol.CAUSAL, folder / "cache", samples=0)


def test_what_goes_on_is_told(tmp_path: Path) -> None:
    ticks: list[tuple[str, int]] = []
    said: list[str] = []
    results = evaluation(tmp_path, FixedReader(record()))(
        lambda what, done: ticks.append((what, done)), said.append
    )
    pairs = len(record().pairs)
    assert ticks == [("cab", pairs), ("baselines", pairs)]
    assert len(said) == 2  # the cache is missing, and then it is built
    assert [row.name for row in results.models] == ["kalman", "cab"]
    write_results(results, tmp_path / "new/out")
    assert {file.name for file in (tmp_path / "new/out").iterdir()} == {"results.json", "tables.md"}


def test_a_cache_of_other_data_is_found_out(tmp_path: Path) -> None:
    evaluation(tmp_path, FixedReader(record()))(lambda *_: None, lambda _: None)
    other = evaluation(tmp_path, FixedReader(record(), record("scene-2", seed=1)))
    with pytest.raises(DataError, match="caches of other data"):
        other(lambda *_: None, lambda _: None)
