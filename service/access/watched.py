"""Values read from files, and read again when the files change."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeVar

import structlog

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")
_Signature = tuple[tuple[int, int, int] | None, ...]


class Watched(Generic[_T]):
    """Value that some files hold. A change that cannot be read is logged once, and leaves the old value."""

    def __init__(self, name: str, paths: Sequence[Path], read: Callable[[], _T]) -> None:
        """Read the files.

        Args:
            name: name of the value, for the log.
            paths: the files.
            read: returns the value; every exception that it raises means that the files are broken.

        Raises:
            Exception: whatever ``read`` raises.
        """
        self._name = name
        self._paths = tuple(paths)
        self._read = read
        self._seen = self._signature()
        self.value = read()
        """Latest value that could be read."""
        self.broken = False
        """True if the files have changed since, and cannot be read."""

    def refresh(self) -> bool:
        """Read the files again if they changed. This may be called from any thread, but not from two.

        Returns:
            True if there is a new value.
        """
        signature = self._signature()
        if signature == self._seen:
            return False
        value, problem = None, None
        try:
            value = self._read()
        except Exception as error:  # a broken file must not stop the watch, whatever is wrong with it
            problem = error
        if self._signature() != signature:  # the files are being written: wait for the rest
            return False
        self._seen = signature
        self.broken = value is None
        if value is None:
            _log.error(f"{self._name} not reloaded; the former ones stay in use", reason=str(problem))
            return False
        self.value = value
        _log.warning(f"{self._name} reloaded", files=[str(path) for path in self._paths])
        return True

    def _signature(self) -> _Signature:
        return tuple(map(_stat, self._paths))


def _stat(path: Path) -> tuple[int, int, int] | None:
    """Return what changes with a file's contents; None if the file is missing."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
