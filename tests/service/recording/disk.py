"""A disk without room."""

import errno
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size: then writes fail as they do with a full quota."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class FullFile(FileIO):
    """A file on a full disk."""

    def write(self, data: object) -> int:
        """Fail as the disk does."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
