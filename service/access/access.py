"""Keys and certificates of a server, kept in step with their files."""

import asyncio

from service.access.gate import Gate
from service.access.tls import TlsError, watch_certificates
from service.settings import Settings, SettingsError
from service.telemetry.metrics import Metrics

_PERIOD = 1.0
"""Seconds between looks at the files."""


class Access:
    """Keys of callers, and certificates for TLS."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        """
        Args:
            settings: name the files.
            metrics: count the calls of each key.

        Raises:
            SettingsError: a file is missing or broken.
        """
        self._metrics = metrics
        self.gate = Gate(settings, metrics)
        try:
            self.certificates = watch_certificates(settings)
            """Certificates for both ports; None: there is no TLS."""
        except TlsError as error:
            raise SettingsError(f"tls: {error}") from error

    @property
    def requires_client_certificates(self) -> bool:
        """True if clients must present a certificate."""
        return self.certificates is not None and self.certificates.value.client_ca is not None

    async def follow(self) -> None:
        """Take over changes of the files, until cancelled."""
        while True:
            await asyncio.sleep(_PERIOD)
            await self.refresh()

    async def refresh(self) -> None:
        """Take over changes of the files now."""
        if await asyncio.to_thread(self.gate.refresh):
            self.gate.apply()
        self._metrics.broken_files.labels("keys").set(self.gate.broken)
        if self.certificates is not None:
            await asyncio.to_thread(self.certificates.refresh)
            self._metrics.broken_files.labels("certificates").set(self.certificates.broken)
