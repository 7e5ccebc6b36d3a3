"""The server: both transports over one data plane, from start to drain."""

import asyncio
import signal
import time
from collections.abc import Callable
from contextlib import suppress

import structlog

from model.checkpoint import CheckpointError
from model.registry import DuplicateModelError, Registry
from service.predict.catalog import Models
from service.predict.dataplane import DataPlane
from service.settings import Settings, SettingsError, bundled_models
from service.telemetry.metrics import Metrics
from service.transports.grpc.server import GrpcServer
from service.transports.rest.server import HttpServer, build_app

_log = structlog.get_logger(__name__)


class StartError(Exception):
    """The server cannot start; the text says why, for an operator."""


class Server:
    """One server. ``start`` it, then ``stop`` it, or ``run`` it until a signal comes."""

    def __init__(self, settings: Settings, load: Callable[[], Models] | None = None) -> None:
        """
        Args:
            settings: all of them.
            load: gives the models; default: the baselines and the checkpoints that the settings name.
        """
        self.settings = settings
        self.metrics = Metrics()
        self.dataplane = DataPlane(settings, self.metrics)
        self._load = load or (lambda: _load_models(settings))
        self._grpc = GrpcServer(self.dataplane, self.metrics, settings)
        self._http = HttpServer(build_app(self.dataplane, self.metrics, settings), settings.http)
        self._signalled = asyncio.Event()

    @property
    def http_address(self) -> str:
        """HOST:PORT of REST, once started."""
        return self._http.address

    @property
    def grpc_address(self) -> str:
        """HOST:PORT of gRPC, once started."""
        return self._grpc.address

    async def start(self) -> None:
        """Listens at once, so that probes get an answer; ready when this returns.

        Raises:
            StartError: an address cannot be listened on, or a model is missing or broken.
        """
        started = time.perf_counter()
        try:
            await self._listen()
            await self.dataplane.open(self._load)
        except (SettingsError, CheckpointError, DuplicateModelError) as error:
            await self.stop(drain=False)
            raise StartError(str(error)) from error
        except BaseException:
            await self.stop(drain=False)
            raise
        self._grpc.set_serving(not self._signalled.is_set())
        _log.info(
            "ready",
            http=self.http_address,
            grpc=self.grpc_address,
            seconds=round(time.perf_counter() - started, 3),
        )

    async def stop(self, drain: bool = True) -> None:
        """Refuses new calls, finishes the accepted ones within ``drain_seconds``, and stops.

        An answer counts as finished when the client has it: what the calls leave of that time is for those
        that read slowly.

        Args:
            drain: False: accepted calls are not waited for.
        """
        started = time.perf_counter()
        self.dataplane.refuse()
        self._grpc.set_serving(False)
        grace = 0.0
        if drain:
            _log.info("draining")
            await self.dataplane.drain(self.settings.drain_seconds)
            grace = max(started + self.settings.drain_seconds - time.perf_counter(), 0.0)
        await asyncio.gather(self._grpc.stop(grace), self._http.stop(grace))
        await self.dataplane.close()
        _log.info("stopped", seconds=round(time.perf_counter() - started, 3))

    async def run(self, when_ready: Callable[["Server"], None] | None = None) -> None:
        """Serves until SIGTERM or SIGINT, then drains.

        Args:
            when_ready: called in a thread once the server takes calls.

        Raises:
            StartError: as ``start``.
        """
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._on_signal, number)
        starting = asyncio.create_task(self.start())
        signalled = asyncio.create_task(self._signalled.wait())
        await asyncio.wait({starting, signalled}, return_when=asyncio.FIRST_COMPLETED)
        if not starting.done():  # a signal while the models load: nothing was accepted yet
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
        await self._signalled.wait()
        await self.stop()

    def _on_signal(self, number: int) -> None:
        _log.info("signal", name=signal.Signals(number).name)
        self.dataplane.refuse()
        self._signalled.set()

    async def _listen(self) -> None:
        try:
            await self._grpc.start()
        except OSError as error:
            raise StartError(f"grpc: cannot listen on {self.settings.grpc}; is it taken?") from error
        try:
            await self._http.start()
        except OSError as error:
            raise StartError(
                f"http: cannot listen on {self.settings.http}: {error.strerror or error}"
            ) from error
        authentication = "bearer tokens" if self.settings.api_tokens else "off: everyone is let in"
        _log.info("listening", http=self.http_address, grpc=self.grpc_address, authentication=authentication)


def _load_models(settings: Settings) -> Registry:
    """The baselines and the checkpoints."""
    folder = settings.models or bundled_models()
    if settings.models is not None and not settings.models.is_dir():
        raise SettingsError(f"models: no such folder: {settings.models}")
    registry = Registry.load(folder, allow_paper=settings.allow_paper_protocol)
    _log.info(
        "models loaded", folder=str(folder) if folder else None, models=[i.name for i in registry.infos()]
    )
    if registry.passed_over:
        # Somebody's own folder may be meant to be served whole; the bundled one is not
        log = _log.info if settings.models is None else _log.warning
        log(
            "models passed over: they are of the paper protocol",
            folder=str(folder),
            models=[info.full_name for info in registry.passed_over],
            load_with="--allow-paper-protocol or FORECAST_ALLOW_PAPER_PROTOCOL=true",
        )
    return registry
