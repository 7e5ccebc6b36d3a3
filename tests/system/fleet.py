"""Two replicas behind HAProxy on one Redis, with the files in deploy/."""

import asyncio
import re
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from loadtest.redis_servers import Process, single
from loadtest.servers import Server, serving
from tests.deploy.files import DEPLOY
from tests.resolver import resolving
from tests.system.programs import program

_HOSTS = ("127.0.0.1", "127.0.0.2")
_SECONDS = 30.0


@dataclass(frozen=True)
class Fleet:
    """The addresses and processes of a fleet."""

    grpc: str
    """Endpoint of gRPC, at HAProxy."""
    rest: str
    """Endpoint of REST, at HAProxy."""
    metrics: str
    """URL of HAProxy's metrics."""
    replicas: tuple[Server, ...]
    redis: Process

    def calls(self, server: Server) -> float:
        """Return the number of Predict calls that a replica has answered."""
        text = httpx.get(f"http://{server.http}/metrics").text
        values = re.findall(
            r'^forecast_requests_total{.*code="OK",method="Predict".*} (\S+)$', text, re.MULTILINE
        )
        return sum(map(float, values))


def free_port() -> int:
    """Return a port that is free on all addresses of the fleet."""
    while True:
        with socket.create_server((_HOSTS[0], 0)) as first:
            port: int = first.getsockname()[1]
            try:
                with socket.create_server((_HOSTS[1], port)):
                    return port
            except OSError:
                continue


async def until(condition: Callable[[], Any], what: str) -> None:
    """Wait until a condition holds, in a thread; connection errors mean that it does not yet."""
    end = time.monotonic() + _SECONDS
    while True:
        try:
            if await asyncio.to_thread(condition):
                return
        except httpx.TransportError:
            pass
        if time.monotonic() > end:
            raise TimeoutError(what)
        await asyncio.sleep(0.1)


def haproxy_config(resolver: str, ports: dict[str, int]) -> str:
    """Return deploy/haproxy/haproxy.cfg with another DNS server and other ports.

    Args:
        resolver: HOST:PORT of the DNS server.
        ports: by their text in the file: those that HAProxy listens on (":8080"), and those of the replicas
            ("forecast:8080").
    """
    text = (DEPLOY / "haproxy/haproxy.cfg").read_text(encoding="utf-8")
    text = text.replace("127.0.0.11:53", resolver)
    text = text.replace("port 8080", f"port {ports['forecast:8080']}")
    for name, port in ports.items():
        new = f"forecast:{port}" if name.startswith("forecast") else f"127.0.0.1:{port}"
        text, number = re.subn(rf"(?<= ){re.escape(name)}(?=\s)", new, text)
        assert number == 1, name
    return text


@asynccontextmanager
async def fleet(folder: Path, **settings: object) -> AsyncIterator[Fleet]:
    """Run two replicas behind HAProxy on one Redis with a password.

    Args:
        folder: for files.
        settings: further settings of the replicas.
    """
    names = (":50051", ":8080", ":8404", "forecast:50051", "forecast:8080")
    ports = {name: free_port() for name in names}
    models = folder / "models"
    models.mkdir(exist_ok=True)
    async with AsyncExitStack() as stack:
        redis = stack.enter_context(single(password="of-the-test"))  # noqa: S106
        replicas = await asyncio.gather(
            *(
                asyncio.to_thread(
                    stack.enter_context,
                    serving(
                        models,
                        http=f"{host}:{ports['forecast:8080']}",
                        grpc=f"{host}:{ports['forecast:50051']}",
                        store=redis.url,
                        **settings,
                    ),
                )
                for host in _HOSTS
            )
        )
        resolver = await stack.enter_async_context(resolving(*_HOSTS))
        config = folder / "haproxy.cfg"
        config.write_text(haproxy_config(resolver, ports), encoding="utf-8")
        await asyncio.to_thread(stack.enter_context, program("haproxy", "-db", "-f", str(config)))
        made = Fleet(
            f"grpc://127.0.0.1:{ports[':50051']}",
            f"http://127.0.0.1:{ports[':8080']}",
            f"http://127.0.0.1:{ports[':8404']}/metrics",
            tuple(replicas),
            redis,
        )
        await until(lambda: up(made) == {"grpc": 2, "rest": 2}, "HAProxy sees both replicas")
        yield made


def up(fleet: Fleet) -> dict[str, int]:
    """Return the number of servers that HAProxy takes to be up, by backend."""
    text = httpx.get(fleet.metrics).text
    rows = re.findall(r'^haproxy_server_status{proxy="(\w+)",server="\w+",state="UP"} 1$', text, re.MULTILINE)
    return {backend: rows.count(backend) for backend in ("grpc", "rest")}
