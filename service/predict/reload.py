"""Taking over models: at the start, and while the server runs.

Everything that can fail happens before the models take over: reading, the canary scene, the choice of the
default, warm-up. Then one assignment makes the new catalog the one that calls begin with; calls in progress
keep the one that they began with, and models that no call holds any more are freed.
"""

import asyncio
import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import TypeVar

import structlog

from cab.forecast.v1 import admin_service_pb2 as pb
from model.forecaster import Forecaster
from service.errors import ReloadRefused
from service.predict.batcher import Batcher
from service.predict.catalog import Catalog, Models, build_catalog, reference
from service.predict.models_folder import Fingerprint, FolderModels, RefusedModel, fingerprint, models_folder
from service.predict.scheduler import MAX_BATCH_SECONDS
from service.predict.torch_threads import set_helper_threads
from service.predict.warmup import warm_up
from service.settings import Settings, SettingsError
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")

Load = Callable[[Models | None], Models]
"""Function that reads the models, from those that are served; None at the start. It runs in a thread."""


class Reloader:
    """The models that are served, and their replacement. Used on one event loop."""

    def __init__(
        self,
        load: Load,
        settings: Settings,
        batcher: Batcher,
        metrics: Metrics,
        take_over: Callable[[Catalog], None],
    ) -> None:
        """
        Args:
            load: reads the models.
            settings: the default models and the size of batches.
            batcher: warms them up.
            metrics: counts reloads.
            take_over: makes a catalog the one that calls begin with.
        """
        self._load = load
        self._settings = settings
        self._batcher = batcher
        self._metrics = metrics
        self._take_over = take_over
        self._catalog: Catalog | None = None
        self._lock = asyncio.Lock()
        self._read_at: Fingerprint = frozenset()
        """Fingerprint of the folder when the models were read last."""
        # Not the threads of the calls: a model of many megabytes would keep one from them
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="models", initializer=set_helper_threads)

    async def start(self) -> None:
        """Load and warm up the models for the first time.

        Raises:
            SettingsError: a required model is missing.
            Exception: any exception of ``load``.
        """
        catalog = await self._read(None)
        await warm_up(self._batcher, catalog, self._settings.max_batch_agents)
        self._set(catalog)

    async def reload(self) -> pb.ReloadModelsResponse:
        """Read the models again, and let them take over.

        Raises:
            ReloadRefused: the new models as a whole cannot be served; nothing has changed.
        """
        async with self._lock:
            try:
                response = await self._reload()
            except SettingsError as error:
                self._metrics.reloads.labels("refused").inc()
                _log.error("reload refused: the models stay as they are", reason=str(error))
                raise ReloadRefused(str(error)) from error
        if response.dropped:
            await self._in_thread(_release_memory)
        changed = "changed" if response.loaded or response.dropped else "unchanged"
        self._metrics.reloads.labels("refused" if response.refused else changed).inc()
        return response

    async def follow(self, seconds: float) -> None:
        """Reload whenever the folder of models has changed, until cancelled.

        A change counts once the folder has stayed the same for one look, so that a copy can be completed.

        Args:
            seconds: seconds between looks.
        """
        folder = models_folder(self._settings)
        seen = self._read_at
        while True:
            await asyncio.sleep(seconds)
            last, seen = seen, await self._in_thread(fingerprint, folder)
            if seen == self._read_at or seen != last:
                continue
            try:
                await self.reload()
            except ReloadRefused:
                pass  # it is logged; the next change is another try
            except Exception:
                _log.exception("reload failed")

    def close(self) -> None:
        """Release the thread; a reload in progress fails."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _reload(self) -> pb.ReloadModelsResponse:
        before = self._catalog
        if before is None:
            raise ReloadRefused("the models are being loaded for the first time")
        catalog = await self._read(before.models)
        old, new = _by_id(before), _by_id(catalog)
        loaded = [forecaster for key, forecaster in new.items() if key not in old]
        dropped = [forecaster for key, forecaster in old.items() if key not in new]
        size = self._settings.max_batch_agents
        try:
            await warm_up(self._batcher, catalog, size, warm=old, max_seconds=MAX_BATCH_SECONDS)
        except Exception as error:
            _log.exception("warm-up failed")
            raise SettingsError(f"models: warm-up failed: {error}") from error
        self._set(catalog)
        self._batcher.forget(dropped)
        response = pb.ReloadModelsResponse(
            loaded=[reference(forecaster.info) for forecaster in loaded],
            dropped=[reference(forecaster.info) for forecaster in dropped],
            refused=[
                pb.RefusedModel(folder=one.folder, reason=one.reason) for one in _refused(catalog.models)
            ],
            default_model=reference(catalog.default.info),
        )
        _log.warning(
            "models reloaded",
            loaded=[forecaster.info.full_name for forecaster in loaded],
            dropped=[forecaster.info.full_name for forecaster in dropped],
            refused=[one.folder for one in response.refused],
            default=catalog.default.info.full_name,
        )
        return response

    async def _read(self, current: Models | None) -> Catalog:
        """Return the models of the folder, new ones included, as a catalog."""
        self._read_at = await self._in_thread(fingerprint, models_folder(self._settings))
        models = await self._in_thread(self._load, current)
        reasons = [f"{one.folder}: {one.reason}" for one in _refused(models)]
        donors = models.donors if isinstance(models, FolderModels) else None
        catalog = build_catalog(models, self._settings.default_model, self._settings.default_models, reasons)
        return replace(catalog, donors=donors)

    def _set(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._metrics.set_models(catalog.models.infos(), catalog.default.info)
        self._take_over(catalog)

    async def _in_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)


def _release_memory() -> None:
    """Return what was freed to the system: glibc would keep the pages of dropped models for later."""
    with suppress(OSError, AttributeError):  # another C library has no such function
        ctypes.CDLL(None).malloc_trim(0)


def _by_id(catalog: Catalog) -> dict[int, Forecaster]:
    """Return the models of a catalog by ``id``, by name and version."""
    forecasters = (catalog.get(info.full_name) for info in catalog.models.infos())
    return {id(forecaster): forecaster for forecaster in forecasters}


def _refused(models: Models) -> tuple[RefusedModel, ...]:
    return models.refused if isinstance(models, FolderModels) else ()
