"""Streams of events that clients open and leave, over both transports."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable

import grpc

from cab.forecast.v1.consistency_service_pb2 import WatchSceneRequest
from cab.forecast.v1.consistency_service_pb2_grpc import ConsistencyServiceStub
from cab.forecast.v1.routes import WATCH_SCENE

PATIENCE = 20.0
"""Seconds that a client waits for the begin of a stream."""
_CLIENTS = 16


async def leave_grpc_streams(address: str, streams: int) -> None:
    """Open streams on one connection, and cancel every other one before it has begun.

    Args:
        address: HOST:PORT.
        streams: number of streams.
    """
    async with grpc.aio.insecure_channel(address) as channel:
        watch = ConsistencyServiceStub(channel).WatchScene

        async def leave(number: int) -> None:
            call = watch(WatchSceneRequest(scene_id=f"scene-{number}"), timeout=PATIENCE)
            if number % 2:
                await call.read()
            else:
                await asyncio.sleep(0.001 * (number % 5))
            call.cancel()

        await _by_clients(leave, streams)


async def leave_rest_streams(address: str, streams: int) -> None:
    """Open streams on a connection each, and close every other one before it has begun.

    Args:
        address: HOST:PORT.
        streams: number of streams.
    """
    host, _, port = address.rpartition(":")

    async def leave(number: int) -> None:
        reader, writer = await asyncio.open_connection(host, int(port))
        query = f"{WATCH_SCENE.path}?scene_id=scene-{number}"
        writer.write(f"GET {query} HTTP/1.1\r\nHost: {host}\r\nAccept: text/event-stream\r\n\r\n".encode())
        if number % 2:
            async with asyncio.timeout(PATIENCE):
                head = await reader.readuntil(b"\r\n\r\n")
            assert b" 200 " in head, head
        else:
            await asyncio.sleep(0.001 * (number % 5))
        writer.transport.abort()

    await _by_clients(leave, streams)


async def _by_clients(leave: Callable[[int], Awaitable[None]], streams: int) -> None:
    numbers = itertools.count()

    async def client() -> None:
        while (number := next(numbers)) < streams:
            await leave(number)

    async with asyncio.TaskGroup() as group:
        for _ in range(_CLIENTS):
            group.create_task(client())
