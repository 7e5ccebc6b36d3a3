"""Figures of a run by epoch: a CSV file, and TensorBoard where it is installed."""

import csv
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from model.training.state import Progress


class RunLog:
    """Appends a row an epoch to ``log.csv``; a resumed run goes on behind its last row.

    Args:
        folder: of the run; TensorBoard's files go into ``tensorboard/`` there.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / "log.csv"
        self._board = _summary_writer(folder / "tensorboard")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._board is not None:
            self._board.close()

    def add(self, progress: Progress, figures: dict[str, float]) -> None:
        """Adds an epoch; rows of the same or later epochs, of a run that was cut off, are replaced."""
        row = {"epoch": progress.epoch, "step": progress.step} | figures
        rows = [old for old in self.rows() if int(old["epoch"]) < progress.epoch]
        names = list(dict.fromkeys([*(name for old in rows for name in old), *row]))
        temporary = self._file.with_suffix(".new")
        with temporary.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, names, restval="")
            writer.writeheader()
            writer.writerows([*rows, row])
        temporary.replace(self._file)
        if self._board is not None:
            for name, value in figures.items():
                self._board.add_scalar(name, value, progress.epoch)
            self._board.flush()

    def rows(self) -> list[dict[str, str]]:
        """All rows, as text."""
        if not self._file.is_file():
            return []
        with self._file.open(newline="", encoding="utf-8") as stream:
            return list(csv.DictReader(stream))


def _summary_writer(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 (an extra)
    except ImportError:
        return None
    return SummaryWriter(str(folder))
