"""Making of the recorder that the settings ask for."""

from importlib import metadata
from typing import TYPE_CHECKING

import structlog

from service.settings import Settings, SettingsError
from service.telemetry.metrics import Metrics

if TYPE_CHECKING:
    from service.recording.recorder import Recorder

_log = structlog.get_logger(__name__)

RESERVE_BYTES = 64 * 2**20
"""Bytes that a recording leaves free on the disk."""


def make_recorder(settings: Settings, metrics: Metrics) -> "Recorder | None":
    """Return the recorder, started; None if nothing is to be recorded.

    Raises:
        SettingsError: a package is missing, or the folder cannot be written to.
    """
    if settings.record is None:
        return None
    try:
        from service.recording.folder import RecordingFolder  # noqa: PLC0415 - the packages are optional
        from service.recording.recorder import Recorder  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise SettingsError(
            f'record: needs the package {error.name}: pip install "cab-forecast[record]"'
        ) from error
    path = settings.record
    try:
        path.mkdir(0o700, parents=True, exist_ok=True)
        probe = path / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SettingsError(f"record: cannot write to {path}: {error.strerror}") from error
    folder = RecordingFolder(
        path,
        settings.record_file_bytes,
        settings.record_files,
        RESERVE_BYTES,
        metadata.version("cab-forecast"),
    )
    recorder = Recorder(folder, settings.record_share, metrics)
    recorder.start()
    _log.warning("recording calls", folder=str(path), share=settings.record_share)
    return recorder
