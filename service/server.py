"""Server: both transports over one data plane, from start to drain."""

import asyncio
import functools
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress

import structlog

from service.access.access import Access
from service.access.gate import require_protection
from service.errors import ServiceError, Unavailable
from service.predict.catalog import Models
from service.predict.dataplane import DataPlane
from service.predict.models_folder import load_models, models_folder
from service.predict.reload import Load
from service.settings import Settings, SettingsError, is_local
from service.telemetry.metrics import Metrics
from service.telemetry.tracing import TracingMissingError, make_tracing
from service.transports.grpc.server import GrpcServer
from service.transports.intake import Intake
from service.transports.rest.server import HttpServer, build_app, build_probes

_log = structlog.get_logger(__name__)


_SWITCH_INTERVAL = 0.0005
"""s, time for which one thread keeps the interpreter while others wait. When a native forward ends, its
thread needs the interpreter to begin the next one; at Python's 5 ms the model would stand still for that long
beside a busy event loop."""
_READINESS_PERIOD = 1.0
"""Seconds between checks of the readiness that gRPC health reports."""


class StartError(Exception):
    """Error of a server that cannot start; the text says why, for an operator."""


class ServeError(Exception):
    """Error of a server that ended because it could answer no calls any more."""


class Server:
    """One server: ``start`` and ``stop`` it, or ``run`` it until a signal."""

    def __init__(self, settings: Settings, load: Load | None = None) -> None:
        """
        Args:
            settings: the settings.
            load: reads the models; default: the baselines and the checkpoints that the settings name.

        Raises:
            StartError: the keys or certificates are missing or broken, anyone could call, or the packages
                for tracing are missing.
        """
        self.settings = settings
        self.metrics = Metrics()
        try:
            require_protection(settings)
            self.access = Access(settings, self.metrics)
        except SettingsError as error:
            raise StartError(str(error)) from error
        try:
            self._tracing = make_tracing() if settings.tracing else None
        except TracingMissingError as error:
            raise StartError(f"tracing: {error}") from error
        self.dataplane = DataPlane(settings, self.metrics)
        self._load = load or functools.partial(_load_models, settings)
        self.intake = Intake(settings, self.metrics)
        self._grpc = GrpcServer(
            self.dataplane, self.metrics, settings, self.intake, self.access, self._tracing
        )
        app = build_app(self.dataplane, self.metrics, settings, self.intake, self.access.gate, self._tracing)
        self._http = HttpServer(app, settings.http, settings, self.access.certificates)
        self._probes = (
            None
            if settings.probes is None
            else HttpServer(build_probes(self.dataplane), settings.probes, settings)
        )
        self._signalled = asyncio.Event()
        self._following: list[asyncio.Task[None]] = []
        self._reloading: asyncio.Task[None] | None = None

    @property
    def http_address(self) -> str:
        """HOST:PORT of REST, once started."""
        return self._http.address

    @property
    def probes_address(self) -> str:
        """HOST:PORT of the port for probes, once started; empty if there is none."""
        return "" if self._probes is None else self._probes.address

    @property
    def grpc_address(self) -> str:
        """HOST:PORT of gRPC, once started."""
        return self._grpc.address

    async def start(self) -> None:
        """Listen, so that probes are answered, then load the models and accept calls.

        Raises:
            StartError: an address cannot be listened on, or a model is missing or broken.
        """
        started = time.perf_counter()
        sys.setswitchinterval(_SWITCH_INTERVAL)
        try:
            await self._listen()
            await self.dataplane.open(self._load)
        except SettingsError as error:
            await self.stop(drain=False)
            raise StartError(str(error)) from error
        except BaseException:
            await self.stop(drain=False)
            raise
        self._grpc.set_serving(not self._signalled.is_set())
        self._following += [
            asyncio.create_task(self._follow_readiness(), name="readiness"),
            asyncio.create_task(self.access.follow(), name="access"),
        ]
        _log.info(
            "ready",
            http=self.http_address,
            grpc=self.grpc_address,
            seconds=round(time.perf_counter() - started, 3),
        )

    async def stop(self, drain: bool = True) -> None:
        """Refuse new calls, finish the accepted ones within ``drain_seconds``, and stop.

        A call is finished when the client has received its response: clients that read slowly get the rest of
        that time.

        Args:
            drain: False: do not wait for accepted calls.
        """
        started = time.perf_counter()
        for task in self._following:
            task.cancel()
        self.dataplane.refuse()
        self._grpc.set_serving(False)
        grace = 0.0
        if drain:
            _log.warning("draining", seconds=self.settings.drain_seconds)
            await self.dataplane.drain(self.settings.drain_seconds)
            grace = max(started + self.settings.drain_seconds - time.perf_counter(), 0.0)
        await asyncio.gather(self._grpc.stop(grace), *(server.stop(grace) for server in self._http_servers()))
        await self.dataplane.close()
        if self._tracing is not None:
            await asyncio.to_thread(self._tracing.close)
        _log.info("stopped", seconds=round(time.perf_counter() - started, 3))

    async def run(self, when_ready: Callable[["Server"], None] | None = None) -> None:
        """Serve until SIGTERM or SIGINT, then drain; SIGHUP reads the models again.

        Args:
            when_ready: called in a thread once the server accepts calls.

        Raises:
            StartError: see ``start``.
            ServeError: the server could answer no calls any more.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._on_signal, number)
        loop.add_signal_handler(signal.SIGHUP, self._on_hangup)
        starting = asyncio.create_task(self.start())
        signalled = asyncio.create_task(self._signalled.wait())
        await asyncio.wait({starting, signalled}, return_when=asyncio.FIRST_COMPLETED)
        if not starting.done():  # a signal while the models load: no call has been accepted yet
            starting.cancel()
            with suppress(asyncio.CancelledError):
                await starting
            return
        try:
            await starting
        finally:
            signalled.cancel()
        if when_ready is not None:
            await asyncio.to_thread(when_ready, self)
        ends = [asyncio.create_task(event.wait()) for event in (self._signalled, self.dataplane.failed)]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        for end in ends:
            end.cancel()
        failed = not self._signalled.is_set()
        await self.stop()
        if failed:
            raise ServeError("the server ended after a failure; its log says why")

    def _on_signal(self, number: int) -> None:
        _log.info("signal", name=signal.Signals(number).name)
        self.dataplane.refuse()
        self._signalled.set()

    def _on_hangup(self) -> None:
        _log.info("signal", name=signal.SIGHUP.name)
        self._reloading = asyncio.create_task(self._reload(), name="hangup")

    async def _reload(self) -> None:
        try:
            await self.dataplane.reload()
        except ServiceError as error:
            _log.warning("models not reloaded", reason=error.detail)
        except Exception:
            _log.exception("reload failed")

    async def _follow_readiness(self) -> None:
        """Keep gRPC health the same as ``/readyz``, which is evaluated whenever it is called."""
        serving = True
        while True:
            await asyncio.sleep(_READINESS_PERIOD)
            reason = ""
            try:
                self.dataplane.require_ready()
            except Unavailable as error:
                reason = error.detail
            if serving == bool(reason):
                serving = not serving
                self._grpc.set_serving(serving)
                _log.warning("readiness changed", ready=serving, reason=reason)

    async def _listen(self) -> None:
        try:
            await self._grpc.start()
        except OSError as error:
            raise StartError(f"grpc: cannot listen on {self.settings.grpc}; is it taken?") from error
        for server in self._http_servers():
            try:
                await server.start()
            except OSError as error:
                name = "http" if server is self._http else "probes"
                raise StartError(
                    f"{name}: cannot listen on {getattr(self.settings, name)}: {error.strerror or error}"
                ) from error
        closed, secure = self.access.gate.closed, self.access.certificates is not None
        _log.info(
            "listening",
            http=self.http_address,
            grpc=self.grpc_address,
            authentication="keys" if closed else "off: every caller is accepted",
            tls=("mutual" if self.access.requires_client_certificates else "on") if secure else "off",
        )
        if closed and not secure and not is_local(self.settings):
            _log.warning("keys arrive unencrypted, unless a proxy in front of the server ends TLS")

    def _http_servers(self) -> list[HttpServer]:
        return [self._http] if self._probes is None else [self._http, self._probes]


def _load_models(settings: Settings, current: Models | None) -> Models:
    """Read the models, and log at the start which there are."""
    models = load_models(settings, current)
    if current is None:
        folder = models_folder(settings)
        _log.warning(
            "models loaded",
            folder=str(folder) if folder else None,
            models=[info.full_name for info in models.infos()],
        )
        if models.passed_over:
            # The user may expect all models of an own folder to be served; not so of the bundled one
            log = _log.info if settings.models is None else _log.warning
            log(
                "models skipped: trained by the paper protocol",
                folder=str(folder),
                models=[info.full_name for info in models.passed_over],
                load_with="--allow-paper-protocol or FORECAST_ALLOW_PAPER_PROTOCOL=true",
            )
    return models
