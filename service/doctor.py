"""Checks of a server's surroundings before it starts: models, Redis, ports, threads, protection.

The checks change nothing: ports are opened and closed, Redis is only asked.
"""

import asyncio
import resource
import socket
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from enum import StrEnum
from time import perf_counter
from typing import Any

from redis.exceptions import RedisError

from service.access.access import Access
from service.access.gate import require_protection
from service.cores import usable_cores
from service.predict.catalog import build_catalog
from service.predict.models_folder import load_models, models_folder
from service.redis_url import Layout, parse_address
from service.settings import Settings, SettingsError, is_local, split_address
from service.telemetry.metrics import Metrics
from service.tracking.store.redis.connection import connect

_REDIS_VERSION = 7
_PINGS = 20
_FILES_PER_CALL = 2


class Level(StrEnum):
    """Result of one check."""

    OK = "OK"
    WARN = "WARN"
    FAIL = "FAIL"


@dataclass(frozen=True)
class Finding:
    """Result of one check, and why."""

    check: str
    level: Level
    text: str


def examine(settings: Settings) -> Iterator[Finding]:
    """Yield the findings for valid settings, in the order of the checks."""
    yield from _models(settings)
    yield from _store(settings)
    for name, address in (("http", settings.http), ("grpc", settings.grpc)):
        yield _port(name, address)
    yield _threads(settings)
    yield _files(settings)
    yield _protection(settings)


def _models(settings: Settings) -> Iterator[Finding]:
    try:
        models = load_models(settings.model_copy(update={"threads": 1}))  # the check itself needs no more
    except SettingsError as error:
        yield Finding("models", Level.FAIL, str(error))
        return
    names = ", ".join(info.full_name for info in models.infos())
    yield Finding("models", Level.OK, f"{models_folder(settings) or 'no folder'}: {names}")
    for one in models.refused:
        yield Finding("models", Level.WARN, f"{one.folder} is refused: {one.reason}")
    for info in models.passed_over if settings.models is not None else ():
        yield Finding(
            "models", Level.WARN, f"{info.full_name} is passed over: the paper protocol is not allowed"
        )
    reasons = [f"{one.folder}: {one.reason}" for one in models.refused]
    try:
        catalog = build_catalog(models, settings.default_model, settings.default_models, reasons)
    except SettingsError as error:
        yield Finding("default model", Level.FAIL, str(error))
        return
    info = catalog.default.info
    level = Level.OK if settings.default_model or info.name == "cab" else Level.WARN
    yield Finding("default model", level, f"{info.full_name}, and {catalog.fallback.info.name} stands in")


def _store(settings: Settings) -> Iterator[Finding]:
    if settings.store == "memory":
        yield Finding("store", Level.OK, "track memory in the process: not shared, lost when it ends")
        return

    async def collect() -> list[Finding]:
        return [finding async for finding in _redis(settings)]

    yield from asyncio.run(collect())


async def _redis(settings: Settings) -> AsyncIterator[Finding]:
    address = parse_address(settings.store)
    servers = ", ".join(f"{one.host}:{one.port}" for one in address.endpoints)
    try:
        client: Any = connect(address, timeout_s=settings.store_timeout_ms / 1000, connections=1)
    except OSError as error:
        yield Finding("store", Level.FAIL, f"the CA file of {servers} cannot be used: {error}")
        return
    try:
        info = await client.info("server")
        if address.layout is Layout.CLUSTER:  # one answer per node
            info = next(iter(info.values())) if "redis_version" not in info else info
        version = str(info["redis_version"])
        durations = []
        for _ in range(_PINGS):
            started = perf_counter()
            await client.ping()
            durations.append(1000 * (perf_counter() - started))
    except (RedisError, OSError) as error:
        yield Finding("store", Level.FAIL, f"Redis at {servers} does not answer: {error}")
        return
    finally:
        await client.aclose()
    if int(version.partition(".")[0]) < _REDIS_VERSION:
        yield Finding(
            "store", Level.FAIL, f"Redis {version} at {servers}; {_REDIS_VERSION} or newer is needed"
        )
        return
    slowest = max(durations[1:])
    text = f"Redis {version} at {servers}, slowest of {_PINGS} pings {slowest:.1f} ms"
    if slowest > settings.store_budget_ms:
        yield Finding("store", Level.WARN, f"{text}; a call waits at most {settings.store_budget_ms:g} ms")
    else:
        yield Finding("store", Level.OK, text)


def _port(name: str, address: str) -> Finding:
    host, port = split_address(address)
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as listener:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen()
    except OSError as error:
        return Finding(name, Level.FAIL, f"cannot listen on {address}: {error.strerror or error}")
    return Finding(name, Level.OK, f"{address} is free")


def _threads(settings: Settings) -> Finding:
    cores = usable_cores()
    if settings.threads is None:
        return Finding("threads", Level.OK, f"one per physical core; {cores:g} cores may be used")
    text = f"{settings.threads} of the forward on {cores:g} cores"
    if settings.threads > cores:
        return Finding("threads", Level.WARN, f"{text}: more threads than cores wait for each other")
    return Finding("threads", Level.OK, text)


def _files(settings: Settings) -> Finding:
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = _FILES_PER_CALL * (settings.max_concurrent_calls + settings.max_watchers)
    if files != resource.RLIM_INFINITY and files < needed:
        return Finding(
            "open files",
            Level.WARN,
            f"at most {files}; {needed} are needed for all calls and streams (ulimit -n)",
        )
    return Finding(
        "open files", Level.OK, "no limit" if files == resource.RLIM_INFINITY else f"at most {files}"
    )


def _protection(settings: Settings) -> Finding:
    try:
        require_protection(settings)
        access = Access(settings, Metrics())
    except SettingsError as error:
        return Finding("protection", Level.FAIL, str(error))
    tls = "no TLS" if access.certificates is None else "TLS"
    if access.requires_client_certificates:
        tls = "TLS with certificates of clients"
    if is_local(settings):
        level, text = Level.OK, "only this machine can connect"
    elif not access.gate.closed:
        level, text = Level.WARN, "everyone who reaches the ports is let in"
    else:
        level, text = (Level.WARN if access.certificates is None else Level.OK), "callers need a key"
    return Finding("protection", level, f"{text}; {tls}")
