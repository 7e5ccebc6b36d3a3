"""Files that are whole or not there."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Gives a file to write instead, which takes the place of the other one at the end.

    Whoever is killed, or fails, meanwhile leaves what was there before.

    Raises:
        OSError: it cannot be written.
    """
    temporary = file.with_name(f"{file.name}.new")
    try:
        yield temporary
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)


def replace_text(file: Path, text: str) -> None:
    """Writes a text in place of what was there.

    Raises:
        OSError: it cannot be written.
    """
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
