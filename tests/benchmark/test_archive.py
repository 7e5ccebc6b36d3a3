"""Answers on disk."""

import sqlite3
from pathlib import Path

import pytest

from benchmark.archive import FILE, Answer, Archive
from benchmark.errors import BenchmarkError
from benchmark.plan import Call
from cab.forecast.v1.model_service_pb2 import Model
from cab.forecast.v1.prediction_service_pb2 import PredictResponse

CALL = Call(7, (0, 2), frozenset({2}))


def answer(seed: int = 0) -> Answer:
    """An answer that can be told from others."""
    return Answer(0.25, PredictResponse(time=3.5, steps=12, step=0.5, seed=seed))


def test_what_was_added_is_there_again(tmp_path: Path) -> None:
    with Archive(tmp_path / "run") as archive:
        archive.add("cab@1.0.0", "scene-1", CALL, answer(1))
        archive.add("cab@1.0.0", "scene-1", Call(3, (0,), frozenset()), answer(2))
        archive.add("kalman@1.0.0", "scene-2", CALL, answer(3))
    with Archive(tmp_path / "run", read_only=True) as archive:
        assert archive.answered() == {
            ("cab@1.0.0", "scene-1", 7),
            ("cab@1.0.0", "scene-1", 3),
            ("kalman@1.0.0", "scene-2", 7),
        }
        assert list(archive.answers("cab@1.0.0", "scene-1")) == [(3, answer(2)), (7, answer(1))]
        assert list(archive.answers("cab@1.0.0", "scene-2")) == []


def test_an_answer_is_there_without_closing(tmp_path: Path) -> None:
    """A process that is killed closes nothing."""
    first = Archive(tmp_path)
    first.add("cab@1.0.0", "scene-1", CALL, answer())
    with Archive(tmp_path) as second:
        assert second.answered() == {("cab@1.0.0", "scene-1", 7)}
    first.close()


def test_answers_belong_to_one_run(tmp_path: Path) -> None:
    facts = {"split": "train_val", "plan": "1234"}
    with Archive(tmp_path) as archive:
        archive.bind(facts)
        archive.note("endpoint", "one")
    with Archive(tmp_path) as archive:
        archive.bind(facts)
        archive.note("endpoint", "another")
        assert archive.facts() == facts | {"endpoint": "another"}
        with pytest.raises(BenchmarkError, match="split was train_val, is val; give the same options"):
            archive.bind(facts | {"split": "val"})


def test_another_model_of_the_same_name_is_refused(tmp_path: Path) -> None:
    known = Model(name="cab", version="1.0.0", trained_on="this", benchmark={"a": 1.0, "b": 2.0})
    with Archive(tmp_path) as archive:
        archive.register("cab@1.0.0", known)
        same = Model(name="cab", version="1.0.0", trained_on="this", benchmark={"b": 2.0, "a": 1.0})
        same.is_default = True
        archive.register("cab@1.0.0", same)
        with pytest.raises(BenchmarkError, match=r"cab@1\.0\.0 of the endpoint is not the model"):
            archive.register("cab@1.0.0", Model(name="cab", version="1.0.0", trained_on="that"))
        assert list(archive.models()) == ["cab@1.0.0"]
        # Words and figures about it may be mended
        archive.register("cab@1.0.0", Model(name="cab", version="1.0.0", trained_on="this", license="new"))


def test_where_there_is_nothing_to_read(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=f"{FILE}: there are no saved answers"):
        Archive(tmp_path / "nowhere", read_only=True)
    assert not (tmp_path / "nowhere").exists()


def test_another_kind_of_file_is_no_archive(tmp_path: Path) -> None:
    (tmp_path / FILE).write_bytes(b"not a database, but as long as the header of one would be" * 20)
    with pytest.raises(BenchmarkError, match="cannot be used for answers"):
        Archive(tmp_path)


def test_the_file_is_plain_sqlite(tmp_path: Path) -> None:
    with Archive(tmp_path) as archive:
        archive.add("cab@1.0.0", "scene-1", CALL, answer())
    file = sqlite3.connect(tmp_path / FILE)
    try:
        assert file.execute("SELECT model, scene, frame, seconds FROM answers").fetchall() == [
            ("cab@1.0.0", "scene-1", 7, 0.25)
        ]
    finally:
        file.close()


def test_answers_may_lie_where_nothing_can_be_written(tmp_path: Path) -> None:
    with Archive(tmp_path) as archive:
        archive.bind({"split": "val"})
        archive.add("cab@1.0.0", "scene-1", CALL, answer())
    before = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).chmod(0o444)
    tmp_path.chmod(0o555)
    try:
        with Archive(tmp_path, read_only=True) as archive:
            archive.check({"split": "val"})
            assert len(archive.answered()) == 1
        assert [file.name for file in tmp_path.iterdir()] == [FILE]
    finally:
        tmp_path.chmod(0o755)
    assert (tmp_path / FILE).read_bytes() == before
