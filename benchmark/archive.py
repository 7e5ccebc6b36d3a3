"""Saved answers of a run, in one SQLite file.

Each answer is committed as it arrives, so that a run that was killed loses none and requests none twice.
Metrics are always computed from the saved answers, so that a resumed run and a later evaluation give the same
figures.
"""

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from benchmark.errors import BenchmarkError
from benchmark.plan import Call
from cab.forecast.v1.model_service_pb2 import Model
from cab.forecast.v1.prediction_service_pb2 import PredictResponse

FILE = "answers.sqlite"
"""Name of the file in the folder of a run."""

_TABLES = """
CREATE TABLE IF NOT EXISTS run (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS models (key TEXT PRIMARY KEY, model BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS answers (
    model TEXT NOT NULL, scene TEXT NOT NULL, frame INTEGER NOT NULL, seconds REAL NOT NULL,
    response BLOB NOT NULL, PRIMARY KEY (model, scene, frame)
);
CREATE TABLE IF NOT EXISTS refusals (
    model TEXT NOT NULL, scene TEXT NOT NULL, frame INTEGER NOT NULL, why TEXT NOT NULL,
    PRIMARY KEY (model, scene, frame)
);
"""


@dataclass(frozen=True)
class Refusal:
    """A call that the endpoint refused."""

    model: str
    scene: str
    frame: int
    why: str

    def __str__(self) -> str:
        return f"{self.model}, {self.scene}, frame {self.frame}: {self.why}"


@dataclass(frozen=True)
class Answer:
    """Response to one call."""

    seconds: float
    """Time that the client waited."""
    response: PredictResponse


class Archive:
    """The answers of one run.

    Args:
        folder: folder of the run, created if missing.
        read_only: whether to only read; the file must exist.

    Raises:
        BenchmarkError: the file cannot be opened, or does not exist.
    """

    def __init__(self, folder: Path, read_only: bool = False) -> None:
        self._path = folder / FILE
        if read_only and not self._path.is_file():
            raise BenchmarkError(f"{self._path}: there are no saved answers")
        try:
            self._file = self._open_to_read() if read_only else self._open_to_write(folder)
        except (OSError, sqlite3.Error) as error:
            raise BenchmarkError(f"{self._path}: cannot be used for answers: {error}") from error

    def _open_to_read(self) -> sqlite3.Connection:
        # Without a write-ahead log there is no writer. The file can then be read even where SQLite cannot
        # create its lock files.
        settled = not self._path.with_name(f"{FILE}-wal").exists()
        how = "mode=ro&immutable=1" if settled else "mode=ro"
        file = sqlite3.connect(f"{self._path.resolve().as_uri()}?{how}", uri=True)
        try:
            file.execute("SELECT model FROM answers LIMIT 1")
        except sqlite3.Error:
            file.close()
            raise
        return file

    def _open_to_write(self, folder: Path) -> sqlite3.Connection:
        folder.mkdir(parents=True, exist_ok=True)
        file = sqlite3.connect(self._path, isolation_level=None)
        try:
            # Commits do not wait for the disk: a killed process loses nothing, a power cut the last answers
            file.execute("PRAGMA journal_mode = WAL")
            file.execute("PRAGMA synchronous = NORMAL")
            file.executescript(_TABLES)
        except sqlite3.Error:
            file.close()
            raise
        return file

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def check(self, facts: Mapping[str, str]) -> None:
        """Refuse answers of another run.

        Args:
            facts: properties of this run by name.

        Raises:
            BenchmarkError: a property differs; the text names it.
        """
        known = self.facts()
        for name, value in facts.items():
            if known.get(name, value) != value:
                raise BenchmarkError(
                    f"{self._path}: holds answers of another run: {name} was {known[name]}, is {value}; "
                    "give the same options, or another folder"
                )

    def bind(self, facts: Mapping[str, str]) -> None:
        """Bind the archive to a run.

        Args:
            facts: properties of the run by name.

        Raises:
            BenchmarkError: the archive holds answers of another run.
        """
        self.check(facts)
        self._file.executemany("INSERT OR REPLACE INTO run VALUES (?, ?)", facts.items())

    def note(self, name: str, value: str) -> None:
        """Record a property that may differ between two replays of a run."""
        self._file.execute("INSERT OR REPLACE INTO run VALUES (?, ?)", (name, value))

    def facts(self) -> dict[str, str]:
        """Return all recorded properties."""
        return dict(self._file.execute("SELECT key, value FROM run"))

    def register(self, key: str, model: Model) -> None:
        """Record a model before its answers.

        Models are compared by their descriptions, as a client does not know their weights.

        Raises:
            BenchmarkError: the archive holds answers of another model of that name.
        """
        known = self.models().get(key)
        if known is not None and not _same(known, model):
            raise BenchmarkError(
                f"{self._path}: {key} of the endpoint is not the model whose answers are saved; "
                "give another folder"
            )
        row = (key, model.SerializeToString())
        self._file.execute(
            "INSERT INTO models VALUES (?, ?) ON CONFLICT DO UPDATE SET model = excluded.model", row
        )

    def models(self) -> dict[str, Model]:
        """Return the recorded models by ``name@version``, in the order of registration."""
        rows = self._file.execute("SELECT key, model FROM models ORDER BY rowid")
        return {key: Model.FromString(model) for key, model in rows}

    def answered(self) -> set[tuple[str, str, int]]:
        """Return model, scene and frame of every call with an answer."""
        return set(self._file.execute("SELECT model, scene, frame FROM answers"))

    def add(self, model: str, scene: str, call: Call, answer: Answer) -> None:
        """Save an answer, and delete a refusal of the same call."""
        row = (model, scene, call.frame, answer.seconds, answer.response.SerializeToString())
        self._file.execute("INSERT OR REPLACE INTO answers VALUES (?, ?, ?, ?, ?)", row)
        self._file.execute("DELETE FROM refusals WHERE model = ? AND scene = ? AND frame = ?", row[:3])

    def refuse(self, model: str, scene: str, call: Call, why: str) -> None:
        """Save the refusal of a call."""
        row = (model, scene, call.frame, why)
        self._file.execute("INSERT OR REPLACE INTO refusals VALUES (?, ?, ?, ?)", row)

    def refusals(self) -> list[Refusal]:
        """Return the refused calls without a later answer."""
        rows = self._file.execute("SELECT model, scene, frame, why FROM refusals ORDER BY rowid")
        return [Refusal(*row) for row in rows]

    def answers(self, model: str, scene: str) -> Iterator[tuple[int, Answer]]:
        """Yield frame and answer of every call about a scene, by frame."""
        rows = self._file.execute(
            "SELECT frame, seconds, response FROM answers WHERE model = ? AND scene = ? ORDER BY frame",
            (model, scene),
        )
        with closing(rows):
            for frame, seconds, response in rows:
                yield frame, Answer(seconds, PredictResponse.FromString(response))


def _same(known: Model, model: Model) -> bool:
    """Return whether two descriptions are of the same model; texts and figures may differ."""
    plain = [Model.FromString(one.SerializeToString()) for one in (known, model)]
    for one in plain:
        for field in ("is_default", "description", "benchmark", "license"):
            one.ClearField(field)
    return plain[0] == plain[1]
