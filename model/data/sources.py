"""Data sets by their names on the command line."""

from collections.abc import Callable
from pathlib import Path

from model.data.nuscenes_pred import NuscenesPredReader
from model.data.scenes import DataError, Reader
from model.data.synthetic import SyntheticReader
from model.forecaster import Protocol


def _official(path: Path) -> Reader:
    from model.data.nuscenes import NuscenesReader  # noqa: PLC0415 (an extra, with numpy < 2)

    try:
        return NuscenesReader(path)
    except ImportError as error:
        raise DataError(f"official nuScenes data needs the extra benchmark: {error}") from error


READERS: dict[str, Callable[[Path], Reader]] = {
    "nuscenes_pred": NuscenesPredReader,
    "nuscenes": _official,
    "synthetic": SyntheticReader,
}
"""Readers of data sets by the KIND of KIND:PATH; the PATH of made-up data is its seed."""


def parse_data(text: str) -> tuple[str, Path]:
    """Return KIND and PATH of KIND:PATH.

    Raises:
        DataError: the text has another form, or the kind is unknown.
    """
    kind, colon, path = text.partition(":")
    if not colon or not path or kind not in READERS:
        raise DataError(f"data: {text!r} is not KIND:PATH with KIND one of {', '.join(READERS)}")
    return kind, Path(path)


def parse_also(text: str) -> tuple[str, Path, str]:
    """Return KIND, PATH and SPLIT of KIND:PATH@SPLIT; the default split is ``train``.

    Raises:
        DataError: the text has another form, or the kind is unknown.
    """
    place, at, split = text.rpartition("@")
    kind, path = parse_data(place if at else text)
    return kind, path, split if at else "train"


def parse_protocol(name: str) -> Protocol:
    """Return a protocol by its name.

    Raises:
        DataError: there is no protocol of that name.
    """
    try:
        return Protocol(name)
    except ValueError:
        raise DataError(f"there is no protocol {name!r}; there are {', '.join(Protocol)}") from None
